"""Options of a configuration folder: a YAML of a stranger, composed and built."""

from collections.abc import Iterator
from pathlib import Path


def seeds(folder: Path) -> Iterator[bytes]:
    """Options that travel with the program, and some words of Hydra."""
    from trms_cli.core.resources import config_folder

    for name in ("pid", "open_loop", "lqr"):
        yield (config_folder() / "controller" / f"{name}.yaml").read_bytes()
    yield b"# @package _global_\ndefaults:\n  - override /ref: sine\nseed: ${sim.duration}\n"
    yield b"defaults: [pid, _self_]\nx: &a [1, 2]\ny: *a\nz: ${oc.env:HOME}\n"


def read(data: bytes, folder: Path) -> None:
    """The composed experiment, shown and built as far as its controller."""
    from trms_cli.composition.composer import compose
    from trms_cli.core.plugins import build

    options = folder / "configs"
    (options / "controller").mkdir(parents=True, exist_ok=True)
    (options / "controller" / "fuzzed.yaml").write_bytes(data)
    composition = compose(["--config-dir", str(options), "controller=fuzzed"])
    composition.yaml  # noqa: B018
    build(composition.config["controller"], "controller")
