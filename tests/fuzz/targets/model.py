"""Model files: parameters, fitted models, models with effects, networks."""

from collections.abc import Iterator
from pathlib import Path


def seeds(folder: Path) -> Iterator[bytes]:
    """Sets that travel with the program, and a corrected model."""
    from trms_cli.core.resources import config_folder

    for name in ("bench", "tras"):
        yield (config_folder() / "parameters" / f"{name}.yaml").read_bytes()
    bench = (config_folder() / "parameters" / "bench.yaml").read_bytes()
    yield bench + b"effects:\n  yaw_coulomb_friction: {torque: 0.004}\n"
    own = b"effects:\n  own: {_target_: trms_cli.effects.input_delay.InputDelay, delay: 0.05}\n"
    yield bench + own


def read(data: bytes, folder: Path) -> None:
    """The model of the file."""
    from trms_cli.effects.model_file import load_model

    path = folder / "model.yaml"
    path.write_bytes(data)
    load_model(str(path))
