"""Each page of docs/decisions has what a reader looks for, and the index lists it as it is."""

import re
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "docs" / "decisions"
INDEX = (FOLDER / "README.md").read_text()
PAGES = sorted(path for path in FOLDER.glob("*.md") if path.name != "README.md")


def test_the_index_lists_every_page() -> None:
    assert sorted(re.findall(r"\]\(([\w-]+\.md)\)", INDEX)) == [page.name for page in PAGES]
    assert len(PAGES) > 20


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_has_its_parts(page: Path) -> None:
    text = page.read_text()
    head = re.match(r"# (.+)\n\n- Status: (.+)\n- Date: (\d{4}-\d\d-\d\d)\n\n## Decision\n", text)
    assert head
    title, status, date = head.groups()
    assert f"| [{title}]({page.name}) | {status} | {date} |" in INDEX
    parts = re.split(r"^## (.+)\n", text, flags=re.MULTILINE)
    assert parts[1::2] == ["Decision", "Evidence", "Dropped"]
    assert all(len(part.split()) > 2 for part in parts[2::2])
    assert re.search(r"`python\s|figures", parts[4]), "evidence has a command, or says why not"
    assert "```" not in text and not re.search(r"^    \S", text, re.MULTILINE), "no code, in prose"
