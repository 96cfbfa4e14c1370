"""What the README says in Python runs, on a smaller room and for fewer steps."""

import re
from pathlib import Path

import pytest

README = (Path(__file__).parent.parent / "README.md").read_text()


def test_the_python_of_the_readme_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("av")
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)[:2]  # torch comes later
    assert len(blocks) == 2 and all(block.count("\n") <= 12 for block in blocks)
    code = "".join(blocks)
    for given, smaller in {
        'load_scene("builtin:room")': 'load_scene("builtin:room", downscale=8)',
        "steps=2000": "steps=5",
        "n_frames=240": "n_frames=3",
    }.items():
        assert given in code
        code = code.replace(given, smaller)
    names: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), names)
    assert names["image"].rgb.shape == (15, 20, 3)  # type: ignore[attr-defined]
    assert "psnr" in capsys.readouterr().out.lower()
    assert (tmp_path / "orbit.mp4").stat().st_size > 0
