"""The device code in another precision: the same files, imported once more."""

import importlib
import importlib.util
import sys
from functools import cache
from pathlib import Path
from types import ModuleType


@cache
def load(precision: str, module: str) -> ModuleType:
    """A module of the package, such as "launch.assembly", in "float32" or "float64".

    float64 is for checking gradients and for torch users: types.py reads the package's name, and
    all imports inside the package are relative, so a second package of the same files under another
    name is the whole mechanism.
    """
    name = __package__.partition(".")[0]
    if precision == "float64":
        name = "warpnerf_kernels_float64"
        if name not in sys.modules:
            folder = Path(__file__).parent.parent
            spec = importlib.util.spec_from_file_location(
                name, folder / "__init__.py", submodule_search_locations=[str(folder)]
            )
            package = importlib.util.module_from_spec(spec)
            sys.modules[name] = package
            spec.loader.exec_module(package)
    elif precision != "float32":
        raise ValueError(f'precision must be "float32" or "float64", not {precision!r}')
    return importlib.import_module(f"{name}.{module}")
