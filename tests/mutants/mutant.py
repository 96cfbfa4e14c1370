"""What a mutant is."""

from dataclasses import dataclass
from pathlib import Path

KERNELS = Path("kernels") / "warpnerf_kernels"


@dataclass(frozen=True)
class Mutant:
    """One text replaced in one file of the kernels."""

    name: str
    file: str
    search: str
    replacement: str
    tests: str
    """The file, or the one test in it, that has to notice."""
    occurrence: int = 1
    """Which one, of `of` in all."""
    of: int = 1

    def apply(self, folder: Path) -> None:
        """Change the file in a copy of the repository."""
        path = folder / KERNELS / self.file
        parts = path.read_text().split(self.search)
        if len(parts) - 1 != self.of:
            raise ValueError(
                f"{self.name}: {self.file} holds {self.search!r} {len(parts) - 1} times, "
                f"not {self.of}; bring tests/mutants up to date."
            )
        before = self.search.join(parts[: self.occurrence])
        after = self.search.join(parts[self.occurrence :])
        path.write_text(before + self.replacement + after)
