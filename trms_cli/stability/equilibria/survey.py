"""All equilibria over one input: curves, what is special on them, and the proof beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.models.model import Model, names
from trms_cli.stability.equilibria.completeness import Piece, Proof, Prover, over_range
from trms_cli.stability.equilibria.continuation import (
    Curve,
    at_input,
    curve_through,
    curves_through,
    starts,
)
from trms_cli.stability.equilibria.curve_equations import CurveEquations, EquilibriumPoint
from trms_cli.stability.equilibria.landmarks import Landmark, landmarks
from trms_cli.stability.equilibria.rest_system import RestSystem, rest_system
from trms_cli.stability.equilibria.search_box import bounds_of
from trms_cli.stability.equilibria.stability_of_points import judged
from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.local.linear import Linear
from trms_cli.stability.study import Tell

FloatArray = npt.NDArray[np.float64]

#: Inputs at which equilibria are looked for from many starts, and how many starts.
_INPUTS, _STARTS = 9, 16
#: Share of the range below which a part of it is no longer cut.
_RESOLUTION = 2e-4
#: Scaled distance within which a point of a curve is the equilibrium that was proved.
_SAME = 1e-6


@dataclass(frozen=True)
class Setting:
    """What is varied, and what the rest is."""

    over: str  #: The varied input
    bounds: tuple[float, float]  #: Its range
    inputs: Mapping[str, float]  #: The other inputs, where they are given
    held: Mapping[str, float]  #: Angles that are held by an input that follows, rad


@dataclass(frozen=True)
class JudgedCurve:
    """A curve with the stability of its points."""

    curve: Curve
    points: tuple[EquilibriumPoint, ...]  #: One for each point of the curve
    landmarks: tuple[Landmark, ...]


@dataclass(frozen=True)
class Checked:
    """A proof and the points of the curves at the same input."""

    input: float
    proof: Proof
    #: Of the curves, in the order of the proof's equilibria where they agree
    points: tuple[EquilibriumPoint, ...]
    #: Whether each proved equilibrium is on a curve, and each point of a curve in the bounds of an
    #: equilibrium, proved or undecided
    agree: bool


@dataclass(frozen=True)
class Survey:
    """All equilibria over one input."""

    setting: Setting
    system: RestSystem
    equations: CurveEquations
    box: Interval  #: (n,), of the unknowns
    curves: tuple[JudgedCurve, ...]
    checks: tuple[Checked, ...]
    pieces: tuple[Piece, ...]  #: Numbers over the whole range; empty if not asked for
    late: int  #: Curves that only the proof led to

    @property
    def landmarks(self) -> tuple[Landmark, ...]:
        return tuple(one for curve in self.curves for one in curve.landmarks)


def survey(
    model: Model,
    setting: Setting,
    box: Mapping[str, Sequence[float]],
    proof_inputs: FloatArray,
    whole_range: bool,
    tell: Tell,
) -> Survey:
    """All equilibria of a model over one input.

    Parameters
    ----------
    box : dict of str to (float, float)
        Bounds of states, where not the default.
    proof_inputs : (m,) array
        Inputs at which the number of equilibria is proved.
    whole_range : bool
        Whether it is proved between them too.

    Raises
    ------
    TrmsError
        For a setting or a box that the model does not allow.
    """
    inputs = {setting.over, *setting.inputs}
    system = rest_system(model, inputs, setting.held)
    bounds, scale = bounds_of(system, box)
    v = np.zeros(len(system.given))
    for name, value in setting.inputs.items():
        v[system.given_index(name)] = value
    index = system.given_index(setting.over)
    equations = CurveEquations(system, index, v, bounds, scale, setting.bounds)
    linear = Linear(model)

    tell(f"curves over {setting.over}")
    seeds = starts(equations, np.linspace(*setting.bounds, _INPUTS), _STARTS)
    curves = curves_through(equations, seeds)

    tell(f"proofs over {setting.over}")
    prover = Prover(system, bounds, scale)
    given = np.tile(v, (len(proof_inputs), 1))
    given[:, index] = proof_inputs
    proofs = prover.at(given)
    curves, late = completed(equations, curves, proofs)
    checks = tuple(
        _check(linear, equations, curves, float(value), proof)
        for value, proof in zip(proof_inputs, proofs, strict=True)
    )
    pieces: tuple[Piece, ...] = ()
    if whole_range:
        tell(f"proof for every {setting.over}")
        width = setting.bounds[1] - setting.bounds[0]
        pieces = over_range(prover, v, index, setting.bounds, _RESOLUTION * width)
    return Survey(
        setting=setting,
        system=system,
        equations=equations,
        box=bounds,
        curves=tuple(_judged_curve(linear, equations, curve) for curve in curves),
        checks=checks,
        pieces=pieces,
        late=late,
    )


def completed(
    equations: CurveEquations, curves: list[Curve], proofs: Sequence[Proof]
) -> tuple[list[Curve], int]:
    """The curves with those through proved equilibria that are on none, and how many those are."""
    late = 0
    for proof in proofs:
        value = float(proof.given.lower[equations.varied])
        for one in proof.proved:
            known = [y for curve in curves for y in at_input(equations, curve, value)]
            if any(_within(equations, y, one.z) for y in known):
                continue
            y = equations.pinned(np.append(one.z.middle, value), equations.n, value)
            if y is not None and equations.inside(y):
                curves = [*curves, curve_through(equations, y)]
                late += 1
    return curves, late


def _within(equations: CurveEquations, y: FloatArray, z: Interval) -> bool:
    slack = _SAME * equations.scale[:-1]
    return bool(np.all((z.lower - slack <= y[:-1]) & (y[:-1] <= z.upper + slack)))


def _check(
    linear: Linear,
    equations: CurveEquations,
    curves: Sequence[Curve],
    value: float,
    proof: Proof,
) -> Checked:
    known = [y for curve in curves for y in at_input(equations, curve, value)]
    ordered: list[FloatArray] = []
    agree = True
    for one in proof.found:
        inside = [y for y in known if _within(equations, y, one.z)]
        agree &= len(inside) == 1 if one.unique else True
        ordered += inside
    agree &= all(any(_within(equations, y, one.z) for one in proof.found) for y in known)
    points = tuple(judged(linear, equations, y) for y in (ordered if agree else known))
    return Checked(value, proof, points, agree)


def _judged_curve(linear: Linear, equations: CurveEquations, curve: Curve) -> JudgedCurve:
    points = tuple(judged(linear, equations, y) for y in curve.y)
    return JudgedCurve(curve, points, tuple(landmarks(linear, equations, curve, points)))


def setting_of(
    model: Model,
    over: str,
    bounds: tuple[float, float],
    at: Mapping[str, float],
) -> Setting:
    """The other inputs of a survey.

    Inputs of ``at`` have their value, the others zero. An angle of ``at`` is held by the input of
    its own rotor, unless that is what is varied. With nothing named the pitch is held level where a
    tail rotor is varied and nothing else asks for the main rotor's command.
    """
    own = {axis: model.rotors.get(rotor) for axis, rotor in (("pitch", "main"), ("yaw", "tail"))}
    holder = {model.axes[axis].angle: own[axis] for axis in own if axis in model.axes}
    asked = dict(at)
    held = {
        name: value
        for name, value in asked.items()
        if name in holder and holder[name] not in (None, over)
    }
    if not asked and "pitch" in model.axes and own["pitch"] is not None and over == own["yaw"]:
        angle = model.axes["pitch"].angle
        if not rest_system(model, {over}).free:
            held = {angle: 0.0}
    released = {holder[name] for name in held}
    others = [name for name in names(model.inputs) if name not in (over, *released)]
    free = rest_system(model, {over}, held)
    inputs = {n: float(asked.get(n, 0.0)) for n in others if n not in free.released}
    return Setting(over, bounds, inputs, held)
