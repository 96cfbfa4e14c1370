"""PSNR by hand, SSIM against scikit-image, FLIP by its definition's ends."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flip_evaluator import evaluate
from skimage.metrics import structural_similarity

from warpnerf.checks import InputError
from warpnerf.evaluation import metrics
from warpnerf.evaluation.metrics import colour_corrected, flip, has_flip, psnr, ssim
from warpnerf.runtime.memory import usable_cores


def images(seed: int, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = rng.random((height, width, 3))
    return np.clip(truth + rng.normal(0.0, 0.1 * (seed + 1), truth.shape), 0.0, 1.0), truth


def test_psnr_of_a_known_error() -> None:
    truth = np.full((4, 5, 3), 0.5)
    assert psnr(truth + 0.1, truth) == pytest.approx(20.0, abs=1e-9)


def test_corrected_colours_are_those_of_another_exposure() -> None:
    rng = np.random.default_rng(0)
    rgb, mask = rng.random((12, 15, 3)), rng.random((12, 15)) < 0.6
    truth = rgb * [0.5, 0.7, 0.3] + [0.1, 0.2, 0.0]
    np.testing.assert_allclose(colour_corrected(rgb, truth), truth, atol=1e-12)
    outside = np.where(mask[..., None], truth, rng.random(rgb.shape))
    np.testing.assert_allclose(colour_corrected(rgb, outside, mask)[mask], truth[mask], atol=1e-12)
    assert np.abs(colour_corrected(rgb, outside) - truth)[mask].max() > 0.05
    bright = colour_corrected(rgb, np.clip(3.0 * rgb, 0.0, 1.0))
    assert bright.max() == 1.0 and bright.min() >= 0.0
    grey = np.full_like(rgb, 0.3)  # which tells no gain
    np.testing.assert_allclose(
        colour_corrected(grey, truth), np.broadcast_to(truth.mean(axis=(0, 1)), rgb.shape)
    )


@pytest.mark.parametrize(("height", "width"), [(11, 11), (13, 40), (48, 31)])
@pytest.mark.parametrize("seed", range(3))
def test_ssim_is_that_of_scikit_image(seed: int, height: int, width: int) -> None:
    rgb, truth = images(seed, height, width)
    expected = structural_similarity(
        rgb,
        truth,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
    )
    assert expected < 0.99
    assert ssim(rgb, truth) == pytest.approx(expected, abs=1e-6)
    assert ssim(rgb.astype(np.float32), truth) == pytest.approx(expected, abs=1e-6)


def test_equal_images_are_alike() -> None:
    rgb, _ = images(0, 16, 16)
    assert ssim(rgb, rgb) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("metric", [psnr, ssim, flip])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("which", [0, 1])
def test_not_finite_is_refused(metric, bad: float, which: int) -> None:
    pair = [np.zeros((12, 12, 3)), np.zeros((12, 12, 3))]
    pair[which][3, 4, 1] = bad
    with pytest.raises(InputError, match="finite"):
        metric(*pair)


@pytest.mark.parametrize("metric", [psnr, ssim, flip])
def test_differing_shapes_are_refused(metric) -> None:
    with pytest.raises(InputError, match=r"12, 12, 3.*12, 13, 3"):
        metric(np.zeros((12, 12, 3)), np.zeros((12, 13, 3)))


def test_ssim_refuses_what_is_smaller_than_its_window() -> None:
    with pytest.raises(InputError, match="11 x 11"):
        ssim(np.zeros((10, 30, 3)), np.zeros((10, 30, 3)))


def test_flip_is_that_of_its_package() -> None:
    """Equal images, a known pair, and which image is the reference."""
    rgb, truth = images(0, 24, 32)
    assert has_flip()
    assert flip(truth, truth) == pytest.approx(0.0, abs=1e-6)
    black, white = np.zeros((24, 32, 3)), np.ones((24, 32, 3))
    # A difference of lightness by 100 is among the largest there are.
    assert 0.95 < flip(white, black) <= 1.0
    expected = evaluate(truth.astype(np.float32), rgb.astype(np.float32), "LDR")[1]
    assert 0.05 < expected < 0.9
    assert flip(rgb, truth) == pytest.approx(expected, abs=1e-7)


def test_flip_without_its_package_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(
        InputError, match=r'FLIP needs flip_evaluator: pip install "warpnerf\[metrics\]"'
    ):
        flip(np.zeros((12, 12, 3)), np.zeros((12, 12, 3)))


def masked_images(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rgb, truth = images(seed, 30, 40)
    mask = np.random.default_rng(seed).random((30, 40)) < 0.5
    mask[:, 20:30] = False
    return rgb, truth, mask


def test_what_a_mask_hides_does_not_count() -> None:
    rgb, truth, mask = masked_images(1)
    other = np.where(mask[..., None], rgb, 1.0 - rgb)
    for measure in (psnr, ssim, flip):
        assert measure(other, truth, mask) == measure(rgb, truth, mask)
        assert measure(rgb, truth, mask) != measure(rgb, truth)
    assert psnr(rgb, truth, mask) == pytest.approx(
        -10 * np.log10(((rgb - truth)[mask] ** 2).mean())
    )


def test_flip_is_a_mean_over_the_pixels_that_count() -> None:
    dark, bright = np.full((40, 60, 3), 0.3), np.full((40, 60, 3), 0.6)
    left = np.zeros((40, 60), bool)
    left[:, :30] = True
    whole = flip(dark, bright)
    assert whole > 0.2
    assert flip(dark, bright, left) == pytest.approx(whole, rel=0.1)  # not half of it


def test_ssim_with_a_mask_by_hand() -> None:
    rgb, truth, mask = masked_images(2)
    offsets = np.arange(-5, 6)
    gaussian = np.exp(-0.5 * (offsets[:, None] ** 2 + offsets**2) / 1.5**2)
    values = []
    for row, column in np.argwhere(mask):
        if not (5 <= row < 25 and 5 <= column < 35):
            continue
        window = slice(row - 5, row + 6), slice(column - 5, column + 6)
        weights = (gaussian * mask[window])[..., None]
        weights = weights / weights.sum()
        a, b = rgb[window], truth[window]
        mean_a, mean_b = (weights * a).sum((0, 1)), (weights * b).sum((0, 1))
        var_a, var_b = (
            (weights * (a - mean_a) ** 2).sum((0, 1)),
            (weights * (b - mean_b) ** 2).sum((0, 1)),
        )
        both = (weights * (a - mean_a) * (b - mean_b)).sum((0, 1))
        c1, c2 = 1e-4, 9e-4
        values.append(
            (2 * mean_a * mean_b + c1)
            * (2 * both + c2)
            / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))
        )
    assert ssim(rgb, truth, mask) == pytest.approx(np.mean(values), abs=1e-9)


def test_a_mask_of_all_pixels_is_none() -> None:
    rgb, truth, mask = masked_images(0)
    everything = mask | True
    assert psnr(rgb, truth, everything) == pytest.approx(psnr(rgb, truth))
    assert ssim(rgb, truth, everything) == pytest.approx(ssim(rgb, truth), abs=1e-12)
    assert flip(rgb, truth, everything) == pytest.approx(flip(rgb, truth), abs=1e-6)


def test_where_a_mask_leaves_no_window_there_is_no_ssim() -> None:
    rgb, truth, mask = masked_images(0)
    mask[5:25, 5:35] = False
    assert mask.any() and ssim(rgb, truth, mask) is None


def test_threads_of_flip_do_not_spin_and_the_environment_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "flip_evaluator.py").write_text("import os\nevaluate = dict(os.environ)\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "flip_evaluator")
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    before = dict(os.environ)
    loaded: Any = metrics._flip_evaluator.__wrapped__()
    assert loaded["OMP_WAIT_POLICY"] == "passive" and loaded["OMP_NUM_THREADS"] == "3"
    assert dict(os.environ) == before
    monkeypatch.delitem(sys.modules, "flip_evaluator")
    monkeypatch.delenv("OMP_NUM_THREADS")
    loaded = metrics._flip_evaluator.__wrapped__()
    assert loaded["OMP_NUM_THREADS"] == str(usable_cores())
    assert "OMP_NUM_THREADS" not in os.environ
