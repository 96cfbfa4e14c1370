"""Moments of photographs' colours, and exposures fitted to them: against least squares of numpy."""

from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.support.kernel_runner import Kernels

N_VIEWS, N_RAYS, MOMENTS = 4, 500, 5


@pytest.fixture
def rays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    return {
        "views": rng.integers(-1, N_VIEWS, N_RAYS),
        "rgb": rng.random((N_RAYS, 3)),
        "pixels": rng.random((N_RAYS, 3)),
        "gains": rng.uniform(0.5, 2.0, (N_VIEWS, 3)),
        "offsets": rng.uniform(-0.1, 0.1, (N_VIEWS, 3)),
    }


def moments_of(kernels: Kernels, rays: dict[str, np.ndarray]) -> wp.array:
    """What a launch adds to none: [1, N_VIEWS * 3 * MOMENTS]."""
    vec3, views = kernels.types.vec3, rays["views"]
    target = (rays["pixels"] - rays["offsets"][views]) / rays["gains"][views]
    given = [kernels.array(rgb, vec3) for rgb in (rays["rgb"], target)]
    exposures = [kernels.array(rays[name], vec3) for name in ("gains", "offsets")]
    found = kernels.zeros((1, N_VIEWS * 3 * MOMENTS))
    which = wp.array(views, dtype=wp.int32, device=kernels.device)
    add = kernels.module("optim.exposure").add_moments
    kernels.alone.launch(add, N_RAYS, which, *given, *exposures, found)
    return found


def counted(rays: dict[str, np.ndarray], view: int, channel: int) -> tuple[Any, Any]:
    """Colours of the field and pixels of a channel of a photograph, those that are not cut off."""
    x, y = (rays[name][rays["views"] == view, channel] for name in ("rgb", "pixels"))
    inside = (y > 0.5 / 255.0) & (y < 254.5 / 255.0)
    return x[inside], y[inside]


def test_moments_are_sums_over_the_rays_of_each_photograph(
    kernels64: Kernels, rays: dict[str, np.ndarray]
) -> None:
    rays["pixels"][:40] = 0.0  # black, and white: of these some are cut off
    rays["pixels"][40:80] = 1.0
    rays["pixels"][80:90] = 1.0 / 255.0
    found = moments_of(kernels64, rays).numpy().reshape(N_VIEWS, 3, MOMENTS)
    for view in range(N_VIEWS):
        for channel in range(3):
            x, y = (values - 0.5 for values in counted(rays, view, channel))
            expected = len(x), x.sum(), y.sum(), (x * x).sum(), (x * y).sum()
            np.testing.assert_allclose(found[view, channel], expected, atol=1e-12)


@pytest.mark.parametrize("prior", [0.0, 30.0])
def test_exposures_are_least_squares_with_older_rays_and_the_prior(
    kernels64: Kernels, rays: dict[str, np.ndarray], prior: float
) -> None:
    """The prior's rays have the moments of uniform colours: so have two, at -+1/sqrt(12)."""
    older, keep = dict(rays, rgb=rays["pixels"], pixels=rays["rgb"] ** 2), 0.25
    sums = kernels64.array(moments_of(kernels64, older).numpy().ravel())
    moments, vec3 = moments_of(kernels64, rays), kernels64.types.vec3
    gains, offsets = kernels64.zeros(N_VIEWS, vec3), kernels64.zeros(N_VIEWS, vec3)
    fit = kernels64.module("optim.exposure").fit_exposures
    expected_sums = keep * sums.numpy() + moments.numpy()[0]
    kernels64.workers.launch(fit, N_VIEWS, keep, prior, moments, sums, gains, offsets)
    np.testing.assert_allclose(sums.numpy(), expected_sums, rtol=1e-14, atol=1e-14)
    assert (moments.numpy() == 0.0).all()
    even = 0.5 + np.array([-1.0, 1.0]) / np.sqrt(12.0)
    for view in range(N_VIEWS):
        for channel in range(3):
            pairs = [counted(of, view, channel) for of in (rays, older)]
            weights = [np.full(len(pairs[0][0]), 1.0), np.full(len(pairs[1][0]), keep)]
            x, y = (np.concatenate([*both, even]) for both in zip(*pairs, strict=True))
            root = np.sqrt(np.concatenate([*weights, [0.5 * prior] * 2]))
            columns = np.stack([x, np.ones_like(x)], axis=1) * root[:, None]
            slope, level = np.linalg.lstsq(columns, y * root, rcond=None)[0]
            if 0.125 < slope < 8.0:
                np.testing.assert_allclose(gains.numpy()[view, channel], slope, rtol=1e-7)
                np.testing.assert_allclose(offsets.numpy()[view, channel], level, atol=1e-7)
            else:  # a slope of noise, which no photograph has
                assert gains.numpy()[view, channel] == pytest.approx(0.125)


def test_without_rays_an_exposure_changes_nothing(kernels32: Kernels) -> None:
    vec3, n = kernels32.types.vec3, N_VIEWS * 3 * MOMENTS
    gains, offsets = kernels32.zeros(N_VIEWS, vec3), kernels32.zeros(N_VIEWS, vec3)
    module, launch = kernels32.module("optim.exposure"), kernels32.workers.launch
    none = kernels32.zeros((1, n)), kernels32.zeros(n)
    launch(module.fit_exposures, N_VIEWS, 0.998, 200.0, *none, gains, offsets)
    launch(module.centre_exposures, 3, gains, offsets)
    assert (gains.numpy() == 1.0).all() and (offsets.numpy() == 0.0).all()


def test_centred_they_are_the_same_map_of_a_field_that_has_their_mean(
    kernels64: Kernels, rays: dict[str, np.ndarray]
) -> None:
    vec3 = kernels64.types.vec3
    gains, offsets = (kernels64.array(rays[name], vec3) for name in ("gains", "offsets"))
    kernels64.workers.launch(kernels64.module("optim.exposure").centre_exposures, 3, gains, offsets)
    gain, offset = gains.numpy(), offsets.numpy()
    np.testing.assert_allclose(np.log(gain).mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(offset.mean(axis=0), 0.0, atol=1e-12)
    # A field's colour c looks in all photographs as (c - b) / a did, for one a and b of a channel.
    a = rays["gains"] / gain
    b = (rays["offsets"] - offset) / gain
    np.testing.assert_allclose(a, a[:1].repeat(N_VIEWS, axis=0), rtol=1e-12)
    np.testing.assert_allclose(b, b[:1].repeat(N_VIEWS, axis=0), atol=1e-12)
