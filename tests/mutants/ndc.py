"""Mutants of normalised device coordinates: where a ray runs in them, and where that is in the scene."""

from mutant import Mutant

VALUES = "kernels/test_render.py::test_values_and_visited_samples"
PLAIN = f"{VALUES}[ndc]"
CLIPPED = f"{VALUES}[ndc, clipped]"
EQUAL = "kernels/test_packs.py::test_packs_equal_the_plain_kernels"
LOSSES = "kernels/test_seams.py::test_losses_in_a_frustum_are_those_of_distances_in_the_scene"

MUTANTS = [
    # ndc.py
    Mutant(
        "ndc: seen from the scene's origin",
        "space/ndc.py",
        "p = frustum.axes * (origin - frustum.origin)",
        "p = frustum.axes * origin",
        PLAIN,
    ),
    Mutant(
        "ndc: axes the other way round",
        "space/ndc.py",
        "d = frustum.axes * direction",
        "d = wp.transpose(frustum.axes) * direction",
        PLAIN,
    ),
    Mutant(
        "ndc: near clip forgotten",
        "space/ndc.py",
        "line.t = frustum.begin",
        "line.t = real(0.0)",
        CLIPPED,
    ),
    Mutant(
        "ndc: near plane from the origin's depth on",
        "space/ndc.py",
        "line.t = (frustum.near - p[2]) / line.slope",
        "line.t += (frustum.near - p[2]) / line.slope",
        PLAIN,
    ),
    Mutant("ndc: across without perspective", "space/ndc.py", "d[0] - p[0] * share", "d[0]", PLAIN),
    Mutant(
        "ndc: sign of the perspective",
        "space/ndc.py",
        "d[1] - p[1] * share",
        "d[1] + p[1] * share",
        PLAIN,
    ),
    Mutant(
        "ndc: speed along the depth",
        "space/ndc.py",
        "frustum.depth * frustum.near * share",
        "frustum.depth * share",
        PLAIN,
    ),
    Mutant(
        "ndc: depth of the place",
        "space/ndc.py",
        "(real(1.0) - frustum.near / line.w)",
        "(line.w / frustum.near - real(1.0))",
        PLAIN,
    ),
    Mutant(
        "ndc: place not divided",
        "space/ndc.py",
        "p[0] / line.w, p[1]",
        "p[0] / frustum.near, p[1]",
        PLAIN,
    ),
    Mutant(
        "ndc: t without its pole",
        "space/ndc.py",
        "line.speed - s * line.slope",
        "line.speed",
        PLAIN,
    ),
    Mutant(
        "ndc: t without its beginning",
        "space/ndc.py",
        "return line.t + s * line.w / left",
        "return s * line.w / left",
        PLAIN,
    ),
    Mutant("ndc: t in near planes", "space/ndc.py", "s * line.w / left", "s / left", PLAIN),
    Mutant(
        "ndc: s(t) too short",
        "space/ndc.py",
        "return line.speed * ((t - line.t) / w)",
        "return real(0.5) * line.speed * ((t - line.t) / w)",
        CLIPPED,
    ),
    Mutant(
        "ndc: s(t) of rays that come back",
        "space/ndc.py",
        "    if w <= real(0.0):\n        return real(1.0e30)\n",
        "",
        PLAIN,
    ),
    Mutant(
        "ndc: stretch without perspective",
        "space/ndc.py",
        "return w * w / (line.w * line.speed)",
        "return w / line.speed",
        LOSSES,
    ),
    Mutant(
        "ndc: pole before the far plane",
        "space/ndc.py",
        "LEAST = 0.5 / FARTHEST",
        "LEAST = 100.0 / FARTHEST",
        PLAIN,
    ),
    # traversal.py
    Mutant(
        "ndc: distances in its own units",
        "sampling/traversal.py",
        "sample.t = distance_of(ray, t)",
        "sample.t = t",
        PLAIN,
    ),
    Mutant(
        "ndc: far plane a step late",
        "space/ndc.py",
        "return distance >= box.frustum.end",
        "return distance > real(1.0e9)",
        CLIPPED,
    ),
    Mutant(
        "ndc: direction of any length",
        "space/ndc.py",
        "ray.q_direction = wp.cw_div(along, box.half)",
        "ray.q_direction = wp.cw_div(ray.direction, box.half)",
        PLAIN,
    ),
    Mutant(
        "ndc: lengths of losses in its own units",
        "space/ndc.py",
        "return dt * stretch_at(ray.line, distance)",
        "return dt",
        LOSSES,
    ),
    Mutant(
        "packs, ndc: far plane a step late",
        "space/ndc.py",
        "active &= t < box.frustum.end;\n",
        "",
        f"{EQUAL}[ndc, clipped]",
    ),
    Mutant(
        "packs, ndc: sign of the slope",
        "space/ndc.py",
        "ray.line.speed - t * ray.line.slope",
        "ray.line.speed + t * ray.line.slope",
        f"{EQUAL}[ndc]",
    ),
    Mutant(
        "packs, ndc: t without its beginning",
        "space/ndc.py",
        "t = ray.line.t + t * ray.line.w / left;",
        "t = t * ray.line.w / left;",
        f"{EQUAL}[ndc]",
    ),
    Mutant(
        "packs, ndc: samples beside the box",
        "space/ndc.py",
        "locate=WITHIN",
        'locate=""',
        f"{EQUAL}[ndc]",
    ),
    Mutant(
        "packs, ndc: lengths of losses in its own units",
        "space/ndc.py",
        "length *= w * w / (ray.line.w * ray.line.speed);\n",
        "",
        LOSSES,
    ),
]
