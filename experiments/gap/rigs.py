"""Rigs of the blind benchmark, each with one effect and parameters a little off the model's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import yaml

from experiments.gap.blind.drivers import rich_excitation
from experiments.gap.blind.rig import Driver, RigRecordings, Rigs
from experiments.gap.driver import CHANNELS
from trms_cli.identification.model_writer import write_model
from trms_cli.models.model import names
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.parameters import ParameterSet
from trms_cli.models.rest import resting_state
from trms_cli.simulation.rollout import Rollout

FloatArray = npt.NDArray[np.float64]

#: Share of the way to its stops that the nominal model may go under an excitation.
_GENTLE = 0.7
INPUTS = ("u_v", "u_h")


@dataclass(frozen=True)
class Rig:
    """A rig and what is hidden in it."""

    effect: str
    sizes: Mapping[str, float]  #: Of the effect; empty for a rig that has none
    seed: int
    parameters: ParameterSet

    @property
    def name(self) -> str:
        return f"{self.effect}-{self.seed}"

    def write_true_model(self, path: Path) -> Path:
        """The rig's parameters with the library's effect at the rig's sizes, as a model file."""
        values = {p.name: {"value": p.value, "unit": p.unit} for p in self.parameters}
        effects = {self.effect: dict(self.sizes)} if self.sizes else {}
        limits = {"u_v": 2.5, "u_h": 2.5, "alpha_v": 1.05, "alpha_h": 2.8}
        document = {"name": self.name, "model": "newtonian", "parameters": values}
        write_model(document | {"limits": limits, "effects": effects}, path)
        return path


def rig_of(effect: str, sizes: Mapping[str, float], seed: int, scatter: float) -> Rig:
    """A rig drawn about the nominal parameters.

    ``scatter``: deviation of the parameters as a share of that of their priors.
    """
    return Rig(effect, sizes, seed, Newtonian().parameters.draw(seed, scatter))


class OwnDraws(np.random.Generator):
    """Draws for a number of rigs, of which some are taken, in any order and more than once.

    A rig then meets the same noise and the same drift whatever commands it and whoever runs beside
    it, and what remains between two runs is what the model did.

    Parameters
    ----------
    seed : int
    places : sequence of int
        Which of the rigs each column is.
    of : int
        Number of rigs that there are.
    """

    def __init__(self, seed: int, places: Sequence[int], of: int) -> None:
        super().__init__(np.random.PCG64(seed))
        self._places, self._of = np.array(places), of

    def _shape(self, size: Any) -> tuple[int, ...]:
        *outer, n = (size,) if isinstance(size, int) else size
        if n != len(self._places):
            raise ValueError(f"draws for {n} rigs, of {len(self._places)}")
        return (*outer, self._of)

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        return super().uniform(low, high, self._shape(size))[..., self._places]

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        # as Generator.normal computes it; ``loc`` and ``scale`` may be those of each column
        return loc + scale * super().standard_normal(self._shape(size))[..., self._places]

    def standard_normal(self, size: Any = None, *_: Any, **__: Any) -> Any:
        return super().standard_normal(self._shape(size))[..., self._places]


def drive_rigs(
    rigs: Sequence[Rig],
    driver: Driver,
    duration: float,
    sample_time: float,
    *,
    among: Sequence[Rig] = (),
    settling: float = 0.0,
    seed: int = 0,
) -> RigRecordings:
    """Drive rigs at once, some of them several times.

    Parameters
    ----------
    duration, sample_time, settling : float
        s; see :meth:`experiments.gap.blind.rig.Rigs.run`.
    among : sequence of Rig
        All rigs there are, each once; with ``seed`` they determine what a rig meets. Empty: those
        given.
    seed : int
        Of noise and drift.
    """
    n = len(rigs)
    constants = {
        name: np.array([rig.parameters[name].value for rig in rigs])
        for name in Newtonian().parameters.names
    }
    sizes: dict[str, FloatArray] = {}
    for i, rig in enumerate(rigs):
        for size, value in rig.sizes.items():
            sizes.setdefault(f"{rig.effect}.{size}", np.zeros(n))[i] = value
    rig_names = [rig.name for rig in among or rigs]
    # numpy takes a generator where it takes a seed
    random = cast(int, OwnDraws(seed, [rig_names.index(rig.name) for rig in rigs], len(rig_names)))
    return Rigs(constants, sizes, seed=random).run(driver, duration, sample_time, settling)


def gentle_excitation(seed: int, duration: float, sample_time: float) -> FloatArray:
    """The benchmark's rich excitation, drawn until the nominal model stays far from its stops.

    What a lab does before it lets commands loose on a rig.

    Returns (samples, 2) array; V.
    """
    model, samples = Newtonian(), round(duration / sample_time)
    rollout = Rollout(model, sample_time)
    angles = [names(model.outputs).index(name) for name in CHANNELS[:2]]
    stops = np.array([model.stops[name] for name in CHANNELS[:2]])
    for attempt in range(100):
        commands = rich_excitation([1000 * seed + attempt], samples, sample_time)[0]
        start = rollout.initial(resting_state(model, {}, commands[0]), commands[0])
        y = rollout.outputs(commands, [0], [samples], start[None]).y[:, angles]
        if np.all(np.abs(y) < _GENTLE * stops):
            return commands
    raise ValueError(f"no excitation of {duration} s stays inside the stops")


def write_csv(recorded: RigRecordings, rig: int, path: Path) -> Path:
    """One rig's recording as a laboratory writes it."""
    units = dict(zip((*INPUTS, *CHANNELS), ("V", "V", "rad", "rad", "rad/s", "rad/s"), strict=True))
    head = ",".join(["t[s]", *(f"{name}[{unit}]" for name, unit in units.items())])
    table = np.column_stack([recorded.time, recorded.commands[rig], recorded.measured[rig]])
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=head, comments="")
    return path


def read_study(path: Path | None = None) -> dict[str, Any]:
    """The study's settings."""
    path = path or Path(__file__).with_name("closing_loop.yaml")
    content: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return content
