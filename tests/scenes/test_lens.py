"""Lenses from files, and the limits of the distortion."""

from __future__ import annotations

from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from PIL import Image

from tests.support.tiny_scenes import camera_at, picture, save, write_transforms
from warpnerf.checks import InputError
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.fisheye import angle_of, largest_angle
from warpnerf.scenes.cameras.lens import LensFields, read_lens
from warpnerf.scenes.cameras.undistort import directions, has_invertible_distortion, seen_pixels
from warpnerf.scenes.formats.load import load_scene

FILE = Path("scene/transforms.json")
POSE = np.eye(3, 4)


def camera(frame: LensFields, whole: LensFields | None = None) -> Camera:
    """Camera of an image of 8x6 pixels."""
    lens = read_lens(FILE, [("$.frames[0]", frame), ("$", whole or LensFields())])
    return lens.camera(width=8, height=6, c2w=POSE, image="a.png")


def test_everything_is_taken_from_the_file() -> None:
    keys = {"k1": 0.01, "k2": -0.02, "k3": 0.03, "p1": 0.004, "p2": -0.005}
    result = camera(LensFields(fl_x=10.0, fl_y=11.0, cx=4.5, cy=2.5, w=8.0, h=6.0, **keys))
    assert (result.fx, result.fy, result.cx, result.cy) == (10.0, 11.0, 4.5, 2.5)
    assert {key: getattr(result, key) for key in keys} == keys


def test_what_is_missing_follows_from_the_image() -> None:
    result = camera(LensFields(camera_angle_x=np.pi / 2))
    assert (result.fx, result.fy) == pytest.approx((4.0, 4.0))
    assert (result.cx, result.cy, result.k1) == (4.0, 3.0, 0.0)
    result = camera(LensFields(camera_angle_x=np.pi / 2, camera_angle_y=np.pi / 2))
    assert (result.fx, result.fy) == pytest.approx((4.0, 3.0))
    assert camera(LensFields(fl_y=9.0)).fx == 9.0


def test_focal_length_wins_over_angle_and_frame_over_file() -> None:
    assert camera(LensFields(fl_x=10.0, camera_angle_x=1.0)).fx == 10.0
    result = camera(LensFields(camera_angle_x=np.pi / 2), LensFields(fl_x=10.0, cx=5.0))
    assert (result.fx, result.cx) == (pytest.approx(4.0), 5.0)


def test_a_focal_length_and_an_angle_that_contradict_each_other_are_told() -> None:
    def told(frame: LensFields, whole: LensFields) -> str:
        lens = read_lens(FILE, [("$.frames[0]", frame), ("$", whole)])
        return lens.contradiction(8, 6)

    none = LensFields()
    right = {"camera_angle_x": np.pi / 2, "camera_angle_y": 2.0 * np.arctan(0.75)}
    assert told(none, LensFields(fl_x=4.03, fl_y=3.97, **right)) == ""
    assert told(none, LensFields(fl_x=8.0, **right)) == (
        "$.fl_x is 8 pixels, which is used, but by $.camera_angle_x, 90 degrees of 8 pixels, it "
        "is 4; remove the wrong one"
    )
    assert "$.fl_y is 3 pixels" in told(none, LensFields(fl_x=4.0, fl_y=3.0, **right))
    # Some exports for Blender have the field of view of the sensor's height beside the right one.
    assert (
        told(none, LensFields(fl_x=4.0, fl_y=4.0, camera_angle_x=np.pi / 2, camera_angle_y=1.0))
        == ""
    )
    assert "$.camera_angle_y" in told(none, LensFields(fl_x=4.0, fl_y=4.0, camera_angle_y=1.0))
    # Blender's angle_x is that of the longer side.
    lens = read_lens(FILE, [("$", LensFields(fl_x=4.0, fl_y=4.0, camera_angle_x=np.pi / 2))])
    assert lens.contradiction(6, 8) == "" and "$.camera_angle_x" in lens.contradiction(6, 10)
    # What a frame says is what holds of it, whatever the file says of others.
    assert told(LensFields(fl_x=8.0), LensFields(**right)) == ""
    assert told(LensFields(camera_angle_x=1.0), LensFields(fl_x=4.0)) == ""
    assert told(none, LensFields(fl_x=8.0, fl_y=8.0, is_fisheye=True, **right)) == ""


@pytest.mark.parametrize(("model", "flag"), [("PINHOLE", True), ("OPENCV_FISHEYE", False)])
def test_of_two_kinds_of_lenses_the_model_is_used(model: str, flag: bool) -> None:
    lens = read_lens(FILE, [("$", LensFields(camera_model=model, is_fisheye=flag, fl_x=9.0))])
    assert lens.fisheye == (not flag)
    assert lens.contradiction(8, 6) == (
        f"$.camera_model is {model}, which is used, but $.is_fisheye is {str(flag).lower()}; "
        "correct the wrong one"
    )


RESIZED = LensFields(fl_x=20.0, fl_y=22.0, cx=8.5, cy=5.5, w=16.0, h=12.0, k1=0.01)


@pytest.mark.parametrize(
    ("lens", "scale"),
    [
        (RESIZED, 0.5),
        (msgspec.structs.replace(RESIZED, h=11.0), 0.5),  # rounded up
        (LensFields(fl_x=5.0, fl_y=5.5, cx=2.125, cy=1.375, w=4.0, h=3.0), 2.0),
    ],
)
def test_a_lens_is_scaled_to_resized_photographs(lens: LensFields, scale: float) -> None:
    result = camera(lens)
    along = 6.0 / lens.h if lens.h else 0.0
    assert (result.fx, result.cx) == (scale * (lens.fl_x or 0.0), scale * (lens.cx or 0.0))
    assert (result.fy, result.cy) == pytest.approx(
        (along * (lens.fl_y or 0.0), along * (lens.cy or 0.0))
    )
    assert result.k1 == (lens.k1 or 0.0)
    stated = read_lens(FILE, [("$", lens)]).was_for(8, 6)
    assert stated == (lens.w, lens.h)


@pytest.mark.parametrize(
    ("width", "height", "changes"),
    [
        (160, 120, {}),
        (140, 120, {}),  # cut off at one side
        (159, 120, {}),
        (120, 160, {}),
        (80, 62, {}),
        (80, 60, {"cx": 41.0, "cy": 29.0}),  # of the small ones already
        (80, 60, {"cy": None}),
        (80, 60, {"w": None}),
        (80, 60, {"w": 0.0, "h": 0.0}),
    ],
)
def test_other_photographs_are_no_resized_ones(
    width: int, height: int, changes: dict[str, float | None]
) -> None:
    fields = LensFields(fl_x=200.0, cx=82.0, cy=58.0, w=160.0, h=120.0)
    lens = read_lens(FILE, [("$", msgspec.structs.replace(fields, **changes))])
    assert lens.was_for(80, 60) == (None if changes else (160.0, 120.0))
    assert lens.was_for(width, height) is None


@pytest.mark.parametrize(
    ("width", "height", "is_resized"),
    [(270, 480, False), (268, 477, False), (273, 486, False), (266, 473, True), (276, 491, True)],
)
def test_photographs_of_nearly_the_stated_size_are_not_resized_ones(
    width: int, height: int, is_resized: bool
) -> None:
    middle = 135.75 if width < 271 else 135.25
    fields = LensFields(fl_x=342.0, cx=middle, cy=middle + 105.5, w=271.0, h=482.0)
    stated = read_lens(FILE, [("$", fields)]).was_for(width, height)
    assert stated == ((271.0, 482.0) if is_resized else None)


@pytest.mark.parametrize(
    "model", ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"]
)
def test_known_models_are_accepted(model: str) -> None:
    assert camera(LensFields(camera_model=model, fl_x=10.0, is_fisheye=False, k4=0.0)).fx == 10.0


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (LensFields(), r"\$\.frames\[0\]: has no focal length"),
        (LensFields(fl_x=0.0), r"\$\.frames\[0\]\.fl_x: 0 is no focal length"),
        (LensFields(fl_x=-1.0), r"\.fl_x: -1 is no focal length"),
        (LensFields(fl_x=np.nan), r"\.fl_x: nan is no focal length"),
        (LensFields(fl_x=10.0, fl_y=np.inf), r"\.fl_y: inf is no focal length"),
        (LensFields(camera_angle_x=0.0), r"\.camera_angle_x: 0 is not a field of view"),
        (LensFields(camera_angle_x=np.pi), r"\.camera_angle_x: 3.14159 is not a field of view"),
        (LensFields(camera_angle_x=40.0), r"\.camera_angle_x: 40 is not a field of view"),
        (LensFields(camera_angle_x=np.nan), r"\.camera_angle_x: nan is not a field of view"),
        (LensFields(camera_angle_x=5e-324), r"\.camera_angle_x: 4.94066e-324 is not a field of"),
        (LensFields(camera_angle_x=1e-50), r"\.camera_angle_x: means a focal length of"),
        (LensFields(fl_x=0.1), r"\.fl_x: means a focal length of 0.1 pixels.*8x6; give pixels"),
        (LensFields(fl_x=10.0, cx=np.nan), r"\.cx: nan is not a finite number"),
        (LensFields(fl_x=10.0, cy=1e5), r"\.cy: means a principal point at 100000 pixels"),
        (LensFields(fl_x=10.0, k2=np.inf), r"\.k2: inf is not a finite number"),
        (
            LensFields(fl_x=10.0, k4=0.1),
            r"\.k4: is read as OpenCV's .* camera_model is \"FULL_OPENCV",
        ),
        (LensFields(fl_x=10.0, camera_model="OPENCV", k6=0.1), r"\.k6: is read as OpenCV's"),
        (LensFields(fl_x=4.0, camera_model="FULL_OPENCV", k4=9.0), r"\.k4 = 9 folds over within"),
        (LensFields(fl_x=10.0, camera_model="FISHEYE624"), r"\.camera_model: 'FISHEYE624' is none"),
        (
            LensFields(fl_x=10.0, is_fisheye=True, p1=0.1),
            r"\.p1: a fisheye lens has none; calibrate",
        ),
        (LensFields(fl_x=10.0, is_fisheye=True, k5=0.1), r"\.k5: a fisheye lens has none"),
        (
            LensFields(camera_angle_x=1.0, is_fisheye=True),
            r"\.camera_angle_x: does not give a fisheye lens's focal length; add fl_x",
        ),
        (LensFields(fl_x=4.0, is_fisheye=True, k1=-4.0), r"\.k1 = -4 folds over within the image"),
        (LensFields(fl_x=10.0, w=16.0, h=12.0), r"\.w: .* 16x12 pixels, but a\.png has 8x6"),
        (LensFields(fl_x=10.0, w=8.0, h=12.0), r"\.h: .* 8x12 pixels, but a\.png has 8x6"),
        (
            LensFields(fl_x=10.0, w=6.0, h=8.0),
            r"\.w: .* 6x8 pixels, but a\.png has 8x6: either it is stored turned, .* exchanged",
        ),
        (LensFields(fl_x=4.0, k1=-0.5), r"\.k1 = -0\.5 folds over within the image a\.png"),
    ],
)
def test_bad_lens_is_refused_by_name(frame: LensFields, message: str) -> None:
    with pytest.raises(InputError, match=rf"transforms\.json: .*{message}"):
        camera(frame)


def test_message_names_the_level_that_is_wrong() -> None:
    with pytest.raises(InputError, match=r"transforms\.json: \$\.fl_x: -1"):
        camera(LensFields(cx=4.0), LensFields(fl_x=-1.0))


@pytest.mark.parametrize(
    ("frame", "whole"),
    [
        (LensFields(camera_model="OPENCV_FISHEYE"), LensFields(camera_model="OPENCV")),
        (LensFields(), LensFields(camera_model="OPENCV_FISHEYE")),
        (LensFields(is_fisheye=True), LensFields()),
        (LensFields(k1=0.02), LensFields(is_fisheye=True)),
    ],
)
def test_fisheye_lenses_are_recognised(frame: LensFields, whole: LensFields) -> None:
    result = camera(frame, msgspec.structs.replace(whole, fl_x=10.0, k1=0.02, k4=0.01))
    assert result.fisheye and result.radial == (0.02, 0.0, 0.0, 0.01)
    assert not camera(LensFields(is_fisheye=False, fl_x=1.0), LensFields(is_fisheye=True)).fisheye


@pytest.mark.parametrize(
    ("frame", "whole"),
    [
        (LensFields(camera_model="FULL_OPENCV"), LensFields(camera_model="OPENCV")),
        (LensFields(), LensFields(camera_model="FULL_OPENCV")),
    ],
)
def test_rational_lenses_are_recognised(frame: LensFields, whole: LensFields) -> None:
    keys = {"k1": 0.3, "k4": 0.2, "k5": 0.01, "k6": -0.02}
    result = camera(frame, msgspec.structs.replace(whole, fl_x=10.0, **keys))
    assert result.rational and {key: getattr(result, key) for key in keys} == keys
    assert not camera(LensFields(camera_model="FULL_OPENCV", fl_x=10.0, k1=0.1)).rational


def test_cameras_take_coefficients_of_their_lens_only() -> None:
    for name in ("p2", "k5", "k6"):
        with pytest.raises(InputError, match=rf"Camera\.{name} must be 0 for a fisheye lens"):
            camera_at(np.eye(4), fisheye=True, **{name: 0.1})


def fisheye(focal: float, *k: float, size: int = 100) -> Camera:
    names = ("k1", "k2", "k3", "k4")
    lens = dict(zip(names, k, strict=False))
    half = size / 2
    square = {"width": size, "height": size, "cx": half, "cy": half}
    return camera_at(np.eye(4), **square, fx=focal, fy=focal, fisheye=True, **lens)


def test_fisheye_distortion_agrees_with_opencv() -> None:
    lens = fisheye(30.0, 0.08, -0.03, 0.01, -0.001)
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (20, 2))
    points[0] = 1e-9
    expected = cv2.fisheye.distortPoints(points[None], np.eye(3), np.array(lens.radial))[0]
    distorted, jacobian = lens.distort(points)
    np.testing.assert_allclose(distorted, expected, rtol=0, atol=1e-12)
    step = 1e-6
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        slope = (lens.distort(points + shift)[0] - lens.distort(points - shift)[0]) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, axis], slope, rtol=0, atol=1e-7)


@pytest.mark.parametrize("kind", ["pinhole", "distorted", "rational", "fisheye", "wide"])
def test_directions_are_where_pixels_look(kind: str) -> None:
    lens = {
        "pinhole": camera_at(np.eye(4), fy=11.0),
        "distorted": random_lens(1),
        "rational": random_lens(1, rational=True),
        "fisheye": fisheye(60.0, 0.08, -0.03, 0.01, -0.001),
        "wide": fisheye(25.0),
    }[kind]
    rng = np.random.default_rng(2)
    pixels = rng.uniform(0.0, 1.0, (50, 2)) * [lens.width, lens.height]
    found = directions(lens, pixels)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0)
    if kind == "wide":  # theta = r / f, behind the camera at the corners
        away = np.linalg.norm(pixels - 50.0, axis=1) / 25.0
        np.testing.assert_allclose(np.arccos(-found[:, 2]), away, atol=1e-12)
        assert away.max() > np.pi / 2
        found, pixels = found[away < 1.5], pixels[away < 1.5]
    points = found[:, :2] * [1.0, -1.0] / -found[:, 2:]
    back = lens.distort(points)[0] * [lens.fx, lens.fy] + [lens.cx, lens.cy]
    np.testing.assert_allclose(back, pixels, rtol=0, atol=1e-7)


def test_a_fisheye_sees_as_far_aside_as_its_polynomial_rises() -> None:
    assert largest_angle((0.0, 0.0, 0.0, 0.0)) == np.pi  # all around
    # 1 + 3 k1 theta^2 falls to 0.01.
    folding = largest_angle((-0.2, 0.0, 0.0, 0.0))
    assert folding == pytest.approx(np.sqrt(0.99 / 0.6), abs=np.pi / 4096)
    angles = np.array([0.1, 1.0, 1.28])
    distorted = angles - 0.2 * angles**3
    np.testing.assert_allclose(angle_of((-0.2, 0.0, 0.0, 0.0), distorted), angles, atol=1e-7)
    assert angle_of((-0.2, 0.0, 0.0, 0.0), np.array(5.0)) == folding
    np.testing.assert_allclose(angle_of((0.0,) * 4, np.array([0.3, 1.9, 3.1])), [0.3, 1.9, 3.1])


def test_corners_that_a_fisheye_does_not_see_are_known() -> None:
    assert seen_pixels(camera_at(np.eye(4))) is None
    assert seen_pixels(fisheye(30.0)) is None
    # 180 degrees, which is the most there is, lie pi f from the middle: 37.7 pixels.
    seen = seen_pixels(fisheye(12.0))
    assert seen is not None
    v, u = np.indices(seen.shape) + 0.5
    assert np.array_equal(seen, np.hypot(u - 50.0, v - 50.0) <= 12.0 * np.pi)
    assert has_invertible_distortion(fisheye(12.0))
    assert not has_invertible_distortion(fisheye(6.0))


def random_lens(seed: int, rational: bool = False) -> Camera:
    rng = np.random.default_rng(seed)
    k1, k2, k3, p1, p2 = rng.normal(0.0, [0.1, 0.05, 0.02, 0.01, 0.01])
    divisor = dict(zip(("k4", "k5", "k6"), rng.normal(0.0, [0.2, 0.1, 0.05]), strict=True))
    bent = {"k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2} | (divisor if rational else {})
    return camera_at(np.eye(4), **bent)


@pytest.mark.parametrize("rational", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_distortion_agrees_with_opencv(seed: int, rational: bool) -> None:
    lens = random_lens(seed, rational)
    points = np.random.default_rng(seed).uniform(-0.5, 0.5, (20, 2))
    coefficients = np.array(
        [lens.k1, lens.k2, lens.p1, lens.p2, *(lens.k3, lens.k4, lens.k5, lens.k6)]
    )
    expected, _ = cv2.projectPoints(
        np.concatenate([points, np.ones((20, 1))], axis=1),
        *(np.zeros(3), np.zeros(3), np.eye(3), coefficients),
    )
    distorted, jacobian = lens.distort(points)
    np.testing.assert_allclose(distorted, expected[:, 0], rtol=0, atol=1e-14)

    step = 1e-6
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        slope = (lens.distort(points + shift)[0] - lens.distort(points - shift)[0]) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, axis], slope, rtol=0, atol=1e-8)


@pytest.mark.parametrize("k1", [-2.0, -1.0, -0.7, -0.45, -0.38, -0.25, -0.1, 0.5, 5.0])
def test_fold_of_one_coefficient_is_found_where_it_is(k1: float) -> None:
    # r (1 + k1 r^2) has its maximum (2/3) sqrt(-1 / (3 k1)); the corner is at distorted radius 0.5
    # or 0.7071. Where the determinant (1 + k1 r^2)(1 + 3 k1 r^2) gets close to 0 may go both ways.
    for half in (0.3535533905932738, 0.5):
        lens = camera_at(np.eye(4), width=10, height=10, cx=5.0, cy=5.0, fx=5 / half, fy=5 / half)
        lens = Camera(**{**vars(lens), "k1": k1})
        farthest = (2.0 / 3.0) * np.sqrt(1.0 / (-3.0 * k1)) if k1 < 0.0 else np.inf
        corner = half * np.sqrt(2.0)
        assert abs(farthest / corner - 1.0) > 0.01
        assert has_invertible_distortion(lens) == (corner < farthest)


def test_fold_that_a_higher_coefficient_turns_back_is_found() -> None:
    # r - r^3 + r^5 / 2.5 falls between its extrema, then rises to pass the corner again.
    lens = camera_at(
        np.eye(4), width=10, height=10, cx=5.0, cy=5.0, fx=5.0, fy=5.0, k1=-1.0, k2=0.4
    )
    assert not has_invertible_distortion(lens)


def test_the_fold_of_a_rational_lens_is_found() -> None:
    # r / (1 + k4 r^2) is largest at r = k4^-1/2, where it is half of that; the corner is at 0.7071.
    square = {"width": 10, "height": 10, "cx": 5.0, "cy": 5.0, "fx": 10.0, "fy": 10.0}
    for k4, foldless in ((0.2, True), (0.4, True), (0.6, False), (3.0, False)):
        assert (0.5 * k4**-0.5 > np.hypot(0.5, 0.5)) == foldless
        assert has_invertible_distortion(camera_at(np.eye(4), **square, k4=k4)) == foldless
    # A pole on the way is never reached: distorted radii rise to infinity before it.
    assert has_invertible_distortion(camera_at(np.eye(4), **square, k4=-3.0))


def test_distortion_of_real_lenses_is_accepted() -> None:
    fox = camera_at(
        np.eye(4),
        **{"width": 270, "height": 480, "fx": 343.88, "fy": 343.62, "cx": 138.64, "cy": 241.32},
        **{"k1": 0.0578421, "k2": -0.0805099, "p1": -0.000980296, "p2": 0.00015575},
    )
    assert has_invertible_distortion(fox)


@pytest.mark.parametrize(
    ("written", "fisheye"),
    [("opencv", False), ("Pinhole", False), ("PERSPECTIVE", False), ("opencv_fisheye", True)],
)
def test_models_of_cameras_are_known_in_any_case(written: str, fisheye: bool) -> None:
    lens = read_lens(FILE, [("$", LensFields(camera_model=written, fl_x=9.0))])
    assert lens.fisheye == fisheye and not lens.doubt


@pytest.mark.parametrize(
    ("focal", "own", "says"),
    [
        ((26, 26, 26, 26), False, False),
        ((26, 27, 26, 26), False, False),
        ((26, 77, 26, 26), False, True),
        ((26, 77, 26, 26), True, False),
        ((0, 26, 0, 0), False, False),
    ],
)
def test_photographs_of_several_focal_lengths_have_no_one_lens(
    tmp_path: Path, focal: tuple[int, ...], own: bool, says: bool
) -> None:
    """As of a zoom, or of a telephone's other camera."""
    content = write_transforms(tmp_path)
    for k, frame in enumerate(content["frames"]):
        exif = Image.Exif()
        if focal[k]:
            exif.get_ifd(0x8769)[41989] = focal[k]
        Image.fromarray(picture(k)).save(tmp_path / f"{k}.jpg", exif=exif)
        frame |= {"file_path": f"{k}.jpg"} | ({"fl_x": 10.0 * focal[k] / 26} if own else {})
    save(tmp_path / "transforms.json", content)
    said = [w for w in load_scene(tmp_path).warnings if "focal lengths by EXIF" in w]
    assert len(said) == says
    if says:
        assert "EXIF (0.jpg 26 mm, 1.jpg 77 mm) have one lens in transforms.json" in said[0]


@pytest.mark.parametrize(
    ("of_film", "own", "says"),
    [
        ((26, 0, 26, 0), (4.25, 4.25, 4.25, 4.25), False),
        ((26, 0, 26, 0), (4.25, 4.25, 4.25, 9.0), True),
        ((26, 0, 52, 0), (4.25, 4.25, 4.25, 4.25), True),
    ],
)
def test_focal_lengths_for_film_are_no_others_than_the_lens_s_own(
    tmp_path: Path, of_film: tuple[int, ...], own: tuple[float, ...], says: bool
) -> None:
    """Some photographs of a telephone state one of these only."""
    content = write_transforms(tmp_path)
    for k, frame in enumerate(content["frames"]):
        exif = Image.Exif()
        details = exif.get_ifd(0x8769)
        details[37386] = own[k]
        if of_film[k]:
            details[41989] = of_film[k]
        Image.fromarray(picture(k)).save(tmp_path / f"{k}.jpg", exif=exif)
        frame["file_path"] = f"{k}.jpg"
    save(tmp_path / "transforms.json", content)
    assert any("focal lengths by EXIF" in w for w in load_scene(tmp_path).warnings) == says
