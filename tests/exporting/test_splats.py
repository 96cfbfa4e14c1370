"""Splats: their file, how opaque they are, and what an independent renderer makes of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.reference.splats import draw_splats, read_splats, rotations
from tests.support.solid_fields import ball_field, camera_at, cameras_around
from warpnerf.checks import InputError
from warpnerf.exporting import splats
from warpnerf.exporting.splats import Splats, splats_of, splats_ply
from warpnerf.exporting.visibility import visibility
from warpnerf.fields.nodes import points_of
from warpnerf.rendering.field import Field
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.quaternions import quaternions

FIELDS = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def drawn(made: Splats, camera: Camera, field: Field) -> np.ndarray:
    columns = read_splats(b"".join(splats_ply(made)))
    size, focal = (camera.width, camera.height), (camera.fx, camera.fy)
    return draw_splats(columns, camera.c2w, focal, (camera.cx, camera.cy), size, field.background)


def psnr(image: np.ndarray, other: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.mean((image - other) ** 2)))


@pytest.mark.parametrize(
    ("up", "axis"),
    [
        ((0.0, 0.0, 1.0), b"z"),
        ((0.1, -0.99, 0.0), b"-y"),
        ((0.7, 0.7, 0.0), None),
        (None, None),
    ],
)
def test_the_header_names_the_vertical_axis(
    up: tuple[float, float, float] | None, axis: bytes | None
) -> None:
    header = splats_ply(splats_of(ball_field()), None if up is None else np.array(up))[0]
    lines = [line for line in header.splitlines() if line.startswith(b"comment Vertical Axis: ")]
    assert [line.rpartition(b" ")[2] for line in lines] == ([] if axis is None else [axis])


def test_the_file_has_the_fields_of_3dgs_in_their_order() -> None:
    made = splats_of(ball_field())
    columns = read_splats(b"".join(splats_ply(made)))
    assert tuple(columns) == FIELDS
    np.testing.assert_allclose(1 / (1 + np.exp(-columns["opacity"])), made.opacity, atol=1e-6)
    np.testing.assert_allclose(np.exp(columns["scale_1"]), made.scales[:, 1], rtol=1e-5)
    red = 0.5 + 0.28209479177387814 * columns["f_dc_0"]
    np.testing.assert_allclose(red, made.rgb[:, 0], atol=1e-6)
    np.testing.assert_array_equal(columns["rot_0"], made.rotations[:, 0])


def test_a_ball_of_splats_looks_like_the_field() -> None:
    field = ball_field()
    made = splats_of(field, visibility(field, cameras_around()))
    assert len(made.centres) < 0.5 * len(splats_of(field).centres)  # the inside is left out
    for position in ((2.4, 0.6, 0.9), (-1.0, -2.0, -0.8)):
        camera = camera_at(position, 96, 80)
        image, truth = drawn(made, camera, field), field.render(camera).rgb
        assert psnr(image, truth) > 24.0
        assert psnr(image[::-1], truth) < 20.0 and psnr(image[:, ::-1], truth) < 20.0


@pytest.mark.filterwarnings("error")
def test_the_rim_of_folded_space_is_left_out_silently() -> None:
    """Opaque everywhere: the outermost nodes are infinitely far away."""
    field = ball_field(contraction="linf")
    values = field.storage.values.numpy()
    values[:, 0] = 10.0
    field.storage.values.assign(values)
    made = splats_of(field)
    assert len(made.centres) > 1000 and np.isfinite(made.centres).all()


@pytest.mark.parametrize("sigma", [2.0, 5.0])
def test_matter_of_even_density_is_as_opaque(sigma: float) -> None:
    """Fog all over the box, from outside; the camera sees only what lies before the faces."""
    field = ball_field(radius=10.0)
    grid = field.storage
    values = grid.values.numpy()
    values[:, 0] = np.log(np.expm1(sigma / grid.density_scale))
    grid.values.assign(values)
    camera = replace(camera_at((6.0, 0.5, 0.4), 24, 20), fx=900.0, fy=900.0)
    saved = splats.FAINTEST
    try:
        splats.FAINTEST = 1e-4
        made = splats_of(field)
    finally:
        splats.FAINTEST = saved
    dark = replace(made, rgb=np.zeros_like(made.rgb))
    columns = read_splats(b"".join(splats_ply(dark)))
    passed = draw_splats(
        columns, camera.c2w, (900.0, 900.0), (12.0, 10.0), (24, 20), (1.0, 1.0, 1.0)
    )
    truth = (
        1.0
        - replace(field, steps=replace(field.steps, transmittance_min=0.0)).render(camera).opacity
    )
    depth, expected = -np.log(passed[..., 0]), -np.log(truth)
    np.testing.assert_allclose(depth.mean(), expected.mean(), rtol=0.06)


@pytest.mark.parametrize("opacity", [0.03, 0.019])
def test_the_faintest_cell_that_gets_a_splat_has_two_hundredths(opacity: float) -> None:
    field = ball_field()
    grid = field.storage
    sigma = -np.log1p(-opacity) / field.lattice.voxel_size.max()
    values = grid.values.numpy()
    values[:, 0] = np.log(np.expm1(sigma / grid.density_scale))
    grid.values.assign(values)
    if opacity > 0.02:
        assert len(splats_of(field).centres) == len(values)
    else:
        with pytest.raises(InputError, match="no splat is left"):
            splats_of(field)


def test_opacities_have_the_dilogarithms_that_are_known() -> None:
    golden = 0.5 * (5.0**0.5 - 1.0)
    known = {
        0.0: 1e-4,  # at least, as logits are finite
        np.pi**2 / 12.0 - 0.5 * np.log(2.0) ** 2: 0.5,
        np.pi**2 / 10.0 - np.log(golden) ** 2: golden,
        np.pi**2 / 6.0: splats.DENSEST,  # of 1
    }
    found = splats._opacity(np.array(list(known)))
    np.testing.assert_allclose(found, list(known.values()), rtol=1e-4)


@pytest.mark.parametrize("contraction", ["linf", "l2"])
def test_splats_of_folded_space_are_as_large_as_their_cells(contraction: str) -> None:
    field = ball_field((0.3, 0.0, 0.0), 1.8, contraction)
    made = splats_of(field)
    far = np.abs(made.centres).max(axis=1) > 1.5
    assert far.sum() > 500
    turned = rotations(made.rotations[far].astype(float)) * made.scales[far][:, None, :]
    covariance = turned @ turned.transpose(0, 2, 1)
    step = np.eye(3)
    from warpnerf.fields.nodes import nodes_of

    nodes = nodes_of(field.lattice, made.centres[far].astype(float))
    cells = np.stack(
        [
            points_of(field.lattice, nodes + 0.5 * e) - points_of(field.lattice, nodes - 0.5 * e)
            for e in step
        ],
        axis=2,
    )
    expected = 0.25 * cells @ cells.transpose(0, 2, 1)
    scale = np.abs(expected).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(covariance / scale, expected / scale, atol=2e-3)
    inner = splats_of(field, crop=(field.lattice.box_min, field.lattice.box_max))
    assert len(inner.centres) < len(made.centres)
    assert (np.abs(inner.centres) <= 1.2).all()


def test_quaternions_turn_as_their_matrices_do() -> None:
    rng = np.random.default_rng(0)
    wanted = rng.normal(size=(500, 4))
    wanted[:4] = np.eye(4)  # half turns, and none
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    made = quaternions(rotations(wanted))
    np.testing.assert_allclose(np.abs((made * wanted).sum(axis=1)), 1.0, atol=1e-9)


def test_nothing_to_write_is_said() -> None:
    with pytest.raises(InputError, match="no splat is left"):
        splats_of(ball_field(), crop=((-0.9, -0.9, -0.9), (-0.8, -0.8, -0.8)))
