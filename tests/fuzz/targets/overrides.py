"""What is typed: overrides, one a line."""

from collections.abc import Iterator
from pathlib import Path


def seeds(folder: Path) -> Iterator[bytes]:
    """Lines of the documentation."""
    yield b"controller=pid\nref=square\nsim.duration=1\nseed=3"
    yield b"effect=[yaw_coulomb_friction,input_delay]\nplant.parameters.k_g=0.05\n+ref.x=1"
    yield b"signal@ref.alpha_v=sine\n~effect\nout='a b'\nmodel=newtonian\n--cfg=job"
    yield b"hydra.run.dir=x\nhydra/launcher=joblib\n++a.b=${oc.env:HOME}\nref=sine,square"


def read(data: bytes, folder: Path) -> None:
    """The composed experiment."""
    from trms_cli.composition.composer import compose

    compose(data.decode("utf-8", "replace").split("\n"))
