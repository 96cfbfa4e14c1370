"""A field, and a training, comes back as it was, or not at all."""

from __future__ import annotations

import json
import os
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from tests.support.tiny_fields import assert_same_state, tiny_field, tiny_state
from tests.support.tiny_scenes import camera_at, ring
from warpnerf.checks import InputError
from warpnerf.config import GridConfig, MarchConfig, TrainConfig
from warpnerf.grid_config import Contraction
from warpnerf.model.interface import Model, n_weights
from warpnerf.model.models import Deferred, PerSample, Rgb, SphericalHarmonics
from warpnerf.optim_config import OptimConfig
from warpnerf.runs.checkpoint import load_checkpoint, load_field, save_checkpoint, save_field
from warpnerf.runs.tensor_file import DamagedFileError, digest_of
from warpnerf.writing import write_atomically

pytestmark = pytest.mark.usefixtures("unoptimised")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "field.safetensors"
    save_field(path, tiny_field())
    return path


def rewrite(path: Path, header: Any = None, **tensors: np.ndarray) -> None:
    """Forge a file whose digest is right: other header text, or tensors added or replaced."""
    with safe_open(path, framework="numpy") as file:
        text = file.metadata()["header"]
    contents = load_file(path) | tensors
    text = text if header is None else header(text)
    digest = digest_of(text, contents)
    save_file(contents, path, metadata={"header": text, "sha256": digest})


MODELS = [Rgb(), SphericalHarmonics(degree=1), Deferred(), PerSample(width=16, hidden_layers=1)]


@pytest.mark.ci
@pytest.mark.parametrize(
    ("contraction", "model"),
    [*((c, Rgb()) for c in ("none", "linf", "l2")), *(("none", model) for model in MODELS[1:])],
    ids=["none", "linf", "l2", *(model.name for model in MODELS[1:])],
)
def test_it_comes_back_bit_for_bit(tmp_path: Path, contraction: Contraction, model: Model) -> None:
    field = tiny_field(contraction=contraction, model=model)
    path = tmp_path / "field.safetensors"
    save_field(path, field)
    back = load_field(path, threads=1)
    np.testing.assert_array_equal(back.storage.values.numpy(), field.storage.values.numpy())
    np.testing.assert_array_equal(back.weights.numpy(), field.weights.numpy())
    np.testing.assert_array_equal(back.free.distance.numpy(), field.free.distance.numpy())
    assert back.model == model
    assert (back.steps, back.background) == (field.steps, field.background)
    camera = camera_at(ring(3)[1])
    seen, expected = back.render(camera), field.render(camera)
    assert expected.opacity.max() > 0.5
    for name in ("rgb", "depth", "opacity"):
        np.testing.assert_array_equal(getattr(seen, name), getattr(expected, name))


def test_writing_leaves_nothing_else_behind(file: Path) -> None:
    save_field(file, tiny_field(density=1.0))  # over the older one
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_a_failed_write_keeps_the_older_file(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = file.read_bytes()

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        save_field(file, tiny_field(density=1.0))
    assert file.read_bytes() == before
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_a_cut_file_is_refused_by_name(file: Path) -> None:
    content = file.read_bytes()
    for length in [0, 4, 8, 100, len(content) // 2, len(content) - 1]:
        file.write_bytes(content[:length])
        with pytest.raises(InputError, match=r"field\.safetensors"):
            load_field(file, threads=1)


def test_any_flipped_bit_is_refused(file: Path) -> None:
    content = file.read_bytes()
    rng = np.random.default_rng(0)
    start = int.from_bytes(content[:8], "little") + 8
    places = [*range(8), *rng.integers(8, start, 60), *rng.integers(start, len(content), 60)]
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(damaged)
        with pytest.raises(InputError, match=r"field\.safetensors"):
            load_field(file, threads=1)


@pytest.mark.parametrize("content", [b"", b"{}", b"\x80\x04}.", b"\xff" * 64])
def test_a_foreign_file_is_refused(file: Path, content: bytes) -> None:
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"field\.safetensors"):
        load_field(file)


def test_foreign_safetensors_are_refused(file: Path) -> None:
    save_file({"weight": np.zeros(3, np.float32)}, file)
    with pytest.raises(InputError, match=r"field\.safetensors"):
        load_field(file)


def test_a_field_with_nan_is_refused(tmp_path: Path) -> None:
    field = tiny_field()
    values = field.storage.values.numpy()
    values[7, 2] = np.nan
    field.storage.values.assign(values)
    save_field(tmp_path / "nan.safetensors", field)
    with pytest.raises(InputError, match=r"nan\.safetensors"):
        load_field(tmp_path / "nan.safetensors", threads=1)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.safetensors"):
        load_field(tmp_path / "none.safetensors")


EVERYTHING_SET = TrainConfig(
    steps=7,
    time_limit=1.0 / 3.0,
    scaling="quadratic",
    content_distance=0.1,
    jacobian="paper",
    background=(0.1, 0.2, 0.3),
    seed=2**62 + 1,
    threads=3,
    device="cuda:1",
    checkpoint_every=0.7,
    model=PerSample(features=9, frequencies=2, width=16, hidden_layers=1, threshold=1e-3 / 3.0),
    grid=GridConfig(voxels=1000, grow_at=(0.1, 0.2, 1.0 / 3.0)),
    march=MarchConfig(far=1e9 / 3.0, jitter=False),
    optim=OptimConfig(epsilon=1e-300, near_decay=0.1 / 3.0),
)


@pytest.mark.parametrize(
    "config",
    [TrainConfig(), EVERYTHING_SET, *(TrainConfig(model=model) for model in MODELS)],
    ids=["defaults", "all set", *(model.name for model in MODELS)],
)
def test_a_training_comes_back_bit_for_bit(tmp_path: Path, config: TrainConfig) -> None:
    state = tiny_state(300, config)
    save_checkpoint(tmp_path / "training", state)
    assert_same_state(load_checkpoint(tmp_path / "training"), state)


def test_rendering_reads_either_file(tmp_path: Path, file: Path) -> None:
    state = tiny_state(3)
    save_checkpoint(tmp_path / "training", state)
    save_field(file, state.field)
    camera = camera_at(ring(3)[1])
    expected = state.field.render(camera).rgb
    for path in (file, tmp_path / "training"):
        np.testing.assert_array_equal(load_field(path, threads=1).render(camera).rgb, expected)


def test_a_field_is_nothing_to_go_on_with(file: Path) -> None:
    with pytest.raises(InputError, match=r"field\.safetensors holds a field but no training"):
        load_checkpoint(file)


def test_metadata_tell_what_a_file_is(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "training", tiny_state(3))
    with safe_open(tmp_path / "training", framework="numpy") as file:
        metadata = file.metadata()
    header = json.loads(metadata["header"])
    assert header["format"] == "warpnerf-training-8"
    assert (
        header["model"]["name"]
        == header["training"]["plan"]["config"]["model"]["name"]
        == "deferred"
    )
    assert header["training"]["progress"]["step"] == 3
    assert header["training"]["plan"]["config"]["grid"]["voxels"] == TrainConfig().grid.voxels
    assert len(metadata["sha256"]) == 64


def test_the_file_is_as_the_package_writes_it(tmp_path: Path, file: Path) -> None:
    """Tensors one after another from an aligned start, and none left out."""
    save_file(load_file(file), tmp_path / "theirs")
    for path in (file, tmp_path / "theirs"):
        content = path.read_bytes()
        start = 8 + int.from_bytes(content[:8], "little")
        assert start % 8 == 0
        if path == file:
            ours = content[start:]
    assert ours == content[start:]


def test_a_short_write_is_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = os.write
    monkeypatch.setattr("os.write", lambda file, data: write(file, data[:3]))
    write_atomically(tmp_path / "file", b"abcdefgh", b"", memoryview(b"ijk"))
    assert (tmp_path / "file").read_bytes() == b"abcdefghijk"


def test_a_link_stays_and_leads_to_what_is_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"old")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    write_atomically(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "file").read_bytes() == b"new"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes here")
def test_a_pipe_is_written_to(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_atomically(tmp_path / "pipe", b"abc", memoryview(b"def"))
        assert os.read(reader, 100) == b"abcdef"
    finally:
        os.close(reader)
    assert (tmp_path / "pipe").is_fifo()
    write_atomically(os.devnull, b"abc")
    assert not Path(os.devnull).is_file()


@pytest.mark.skipif(not Path("/dev/fd").exists(), reason="open files have no names here")
def test_what_is_open_is_written_to(tmp_path: Path) -> None:
    with (tmp_path / "file").open("w+b") as file:
        write_atomically(f"/dev/fd/{file.fileno()}", b"abc")
        file.seek(0, os.SEEK_END)
        file.write(b"def")
    assert (tmp_path / "file").read_bytes() == b"abcdef"


@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="there is no such folder here")
def test_files_in_memory_are_files(monkeypatch: pytest.MonkeyPatch) -> None:
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        path = Path(folder) / "file"
        path.write_bytes(b"older")
        with monkeypatch.context() as patch, pytest.raises(OSError):
            patch.setattr(os, "fsync", lambda file: os.close(-1))
            write_atomically(path, b"new")
        assert path.read_bytes() == b"older"


N_WEIGHTS = n_weights(Deferred())


def in_model(old: str, new: str) -> Callable[[str], str]:
    """Replace a text in the header where it says which model the field has, and nowhere else."""

    def change(text: str) -> str:
        before, model, after = re.split(r'("model": {[^{}]*}, "size")', text)
        assert old in model
        return before + model.replace(old, new) + after

    return change


def in_config(old: str, new: str) -> Callable[[str], str]:
    """The same where it says which model was requested."""

    def change(text: str) -> str:
        before, model, after = re.split(r'("model": {[^{}]*}, "occupancy_every")', text)
        assert old in model
        return before + model.replace(old, new) + after

    return change


@pytest.mark.parametrize(
    ("header", "tensors", "says"),
    [
        (lambda text: text.replace("training-8", "training-9"), {}, "training-9"),
        (lambda text: text[:-1], {}, "header"),
        (lambda text: "[" * 100_000, {}, "header"),
        (lambda text: "[]", {}, "header"),
        (lambda text: text[:-1] + ', "border": 0.0}', {}, "'border' is given twice"),
        (lambda text: text.replace('"border": 0.0', '"border": NaN'), {}, "finite"),
        (lambda text: text.replace('"border": 0.0', '"border": 1e999'), {}, "finite"),
        (lambda text: text.replace('"border": 0.0', '"border": "wide"'), {}, "border"),
        (lambda text: text.replace('"border": 0.0', '"border": 7.0'), {}, "rendered"),
        (lambda text: text.replace('"grown": 2', '"grown": 9'), {}, "9 times"),
        (lambda text: text.replace('"updates": 5', '"updates": 6'), {}, "6 updates"),
        (lambda text: text.replace('"restarted": 0', '"restarted": 7'), {}, "after 7"),
        (lambda text: text.replace('"seed": 0', '"seed": -1'), {}, "seed"),
        (lambda text: text.replace('"step": 5', '"step": "five"'), {}, "step"),
        (in_model('"deferred"', '"dreams"'), {}, "dreams"),
        (in_model('"specular": 12', '"specular": 11'), {}, "rendered"),  # as many floats
        (in_model('"width": 64', '"width": 16'), {}, "rendered"),
        (in_model('"width": 64', '"width": 33'), {}, "model.width"),
        (in_model('"width": 64', '"width": 64.0'), {}, "'width'"),
        (in_model('"width": 64', '"breadth": 64'), {}, "'breadth'"),
        (in_config('"frequencies": 1', '"frequencies": 2'), {}, "another model"),
        (None, {"extra": np.zeros(3, np.float32)}, "extra"),
        (None, {"moments": np.zeros((210, 16), np.uint32)}, "moments"),
        (None, {"values.moments": np.zeros((180, 16), np.uint32)}, "'values.moments'"),
        (None, {"values.moments": np.zeros((210, 16), np.float32)}, "'values.moments'"),
        (None, {"values.moments": np.full((210, 16), 0x7F800000, np.uint32)}, "'values.moments'"),
        (None, {"values.moments": np.full((210, 16), 0x0000FF00, np.uint32)}, "'values.moments'"),
        (None, {"weights.mean": np.zeros(7, np.float32)}, "'weights.mean'"),
        (None, {"weights.square": np.full(N_WEIGHTS, np.inf, np.float32)}, "'weights.square'"),
        (None, {"weights": np.zeros(N_WEIGHTS + 1, np.float32)}, "rendered"),
        (None, {"weights": np.zeros(N_WEIGHTS, np.uint32)}, "rendered"),
        (None, {"weights": np.full(N_WEIGHTS, np.nan, np.float32)}, "rendered"),
        (None, {"values": np.zeros((5, 6, 7, 3), np.float32)}, "values"),
        (None, {"free_distance": np.zeros((0, 2, 2), np.uint8)}, "rendered"),
    ],
)
def test_a_forged_training_is_refused(
    tmp_path: Path, header: Any, tensors: dict[str, np.ndarray], says: str
) -> None:
    path = tmp_path / "training.safetensors"
    save_checkpoint(path, tiny_state(5))
    rewrite(path, header, **tensors)
    with pytest.raises(InputError, match=r"training\.safetensors") as caught:
        load_checkpoint(path)
    assert says in str(caught.value)


def test_a_key_given_twice_is_refused(file: Path) -> None:
    """Readers differ on which of the two they take."""
    content = file.read_bytes()
    length = int.from_bytes(content[:8], "little")
    text = content[8 : 8 + length].rstrip()
    digest = json.loads(text)["__metadata__"]["sha256"]
    twice = text.replace(b'"sha256":', b'"sha256": "%s", "sha256":' % digest.encode(), 1)
    assert len(twice) > len(text)
    file.write_bytes(len(twice).to_bytes(8, "little") + twice + content[8 + length :])
    with pytest.raises(DamagedFileError, match="'sha256' is given twice"):
        load_field(file)


def test_another_version_is_not_called_damage(file: Path) -> None:
    """Else a newer checkpoint would be skipped for an older one, and in the end removed."""
    rewrite(file, lambda text: text.replace("field-2", "field-9"))
    with pytest.raises(InputError, match="field-9") as caught:
        load_field(file)
    assert not isinstance(caught.value, DamagedFileError)


def test_a_pipe_is_refused_unopened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="pipe is not a file"):
        load_field(tmp_path / "pipe")
