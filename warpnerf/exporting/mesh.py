"""Export of a triangle mesh: glTF in one file (.glb), PLY and OBJ, with colours at vertices."""

from __future__ import annotations

import json
import struct

import numpy as np

from warpnerf.exporting.ply import ply, surface_columns
from warpnerf.exporting.surface import Surface

ARRAY, INDICES = 34962, 34963
UINT32, FLOAT32 = 5125, 5126
"""glTF's numbers for kinds of buffers and of values."""


def mesh_ply(surface: Surface) -> list[bytes]:
    """A mesh as PLY, in scene coordinates."""
    columns = surface_columns(surface.points, surface.normals, surface.rgb)
    return ply(columns, surface.faces)


def points_ply(surface: Surface) -> list[bytes]:
    """A surface's vertices alone, as PLY: about one for each voxel that it passes through."""
    return ply(surface_columns(surface.points, surface.normals, surface.rgb))


def mesh_obj(surface: Surface) -> list[bytes]:
    """A mesh as OBJ in scene coordinates, with colours behind the coordinates of a vertex."""
    vertices = np.concatenate([surface.points, surface.rgb], axis=1)
    corners = np.repeat(surface.faces + 1, 2, axis=1)
    number = "%.7g" if surface.points.dtype == np.float32 else "%.12g"
    parts = (
        (f"v {number} {number} {number} %.4f %.4f %.4f\n", vertices),
        ("vn %.4f %.4f %.4f\n", surface.normals),
        ("f %d//%d %d//%d %d//%d\n", corners),
    )
    texts = [b"# warpnerf\n"]
    for line, rows in parts:
        texts.append((line * len(rows) % tuple(rows.ravel().tolist())).encode())
    return texts


def mesh_glb(
    surface: Surface, up: np.ndarray | None = None, offset: np.ndarray | None = None
) -> list[bytes]:
    """A mesh as binary glTF 2.0.

    Vertices are in scene coordinates. As y points up in glTF, the mesh hangs on a node that turns
    the scene's up to y. Colours are in linear light, as glTF wants them, and the material is not
    lit again: the photographs' light is in them.

    Format: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, and KHR_materials_unlit.

    Args:
        surface: The mesh.
        up: [3] unit vector; None: y.
        offset: [3] what is missing to the coordinates of the scene's file, scene units, which go to
            the asset's extras: vertices are in single precision. None: nothing.
    """
    arrays = (
        (surface.points.astype("<f4"), FLOAT32, "VEC3", ARRAY),
        (surface.normals.astype("<f4"), FLOAT32, "VEC3", ARRAY),
        (linear_light(surface.rgb).astype("<f4"), FLOAT32, "VEC3", ARRAY),
        (surface.faces.astype("<u4").reshape(-1), UINT32, "SCALAR", INDICES),
    )
    accessors, views, begin = [], [], 0
    for index, (array, kind, shape, target) in enumerate(arrays):
        accessor = {
            "bufferView": index,
            "componentType": kind,
            "count": len(array),
            "type": shape,
        }
        if index == 0:  # required of positions
            accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        accessors.append(accessor)
        size = array.nbytes
        views.append({"buffer": 0, "byteOffset": begin, "byteLength": size, "target": target})
        begin += size  # all sizes are multiples of 4
    material = {
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
        "doubleSided": True,
        "extensions": {"KHR_materials_unlit": {}},
    }
    extras = {} if offset is None else {"extras": {"offset": offset.tolist()}}
    attributes = {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}
    tree = {
        "asset": {"version": "2.0", "generator": "warpnerf"} | extras,
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": _to_y(up)}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 3, "material": 0}]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": begin}],
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + begin)
    return [
        header + struct.pack("<I4s", len(text), b"JSON") + text,
        struct.pack("<I4s", begin, b"BIN\0"),
        *(array.tobytes() for array, *_ in arrays),
    ]


def linear_light(rgb: np.ndarray) -> np.ndarray:
    """sRGB in [0, 1] as linear light, by IEC 61966-2-1."""
    rgb = np.asarray(rgb, np.float64)
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


def _to_y(up: np.ndarray | None) -> list[float]:
    """The shortest rotation from up to y, a quaternion x, y, z, w."""
    x, y, z = (0.0, 1.0, 0.0) if up is None else np.asarray(up, np.float64)
    if y < -1.0 + 1e-9:
        return [1.0, 0.0, 0.0, 0.0]
    quaternion = np.array([-z, 0.0, x, 1.0 + y])  # up x y, and 1 + up . y
    return [float(part) for part in quaternion / np.linalg.norm(quaternion)]
