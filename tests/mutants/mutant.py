"""What a mutant is."""

from dataclasses import dataclass
from pathlib import Path

KERNELS = Path("kernels") / "warpnerf_kernels"
HOST = Path("warpnerf")


@dataclass(frozen=True)
class Mutant:
    """One text replaced in one file."""

    name: str
    file: str
    search: str
    replacement: str
    tests: str
    """The file, or the one test in it, that has to notice."""
    occurrence: int = 1
    """Which one, of `of` in all."""
    of: int = 1
    root: Path = KERNELS
    """The package that the file is in."""

    @property
    def path(self) -> Path:
        """Of the file, in a copy of the repository."""
        return self.root / self.file

    @property
    def marks(self) -> str:
        """Which tests may notice, as pytest selects them: of the host, those that CI runs."""
        return "" if self.root == KERNELS else "not slow"

    def apply(self, folder: Path) -> None:
        """Change the file in a copy of the repository."""
        path = folder / self.path
        parts = path.read_text().split(self.search)
        if len(parts) - 1 != self.of:
            raise ValueError(
                f"{self.name}: {self.path} holds {self.search!r} {len(parts) - 1} times, "
                f"not {self.of}; bring tests/mutants up to date."
            )
        before = self.search.join(parts[: self.occurrence])
        after = self.search.join(parts[self.occurrence :])
        path.write_text(before + self.replacement + after)


def of_host(
    name: str,
    file: str,
    search: str,
    replacement: str,
    tests: str,
    occurrence: int = 1,
    of: int = 1,
) -> Mutant:
    """One in a file of the package warpnerf, which compiles nothing again."""
    return Mutant(name, file, search, replacement, tests, occurrence, of, HOST)
