"""Break the kernels on purpose, one line at a time, and show that the tests notice each time.

    python tests/mutants.py [--jobs N] [NAME ...]

Each mutant is a copy of kernels/, warpnerf/ and tests/ in a temporary folder with one text
replaced; the working tree stays as it is. A mutant is killed when the tests of its file run and one
of them fails; code that no longer compiles or cannot be collected does not count. Exits with 1 if a
mutant survives, breaks, or no longer finds its text.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
KERNELS = Path("kernels") / "warpnerf_kernels"
COPIED = ("kernels", "warpnerf", "tests")
TIME_LIMIT = 300.0
"""Seconds for the tests of one mutant; one that runs longer never ends, and is noticed as well."""

RENDER = "test_kernel_render.py"
INTERP = "test_kernel_interp.py"
REGULARIZE = "test_kernel_regularize.py"
ADAM = "test_kernel_adam.py"
OCCUPANCY = "test_kernel_occupancy.py"
CAMERA = "test_kernel_camera.py"
GRADSCALE = "test_gradscale.py"


@dataclass(frozen=True)
class Mutant:
    """One text replaced in one file of the kernels."""

    name: str
    file: str
    search: str
    replacement: str
    tests: str
    occurrence: int = 1
    """Which one, of `of` in all."""
    of: int = 1

    def apply(self, folder: Path) -> None:
        """Change the file in a copy of the repository."""
        path = folder / KERNELS / self.file
        parts = path.read_text().split(self.search)
        if len(parts) - 1 != self.of:
            raise ValueError(
                f"{self.name}: {self.file} holds {self.search!r} {len(parts) - 1} times, "
                f"not {self.of}; bring tests/mutants.py up to date."
            )
        before = self.search.join(parts[: self.occurrence])
        after = self.search.join(parts[self.occurrence :])
        path.write_text(before + self.replacement + after)


MUTANTS = [
    # render.py: values
    Mutant("background forgotten", "render.py",
           "total.rgb + total.transmittance * ray_value(background, i)", "total.rgb", RENDER),
    Mutant("background of ray 0", "render.py",
           "behind_all = ray_value(background, i)",
           "behind_all = ray_value(background, 0)", RENDER),
    Mutant("weight after the sample", "render.py",
           "            total.transmittance *= sample.attenuation\n",
           "            total.transmittance *= sample.attenuation * sample.attenuation\n", RENDER),
    Mutant("depth at the step's end", "render.py",
           "total.depth += weight * sample.t",
           "total.depth += weight * (sample.t + sample.dt)", RENDER),
    Mutant("t at the step's start", "render.py",
           "t = t0 + ray.offset * dt", "t = t0", RENDER),
    Mutant("far included", "render.py", "if t >= march.far:", "if t > march.far + dt:", RENDER),
    Mutant("density scale dropped from the value", "render.py",
           "sample.sigma = grid.density_scale * softplus(raw_density)",
           "sample.sigma = softplus(raw_density)", RENDER),
    Mutant("early stop a sample late", "render.py",
           "            if total.transmittance < march.transmittance_min:\n",
           "            if total.transmittance < march.transmittance_min * sample.attenuation:\n",
           RENDER),
    # render.py: adjoint
    Mutant("sign of the suffix", "render.py",
           "(transmittance * adj_weight - behind)",
           "(transmittance * adj_weight + behind)", RENDER),
    Mutant("T_i for T_{i+1}", "render.py",
           "        transmittance *= sample.attenuation\n        adj_weight",
           "        scale_of_next = sample.attenuation\n        adj_weight", RENDER),
    Mutant("T_end term dropped", "render.py",
           "        + adj_transmittance * total.transmittance\n", "", RENDER),
    Mutant("opacity's sign", "render.py",
           "wp.dot(adj_rgb, background) - adj_opacity",
           "wp.dot(adj_rgb, background) + adj_opacity", RENDER),
    Mutant("background term dropped", "render.py",
           "wp.dot(adj_rgb, background) - adj_opacity", "-adj_opacity", RENDER),
    Mutant("depth term dropped", "render.py",
           "wp.dot(adj_rgb, sample.rgb) + adj_depth * sample.t",
           "wp.dot(adj_rgb, sample.rgb)", RENDER),
    Mutant("suffix sheds after use", "render.py",
           "        behind -= weight * adj_weight\n",
           "        behind -= real(0.999) * weight * adj_weight\n",
           RENDER),
    Mutant("dt dropped", "render.py",
           "scale * (sample.dt * (transmittance", "scale * ((transmittance", RENDER),
    Mutant("scale dropped from density", "render.py",
           "adj_sigma = scale * (sample.dt", "adj_sigma = (sample.dt", RENDER),
    Mutant("scale dropped from colour", "render.py",
           "adj_sample_rgb = scale * (weight * adj_rgb)",
           "adj_sample_rgb = weight * adj_rgb", RENDER),
    Mutant("scale from the step's start", "render.py",
           "distance_scale(sample.t, content",
           "distance_scale(sample.t - real(0.5) * sample.dt, content",
           RENDER),
    Mutant("content distance of ray 0", "render.py",
           "ray_value(content_distance, i)", "ray_value(content_distance, 0)", RENDER, 1, 2),
    Mutant("content distance of ray 0, training", "render.py",
           "ray_value(content_distance, i)", "ray_value(content_distance, 0)", RENDER, 2, 2),
    Mutant("last sample not replayed", "render.py",
           "for n in range(total.n_samples):", "for n in range(total.n_samples - 1):", RENDER),
    Mutant("kept sample off by one", "render.py",
           "sample = kept[row + n]", "sample = kept[row + wp.max(n - 1, 0)]", RENDER),
    Mutant("capacity off by one", "render.py",
           "        if n < capacity:", "        if n <= capacity:", RENDER),
    Mutant("density scale dropped from the slope", "render.py",
           "sample.sigma_slope = grid.density_scale * softplus_slope",
           "sample.sigma_slope = softplus_slope", RENDER),
    Mutant("density shift dropped", "render.py",
           "raw[0] + grid.density_shift", "raw[0]", RENDER),
    # interp.py
    Mutant("gather: corners swapped", "interp.py",
           "gz * values[n01] + fz * values[n01 + 1]",
           "gz * values[n10] + fz * values[n10 + 1]", INTERP),
    Mutant("gather: axes swapped", "interp.py",
           "stride_y = size[2]\n    stride_x = size[1] * size[2]",
           "stride_x = size[2]\n    stride_y = size[1] * size[2]", INTERP, 1, 2),
    Mutant("adj_gather: weights swapped", "interp.py",
           "    low = gx * fy * adj_value", "    low = fx * gy * adj_value", INTERP),
    Mutant("adj_gather: corner", "interp.py",
           "worker, n11 + 1, fz * low", "worker, n11, fz * low", INTERP),
    Mutant("adj_gather: another worker's row", "interp.py",
           "wp.atomic_add(adj_values, worker, n00, gz * low)",
           "wp.atomic_add(adj_values, 0, n00, gz * low)", INTERP),
    Mutant("adj_gather: tile not flagged", "interp.py",
           "    touched[tile_of(n11 + 1)] = yes\n", "", INTERP),
    Mutant("far face out of the grid", "interp.py",
           "wp.clamp(int(u[1]), 0, size[1] - 2)", "wp.clamp(int(u[1]), 0, size[1] - 1)", INTERP),
    # activation.py
    Mutant("softplus's slope", "activation.py",
           "wp.where(x >= real(0.0), real(1.0), e)",
           "wp.where(x >= real(0.0), e, real(1.0))", INTERP),
    Mutant("softplus series", "activation.py",
           "- x * (real(1.0) / real(3.0)", "+ x * (real(1.0) / real(3.0)", INTERP),
    Mutant("opacity series", "activation.py",
           "real(1.0) / real(6.0)", "real(1.0) / real(3.0)", INTERP),
    Mutant("sigmoid's slope", "activation.py",
           "y[0] * (one - y[0]) * adj_y[0]", "y[0] * (one + y[0]) * adj_y[0]", INTERP),
    Mutant("sigmoid's slope, blue", "activation.py",
           "y[2] * (one - y[2]) * adj_y[2]", "y[1] * (one - y[2]) * adj_y[2]", RENDER),
    # contraction.py
    Mutant("contraction: border term", "contraction.py",
           "real(1.0) + border - border / n", "real(1.0) + border + border / n", INTERP),
    Mutant("determinant: a power of n", "contraction.py",
           "return border / (n * n) * across * across",
           "return border / n * across * across", INTERP),
    Mutant("norms swapped", "contraction.py",
           "if contraction == L2:", "if contraction == LINF:", INTERP),
    # march.py
    Mutant("growth one step early", "march.py",
           "if k <= march.n_linear or", "if k < march.n_linear - 1 or", RENDER),
    Mutant("a slab's axis", "march.py",
           "slab(ray.q_origin[1], ray.q_direction[1], interval)",
           "slab(ray.q_origin[1], ray.q_direction[2], interval)", RENDER),
    Mutant("first step lost", "march.py",
           "int(wp.min(steps_before(march, interval[0]), most)) - 1",
           "int(wp.min(steps_before(march, interval[0]), most)) + 1", RENDER),
    Mutant("last step lost", "march.py",
           "int(wp.min(steps_before(march, interval[1]), most)) + 2",
           "int(wp.min(steps_before(march, interval[1]), most))", RENDER),
    Mutant("mask off by one cell", "march.py",
           "i = wp.clamp(int(m[0]), 0", "i = wp.clamp(int(m[0]) + 1, 0", OCCUPANCY),
    Mutant("a ring too far", "march.py",
           "rings = real(distance - 1)", "rings = real(distance)", OCCUPANCY),
    Mutant("leap backwards along a ray", "march.py",
           "return (rings + within) / -speed",
           "return (rings + real(1.0) - within) / -speed", OCCUPANCY),
    Mutant("leap under contraction", "march.py",
           "(real(2.0) * wp.length(ray.q_direction) * widest)",
           "(real(0.2) * wp.length(ray.q_direction) * widest)", OCCUPANCY),
    Mutant("leap a sample too far", "march.py",
           "- ray.offset - real(1.0e-3))", "- ray.offset + real(2.0))", OCCUPANCY),
    # gradscale.py
    Mutant("not squared", "gradscale.py", "scale = ratio * ratio", "scale = ratio", GRADSCALE),
    Mutant("clamp from below", "gradscale.py",
           "wp.min(real(1.0), scale)", "wp.max(real(1.0), scale)", GRADSCALE),
    Mutant("Jacobian inverted", "gradscale.py",
           "scale = scale * det_jacobian", "scale = scale / det_jacobian", GRADSCALE),
    Mutant("clamped before the Jacobian", "gradscale.py",
           "    if jacobian == JACOBIAN_DENSITY:\n",
           "    if scaling == CLAMPED:\n        scale = wp.min(real(1.0), scale)\n"
           "    if jacobian == JACOBIAN_DENSITY:\n", GRADSCALE),
    Mutant("product for quotient", "gradscale.py",
           "ratio = t / content_distance", "ratio = t * content_distance", GRADSCALE),
    # loss.py
    Mutant("loss: factor 2", "loss.py",
           "(real(2.0) * adj_error)", "adj_error", RENDER),
    Mutant("loss: sign", "loss.py",
           "(real(2.0) * adj_error) * (rgb - target_rgb)",
           "(real(2.0) * adj_error) * (target_rgb - rgb)", RENDER),
    # regularize.py
    Mutant("variation: axis", "regularize.py",
           "values[flat_index(i, j - 1, k, size)]",
           "values[flat_index(i - 1, j, k, size)]", REGULARIZE),
    Mutant("variation: one side only", "regularize.py",
           "        total += adj_pair_variation(weight, value, values[n - 1])\n",
           "        total += real(0.0) * value\n", REGULARIZE),
    Mutant("variation: huber's slope", "regularize.py",
           "wp.clamp(difference, real(-1.0), real(1.0))", "difference", REGULARIZE),
    Mutant("variation: weights swapped", "regularize.py",
           "adj_huber(d[1], weight[1])", "adj_huber(d[1], weight[0])", REGULARIZE),
    Mutant("variation: first worker only", "regularize.py",
           "for worker in range(adj_values.shape[0]):", "for worker in range(1):", REGULARIZE),
    # adam.py
    Mutant("Adam: betas swapped", "adam.py",
           "m[channel] = beta1 * m[channel]", "m[channel] = beta2 * m[channel]", ADAM),
    Mutant("Adam: bias correction swapped", "adam.py",
           "wp.sqrt(correction2 * v[channel])", "wp.sqrt(correction1 * v[channel])", ADAM),
    Mutant("Adam: epsilon under the root", "adam.py",
           "wp.sqrt(correction2 * v[channel]) + epsilon",
           "wp.sqrt(correction2 * v[channel] + epsilon)",
           ADAM),
    Mutant("Adam: zero gradients move", "adam.py",
           "if g != real(0.0):", "if g != real(1.0e30):", ADAM),
    Mutant("Adam: gradients of one worker", "adam.py",
           "                gradient += row\n", "                gradient = row\n", ADAM),
    Mutant("Adam: gradients not zeroed", "adam.py",
           "                gradients[worker, i] = zero\n", "", ADAM),
    # occupancy.py
    Mutant("occupancy: axis", "occupancy.py",
           "        stride = size[2]\n", "        stride = size[1]\n", OCCUPANCY),
    Mutant("occupancy: sum for the largest", "occupancy.py",
           "wp.max(s, int(distance[n - s * stride]))",
           "s + int(distance[n - s * stride])", OCCUPANCY),
    Mutant("occupancy: margin of a node", "occupancy.py",
           "// n_cells - 1)", "// n_cells)", OCCUPANCY),
    Mutant("occupancy: density scale", "occupancy.py",
           "-step * grid.density_scale * softplus", "-step * softplus", OCCUPANCY),
    # camera.py
    Mutant("camera: pixel corner", "camera.py",
           "view, real(i % view.width) + real(0.5)", "view, real(i % view.width)", CAMERA),
    Mutant("camera: row's sign", "camera.py",
           "vec3(p[0], -p[1], real(-1.0))", "vec3(p[0], p[1], real(-1.0))", CAMERA),
    Mutant("camera: k3 dropped", "camera.py",
           "(view.radial[1] + r2 * view.radial[2])", "view.radial[1]", CAMERA, 1, 2),
    Mutant("camera: tangential swapped", "camera.py",
           "x * radial + two * p1 * x * y + p2 * (r2",
           "x * radial + two * p2 * x * y + p1 * (r2", CAMERA),
    Mutant("camera: alpha twice", "camera.py",
           "alpha * rgb + (real(1.0) - alpha) * behind",
           "alpha * (alpha * rgb) + (real(1.0) - alpha) * behind", CAMERA),
]  # fmt: skip


def copy_to(folder: Path) -> None:
    for name in COPIED:
        shutil.copytree(
            ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", ".*")
        )
    shutil.copy(ROOT / "pyproject.toml", folder)


def run_tests(folder: Path, tests: list[str], cache: Path) -> tuple[int | None, str]:
    """pytest's exit status (None: out of time) and output, in a copy of the repository."""
    environment = os.environ | {
        "PYTHONPATH": f"{folder}{os.pathsep}{folder / 'kernels'}",
        "PYTHONDONTWRITEBYTECODE": "1",
        "WARP_CACHE_PATH": str(cache),
    }
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    command += ["--tb=short", *(f"tests/{name}" for name in tests)]
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=TIME_LIMIT,
        )
    except subprocess.TimeoutExpired:
        return None, ""
    return done.returncode, done.stdout + done.stderr


def check(mutant: Mutant, folder: Path, cache: Path) -> tuple[str, str]:
    """Whether it is "killed", "survived" or "broken", and what says so."""
    folder = folder / str(MUTANTS.index(mutant))
    folder.mkdir()
    copy_to(folder)
    mutant.apply(folder)
    status, output = run_tests(folder, [mutant.tests], cache)
    shutil.rmtree(folder)
    if status is None:
        return "killed", "never ends"
    if status in (-signal.SIGSEGV, -signal.SIGABRT, -signal.SIGBUS):
        return "killed", "crashes"
    if status == 0:
        return "survived", mutant.tests
    failed = [line for line in output.splitlines() if line.startswith("FAILED ")]
    noticed = "AssertionError" in output or "\nE       assert" in output or "\nE   assert" in output
    if status == 1 and failed and noticed:
        return "killed", failed[0].removeprefix("FAILED tests/").split(" - ")[0]
    return "broken", output[-1500:]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="of mutants, in part; none: all of them")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    chosen = [
        m for m in MUTANTS if not options.names or any(name in m.name for name in options.names)
    ]
    counts = {"killed": 0, "survived": 0, "broken": 0}
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutants-") as name:
        folder, cache = Path(name), Path(name) / "cache"
        # Without a mutation the same tests pass, in the copy: else their failing would say nothing.
        whole = folder / "whole"
        whole.mkdir()
        copy_to(whole)
        for mutant in chosen:  # all texts are found before the long work begins
            text = (whole / KERNELS / mutant.file).read_text()
            mutant.apply(whole)
            (whole / KERNELS / mutant.file).write_text(text)
        status, output = run_tests(whole, sorted({m.tests for m in chosen}), cache)
        if status != 0:
            print(output[-3000:])
            print("the tests fail without any mutation")
            return 1
        with ThreadPoolExecutor(options.jobs) as pool:
            results = pool.map(lambda mutant: check(mutant, folder, cache), chosen)
            for mutant, (verdict, reason) in zip(chosen, results, strict=True):
                counts[verdict] += 1
                print(f"{verdict:9}{mutant.file:16}{mutant.name:40}{reason}", flush=True)
    summary = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
    print(f"{len(chosen)} mutants: {summary}; {time.monotonic() - started:.0f} s")
    return 0 if counts["killed"] == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
