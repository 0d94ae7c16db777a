"""A rig of the blind sets as a plant: nothing of the models but the values of the parameters.

The equations, the integrator, the friction by bristles and the nuisances are those of
:mod:`experiments.gap.blind.rig`. As an option of ``trms run`` and ``trms rig serve``:
``--config-dir experiments/chapter7/configs plant=blind_rig``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.gap.blind.rig import COMMAND_LIMIT, Nuisances, Rigs, RigsInMotion
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.models.model import Signal
from trms_cli.models.newtonian import Newtonian
from trms_cli.plants.disturbance import ScheduledDisturbance
from trms_cli.plants.envelope import Envelope
from trms_cli.plants.landing import Landing
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.sensors import Sensors

FloatArray = npt.NDArray[np.float64]
#: Equations on which torques can act, in the order of the rig's.
_EQUATIONS = ("pitch_moment", "yaw_moment")


@dataclass(frozen=True, kw_only=True)
class BlindRig:
    """One rig."""

    prior_seed: int = 7  #: Draws all parameters from their priors
    prior_scale: float = 1.0  #: Multiplies the priors' standard deviations
    #: Of effects by name, in the units of the blind sets
    sizes: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    nuisances: Mapping[str, float] = field(default_factory=dict)  #: That differ from the usual
    disturbances: Mapping[str, ScheduledDisturbance] = field(default_factory=dict)
    sensors: Sensors = field(default_factory=Sensors)  #: What is declared of the readings
    landing: Landing = field(default_factory=lambda: Landing(after_run=False))
    envelope: Envelope = field(default_factory=Envelope)

    def __post_init__(self) -> None:
        for name, disturbance in self.disturbances.items():
            words = f"nothing can push on {disturbance.equation!r} of a blind rig"
            where = f"plant.disturbances.{name}.equation"
            require_known(disturbance.equation, _EQUATIONS, words, where)
            if disturbance.known:
                raise ConfigurationError(
                    "a blind rig measures no torque",
                    where=f"plant.disturbances.{name}.known",
                    remedy="known: false",
                )
        for name in self.nuisances:
            words = f"there is no nuisance {name!r}"
            require_known(name, tuple(vars(Nuisances())), words, f"plant.nuisances.{name}")

    def init(self, setup: PlantSetup) -> BlindRun:
        """The rig at time zero, hanging at rest."""
        return BlindRun(self, setup, RigsSideBySide([self], [setup]), 0)

    def torques(self, setup: PlantSetup) -> FloatArray:
        """External torques on pitch and yaw at each sample, (samples, 2), N m."""
        times = np.arange(setup.samples, dtype=np.float64) * setup.sample_time
        torques = np.zeros((setup.samples, len(_EQUATIONS)))
        for disturbance in self.disturbances.values():
            torques[:, _EQUATIONS.index(disturbance.equation)] += disturbance.torque.sample(times)
        return torques


class RigsSideBySide:
    """Rigs that are integrated together: many cost what one costs.

    Each has random numbers of its own, so that a rig meets the same whoever stands beside it.
    """

    def __init__(self, rigs: Sequence[BlindRig], setups: Sequence[PlantSetup]) -> None:
        parameters = [Newtonian().parameters.draw(r.prior_seed, r.prior_scale) for r in rigs]
        n = len(rigs)
        sizes: dict[str, FloatArray] = {}
        for i, rig in enumerate(rigs):
            for effect, own_sizes in rig.sizes.items():
                for name, size in own_sizes.items():
                    sizes.setdefault(f"{effect}.{name}", np.zeros(n))[i] = size
        nuisances: dict[str, FloatArray] = {}
        for i, rig in enumerate(rigs):
            for name, value in rig.nuisances.items():
                usual = np.full(n, getattr(Nuisances(), name), dtype=float)
                nuisances.setdefault(name, usual)[i] = value
        rigs_of_all = Rigs(
            {name: np.array([p[name].value for p in parameters]) for name in parameters[0].names},
            sizes,
            Nuisances(**nuisances),
            # numpy takes a generator where it takes a seed
            OwnDraws([setup.seed for setup in setups]),  # type: ignore[arg-type]
        )
        self._motion: RigsInMotion = rigs_of_all.begin(setups[0].sample_time)
        self._torques = [rig.torques(setup) for rig, setup in zip(rigs, setups, strict=True)]
        self._sample = 0
        self.commands = np.zeros((n, 2))  #: (n, 2) array; V, in force until they are changed
        self.measured = self._motion.measure()  #: (n, 4) array; α_v, α_h, ω_v, ω_h

    def states(self) -> Mapping[str, FloatArray]:
        """True states by the model's names, each (n,): the momenta by the rigs' own geometry."""
        motion, constants = self._motion, self._motion.rigs.constants
        w_m, w_t, q, r, theta, psi = motion.x
        inertia = (
            motion.D * np.cos(theta) ** 2 + motion.E * np.sin(theta) ** 2 + motion.F
        ) * motion.own.yaw_inertia
        return {
            "alpha_v": theta,
            "alpha_h": psi,
            "omega_v": w_m,
            "omega_h": w_t,
            "S_v": q - constants["k_t"] * w_t / motion.J_v,
            "S_h": r - constants["k_m"] * w_m * np.cos(theta) / inertia,
        }

    def advance(self) -> None:
        """Hold all commands for one sample."""
        for i, torques in enumerate(self._torques):
            self._motion.push[:, i] = torques[min(self._sample, len(torques) - 1)]
        limited = np.clip(self.commands, -COMMAND_LIMIT, COMMAND_LIMIT)
        self._motion.advance(limited)
        self._sample += 1
        self.measured = self._motion.measure()


class BlindRun:
    """A rig during one run; see :class:`trms_cli.plants.plant.PlantRun`.

    ``rigs``: among which it is the one at ``place``; alone, it lets them move itself.
    """

    known_disturbances: Mapping[str, FloatArray] = {}

    def __init__(self, rig: BlindRig, setup: PlantSetup, rigs: RigsSideBySide, place: int) -> None:
        model = Newtonian()
        self.inputs: tuple[Signal, ...] = model.inputs
        self.outputs: tuple[Signal, ...] = model.outputs
        self.states: tuple[Signal, ...] = model.states
        channels = tuple(signal.name for signal in model.outputs)
        self.noise_sd = rig.sensors.declared_noise(channels)
        self.first_command = np.zeros(len(model.inputs))
        self.input_limits = model.input_bounds()
        self._rigs, self._place = rigs, place
        self._order = [("alpha_v", "alpha_h", "omega_v", "omega_h").index(c) for c in channels]

    @property
    def state(self) -> FloatArray:
        """The true state, (n_x,)."""
        states = self._rigs.states()
        return np.array([states[signal.name][self._place] for signal in self.states])

    def measure(self) -> FloatArray:
        """What the sensors show, (n_y,)."""
        return self._rigs.measured[self._place, self._order].copy()

    def advance(self, command: FloatArray) -> None:
        """Hold a command for a sample."""
        self.command(command)
        self._rigs.advance()

    def command(self, command: FloatArray) -> None:
        """Say what is to be held, and leave it to others to let the rigs move."""
        self._rigs.commands[self._place] = command


class OwnDraws(np.random.Generator):
    """Draws for rigs, each by a seed of its own."""

    def __init__(self, seeds: Sequence[int]) -> None:
        super().__init__(np.random.PCG64(0))  # which draws nothing
        self._each = [np.random.default_rng([seed, 0x424C494E]) for seed in seeds]

    def _shape(self, size: Any) -> tuple[int, ...]:
        *outer, n = (size,) if isinstance(size, int) else size
        if n != len(self._each):
            raise ValueError(f"draws for {n} rigs, of {len(self._each)}")
        return tuple(outer)

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        outer = self._shape(size)
        return np.stack([g.uniform(low, high, outer) for g in self._each], axis=-1)

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = None) -> Any:
        return loc + scale * self.standard_normal(size)

    def standard_normal(self, size: Any = None, *_: Any, **__: Any) -> Any:
        outer = self._shape(size)
        return np.stack([g.standard_normal(outer) for g in self._each], axis=-1)
