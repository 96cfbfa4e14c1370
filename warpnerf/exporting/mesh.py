"""Export of a triangle mesh: glTF in one file (.glb), PLY and OBJ, with colours at vertices."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from warpnerf.exporting.atlas import Textured
from warpnerf.exporting.ply import ply, surface_columns
from warpnerf.exporting.surface import Surface
from warpnerf.media.pictures import png

ARRAY, INDICES = 34962, 34963
UINT32, FLOAT32 = 5125, 5126
LINEAR, CLAMP = 9729, 33071
"""glTF's numbers for kinds of buffers, of values, and of a texture's filter and borders."""


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
    surface: Surface | Textured,
    up: np.ndarray | None = None,
    offset: np.ndarray | None = None,
) -> list[bytes]:
    """A mesh as binary glTF 2.0, with vertex colours, or with a texture.

    Vertices are in scene coordinates. As y points up in glTF, the mesh hangs on a node that turns
    the scene's up to y. The material is not lit again: the photographs' light is in it. Vertex
    colours are in linear light, as glTF wants them. It multiplies a texture by them, so that
    beside a texture they have a name of their own, _COLOR_0, which only programs that look for it
    read.

    Format: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, and KHR_materials_unlit.

    Args:
        surface: The mesh.
        up: [3] unit vector; None: y.
        offset: [3] what is missing to the coordinates of the scene's file, scene units, which go to
            the asset's extras: vertices are in single precision. None: nothing.
    """
    image = surface.texture if isinstance(surface, Textured) else None
    uv = surface.uv if isinstance(surface, Textured) else None
    surface = surface.surface if isinstance(surface, Textured) else surface
    named = {
        "POSITION": surface.points,
        "NORMAL": surface.normals,
        "COLOR_0" if uv is None else "_COLOR_0": linear_light(surface.rgb),
        **({} if uv is None else {"TEXCOORD_0": uv}),
    }
    pieces = [np.ascontiguousarray(array, "<f4").tobytes() for array in named.values()]
    accessors = [
        {
            "bufferView": index,
            "componentType": FLOAT32,
            "count": len(array),
            "type": f"VEC{array.shape[1]}",
        }
        for index, array in enumerate(named.values())
    ]
    low, high = surface.points.min(axis=0), surface.points.max(axis=0)
    accessors[0] |= {"min": low.tolist(), "max": high.tolist()}  # required of positions
    accessors.append(
        {
            "bufferView": len(pieces),
            "componentType": UINT32,
            "count": 3 * len(surface.faces),
            "type": "SCALAR",
        }
    )
    targets: list[int | None] = [*([ARRAY] * len(pieces)), INDICES]
    pieces.append(surface.faces.astype("<u4").tobytes())
    pbr: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    extra: dict[str, Any] = {}
    if image is not None:
        pbr["baseColorTexture"] = {"index": 0}
        extra = {
            "textures": [{"source": 0, "sampler": 0}],
            "samplers": [
                {"magFilter": LINEAR, "minFilter": LINEAR, "wrapS": CLAMP, "wrapT": CLAMP}
            ],
            "images": [{"bufferView": len(pieces), "mimeType": "image/png"}],
        }
        pieces.append(png(image))
        targets.append(None)
    views, begin = [], 0
    for piece, target in zip(pieces, targets, strict=True):
        view = {"buffer": 0, "byteOffset": begin, "byteLength": len(piece)}
        views.append(view if target is None else view | {"target": target})
        begin += len(piece) + -len(piece) % 4
    material = {
        "pbrMetallicRoughness": pbr,
        "doubleSided": True,
        "extensions": {"KHR_materials_unlit": {}},
    }
    extras = {} if offset is None else {"extras": {"offset": offset.tolist()}}
    attributes = {name: index for index, name in enumerate(named)}
    primitive = {"attributes": attributes, "indices": len(named), "material": 0}
    tree = {
        "asset": {"version": "2.0", "generator": "warpnerf"} | extras,
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": _to_y(up)}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": begin}],
        **extra,
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + begin)
    return [
        header + struct.pack("<I4s", len(text), b"JSON") + text,
        struct.pack("<I4s", begin, b"BIN\0"),
        *(piece + bytes(-len(piece) % 4) for piece in pieces),
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
