"""docs/benchmarks.md is what benchmarks/write_docs.py writes, and all its figures are records'."""

import ast
import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

import page_evidence  # noqa: E402
import page_jobs  # noqa: E402
import page_quality  # noqa: E402
import write_docs  # noqa: E402

NAMES = sorted(path.stem.removesuffix("_cpu") for path in write_docs.RESULTS.glob("*.json"))


def test_the_page_is_what_the_script_writes() -> None:
    written = write_docs.page()
    assert write_docs.PAGE.read_text() == written, "run python benchmarks/write_docs.py"
    assert written.count("\n") < 280


def test_every_record_is_on_the_page_and_is_a_scripts() -> None:
    """One that is on no page is one of which nobody knows that it is there."""
    linked = set(re.findall(r"results/(\w+)_cpu\.json", write_docs.page()))
    assert linked == set(NAMES) and len(NAMES) > 20
    for name in NAMES:
        record = json.loads((write_docs.RESULTS / f"{name}_cpu.json").read_text())
        script = record["machine"]["command"].split()[1]
        assert (ROOT / script).is_file() and name.startswith(Path(script).stem)


def changed(value: Any) -> Any:
    """The same with other figures; counts, which are whole, stay."""
    if isinstance(value, dict):
        return {key: changed(one) for key, one in value.items()}
    if isinstance(value, list):
        return [changed(one) for one in value]
    return 1.5 * value if isinstance(value, float) else value


@pytest.mark.parametrize("name", NAMES)
def test_another_record_is_another_page(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "results"
    shutil.copytree(write_docs.RESULTS, folder)
    path = folder / f"{name}_cpu.json"
    path.write_text(json.dumps(changed(json.loads(path.read_text()))))
    assert write_docs.page(folder) != write_docs.page()


def written_by_hand(source: str) -> list[str]:
    """Strings with figures in a module, besides docstrings, keys and how numbers are formatted."""
    tree = ast.parse(source)
    formats = {
        id(part)
        for node in ast.walk(tree)
        if isinstance(node, ast.FormattedValue) and node.format_spec
        for part in ast.walk(node.format_spec)
    }
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    keys = {id(node.slice) for node in ast.walk(tree) if isinstance(node, ast.Subscript)}
    return [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and id(node) not in formats | docstrings | keys
        and re.search(r"\d", node.value)
    ]


def test_no_figure_is_written_by_hand() -> None:
    assert written_by_hand('"""1"""\nx = f"{y:.2f} dB"\nz = w["5_cm"]') == []
    assert written_by_hand('x = f"{y:.2f} after 9 s"') == [" after 9 s"]
    for module in (write_docs, page_evidence, page_jobs, page_quality):
        assert written_by_hand(Path(module.__file__).read_text()) == []
