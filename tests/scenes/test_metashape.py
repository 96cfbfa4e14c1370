"""Metashape's XML: lenses, transforms, cameras that are left out, and damage."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tests.support.program_exports import SENSOR, write_metashape, write_pictures
from tests.support.tiny_scenes import ring
from warpnerf.checks import InputError
from warpnerf.scenes.formats.load import load_scene


def with_lens(lens: str, kind: str = "frame") -> str:
    return SENSOR.replace("<b1>-1</b1>", f"<b1>-1</b1>{lens}").replace(
        'type="frame" class="adj', f'type="{kind}" class="adj'
    )


def test_metashape_tangential_is_the_other_way_round(tmp_path: Path) -> None:
    lens = "<k1>-0.05</k1><k2>0.02</k2><k3>-0.01</k3><p1>0.001</p1><p2>-0.002</p2>"
    write_metashape(tmp_path, sensor=with_lens(lens))
    camera = load_scene(tmp_path).views[0].camera
    assert (camera.k1, camera.k2, camera.k3) == (-0.05, 0.02, -0.01)
    assert (camera.p1, camera.p2) == (-0.002, 0.001)
    assert (camera.fx, camera.fy) == (10.0, 11.0)
    assert not camera.fisheye
    assert not camera.rational


@pytest.mark.parametrize("kind", ["fisheye", "equidistant_fisheye"])
def test_metashape_fisheye(tmp_path: Path, kind: str) -> None:
    write_metashape(tmp_path, sensor=with_lens("<k1>-0.05</k1><k4>0.001</k4>", kind))
    camera = load_scene(tmp_path).views[0].camera
    assert camera.fisheye
    assert camera.radial == (-0.05, 0.0, 0.0, 0.001)


@pytest.mark.parametrize(
    ("lens", "kind", "said"),
    [
        ("<k1>-0.05</k1><k4>0.03</k4>", "frame", "BROWN lens; .* is used in its place"),
        ("<b2>3</b2>", "frame", "BROWN lens; .* so they are undistorted"),
        ("<k1>0.02</k1>", "equisolid_fisheye", "BROWN_EQUISOLID lens; .* in its place"),
    ],
)
def test_metashape_other_lenses(tmp_path: Path, lens: str, kind: str, said: str) -> None:
    write_metashape(tmp_path, sensor=with_lens(lens, kind))
    scene = load_scene(tmp_path)
    assert any(re.search(said, note) for note in scene.notes)


def test_metashape_before_1_2_has_the_principal_point_from_the_edges(tmp_path: Path) -> None:
    old = "<fx>10</fx><fy>11</fy><cx>4.25</cx><cy>2.75</cy><p1>0.001</p1>"
    sensor = SENSOR.replace("<f>11</f><cx>0.25</cx><cy>-0.25</cy><b1>-1</b1>", old)
    write_metashape(tmp_path, sensor=sensor)
    camera = load_scene(tmp_path).views[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (10.0, 11.0, 4.25, 2.75)
    assert (camera.p1, camera.p2) == (0.001, 0.0)


TURN = "<rotation>0 -1 0 1 0 0 0 0 1</rotation><translation>5 6 7</translation><scale>2</scale>"


@pytest.mark.parametrize("where", ["chunk", "component"])
def test_metashape_transforms_lead_to_the_projects_coordinates(tmp_path: Path, where: str) -> None:
    rest = f"<transform>{TURN}</transform>"
    if where == "component":
        rest = f'<components><component id="9">{rest}</component></components>'
    write_metashape(tmp_path, rest=rest, component='component_id="9"')
    found = load_scene(tmp_path)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for view, pose in zip(found.views, ring(4), strict=True):
        np.testing.assert_allclose(view.camera.c2w[:, :3], turn @ pose[:3, :3], atol=1e-9)
        there = 2.0 * turn @ pose[:3, 3] + [5.0, 6.0, 7.0]
        np.testing.assert_allclose(view.camera.position, there, atol=1e-9)


def test_metashape_geocentric_coordinates_are_turned_up(tmp_path: Path) -> None:
    """At 48 N, 11 E: cameras of the ring in east, north and up, from that place on the earth."""
    phi, lam = np.radians([48.0, 11.0])
    up = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    east = np.array([-np.sin(lam), np.cos(lam), 0.0])
    axes = np.stack([east, np.cross(up, east), up], axis=1)
    e2 = 1.0 - (6356752.314245 / 6378137.0) ** 2
    normal = 6378137.0 / np.sqrt(1.0 - e2 * np.sin(phi) ** 2)
    origin = normal * up * [1.0, 1.0, 1.0 - e2]
    numbers = [" ".join(map(repr, row.ravel().tolist())) for row in (axes, origin)]
    rest = f"<transform><rotation>{numbers[0]}</rotation><translation>{numbers[1]}</translation>"
    write_metashape(tmp_path, rest=f"{rest}</transform>")
    scene = load_scene(tmp_path)
    positions = np.array([view.camera.position for view in scene.views])
    given = np.array([pose[:3, 3] for pose in ring(4)])
    np.testing.assert_allclose(positions, given - np.median(given, axis=0), atol=1e-5)
    np.testing.assert_allclose(scene.views[0].camera.c2w[:, :3], ring(4)[0][:3, :3], atol=1e-6)
    assert any("turned to east, north and up" in note for note in scene.notes)


@pytest.mark.parametrize(
    ("middle", "reference", "turned"),
    [
        ((560000.0, 6300000.0, 20.0), "", False),  # UTM in Denmark
        ((560000.0, 6355000.0, 20.0), 'LOCAL_CS["Local Coordinates (m)"]', False),
        ((0.0, 6380000.0, 0.0), 'GEOGCS["WGS 84"]', True),
        ((0.0, 6395000.0, 0.0), "", True),
        ((0.0, 0.0, 6356000.0), "", True),
        ((0.0, 0.0, 6380000.0), "", False),
        ((0.0, 0.0, 0.0), "", False),
    ],
)
def test_metashape_coordinates_are_geocentric_near_the_ellipsoid(
    tmp_path: Path, middle: tuple[float, ...], reference: str, turned: bool
) -> None:
    """Northings of UTM are as far from the origin as the ground from the centre of the earth."""
    rest = f"<transform><translation>{' '.join(map(str, middle))}</translation></transform>"
    write_metashape(tmp_path, rest=f"{rest}<reference>{reference}</reference>")
    notes = load_scene(tmp_path).notes
    assert any("turned to east, north and up" in note for note in notes) == turned


def test_metashape_components_without_transforms_are_not_mixed(tmp_path: Path) -> None:
    file = write_metashape(tmp_path, component='component_id="0"')
    text = file.read_text()
    last = 'component_id="0" label="003"'
    assert last in text
    file.write_text(text.replace(last, last.replace('"0"', '"1"', 1)))
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.views] == [f"images/{k:03d}.png" for k in range(3)]
    assert any("left out 1 cameras of 1 smaller components" in note for note in scene.notes)


def test_metashape_labels_with_extensions_and_cameras_that_are_left_out(tmp_path: Path) -> None:
    file = write_metashape(tmp_path)
    text = file.read_text().replace('label="001"', 'label="001.JPG"')
    text = text.replace('label="002"', 'label="002.png"')
    file.write_text(text.replace('label="003"', 'enabled="false" label="003"'))
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.views] == [f"images/{k:03d}.png" for k in range(3)]
    said = "\n".join(scene.notes)
    assert "left out 1 cameras that are switched off" in said
    assert "left out 1 of 4 cameras that are not aligned (first: lost)" in said
    lost = 'sensor_id="3" label="lost"'
    file.write_text(file.read_text().replace(lost, f'master_id="0" {lost}'))
    scene = load_scene(tmp_path)
    assert not any("not aligned" in note for note in scene.notes)
    rig = (
        "left out 1 of 5 cameras (first: lost) that are placed by another one of their rig; export"
    )
    assert any(rig in warning for warning in scene.warnings)


@pytest.mark.parametrize(
    ("of_sensor", "of_camera", "says"),
    [
        ("<rolling_shutter>true</rolling_shutter>", "", "of 1 sensors and cameras (first: lens)"),
        ('<property name="rolling_shutter" value="full"/>', "", "of 1 sensors and cameras (first"),
        ("", "<rolling_shutter>1 0 0</rolling_shutter>", "of 4 sensors and cameras (first: 000)"),
        ("<rolling_shutter>false</rolling_shutter>", "", None),
        ('<property name="rolling_shutter" value="disabled"/>', "", None),
        ("", "", None),
    ],
)
def test_metashape_rolling_shutters_are_named(
    tmp_path: Path, of_sensor: str, of_camera: str, says: str | None
) -> None:
    file = write_metashape(tmp_path, sensor=SENSOR.replace("</sensor>", f"{of_sensor}</sensor>"))
    file.write_text(file.read_text().replace("<transform>", f"{of_camera}<transform>"))
    warnings = [w for w in load_scene(tmp_path).warnings if "shutter" in w]
    assert (len(warnings) == 1 and says in warnings[0]) if says else not warnings


def test_metashape_two_photographs_of_a_name_are_refused(tmp_path: Path) -> None:
    write_metashape(tmp_path)
    write_pictures(tmp_path / "images/more", ["000.png"])
    with pytest.raises(
        InputError, match=r"'000' is the name of 2 photographs \(images/000.png, im"
    ):
        load_scene(tmp_path)


def test_metashape_images_named_after_photographs_are_no_second_ones(tmp_path: Path) -> None:
    write_metashape(tmp_path)
    for name in ("normals", "sky_masks", "depth_maps"):
        write_pictures(tmp_path / "images" / name, ["000.png"])
    assert len(load_scene(tmp_path).views) == 4


def test_metashape_photographs_that_are_links_out_of_the_folder_are_refused(tmp_path: Path) -> None:
    write_metashape(tmp_path / "scene")
    photograph = tmp_path / "scene/images/001.png"
    photograph.rename(tmp_path / "001.png")
    photograph.symlink_to(tmp_path / "001.png")
    with pytest.raises(InputError, match=r"camera '001': .images/001.png. follows a link out of"):
        load_scene(tmp_path / "scene")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("<f>11</f>", "", "sensor 3: has no focal length f; export"),
        ("<f>11</f>", "<f>-3</f>", "sensor 3: its focal length must be above 0"),
        ("<f>11</f>", "<f>wide</f>", "sensor 3: f: holds something else than a finite number"),
        ("<b1>-1</b1>", "<k2>nan</k2>", "sensor 3: k2: holds something else than a finite number"),
        ('width="8" height="6"', 'width="8"', "sensor 3: has no resolution in pixels"),
        ('width="8"', 'width="12"', "is for images of 12x6 pixels, but images/000.png has 8x6"),
        ('type="frame" class="adj', 'type="spherical" class="adj', "lens 'spherical' is not mod"),
        ('sensor_id="3"', 'sensor_id="4"', "camera '000': its sensor is not in the file"),
        ("<transform>", "<transform>1 ", "camera '000': transform: holds something else than 16"),
        ("<transform>", "<nothing>", "is no valid XML: mismatched tag"),
        ("<document", '<!DOCTYPE a [<!ENTITY b "c">]><document', "declares entities or a document"),
        ('label="001"', 'label="000"', "1 cameras are of a photograph that another one is of"),
        ("<calibration", "<other", "is no valid XML"),
        (SENSOR, '<sensor id="3" type="spherical"/>', "lens 'spherical' is not modelled; export"),
        ("<camera ", '<camera enabled="0" ', "its 4 cameras that are aligned are switched off"),
    ],
)
def test_metashape_damage_is_named(tmp_path: Path, old: str, new: str, says: str) -> None:
    file = write_metashape(tmp_path)
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=says):
        load_scene(tmp_path)


def test_metashape_without_aligned_cameras_is_refused(tmp_path: Path) -> None:
    write_metashape(tmp_path, poses=[])
    text = (tmp_path / "cameras.xml").read_text()
    assert "<transform>" not in text
    with pytest.raises(InputError, match="none of its 1 cameras is aligned; align them"):
        load_scene(tmp_path)


def test_of_several_chunks_that_of_most_cameras_is_read(tmp_path: Path) -> None:
    file = write_metashape(tmp_path)
    file.write_text(
        file.read_text().replace("<chunk", '<chunk label="empty"><cameras/></chunk><chunk', 1)
    )
    scene = load_scene(tmp_path)
    assert len(scene.views) == 4
    assert any("of 2 chunks 'Chunk 1' is read" in note for note in scene.notes)
