"""What benchmarks compare: candidates that compute the same, and the work that they are given."""

import dataclasses
import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import candidates
import roofline
import throughput
import workload
from candidates.warpnerf_step import WarpStep


@pytest.mark.slow
@pytest.mark.parametrize("model", ["per_sample"])
def test_compiled_torch_agrees(model):
    """Apart from the rest, for it takes long to compile."""
    found, missing = candidates.find("cpu", model)
    load = found.get("torch.compile")
    if load is None:
        assert missing["torch.compile"] == "there is no C++ compiler"
        return
    work = workload.make_workload("random", 8, 16, 12, scene="sphere", model=model)
    differences = throughput.check(
        {("warpnerf", 2): WarpStep(work, 2, "cpu"), ("torch.compile", 1): load(work, 1, "cpu")}
    )
    assert set(differences) == {"warpnerf, 2 threads", "torch.compile, 1 threads"}


@pytest.mark.slow
@pytest.mark.parametrize("model", ["sh", "per_sample", "deferred"])
def test_numba_agrees(model):
    """Likewise."""
    found, missing = candidates.find("cpu", model)
    load = found.get("numba")
    if load is None:
        assert missing["numba"] == "numba is not installed"
        return
    work = workload.make_workload("random", 8, 48, 24, scene="sphere", model=model)
    throughput.check(
        {("warpnerf", 1): WarpStep(work, 1, "cpu")}
        | {("numba", threads): load(work, threads, "cpu") for threads in (1, 2)}
    )


class Wrong:
    """A candidate that forgets to zero its gradient, or has another fault."""

    def __init__(self, work, fault):
        self._right = WarpStep(work, 1, "cpu")
        self._fault = fault
        self._steps = 0

    def step(self):
        self._right.step()
        self._steps += 1

    def gradient(self):
        gradient = self._right.gradient().copy()
        if self._fault == "not zeroed":
            gradient *= self._steps
        if self._fault == "one node":
            gradient[tuple(np.argwhere(gradient)[0])] += 1e-3 * np.abs(gradient).max()
        if self._fault == "not a number":
            gradient[0, 0, 0, 0] = math.nan
        return gradient

    def rgb(self):
        return self._right.rgb() + (1e-3 if self._fault == "rgb" else 0.0)


@pytest.mark.parametrize("fault", ["not zeroed", "one node", "not a number", "rgb"])
def test_who_computes_something_else_is_not_timed(fault):
    work = workload.make_workload("random", 8, 64, 16)
    runs = {("warpnerf", 1): WarpStep(work, 1, "cpu"), ("other", 1): Wrong(work, fault)}
    with pytest.raises(SystemExit, match=r"other on 1 threads differs in (gradient|rgb)"):
        throughput.check(runs)
    throughput.check(runs | {("other", 1): Wrong(work, "none")})


@pytest.mark.parametrize("rays", ["inside", "random", "patches"])
def test_free_cells_change_nothing(rays):
    work = workload.make_workload(rays, 32, 128, 48, scene="sphere")
    assert 0.3 < (work.free > 0).mean() < 0.95
    everywhere = dataclasses.replace(work, free=np.zeros((1, 1, 1), np.uint8))
    assert work.skips and not everywhere.skips
    assert work.positions()[1].sum() < 0.8 * everywhere.positions()[1].sum()
    runs = [WarpStep(w, 2, "cpu") for w in (work, everywhere)]
    for step in runs:
        step.step()
    # Where one lies on a cell's face depends on rounding.
    assert runs[0].n_samples() == pytest.approx(work.positions()[1].sum(), rel=1e-2)
    skipped, full = (step.gradient() for step in runs)
    assert np.abs(full).max() > 1e-4
    assert np.abs(skipped - full).max() < 1e-5 * np.abs(full).max()


def test_patches_are_neighbouring_pixels_of_one_camera():
    work = workload.make_workload("patches", 4, 128, 8)
    for first in (0, 64):
        origins = work.origins[first : first + 64]
        assert (origins == origins[0]).all()
        d = work.directions[first : first + 64].reshape(8, 8, 3).astype(float)
        assert np.allclose(np.linalg.norm(d, axis=2), 1.0, atol=1e-6)
        for step in (np.diff(d, axis=0), np.diff(d, axis=1)):
            assert np.allclose(np.linalg.norm(step, axis=2), workload.PIXEL, rtol=1e-2)
    assert (work.origins[0] != work.origins[64]).any()


@pytest.mark.parametrize("model", ["rgb", "deferred", "sh"])
def test_needs_counts_lines(model):
    """Against sets of lines, sample by sample."""
    work = workload.make_workload("random", 9, 130, 20, scene="sphere", model=model)
    n_bytes = 4 * work.values.shape[3]
    q, needed = work.positions()
    groups = {}
    for ray, step in np.argwhere(needed):
        i, j, k = np.minimum((q[ray, step].astype(float) + 1) * 4, 7).astype(int)
        lines = groups.setdefault(ray // 64, set())
        for corner in np.ndindex(2, 2, 2):
            x, y, z = np.array([i, j, k]) + corner
            begin = ((x * 9 + y) * 9 + z) * n_bytes
            lines.update(byte // 64 for byte in range(begin, begin + n_bytes))
    needs = roofline.needs(work)
    assert needs.n_samples == needed.sum() > 100
    assert needs.lines == len(set().union(*groups.values()))
    assert needs.lines_by_rays == sum(len(lines) for lines in groups.values()) > needs.lines
