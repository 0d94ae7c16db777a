"""Robust model predictive control by a family of ellipsoids made before the run.

After Wan & Kothare 2003 (Automatica 39); see :mod:`trms_cli.controllers.robust.family`. The same
inequalities as :mod:`trms_cli.controllers.robust_mpc`, solved once; a step looks its law up.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Status
from trms_cli.controllers.robust.family import Family, make_family
from trms_cli.controllers.robust.regulation import Aim, Design, Positive, Regulation
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest

FloatArray = npt.NDArray[np.float64]


@dataclass
class RobustMpcOfflineState:
    """What changes during a run."""

    regulation: Regulation
    family: Family
    aim: Aim | None = None  #: The target of the last sample
    share: float = 1.0  #: By which the family's ellipsoids are shrunk at the target


@dataclass(frozen=True, kw_only=True)
class RobustMpcOffline(Design):
    """Robust MPC by lookup."""

    sample_time: Positive = 0.1  #: Control period, s
    #: The farthest states that laws are made for: a deviation of each controlled angle, rad
    widest: Mapping[str, Positive] = field(default_factory=dict)
    #: Half-width of the references that the family serves, rad; beyond, its certificate does not
    #: hold
    targets: Mapping[str, Annotated[float, Meta(ge=0)]] = field(default_factory=dict)
    rings: Annotated[int, Meta(ge=1)] = 12  #: Ellipsoids
    #: States that the innermost is made for, as a share of the farthest
    smallest: Annotated[float, Meta(gt=0, lt=1)] = 0.02
    #: Whether the observer's constant disturbances enter the target (offset-free)
    disturbance_compensation: bool = True

    def preview(self, setup: ControlSetup) -> int:
        return 0

    def init(self, setup: ControlSetup) -> RobustMpcOfflineState:
        """The family, made or read from the user's cache."""
        regulation = Regulation(self, setup)
        model = setup.model
        widest = _angles(self.widest, model.controlled, 0.5, "widest")
        reach = _angles(self.targets, model.controlled, 0.0, "targets")
        farthest = np.array([regulation.angles(row) for row in np.diag(widest)])
        corners = itertools.product((0.0, -1.0, 1.0), repeat=len(reach))
        every = [regulation.aim_at(np.array(corner) * reach) for corner in corners]
        aims = [aim for aim in every if aim.steady.exact]
        positions = np.geomspace(1.0, self.smallest, self.rings).tolist()
        return RobustMpcOfflineState(
            regulation, make_family(self, regulation, aims, farthest, positions)
        )

    def step(
        self, state: RobustMpcOfflineState, sample: ControlSample, *, want_prediction: bool
    ) -> Command:
        """One sample: target, lookup, command."""
        regulation, family = state.regulation, state.family
        x, w = sample.estimate.x, sample.estimate.disturbance
        total = sum(x.tolist()) + sum(w.tolist()) + float(sample.reference.sum())
        if not math.isfinite(total):
            return _held(sample, regulation, "the estimate or the reference is not finite")
        if not self.disturbance_compensation:
            w = np.zeros_like(w)
        aim = regulation.aim(sample, state.aim, w)
        if aim is not state.aim:
            state.aim, state.share = aim, family.share(regulation.input_bounds(aim))
        z = regulation.deviation(x, aim.target)
        K, ring, level = family.gain(z / state.share)
        u = regulation.command(x, aim, z, K @ z)
        if not np.isfinite(u).all():  # an estimate beyond all bounds
            return _held(sample, regulation, "the law is not finite at this estimate")
        message, status = aim.message, Status.OK
        if ring < 0:
            status = Status.RELAXED
            message = message or "outside of all ellipsoids; the outermost law is cut to the limits"
        cost = family.rings.gammas[max(ring, 0)] * level * state.share**2
        return Command(
            u,
            status,
            objective=cost,
            message=message,
            out_of_reach=aim.steady.projected,
        )


def _held(sample: ControlSample, regulation: Regulation, reason: str) -> Command:
    return Command(
        np.clip(sample.previous_command, regulation.lower, regulation.upper),
        Status.FAILED,
        fallback="hold",
        message=f"{reason}; the last command is held",
    )


def _angles(
    given: Mapping[str, float], controlled: tuple[str, ...], default: float, key: str
) -> FloatArray:
    known = {"alpha_v", "alpha_h", *controlled}
    for name in given:
        if name not in known:
            raise ConfigurationError(
                f"{name!r} is not a controlled angle",
                where=f"controller.{key}",
                remedy=nearest(name, known),
            )
    return np.array([given.get(name, default) for name in controlled])
