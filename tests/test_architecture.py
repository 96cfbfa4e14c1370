"""The import graph and the order of device functions, read off the sources."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
KERNELS = sorted((ROOT / "kernels" / "warpnerf_kernels").glob("*.py"))
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
    assert "warpnerf_kernels.types" in set(imports(ROOT / "kernels/warpnerf_kernels/render.py"))
    assert "torch" in roots(ROOT / "warpnerf/torch.py")


@pytest.mark.parametrize("path", KERNELS, ids=lambda path: path.name)
def test_device_code_knows_no_host(path: Path) -> None:
    assert not roots(path) & {"warpnerf", "numpy", "torch", "tests", "benchmarks", "reference"}


@pytest.mark.parametrize("path", KERNELS, ids=lambda path: path.name)
def test_device_code_imports_itself_by_relative_names(path: Path) -> None:
    """Else its float64 copy would mix with the float32 one."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            assert node.module is not None and not node.module.startswith("warpnerf_kernels")
        if isinstance(node, ast.Import):
            assert not any(alias.name.startswith("warpnerf_kernels") for alias in node.names)


TORCH = ROOT / "warpnerf" / "torch.py"
LPIPS = ROOT / "warpnerf" / "lpips.py"
"""A network with weights of others: torch is imported inside its functions, when it is used."""


@pytest.mark.parametrize("path", PACKAGE, ids=module_of)
def test_the_package_knows_no_tests_and_torch_in_two_files_only(path: Path) -> None:
    assert not roots(path) & {"tests", "benchmarks", "reference", "drive"}
    assert "torch" not in roots(path) or path in (TORCH, LPIPS)
    if path != TORCH:
        outside = set(imports(path, inside_functions=False))
        assert not outside & {"torch", "warpnerf.torch", "warpnerf.lpips"}


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


FLOORS = [
    {"types"},
    {"tiles"},
    {"interp", "activation", "contraction", "march", "gradscale", "loss"},
    {"integral", "vectors"},
    {"packs", "order"},
    {"parcels"},
    {"integral_packed"},
    {"render", "regularize", "adam", "occupancy", "camera", "precision", "probe"},
]


def test_floors_of_device_code() -> None:
    floor = {name: level for level, names in enumerate(FLOORS) for name in names}
    for path in KERNELS:
        if path.stem == "__init__":
            continue
        for name in imports(path):
            below = name.removeprefix("warpnerf_kernels.")
            if below in floor and below != path.stem:
                assert floor[below] <= floor[path.stem], f"{path.stem} imports {below}"


def test_every_adjoint_stands_below_its_forward() -> None:
    """`adj_x` follows `x`, `x_backward` follows `x_forward`; a slope may stand between."""
    adjoints = 0
    for path in KERNELS:
        tree = ast.parse(path.read_text())
        names = [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]
        for index, name in enumerate(names):
            forward = None
            if name.startswith("adj_"):
                forward = name.removeprefix("adj_")
            elif "_backward" in name:
                forward = name.replace("_backward", "_forward")
            if forward is None:
                continue
            adjoints += 1
            before = names[index - 1]
            if before == f"{forward}_slope":
                before = names[index - 2]
            assert before == forward, f"{path.name}: {name} does not stand below {forward}"
    assert adjoints >= 8


def test_gradients_are_host_words_and_adjoints_device_words() -> None:
    for path in KERNELS:
        assert not re.search(r"\bgrad_\w+|\w+_grad\b", path.read_text()), path.name
    for path in PACKAGE:
        assert "adj_" not in path.read_text() or path.name == "torch.py", path.name


def test_one_marching_loop() -> None:
    """Both passes take their samples from next_sample; nothing else asks where a step begins."""
    source = (ROOT / "kernels/warpnerf_kernels/integral.py").read_text()
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef) and "step_length(" in ast.unparse(node):
            assert node.name == "next_sample"
