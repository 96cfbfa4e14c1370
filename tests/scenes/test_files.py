"""JSON and paths from outside, good and bad."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec
import pytest

from warpnerf.checks import InputError
from warpnerf.scenes.files import find_image, read_json, resolve_inside


class Numbers(msgspec.Struct):
    values: list[float]


@pytest.mark.parametrize(
    "raw", [b'{"values": [1, 2.5]}', b'\xef\xbb\xbf{"values": [1, 2.5], "other": {}}']
)
def test_json_is_read_with_and_without_byte_order_mark(tmp_path: Path, raw: bytes) -> None:
    (tmp_path / "a.json").write_bytes(raw)
    assert read_json(tmp_path / "a.json", Numbers).values == [1.0, 2.5]


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (b"", "is empty"),
        (b" \n", "is empty"),
        (b'{"values": [1,]}', "not valid JSON: .*line 1 column 15"),
        (b'{"values": [1', "not valid JSON"),
        (b"[" * 100_000, "brackets nested too deeply"),
        (b'{"values": [NaN]}', r"\$\.values\[0\]: is not a finite number"),
        (b'{"values": [1, -Infinity, NaN]}', r"\$\.values\[1\]: is not a finite number"),
        (b'{"values": [1], "unread": {"a": [0, [1e999]]}}', r"\$\.unread\.a\[1\]\[0\]: is not"),
        (b'{"values": [' + b"9" * 5000 + b"]}", r"\$\.values\[0\]: .* too large"),
        (b'{"values": [' + b"9" * 400 + b"]}", r"\$\.values\[0\]: .* too large"),
        (b'{"values": [1], "values": [2]}', "the key values is given twice"),
        (b'{"values": ["1"]}', r"expected `float`, got `str`, at `\$.values\[0\]`"),
        (b'{"values": [true]}', r"expected `float`, got `bool`, at `\$.values\[0\]`"),
        (b"{}", r"missing required field `values`, at `\$`"),
        (b"[]", r"expected `object`, got `array`, at `\$`"),
        (b'{"values": \xff}', "not text in UTF-8"),
    ],
)
def test_bad_json_is_refused_by_name(tmp_path: Path, raw: bytes, message: str) -> None:
    (tmp_path / "a.json").write_bytes(raw)
    with pytest.raises(InputError, match=rf"a\.json: .*{message}"):
        read_json(tmp_path / "a.json", Numbers)


def test_json_that_is_no_regular_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    (tmp_path / "folder.json").mkdir()
    for name, message in [
        ("pipe", "a pipe or a device"),
        ("folder", "is a folder"),
        ("none", "does not exist"),
    ]:
        with pytest.raises(InputError, match=rf"{name}\.json: .*{message}"):
            read_json(tmp_path / f"{name}.json", Numbers)


@pytest.mark.parametrize("text", ["images/a.png", "./images//a.png", r"images\a.png", "x/../a"])
def test_paths_inside_the_folder_are_resolved(tmp_path: Path, text: str) -> None:
    expected = {"x/../a": "a"}.get(text, "images/a.png")
    assert resolve_inside(tmp_path, text, field="f") == tmp_path / expected


def test_absolute_path_into_the_folder_is_accepted(tmp_path: Path) -> None:
    assert resolve_inside(tmp_path, str(tmp_path / "a.png"), field="f") == tmp_path / "a.png"


@pytest.mark.parametrize(
    "text", ["..", "../a.png", "images/../../a.png", r"..\a.png", "/etc/passwd", r"C:\a.png"]
)
def test_paths_that_leave_the_folder_are_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match=r"t\.json: \$\.p: .* leaves the scene's folder"):
        resolve_inside(tmp_path, text, field="t.json: $.p")


@pytest.mark.parametrize("text", ["", "a\0b", "\ud800"])
def test_texts_that_are_no_paths_are_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match=r"t\.json: \$\.p: .* is not a path"):
        resolve_inside(tmp_path, text, field="t.json: $.p")


def test_links_may_stay_in_the_folder_but_not_leave_it(tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    (scene / "images").mkdir(parents=True)
    (tmp_path / "secret.png").touch()
    (scene / "inward").symlink_to(scene / "images")
    (scene / "outward").symlink_to(tmp_path)
    (scene / "loop").symlink_to("loop")
    assert resolve_inside(scene, "inward/a.png", field="f") == scene / "inward/a.png"
    assert resolve_inside(scene, "loop", field="f") == scene / "loop"
    with pytest.raises(InputError, match="follows a link out of the scene's folder"):
        resolve_inside(scene, "outward/secret.png", field="f")


def test_scene_folder_may_itself_be_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert resolve_inside(tmp_path / "link", "a", field="f") == tmp_path / "link/a"


def test_image_is_found_with_and_without_extension(tmp_path: Path) -> None:
    (tmp_path / "a.png").touch()
    (tmp_path / "b.jpg").touch()
    (tmp_path / "a").mkdir()
    assert find_image(tmp_path, "a", field="f") == tmp_path / "a.png"
    assert find_image(tmp_path, "a.png", field="f") == tmp_path / "a.png"
    assert find_image(tmp_path, "b", field="f") == tmp_path / "b.jpg"
    assert find_image(tmp_path, "c", field="f") is None
    assert find_image(tmp_path, "a.png/below-a-file", field="f") is None


def test_image_that_no_path_leads_to_is_refused(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to("loop")
    for text, message in [
        ("n" * 5000, '"n{100}" cannot be opened: .*too long'),
        ("loop", '"loop" cannot be opened: .*links'),
        ("loop/a", '"loop/a" cannot be opened: .*links'),
    ]:
        with pytest.raises(InputError, match=rf"t\.json: \$\.p: {message}"):
            find_image(tmp_path, text, field="t.json: $.p")
