"""What README.md and docs/python.md say in Python runs, on a smaller room and for fewer steps."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from solid_fields import ball_field
from test_export_cameras import ball_scene

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
SMALLER = {
    'load_scene("builtin:room")': 'load_scene("builtin:room", downscale=8)',
    "steps=2000": "steps=5",
    "n_frames=240": "n_frames=3",
    "torch.zeros(64, 64, 64, 4": "torch.zeros(8, 8, 8, 4",
}


def examples(document: str) -> list[str]:
    """Python in a document, made smaller; blocks are short."""
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / document).read_text(), re.DOTALL)
    assert all(block.count("\n") <= 12 for block in blocks)
    for given, smaller in SMALLER.items():
        blocks = [block.replace(given, smaller) for block in blocks]
    return blocks


def test_the_examples_are_made_smaller() -> None:
    text = README + (ROOT / "docs/python.md").read_text()
    assert all(given in text for given in SMALLER)


def test_the_python_of_the_documents_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("av")
    torch = pytest.importorskip("torch")
    monkeypatch.chdir(tmp_path)
    (readme,) = examples("README.md")
    names: dict[str, object] = {}
    exec(compile(readme, "README.md", "exec"), names)
    assert names["image"].rgb.shape == (15, 20, 3)  # type: ignore[attr-defined]
    assert "psnr" in capsys.readouterr().out.lower()

    after, exported, in_torch, with_head = examples("docs/python.md")
    exec(compile(after, "docs/python.md", "exec"), names)
    assert (tmp_path / "orbit.mp4").stat().st_size > 0
    assert names["result"].progress.step == 5  # type: ignore[attr-defined]

    of_a_ball = names | {"result": SimpleNamespace(field=ball_field()), "scene": ball_scene()}
    exec(compile(exported, "docs/python.md", "exec"), of_a_ball)
    assert (tmp_path / "room.glb").stat().st_size > 0
    assert len(of_a_ball["splats"].centres) > 100  # type: ignore[attr-defined]

    names |= {
        "colors": torch.rand(6, 9, 3, requires_grad=True),
        "sigmas": torch.rand(6, 9, requires_grad=True),
        "distances": torch.rand(6, 9),
        "origins": torch.tensor([[0.1, 0.2, -2.0]]),
        "directions": torch.tensor([[0.0, 0.0, 1.0]]),
    }
    exec(compile(in_torch, "docs/python.md", "exec"), names)
    assert names["rays"].rgb.shape == (1, 3)  # type: ignore[attr-defined]
    assert names["raw"].grad.abs().max() > 0  # type: ignore[attr-defined]
    exec(compile(with_head, "docs/python.md", "exec"), names)
    assert all(tensor.grad.abs().max() > 0 for tensor in names["head"][1:])  # type: ignore
