"""The field's terms: homely words are in no name, docstring, comment, message or document."""

from __future__ import annotations

import ast
import io
import re
import subprocess
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent
while not (ROOT / "pyproject.toml").exists():
    ROOT = ROOT.parent

PROSE: dict[str, str] = {
    r"go(?:es)? on|going on|went on": "continue, resume",
    r"asks? for|asked for|asking for": "request, prefetch, need",
    r"anew": "again, restart, recompute",
    r"(?:adds|added) up(?! to)": "accumulate, composite, sum",
    r"held against": "compared with, checked against",
    r"look(?:s|ed|ing)? (?:a scene |a grid )?over": "summarise, compute the occupancy grid",
    r"hand(?:s|ed|ing)? (?:on|over|back)": "pass on, return",
    r"hand(?:s|ed|ing)? (?:\w+ ){1,4}to what it was read from": "scatter-add",
    r"made again": "recomputed",
    r"keep(?:s|ing)? to (?!the\b)[A-Z_]+": "stay within",
    r"(?:is|are) folded|folded (?:in|space|coordinates|box)": "contracted",
    r"what is odd|oddit(?:y|ies)|odd:": "diagnostics, warning",
    r"(?:One|The|one|the) door (?:to|of)|torch door": "entry point, interface",
    r"(?:in|opaque|all|no|thin|dense|denser) matter": "density, medium, surface",
    r"call(?:s|ed)? (?:\w+ ){0,3}off": "cancel",
    r"everyday": "default",
    r"pick(?:s|ed)? out": "select",
    r"put through": "process",
    r"worked out": "compute",
    r"passed over": "skip",
    r"how far the cameras see": "the extent of the scene",
    r"whose turn": "next, scheduled",
    r"odd nothing": "warnings none",
}
"""In docstrings, comments, strings and documents; what to write instead."""

NAMES: dict[str, str] = {
    "but": "replace",
    "but_first": "without_first",
    "behind_limit": "suffix_limit",
    "call_off": "cancel",
    "called_off": "CANCELLED",
    "deliver": "apply_records",
    "everyday": "DEFAULT_PRESETS",
    "fetch_pack": "prefetch_gradient",
    "find_sight": "extent_by_training",
    "folded": "contracted",
    "folded_length": "contracted_length",
    "give_back": "release_free_memory",
    "integral": "RayAccumulator",
    "keep_to": "cull_background",
    "leave_none": "clear_records",
    "lit_of": "active_of",
    "matter": "DensitySample",
    "matter_of": "activate_density",
    "minimised": "objective",
    "oddities": "diagnostics",
    "oddity": "diagnostic",
    "pick_out": "select_rays",
    "seen_extent": "observed_extent",
    "seen_scene": "with_extent",
    "shed": "advance_suffix",
    "sight": "visibility, observed",
    "take_share": "assign_rays",
    "warmed": "CompiledKernel",
    "words_of": "prelude_of",
}
"""Functions, classes, arguments of the package and the kernels, in lower case."""

ALLOWED = {
    ("warpnerf/inspection/inspection.py", "oddities"),  # former names, for one version more
}

DEVICE_WORDS = re.compile(r"\b(?:UP_[1248]|octet|quad|Lit|least\(|most\(|magnitude\()")
"""Of the C++ in the strings of kernels."""


def _pattern(source: str) -> re.Pattern[str]:
    """Of a phrase, which may go over the end of a line; not of a name in code."""
    return re.compile(rf"(?<![\w.`/-])(?:{source.replace(' ', chr(92) + 's+')})(?![\w`])")


PATTERNS = {source: _pattern(source) for source in PROSE}
HOMELY = _pattern("|".join(PROSE))
SUSPECT = re.compile("|".join(PROSE).replace(" ", r"\W+"))
"""Finds all of these and more, in a file as it is."""


def paths() -> list[str]:
    """Files under version control that are read by people: code and documents, no records."""
    listed = ["git", "ls-files", "-z", "*.py", "*.md"]
    done = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=False)
    found = [name for name in done.stdout.split("\0") if name and (ROOT / name).exists()]
    if not found:  # without git
        folders = ("warpnerf", "kernels", "tests", "benchmarks", "examples", "docs")
        files = [p for f in folders for p in (ROOT / f).rglob("*") if p.suffix in (".py", ".md")]
        found = [p.relative_to(ROOT).as_posix() for p in [*files, *ROOT.glob("*.md")]]
    left_out = ("CHANGELOG.md", Path(__file__).name)  # what was; the words themselves
    return [name for name in found if Path(name).name not in left_out]


def prose(name: str, text: str) -> Iterator[tuple[int, str]]:
    """Where something is said, and what: comments, strings, or all of a document."""
    if name.endswith(".md"):
        yield 1, text
        return
    comments: list[tuple[int, str]] = []
    for found in tokenize.generate_tokens(io.StringIO(text).readline):
        if found.type == tokenize.COMMENT:
            line, said = found.start[0], found.string.lstrip("# ")
            if comments and comments[-1][0] + comments[-1][1].count("\n") == line - 1:
                comments[-1] = (comments[-1][0], f"{comments[-1][1]}\n{said}")
            else:
                comments.append((line, said))
    yield from comments
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value


def homely(name: str, text: str) -> Iterator[str]:
    """What in a file should be said otherwise: file:line, the word, and better ones."""
    device = name.startswith("kernels/") and name.endswith(".py")
    if not SUSPECT.search(text) and not (device and DEVICE_WORDS.search(text)):
        return
    for begin, said in prose(name, text):
        for whole in HOMELY.finditer(said):
            source = next(
                one for one, pattern in PATTERNS.items() if pattern.match(said, *whole.span())
            )
            phrase, line = " ".join(whole[0].split()), begin + said[: whole.start()].count("\n")
            yield f"{name}:{line}: {phrase!r}; better: {PROSE[source]}"
        for word in DEVICE_WORDS.findall(said) if device else ():
            yield f"{name}:{begin}: {word!r} in C++; better: see base/simd.py"


def names(name: str, text: str) -> Iterator[str]:
    """Names of functions, classes and arguments that should be others."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
            given = node.name
        elif isinstance(node, ast.arg):
            given = node.arg
        else:
            continue
        better = NAMES.get(given.lower().lstrip("_"))
        if better is not None and (name, given) not in ALLOWED:
            yield f"{name}:{node.lineno}: the name {given!r}; better: {better}"


def test_there_are_files_of_all_kinds() -> None:
    found = paths()
    for start in ("warpnerf/", "kernels/", "tests/", "benchmarks/", "examples/", "docs/", "README"):
        assert any(name.startswith(start) for name in found), start


def test_what_is_said_is_said_in_the_terms_of_the_field() -> None:
    told = [line for name in paths() for line in homely(name, (ROOT / name).read_text())]
    assert not told, f"{len(told)} homely words:\n" + "\n".join(told)


def test_names_are_terms_of_the_field() -> None:
    own = [name for name in paths() if re.match(r"(?:warpnerf|kernels)/.*\.py$", name)]
    told = [line for name in own for line in names(name, (ROOT / name).read_text())]
    assert not told, f"{len(told)} homely names:\n" + "\n".join(told)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('"""Features are added\n    up along the ray."""', "x.py:1: 'added up'; better: acc"),
        ("x = 1\n# a run that\n# goes on\n", "x.py:3: 'goes on'; better: continue"),
        ('raise ValueError(f"{x} is held against y")', "x.py:1: 'held against'; better: comp"),
    ],
)
def test_a_homely_word_is_found(text: str, says: str) -> None:
    (told,) = homely("x.py", text)
    assert told.startswith(says)


def test_a_homely_name_is_found() -> None:
    told = list(
        names("x.py", "def deliver(sight): ...\nclass Matter: ...\ndef looked_at(x): ...\n")
    )
    assert [line.partition(";")[0] for line in sorted(told)] == [
        "x.py:1: the name 'deliver'",
        "x.py:1: the name 'sight'",
        "x.py:2: the name 'Matter'",
    ]


@pytest.mark.parametrize(
    "text",
    [
        "the folder is unfolded; weights add up to 1, and it adds up to three",
        "it does not matter; an odd number of nodes; by hand, on hand; overlooked",
        "`anew` as code; -anew; a.anew; canvas",
    ],
)
def test_other_words_are_not(text: str) -> None:
    assert list(homely("x.md", text)) == []
