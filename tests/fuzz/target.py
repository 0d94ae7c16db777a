"""What a fuzzing target is, and which there are."""

import importlib
import pkgutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from tests.fuzz import targets
from trms_cli.core.errors import TrmsError

CORPUS = Path(__file__).parent / "corpus"


@dataclass(frozen=True)
class Target:
    """One reader under attack."""

    name: str  #: Of its module
    #: Of :mod:`tests.fuzz.targets`: it has ``seeds(folder)``, which yields inputs that the reader
    #: takes, and ``read(data, folder)``, which has the reader read one
    module: ModuleType

    @property
    def about(self) -> str:
        """The reader, in a line."""
        return (self.module.__doc__ or "").splitlines()[0]

    def seeds(self, folder: Path) -> list[bytes]:
        """Inputs to begin with: what the program writes itself, and what was found before."""
        return [*self.module.seeds(folder), *(path.read_bytes() for path in self.kept())]

    def kept(self) -> list[Path]:
        """Inputs that once broke the reader."""
        folder = CORPUS / self.name
        return sorted(folder.iterdir()) if folder.is_dir() else []

    def read(self, data: bytes, folder: Path) -> TrmsError | None:
        """Have the reader read; returns its complaint, and lets any other failure through."""
        try:
            self.module.read(data, folder)
        except TrmsError as error:
            return error
        return None


def all_targets() -> Iterator[Target]:
    """Every target, by name."""
    for found in pkgutil.iter_modules(targets.__path__):
        yield Target(found.name, importlib.import_module(f"{targets.__name__}.{found.name}"))
