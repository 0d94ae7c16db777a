"""How well the default ``newton_mpc`` follows squares, beside a long-horizon optimum."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.document import LIMIT, Column, Table
from benchmarks.options import Options
from benchmarks.setups import FULL_STATE, SQUARES, experiment, newton_of
from benchmarks.setups import run as close
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.nmpc import Nmpc
from trms_cli.simulation.closed_loop import Experiment

TITLE = "tracking of squares beside the long-horizon optimum"
LONG_HORIZON = 12.0  # s
#: Of the optimum's ISE, with the full state and with noise and filter.
ISE_FULL_STATE, ISE_FILTER = 1.05, 1.15
SETTLED = 4.0  # s
OVERSHOOT = 5.0  # %
RESTING = 0.1  # rad
STEADY = 2 * math.pi / 4096  # rad, one step of the encoder
#: The rig starts on its rest, far from any reference: an axis is at rest from the second step on.
_SECOND_STEP = 20.0  # s
_MOVING = {"both": ("alpha_v", "alpha_h"), "pitch": ("alpha_v",), "yaw": ("alpha_h",)}
_PUSHED = (
    "disturbance@plant.disturbances=[yaw_push]",
    "plant.disturbances.yaw_push.torque.start=0",
)

_OPTIMUM, _PLAIN_OPTIMUM = "(optimum)", "(optimum, angles only)"
_FULL, _FILTER, _PUSH = (
    "newton_mpc, full state",
    "newton_mpc, UKF",
    "newton_mpc, UKF, torque on yaw",
)


@dataclass
class _Outcome:
    reference: str
    who: str
    score: dict[str, Any]
    resting: float  # rad, largest deviation of the axis that should rest

    def channel(self, key: str, axis: str) -> float:
        value = self.score["channels"][axis][key]
        return math.inf if value is None else float(value)

    @property
    def ise(self) -> float:
        """rad² s, of both axes."""
        return self.channel("ise", "alpha_v") + self.channel("ise", "alpha_h")

    def worst(self, key: str) -> float:
        """Of the axes that move."""
        return max(self.channel(key, axis) for axis in _MOVING[self.reference])

    @property
    def steady(self) -> float:
        return max(self.channel("steady_state_error", axis) for axis in ("alpha_v", "alpha_h"))


def run(options: Options) -> list[Table]:
    """All controllers on squares of both axes and of each alone."""
    duration = f"sim.duration={options.duration(80.0)}"
    outcomes: list[_Outcome] = []
    for reference, overrides in SQUARES.items():
        exact = experiment("controller=newton_mpc", *overrides, *FULL_STATE, duration)
        noisy = experiment("controller=newton_mpc", *overrides, "observer=ukf", duration)
        pushed = experiment("controller=newton_mpc", *overrides, "observer=ukf", *_PUSHED, duration)
        weighted, plain = _optima(newton_of(exact))
        for who, loop_setup in {
            _OPTIMUM: replace(exact, controller=weighted),
            _FULL: exact,
            _FILTER: noisy,
            _PUSH: pushed,
            _PLAIN_OPTIMUM: replace(exact, controller=plain),
        }.items():
            outcomes.append(_outcome(reference, who, loop_setup))
    return [_errors(outcomes), _steps(outcomes)]


def _optima(default: NewtonMpc) -> tuple[Nmpc, Nmpc]:
    """With the default's weights, and with those of the angles alone."""
    periods = round(LONG_HORIZON / default.sample_time)
    long = replace(default, prediction_horizon=periods, move_blocks=(1,) * periods)
    angles = {n: q for n, q in default.state_weights.items() if n.startswith("alpha")}
    plain = replace(
        long,
        state_weights=angles,
        rate_weights={},
        input_weights={},
        move_weights={},
        input_rate_limits={},
    )
    # Without weights on moves a resting tail rotor has no slope at all: IPOPT stalls on it.
    return Nmpc.of(long, solver="ipopt"), Nmpc.of(plain, solver="fatrop")


def _outcome(reference: str, who: str, loop_setup: Experiment) -> _Outcome:
    loop, score = close(loop_setup)
    resting = math.nan
    resting_axis = {"pitch": "alpha_h", "yaw": "alpha_v"}.get(reference)
    if resting_axis is not None:
        late = loop.history.times("/plant/state") >= _SECOND_STEP
        if late.any():
            angle = loop.history.columns("/plant/state")[resting_axis]
            resting = float(np.abs(angle[late]).max())
    return _Outcome(reference, who, score, resting)


def _errors(outcomes: list[_Outcome]) -> Table:
    table = Table(
        "tracking_error",
        TITLE + ": integral of the squared error",
        [
            Column("reference", "squares on"),
            Column("who", "newton_mpc with"),
            Column("ise_pitch", "pitch", "rad² s", 4),
            Column("ise_yaw", "yaw", "rad² s", 4),
            Column("relative", "both, of", "the optimum", 4),
            *LIMIT,
        ],
    )
    limits = {_FULL: ISE_FULL_STATE, _FILTER: ISE_FILTER, _PUSH: ISE_FILTER}
    optimum = {o.reference: o.ise for o in outcomes if o.who == _OPTIMUM}
    for outcome in outcomes:
        cells: dict[str, Any] = {
            "reference": outcome.reference,
            "who": outcome.who,
            "ise_pitch": outcome.channel("ise", "alpha_v"),
            "ise_yaw": outcome.channel("ise", "alpha_h"),
        }
        relative = outcome.ise / optimum[outcome.reference]
        if outcome.who in limits:
            table.add_limited("relative", relative, limits[outcome.who], **cells)
        else:
            table.add(relative=relative, **cells)
    table.notes += [
        f"optimum: IPOPT over {LONG_HORIZON:g} s, receding, full state, the default's weights; "
        "“angles only”: without weights on moves, rates and inputs (fatrop).",
        "UKF: tacho noise, encoder and tacho quanta; the torque on yaw is unknown and constant; "
        "the optimum beside it has none.",
    ]
    return table


def _steps(outcomes: list[_Outcome]) -> Table:
    table = Table(
        "tracking_steps",
        TITLE + ": worst step",
        [
            Column("reference", "squares on"),
            Column("who", "newton_mpc with"),
            Column("settling_pitch", "settling", "pitch, s"),
            Column("settling_yaw", "settling", "yaw, s"),
            Column("overshoot_pitch", "overshoot", "pitch, %"),
            Column("overshoot_yaw", "overshoot", "yaw, %"),
            Column("resting", "resting axis", "rad"),
            Column("steady", "steady-state", "error, rad", 2),
            Column("missed", "missed"),
        ],
    )
    for outcome in outcomes:
        checks = {
            "settling": outcome.worst("settling_time_s") <= SETTLED,
            "overshoot": outcome.worst("overshoot_percent") <= OVERSHOOT,
            "resting axis": not outcome.resting > RESTING,
            "steady state": outcome.steady <= STEADY,
        }
        cells: dict[str, Any] = {}
        for axis, name in (("alpha_v", "pitch"), ("alpha_h", "yaw")):
            if axis in _MOVING[outcome.reference]:
                cells[f"settling_{name}"] = outcome.channel("settling_time_s", axis)
                cells[f"overshoot_{name}"] = outcome.channel("overshoot_percent", axis)
        if math.isfinite(outcome.resting):
            cells["resting"] = outcome.resting
        if outcome.who not in (_OPTIMUM, _PLAIN_OPTIMUM):
            cells["met"] = all(checks.values())
            cells["missed"] = ", ".join(name for name, is_met in checks.items() if not is_met)
        table.add(reference=outcome.reference, who=outcome.who, steady=outcome.steady, **cells)
    table.notes += [
        f"limits: settled to 2 % within {SETTLED:g} s, overshoot {OVERSHOOT:g} %, resting axis "
        f"{RESTING:g} rad, steady-state error one step of the encoder ({STEADY:.4f} rad).",
        "The first step starts on the rig's rest, at −0.62 rad in pitch; it counts.",
        *_price(outcomes),
    ]
    return table


def _price(outcomes: list[_Outcome]) -> list[str]:
    """What the weights on moves and rates cost and give, in words."""
    lines = []
    outcomes_by_case = {(o.reference, o.who): o for o in outcomes}
    for reference in SQUARES:
        calm, plain = (
            outcomes_by_case[reference, _FULL],
            outcomes_by_case[reference, _PLAIN_OPTIMUM],
        )
        words = [
            f"{name} {plain.worst(key):.3g} → {calm.worst(key):.3g} {unit}"
            for name, key, unit in (
                ("settling", "settling_time_s", "s"),
                ("overshoot", "overshoot_percent", "%"),
            )
        ]
        if math.isfinite(calm.resting):
            words.append(f"resting axis {plain.resting:.2g} → {calm.resting:.2g} rad")
        lines.append(
            f"squares on {reference}: the optimum for the angles alone → the default: "
            + ", ".join(words)
        )
    return lines
