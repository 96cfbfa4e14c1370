"""The import graph and the order of device functions, read off the sources."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
KERNELS = sorted((ROOT / "kernels" / "warpnerf_kernels").rglob("*.py"))
PACKAGE = sorted((ROOT / "warpnerf").rglob("*.py"))
ORACLE = sorted((ROOT / "tests" / "reference").glob("*.py"))


def module_of(path: Path) -> str:
    root = ROOT / "kernels" if path.is_relative_to(ROOT / "kernels") else ROOT
    parts = list(path.relative_to(root).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def modules() -> dict[str, Path]:
    return {module_of(path): path for path in (*KERNELS, *PACKAGE)}


def imports(path: Path, inside_functions: bool = True) -> Iterator[str]:
    """Absolute names of what a file imports, each name of a from-import with its module."""
    module = module_of(path)
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in nodes(ast.parse(path.read_text()), inside_functions):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")
                base = ".".join([*parents[: len(parents) - node.level + 1], *base.split(".")])
                base = base.rstrip(".")
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)


def nodes(tree: ast.AST, inside_functions: bool) -> Iterator[ast.AST]:
    """All nodes; without functions' bodies and what only type checkers see, if so wished."""
    for node in ast.iter_child_nodes(tree):
        if not inside_functions and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if (
            not inside_functions
            and isinstance(node, ast.If)
            and "TYPE_CHECKING" in ast.unparse(node.test)
        ):
            continue
        yield node
        yield from nodes(node, inside_functions)


def roots(path: Path) -> set[str]:
    return {name.split(".")[0] for name in imports(path)}


def test_there_is_something_to_look_at() -> None:
    assert len(KERNELS) > 10 and len(PACKAGE) > 15 and len(ORACLE) > 4
    assert "warpnerf_kernels.base.types" in set(
        imports(ROOT / "kernels/warpnerf_kernels/launch/packed.py")
    )
    assert "torch" in roots(ROOT / "warpnerf/torch/rendering.py")


@pytest.mark.parametrize("path", KERNELS, ids=lambda path: path.name)
def test_device_code_knows_no_host(path: Path) -> None:
    assert not roots(path) & {"warpnerf", "numpy", "torch", "tests", "benchmarks"}


@pytest.mark.parametrize("path", KERNELS, ids=lambda path: path.name)
def test_device_code_imports_itself_by_relative_names(path: Path) -> None:
    """Else its float64 copy would mix with the float32 one."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            assert node.module is not None and not node.module.startswith("warpnerf_kernels")
        if isinstance(node, ast.Import):
            assert not any(alias.name.startswith("warpnerf_kernels") for alias in node.names)


TORCH = ROOT / "warpnerf" / "torch"
JAX = ROOT / "warpnerf" / "jax"
LPIPS = ROOT / "warpnerf" / "evaluation" / "lpips.py"
"""A network with weights of others: torch is imported inside its functions, when it is used."""


@pytest.mark.parametrize("path", PACKAGE, ids=module_of)
def test_the_package_knows_no_tests_and_frameworks_in_their_places_only(path: Path) -> None:
    assert not roots(path) & {"tests", "benchmarks"}
    assert "torch" not in roots(path) or TORCH in path.parents or path == LPIPS
    assert "jax" not in roots(path) or JAX in path.parents
    if TORCH not in path.parents:
        outside = set(imports(path, inside_functions=False))
        assert not outside & {
            *("torch", "warpnerf.torch", "warpnerf.evaluation.lpips", "warpnerf.jax"),
        }


@pytest.mark.parametrize("path", ORACLE, ids=lambda path: path.name)
def test_the_oracle_shares_no_code(path: Path) -> None:
    assert not roots(path) & {"warpnerf", "warpnerf_kernels", "warp"}


def test_no_circle_of_imports() -> None:
    known = modules()
    graph = {
        module: {name for name in imports(path, inside_functions=False) if name in known} - {module}
        for module, path in known.items()
    }
    done: set[str] = set()

    def visit(module: str, above: tuple[str, ...]) -> None:
        assert module not in above, " -> ".join((*above, module))
        if module not in done:
            for below in sorted(graph[module]):
                visit(below, (*above, module))
            done.add(module)

    for module in graph:
        visit(module, ())
    assert done == set(known)


def layers_of(document: str) -> dict[str, int]:
    """The table under "Layers" in ARCHITECTURE.md: the number of the layer of each name in it."""
    section = document.split("\n## Layers\n")[1].split("\n## ")[0]
    layers: dict[str, int] = {}
    for row in re.findall(r"^\|[^|\n]*\| *`[^|\n]*\|", section, re.MULTILINE):
        number, names = row.strip("|").split("|")
        assert int(number) == len(set(layers.values())) + 1, f"layer {number} is out of order"
        for name in re.findall(r"`([^`]+)`", names):
            assert name not in layers, f"{name} is in two layers"
            layers[name] = int(number)
    return layers


def layer_of(module: str, layers: dict[str, int]) -> int | None:
    """A module's own layer, or else that of the nearest folder around it that has one: `a.b.*`."""
    if module in layers:
        return layers[module]
    while module:
        if f"{module}.*" in layers:
            return layers[f"{module}.*"]
        module = module.rpartition(".")[0]
    return None


LAYERS = layers_of((ROOT / "ARCHITECTURE.md").read_text())


def test_layers_are_read_as_they_are_written() -> None:
    table = "\n## Layers\n\n| | names | |\n|---|---|---|\n"
    table += "| 1 | `a.base.*`, `a` | x |\n| 2 | `a.*` | y |\n\n## Next\n| 3 | `b` | |\n"
    layers = layers_of(table)
    assert layers == {"a.base.*": 1, "a": 1, "a.*": 2}
    assert layer_of("a", layers) == layer_of("a.base", layers) == layer_of("a.base.x", layers) == 1
    assert layer_of("a.other.x", layers) == 2
    assert layer_of("b", layers) is None and layer_of("ab.x", layers) is None
    with pytest.raises(AssertionError, match="two layers"):
        layers_of(table.replace("`a.*`", "`a.*`, `a`"))


def test_layers_list_every_module_and_nothing_else() -> None:
    known = modules()
    unlisted = [module for module in known if layer_of(module, LAYERS) is None]
    assert not unlisted, f"list these in ARCHITECTURE.md, under Layers: {unlisted}"
    stale = [name for name in LAYERS if name.removesuffix(".*") not in known]
    assert not stale, f"ARCHITECTURE.md lists layers of what does not exist: {stale}"
    assert len(set(LAYERS.values())) > 10


@pytest.mark.parametrize("path", (*KERNELS, *PACKAGE), ids=module_of)
def test_imports_point_down_or_stay_within_a_layer(path: Path) -> None:
    known = modules()
    own = layer_of(module_of(path), LAYERS)
    assert own is not None
    for name in sorted(set(imports(path)) & set(known)):
        below = layer_of(name, LAYERS)
        assert below is not None and below <= own, (
            f"{module_of(path)} is in layer {own} and imports {name} of layer {below}"
        )


def forward_of(name: str, names: list[str]) -> str | None:
    """What a function is the adjoint of: adj_x of x, x_backward of x_forward."""
    if name.startswith("adj_"):
        return name.removeprefix("adj_")
    if "backward" in name:
        return name.replace("backward", "forward")
    inner = name.replace("_adj_", "_", 1)  # pack_adj_x of pack_x; others only contain the word
    return inner if inner != name and inner in names else None


def adjoints(source: str) -> list[tuple[str, bool]]:
    """All adjoints in a module, and whether each stands directly below its forward function.

    Vector forms and native functions are functions like others: adj_x_pack stands below x_pack.
    Overloads follow each other. x_slope may stand between x and adj_x. Functions inside functions
    are looked at, too, except inside an adjoint.
    """
    found: list[tuple[str, bool]] = []

    def look(scope: ast.AST) -> None:
        children = list(ast.iter_child_nodes(scope))
        names = [child.name for child in children if isinstance(child, ast.FunctionDef)]
        above: list[str] = []  # functions so far, overloads as one
        for child in children:
            if not isinstance(child, ast.FunctionDef):
                look(child)
                continue
            name = child.name
            forward = forward_of(name, names)
            if forward is None:
                look(child)
            elif above[-1:] != [name]:
                before = above[:-1] if above[-1:] == [f"{forward}_slope"] else above
                found.append((name, before[-1:] == [forward]))
            if above[-1:] != [name]:
                above.append(name)

    look(ast.parse(source))
    return found


def stubs(*names: str) -> str:
    return "".join(f"def {name}(): ...\n" for name in names)


def test_a_misplaced_adjoint_is_seen() -> None:
    def right(*names: str) -> list[bool]:
        return [in_place for _, in_place in adjoints(stubs(*names))]

    assert right("x", "adj_x", "x_pack", "adj_x_pack", "pack_x", "pack_adj_x") == [True] * 3
    assert right("x", "x_slope", "adj_x") == right("x", "x", "adj_x", "adj_x") == [True]
    assert right("x_forward_kernel", "x_backward_kernel") == right("forward", "backward") == [True]
    assert right("x", "y", "adj_x") == right("adj_x", "x") == right("adj_x") == [False]
    assert right("x", "x_pack", "adj_x", "adj_x_pack") == [False, False]
    assert right("pack_x", "y", "pack_adj_x") == [False]
    assert right("x", "begin_adj_walk") == []
    inside = "class Part:\n    def make():\n        def x(): ...\n"
    assert adjoints(inside + "        def adj_x(): ...\n") == [("adj_x", True)]
    assert adjoints(inside + "        y = 1\n    def adj_x(): ...\n") == [("adj_x", False)]
    native = '@wp.func_native("code")\ndef x(): ...\n' * 2
    assert adjoints(native + native.replace("x()", "adj_x()")) == [("adj_x", True)]


def test_every_adjoint_stands_below_its_forward() -> None:
    seen = []
    for path in KERNELS:
        for name, in_place in adjoints(path.read_text()):
            assert in_place, f"{path.name}: {name} does not stand directly below what it belongs to"
            seen.append(name)
    assert len(seen) >= 10 and {"adj_gather", "adj_composite", "render_backward_kernel"} <= {*seen}


def bodies(source: str) -> list[tuple[str, bool]]:
    """Constants named ADJ_X, the C++ of an adjoint, and whether each stands directly below X."""
    names = [
        node.targets[0].id
        for node in ast.parse(source).body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    ]
    return [
        (name, at > 0 and names[at - 1] == name.removeprefix("ADJ_"))
        for at, name in enumerate(names)
        if name.startswith("ADJ_")
    ]


def test_the_code_of_every_adjoint_stands_below_that_of_its_forward() -> None:
    assert bodies("X = 1\nADJ_X = 2") == [("ADJ_X", True)]
    assert bodies("X = 1\nY = 1\nADJ_X = 2") == bodies("ADJ_X = 2\nX = 1") == [("ADJ_X", False)]
    found = []
    for path in KERNELS:
        for name, in_place in bodies(path.read_text()):
            assert in_place, f"{path.name}: {name} does not stand directly below what it belongs to"
            found.append(name)
    assert {"ADJ_SHADE_ROWS", "ADJ_COMPOSITE", "ADJ_DECODE_PACK"} <= {*found}


MOST_ARGUMENTS = 10
"""Of a function, without self and cls; those that belong together are a struct or a dataclass."""


def functions(source: str) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def arguments(function: ast.FunctionDef | ast.AsyncFunctionDef) -> list[ast.arg]:
    """All of a function's, but for self and cls."""
    given = function.args
    found = [*given.posonlyargs, *given.args, *given.kwonlyargs]
    return found[1:] if found and found[0].arg in ("self", "cls") else found


@pytest.mark.parametrize("path", (*KERNELS, *PACKAGE), ids=module_of)
def test_functions_have_few_arguments(path: Path) -> None:
    for function in functions(path.read_text()):
        assert len(arguments(function)) <= MOST_ARGUMENTS, function.name


GROUPS = ("launch", "scene", "rays", "choices", "out")
"""Of a kernel's arguments, in this order; one that has no argument is left out. They are which
items a launch is for, and whose scratch; what all items share; what a ray has, or a point; numbers;
what is written, scratch included."""


def groups(source: str) -> Iterator[tuple[str, dict[str, str]]]:
    """The kernels of a module: name, and arguments with the comment that each is under."""
    lines = source.splitlines()
    for function in functions(source):
        if not any("wp.kernel" in ast.unparse(d) for d in function.decorator_list):
            continue
        found, group = {}, ""
        starts = {argument.lineno: argument.arg for argument in arguments(function)}
        for number in range(function.lineno, function.body[0].lineno):
            text = lines[number - 1].strip()
            if text.startswith("# "):
                group = text.removeprefix("# ")
            elif number in starts:
                found[starts[number]] = group
        yield function.name, found


def problem_of_groups(found: dict[str, str]) -> str:
    """What is wrong with the groups of a kernel's arguments; nothing is empty."""
    order = list(dict.fromkeys(found.values()))
    if not set(order) <= set(GROUPS):
        return f"groups are {GROUPS}, not {order}"
    places = [GROUPS.index(group) for group in found.values()]
    if places != sorted(places):
        return f"groups stand in the order {GROUPS}"
    if order[0] != "launch" or order[-1] != "out":
        return "a kernel begins with its launch and ends with what it writes"
    for name, group in found.items():
        if (name in ("first", "worker", "span", "n_rays")) != (group == "launch"):
            return f"{name} is in the group {group}"
        if name.startswith("out") and group != "out":
            return f"{name} is written, and so belongs to the group out"
    return ""


def test_arguments_of_kernels_stand_in_groups() -> None:
    def kernel(*names: str) -> dict[str, str]:
        text = "".join(f"    {n}\n" if n.startswith("#") else f"    {n}: int,\n" for n in names)
        ((_, found),) = groups(f"@wp.kernel\ndef k(\n{text}):\n    pass\n")
        return found

    good = ("# launch", "first", "# scene", "box", "# out", "out_x")
    assert kernel(*good) == {"first": "launch", "box": "scene", "out_x": "out"}
    assert not problem_of_groups(kernel(*good))
    assert "begins with" in problem_of_groups(kernel(*good[:4]))
    assert "groups are" in problem_of_groups(kernel("first", *good[2:]))
    assert "order" in problem_of_groups(kernel(*good[:2], *good[4:], *good[2:4]))
    assert "span is in" in problem_of_groups(kernel(*good[:4], "span", *good[4:]))
    assert "out_y is written" in problem_of_groups(kernel(*good[:4], "out_y", *good[4:]))
    seen = []
    for path in KERNELS:
        for name, found in groups(path.read_text()):
            assert not problem_of_groups(found), f"{path.name}: {name}: {problem_of_groups(found)}"
            seen.append(name)
    assert len(seen) >= 20 and {"render_train", "sample_pixels", "adam_step"} <= {*seen}


DOCUMENTS = [ROOT / f"{folder}/README.md" for folder in ("kernels", "benchmarks", "examples")]
DOCUMENTS += sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


def anchors(document: Path) -> set[str]:
    """What links may name after #, as GitHub makes it of headings."""
    headings = re.findall(r"^#+ (.*)$", document.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_documents_name_what_exists(document: Path) -> None:
    """Links, their anchors, and Python files, as much of their path as is written."""
    text = document.read_text()
    for link, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", text):
        if "://" in link:
            continue
        target = document.parent / link if link else document
        assert target.exists(), f"link to {link}"
        assert not anchor or anchor in anchors(target), f"link to {link}#{anchor}"
    folders = ("kernels", "warpnerf", "tests", "benchmarks", "examples")
    files = [f"/{p.relative_to(ROOT)}" for folder in folders for p in (ROOT / folder).rglob("*.py")]
    for named in set(re.findall(r"[\w/]+\.py\b", text)):
        assert any(file.endswith(f"/{named}") for file in files), f"{named} does not exist"


def test_gradients_are_host_words_and_adjoints_device_words() -> None:
    for path in KERNELS:
        assert not re.search(r"\bgrad_\w+|\w+_grad\b", path.read_text()), path.name
    for path in PACKAGE:
        assert "adj_" not in path.read_text() or path.parent == TORCH, path.name


def test_one_marching_loop() -> None:
    """Both passes take their samples from next_sample; nothing else asks where a step lies."""
    asking = []
    for path in KERNELS:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and "interval_of(" in ast.unparse(node):
                asking.append(node.name)
    assert asking == ["traversal", "next_sample"]  # which is a function of the former
