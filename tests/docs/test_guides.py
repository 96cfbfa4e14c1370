"""Guides quote what the command says, and the notebook runs."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.documents import ROOT

GUIDE = (ROOT / "docs" / "it-looks-bad.md").read_text()
NOTEBOOKS = sorted((ROOT / "docs").glob("*.ipynb"))
LISTS = {"warnings", "odd", "diagnostics"}
"""Names of lists to which the package appends its warnings."""


def text_of(node: ast.expr) -> str:
    """What a string of the source says, with ... for values."""
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(value) for value in node.values)
    if isinstance(node, ast.BinOp):
        return text_of(node.left) + text_of(node.right)
    return str(node.value) if isinstance(node, ast.Constant) else "..."


def sources(*folders: str) -> Iterator[ast.Module]:
    for folder in folders:
        for path in sorted((ROOT / "warpnerf" / folder).rglob("*.py")):
            yield ast.parse(path.read_text())


def warnings_of_the_package() -> list[str]:
    """Sentences that are appended to lists of warnings when a scene is read or inspected."""
    return [
        text_of(call.args[0])
        for tree in sources("scenes", "inspection")
        for call in ast.walk(tree)
        if isinstance(call, ast.Call)
        and isinstance(call.func, ast.Attribute)
        and call.func.attr == "append"
        and isinstance(call.func.value, ast.Name)
        and call.func.value.id in LISTS
        and isinstance(call.args[0], ast.JoinedStr | ast.Constant | ast.BinOp)
    ]


def quoted(section: str) -> list[str]:
    """The first column of a section's table."""
    part = GUIDE.partition(f"## {section}\n")[2].partition("\n## ")[0]
    return re.findall(r"^\| `([^`]+)` \|", part, re.MULTILINE)


def says(sentence: str, phrase: str) -> bool:
    """Whether a sentence has a phrase; ... in it stands for anything."""
    return bool(re.search(".*".join(map(re.escape, phrase.split("..."))), sentence))


def test_every_warning_is_in_the_guide() -> None:
    phrases = quoted("By what inspect warns of")
    found = warnings_of_the_package()
    assert len(found) > 20 and len(phrases) > 20
    missing = [text for text in found if not any(says(text, phrase) for phrase in phrases)]
    assert not missing, "docs/it-looks-bad.md has no row for:\n" + "\n".join(missing)


def test_what_the_guide_quotes_is_said() -> None:
    strings = [
        text_of(node)
        for tree in sources("scenes", "inspection", "sfm", "reports", "training")
        for node in ast.walk(tree)
        if isinstance(node, ast.JoinedStr | ast.Constant)
    ]
    for section in (
        "By what inspect warns of",
        "By what a training says at its end",
        "By what pose says",
    ):
        for phrase in quoted(section):
            assert any(says(text, phrase) for text in strings), phrase


def cells(notebook: Path) -> list[str]:
    """Code of a notebook."""
    content = json.loads(notebook.read_text())
    assert content["nbformat"] == 4
    assert all(not cell.get("outputs") for cell in content["cells"]), "commit it without outputs"
    return ["".join(c["source"]) for c in content["cells"] if c["cell_type"] == "code"]


def test_notebooks_are_plain_python() -> None:
    assert NOTEBOOKS
    for notebook in NOTEBOOKS:
        for cell in cells(notebook):
            compile(cell, notebook.name, "exec")


@pytest.mark.ci
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As it stands, cell by cell."""
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__main__"}
    for number, cell in enumerate(cells(notebook)):
        exec(compile(cell, f"{notebook.name}, cell {number}", "exec"), names)
    assert (tmp_path / "room.glb").stat().st_size > 0
