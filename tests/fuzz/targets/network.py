"""Network files: trained models of which no equation is known."""

from collections.abc import Iterator
from pathlib import Path


def seeds(folder: Path) -> Iterator[bytes]:
    """A network of one axis, as it travels with the program."""
    from trms_cli.core.resources import config_folder

    yield (config_folder() / "networks" / "narx_vertical.yaml").read_bytes()


def read(data: bytes, folder: Path) -> None:
    """The network and its model."""
    from trms_cli.models.narx_file import narx

    path = folder / "network.yaml"
    path.write_bytes(data)
    narx(network=str(path))
