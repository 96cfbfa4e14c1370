"""PLY, binary and little-endian: vertices with named numbers, and triangles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

KINDS = {"f4": "float", "f8": "double", "u1": "uchar"}
"""PLY's names of numbers, by numpy's."""


def ply(
    columns: dict[str, np.ndarray],
    faces: np.ndarray | None = None,
    comments: Sequence[str] = (),
) -> list[bytes]:
    """The pieces of a PLY file.

    Args:
        columns: A vertex's properties in the order of the file, each [n_vertices] float32, float64
            or uint8.
        faces: [n_faces, 3] of vertices; None: the file has only vertices.
        comments: Lines of the header, besides the one that names the program.

    Returns:
        Header, vertices, and faces where there are any.
    """
    table = np.empty(
        len(next(iter(columns.values()))),
        [(name, f"<{column.dtype.str[1:]}") for name, column in columns.items()],
    )
    lines = ["ply", "format binary_little_endian 1.0", "comment warpnerf"]
    lines += [f"comment {comment}" for comment in comments]
    lines += [f"element vertex {len(table)}"]
    for name, column in columns.items():
        table[name] = column
        lines.append(f"property {KINDS[column.dtype.str[1:]]} {name}")
    pieces = [table.tobytes()]
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        rows = np.empty(len(faces), [("n", "u1"), ("vertices", "<i4", 3)])
        rows["n"], rows["vertices"] = 3, faces
        pieces.append(rows.tobytes())
    header = "\n".join([*lines, "end_header"]) + "\n"
    return [header.encode(), *pieces]


def surface_columns(points: np.ndarray, normals: np.ndarray, rgb: np.ndarray) -> dict:
    """Columns of coloured points with normals, under the names that readers expect.

    Args:
        points: [n, 3] float32, or float64 of georeferenced scenes, scene units.
        normals: [n, 3] unit vectors.
        rgb: [n, 3] in [0, 1].
    """
    colour = np.round(255.0 * rgb).astype(np.uint8)
    named = (
        (("x", "y", "z"), points),
        (("nx", "ny", "nz"), normals.astype(np.float32)),
        (("red", "green", "blue"), colour),
    )
    return {name: values[:, k] for names, values in named for k, name in enumerate(names)}
