"""A model made linear at a point, on both sides of a switch where it lies on one, and its modes.

With equations, ``A = ∂f/∂x``; a model that only steps has ``A = ∂x⁺/∂x`` and its eigenvalues z
stand for ``λ = ln z / T``.

Some coefficients depend on a direction (the cable's stiffness on the side of the yaw, thrust and
drag on the sense of rotation). On such a switch there are two matrices. Small oscillations across
it see their mean: the first harmonic of a spring with two slopes is that of the mean slope (its
describing function), and a central difference gives the same.

Modes are called after the states that take part in them. The participation factor of state i is
``p_i = w_i v_i`` with the left and right eigenvectors normalised to ``wᵀv = 1`` (Pérez-Arriaga,
Verghese & Schweppe 1982, IEEE Trans. Power App. Syst. 101(9)). It does not depend on the units of
the states. Magnitudes are shown as shares.

Multiple eigenvalues are taken together: their eigenvectors are arbitrary, or there are too few of
them, and only the spectral projector onto their common subspace is well defined. Its diagonal is
the sum of their participation factors. It follows from the ordered Schur form and one Sylvester
equation (Golub & Van Loan, Matrix Computations, 4th ed., sec. 7.6). Of a model that steps, what is
gone within a sample (|z| below 1e-3) is memory, as the delayed samples that a network keeps, and no
mode.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import casadi as ca
import numpy as np
import numpy.typing as npt
import scipy.linalg

from trms_cli.core.arrays import BoolArray, ComplexArray, FloatArray
from trms_cli.models.model import Model, names

#: Which matrix at a switch: the mean of both, or that of the side where the switching states are
#: larger (``upper``) or smaller.
Side = Literal["mean", "upper", "lower"]

#: Distances to both sides of a point at which slopes are compared, relative to 1 + |x|. Across a
#: switch they differ by the same at either, in a smooth place by a tenth as much at the second.
_PROBES = (1e-6, 1e-7)
#: Distance at which one side is taken.
_ASIDE = 1e-9
#: Differences of slopes below this, relative to 1 + |slope|, are rounding.
_ROUNDING = 1e-8


@dataclass(frozen=True)
class Switch:
    """A state whose sign of change decides some coefficients at a point."""

    state: int  #: Position of the state
    entries: tuple[tuple[int, int], ...]  #: Entries of A that differ between the sides
    upper: tuple[float, ...]  #: Their values on either side
    lower: tuple[float, ...]  #: Their values on either side


@dataclass(frozen=True)
class Matrices:
    """The linear model at a point."""

    a: FloatArray  #: (n_x, n_x) array; ∂f/∂x, or ∂x⁺/∂x of a model that steps
    b: FloatArray  #: (n_x, n_u) array
    e: FloatArray  #: (n_x, n_w) array; by the disturbances
    c: FloatArray  #: (n_y, n_x) array; of the measured outputs
    sample_time: float | None = None  #: s, of a model that steps


class Linear:
    """Slopes of one model, with equations or with a step of its own, as compiled expressions.

    It keeps nothing between two calls.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self.parameters = model.parameters.values

    @cached_property
    def _slopes(self) -> ca.Function:
        x, u, p, w, f = self._symbols()
        y = self.model.measurement(x, u, p)
        return _still([ca.jacobian(f, v) for v in (x, u, w)] + [ca.jacobian(y, x)], w, [x, u, p])

    @cached_property
    def _a(self) -> ca.Function:
        x, u, p, w, f = self._symbols()
        return _still([ca.jacobian(f, x)], w, [x, u, p])

    @cached_property
    def _change(self) -> ca.Function:
        x, u, p, w, f = self._symbols()
        a = ca.vec(ca.densify(ca.jacobian(f, x)))
        along = ca.vertcat(x, u, p)
        direction = ca.SX.sym("direction", along.shape[0])
        return _still([ca.jtimes(a, along, direction)], w, [x, u, p, direction])

    def matrices(
        self, x: FloatArray, u: FloatArray, side: Side = "mean", p: FloatArray | None = None
    ) -> Matrices:
        """A, B, E and C at a point."""
        a, b, e, c = self._averaged(self._slopes, x, u, side, p)
        return Matrices(a, b, e, c, self.model.sample_time)

    def a(
        self, x: FloatArray, u: FloatArray, side: Side = "mean", p: FloatArray | None = None
    ) -> FloatArray:
        """A alone."""
        return self._averaged(self._a, x, u, side, p)[0]

    def change(
        self,
        x: FloatArray,
        u: FloatArray,
        direction: FloatArray,
        side: Side = "mean",
        p: FloatArray | None = None,
    ) -> FloatArray:
        """dA along a direction (dx, du, dp), (n_x + n_u + n_p,); exact."""
        n = self.model.n_x
        return self._averaged(self._change, x, u, side, p, direction)[0].reshape(n, n, order="F")

    def switches(
        self, x: FloatArray, u: FloatArray, p: FloatArray | None = None
    ) -> tuple[Switch, ...]:
        """The switches that a point lies on; empty where A is continuous."""
        p = self.parameters if p is None else p
        n = self.model.n_x
        if not self._differs(x, u, p, np.ones(n)).any():
            return ()
        switches = []
        for i in range(n):
            away = np.zeros(n)
            away[i] = 1.0
            jumps = self._differs(x, u, p, away)
            if jumps.any():
                step = _ASIDE * (1.0 + abs(x[i])) * away
                upper, lower = self._at([x + step, x - step], u, p)
                entries = tuple((int(r), int(c)) for r, c in np.argwhere(jumps))
                values = (tuple(float(side[e]) for e in entries) for side in (upper, lower))
                switches.append(Switch(i, entries, *values))
        return tuple(switches)

    def _averaged(
        self,
        function: ca.Function,
        x: FloatArray,
        u: FloatArray,
        side: Side,
        p: FloatArray | None,
        *more: FloatArray,
    ) -> list[FloatArray]:
        """The outputs of a function of (x, u, p, …), of one side of a switch or their mean."""
        p = self.parameters if p is None else p
        sides = [function.call([at, u, p, *more]) for at in self._sides(x, u, side, p)]
        return [np.mean([np.array(m) for m in parts], axis=0) for parts in zip(*sides, strict=True)]

    def _sides(
        self, x: FloatArray, u: FloatArray, side: Side, p: FloatArray
    ) -> tuple[FloatArray, ...]:
        """The points whose slopes are averaged."""
        switching = [switch.state for switch in self.switches(x, u, p)]
        if not switching:
            return (x,)
        step = np.zeros(len(x))
        step[switching] = _ASIDE * (1.0 + np.abs(x[switching]))
        upper, lower = x + step, x - step
        return {"upper": (upper,), "lower": (lower,), "mean": (upper, lower)}[side]

    def _differs(self, x: FloatArray, u: FloatArray, p: FloatArray, away: FloatArray) -> BoolArray:
        """Entries of A that jump in a direction."""
        steps = [size * (1.0 + np.abs(x)) * away for size in _PROBES]
        points = [x + sign * step for step in steps for sign in (1, -1)]
        far_up, far_down, near_up, near_down = self._at(points, u, p)
        far, near = np.abs(far_up - far_down), np.abs(near_up - near_down)
        jumps: BoolArray = (near > 0.5 * far) & (near > _ROUNDING * (1.0 + np.abs(near_up)))
        return jumps

    def _at(self, points: list[FloatArray], u: FloatArray, p: FloatArray) -> list[FloatArray]:
        """A at several points, in one call."""
        many = np.array(self._a(np.array(points).T, u, p))
        return np.split(many, len(points), axis=1)

    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
        """x, u, p and w, and the rates or the step of the model."""
        x, u, p, w = self.model.symbols()
        stepping = self.model.sample_time is not None
        f = (self.model.transition if stepping else self.model.dynamics)(x, u, p, w)
        return x, u, p, w, f


def _still(expressions: list[ca.SX], w: ca.SX, inputs: list[ca.SX]) -> ca.Function:
    """A function of dense expressions, without disturbance."""
    dense = [ca.densify(expression) for expression in expressions]
    return ca.Function("slopes", inputs, ca.substitute(dense, [w], [ca.SX.zeros(w.shape[0])]))


#: From this share on, a mode is called after one part alone.
DOMINANT = 0.6
#: Parts below this share do not stand in the name of a mixed mode.
_NAMED = 0.15
#: Beyond this share of past samples a network's mode is its memory and no motion.
_PAST = 0.75
#: Rates below this (1/s) are none: a time constant of four months.
STILL = 1e-7
_LAG = re.compile(r"_lag\d+$")
_ROTOR_OF = {"v": "main", "h": "tail"}


@dataclass(frozen=True)
class RigPart:
    """What a state is of."""

    name: str  #: ``pitch``, ``main rotor``, an effect's name…
    #: ``angle`` or ``rate`` of an axis, ``past`` of what a network remembers; empty for any other
    role: str = ""


def parts_of(model: Model) -> tuple[RigPart, ...]:
    """The part of each state."""
    axis_of = {axis.angle: name for name, axis in model.axes.items()}
    of_suffix = {angle.rpartition("_")[2]: name for angle, name in axis_of.items()}

    def part(name: str) -> RigPart:
        if "." in name:
            return RigPart(name.rpartition(".")[0].replace("_", " "))
        if _LAG.search(name):
            name = _LAG.sub("", name)
            return RigPart(name if name in names(model.inputs) else part(name).name, "past")
        if name in axis_of:
            return RigPart(axis_of[name], "angle")
        symbol, _, suffix = name.rpartition("_")
        rotor = _ROTOR_OF.get(suffix)
        if symbol == "S" and suffix in of_suffix:
            return RigPart(of_suffix[suffix], "rate")
        if symbol in ("omega", "tau") and rotor is not None:
            return RigPart(f"{rotor} rotor")
        if symbol == "i" and rotor is not None:
            return RigPart(f"armature current of the {rotor} motor")
        return RigPart(name.replace("_", " "))

    return tuple(part(name) for name in model.state_names)


def shares_of_parts(parts: tuple[RigPart, ...], participation: FloatArray) -> dict[str, float]:
    """Participation by part, largest first."""
    shares: dict[str, float] = {}
    for part, share in zip(parts, participation, strict=True):
        shares[part.name] = shares.get(part.name, 0.0) + float(share)
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


def mode_name(parts: tuple[RigPart, ...], participation: FloatArray, eigenvalue: complex) -> str:
    """What a mode is called: ``pitch swing``, ``main rotor``, ``pitch and yaw swing``."""
    shares = shares_of_parts(parts, participation)
    first, share = next(iter(shares.items()))
    swings = abs(eigenvalue.imag) > STILL
    if share < DOMINANT:
        mixed = [name for name, part in shares.items() if part >= _NAMED] or [first]
        if len(mixed) > 1:
            together = f"{', '.join(mixed[:-1])} and {mixed[-1]}"
            return f"{together} swing" if swings else f"{together} together"
    roles: dict[str, float] = {}
    for part, size in zip(parts, participation, strict=True):
        if part.name == first:
            roles[part.role] = roles.get(part.role, 0.0) + float(size)
    if roles.get("past", 0.0) > _PAST * share:
        return f"past samples of {first}"
    role = max((role for role in roles if role != "past"), key=lambda role: roles[role])
    if swings:
        return f"{first} swing"
    if not role:
        return first
    if abs(eigenvalue) <= STILL:
        return f"{first} free"
    if eigenvalue.real > STILL:
        return f"{first} divergence"
    return f"{first} rate" if role == "rate" else f"{first} settling"


Verdict = Literal["stable", "marginal", "unstable"]

#: Eigenvalues closer than this, relative to 1 + |λ|, are one multiple eigenvalue: a defective
#: pair computed in double precision parts by about 1e-8.
_TOGETHER = 1e-6
#: |z| below this is memory.
_FORGOTTEN = 1e-3


@dataclass(frozen=True)
class EigenMode:
    """An eigenvalue, or a conjugate pair by that of positive frequency."""

    name: str  #: After the states that take part
    eigenvalue: complex  #: λ, 1/s
    participation: FloatArray  #: (n_x,) array; shares of the states; they add up to 1
    right: ComplexArray  #: (n_x,) arrays; Eigenvectors with ``leftᵀ right = 1``
    left: ComplexArray  #: (n_x,) arrays; of a defective one, any of its own
    multiplicity: int = 1  #: How many equal eigenvalues it stands for
    #: Whether they have fewer eigenvectors than that: motions grow as t e^{λt}
    defective: bool = False
    alternating: bool = False  #: Whether it changes sign at each sample of a model that steps

    @property
    def oscillates(self) -> bool:
        return self.eigenvalue.imag > STILL

    @property
    def natural_frequency(self) -> float:
        """|λ|, rad/s."""
        return abs(self.eigenvalue)

    @property
    def damped_frequency(self) -> float:
        """Im λ, rad/s; 0 for one that does not swing."""
        return self.eigenvalue.imag if self.oscillates else 0.0

    @property
    def damping_ratio(self) -> float | None:
        """−Re λ/|λ|; None where nothing moves."""
        size = abs(self.eigenvalue)
        return None if size <= STILL else -self.eigenvalue.real / size

    @property
    def time_constant(self) -> float | None:
        """1/|Re λ|, s: to decay, or grow, by a factor e; None where it does neither."""
        rate = abs(self.eigenvalue.real)
        return None if rate <= STILL else 1.0 / rate

    @property
    def verdict(self) -> Verdict:
        if self.eigenvalue.real > STILL:
            return "unstable"
        if self.eigenvalue.real < -STILL:
            return "stable"
        return "unstable" if self.defective else "marginal"


@dataclass(frozen=True)
class Modes:
    """All modes of a linear model."""

    modes: tuple[EigenMode, ...]  #: The slowest last
    forgotten: int = 0  #: States that are memory and gone within a sample

    @property
    def verdict(self) -> Verdict:
        """Of the whole."""
        order: tuple[Verdict, ...] = ("stable", "marginal", "unstable")
        return max((mode.verdict for mode in self.modes), key=order.index, default="stable")


def rate_of(value: complex, sample_time: float | None) -> complex:
    """λ in 1/s from an eigenvalue of A; −∞ for a z of zero."""
    if sample_time is None:
        return complex(value)
    if abs(value) < 1e-300:
        return complex(-math.inf, 0.0)
    return complex(np.log(complex(value)) / sample_time)


def modes_of(model: Model, matrices: Matrices) -> Modes:
    """The modes of a linear model of ``model``."""
    return modes_of_matrix(matrices.a, parts_of(model), matrices.sample_time)


def modes_of_matrix(
    a: FloatArray, parts: tuple[RigPart, ...], sample_time: float | None = None
) -> Modes:
    """The modes of a matrix (n, n), of a derivative or of a step of ``sample_time`` (s).

    ``parts`` says what each state is of.
    """
    whole = spectrum_of(a)
    values = whole.values
    modes, forgotten = [], 0
    for group in _together(values):
        value = complex(values[group].mean())
        if sample_time is not None and abs(value) < _FORGOTTEN:
            forgotten += len(group) * (2 if value.imag > STILL else 1)
            continue
        if abs(value.imag) <= _TOGETHER * (1.0 + abs(value)) and len(group) > 1:
            value = complex(value.real, 0.0)
        i = group[0]
        if len(group) == 1:
            participation, defective = whole.participation(i), False
        else:
            share, defective = _joint(a, values[group], value)
            participation = share / share.sum()
        rate = rate_of(value, sample_time)
        alternating = sample_time is not None and value.real < 0 and abs(value.imag) <= STILL
        name, vectors = mode_name(parts, participation, rate), (whole.right[:, i], whole.left[:, i])
        mode = EigenMode(name, rate, participation, *vectors, len(group), defective, alternating)
        modes.append(mode)
    modes.sort(key=lambda mode: (-abs(mode.eigenvalue), mode.name))
    named = distinct_names([mode.name for mode in modes], "faster", "slower")
    modes = [replace(mode, name=name) for mode, name in zip(modes, named, strict=True)]
    return Modes(tuple(modes), forgotten)


@dataclass(frozen=True)
class EigenSpectrum:
    """Eigenvalues of one matrix in an order, with eigenvectors."""

    values: ComplexArray  #: (n,) complex array; of the matrix: λ, or z of a model that steps
    #: ``left``, ``right``: (n, n) complex arrays; columns, ``leftᵢᵀ rightᵢ = 1``
    left: ComplexArray
    right: ComplexArray

    def reorder(self, order: npt.NDArray[np.intp]) -> EigenSpectrum:
        """The same in another order."""
        return EigenSpectrum(self.values[order], self.left[:, order], self.right[:, order])

    def participation(self, i: int) -> FloatArray:
        """Shares of the states in mode i."""
        share = np.abs(self.left[:, i] * self.right[:, i])
        return np.asarray(share / share.sum())


def spectrum_of(a: FloatArray) -> EigenSpectrum:
    """The spectrum of a matrix, in LAPACK's order.

    Where a defective eigenvalue makes ``leftᵢᵀ rightᵢ = 1`` impossible the product is kept off
    zero.
    """
    values, left, right = scipy.linalg.eig(a, left=True, right=True)
    left = left.conj()  # scipy's are of vᴴA = λvᴴ
    product = np.sum(left * right, axis=0)
    product = np.where(np.abs(product) < 1e-14, 1e-14, product)
    return EigenSpectrum(
        values.astype(complex), (left / product).astype(complex), right.astype(complex)
    )


def _together(values: ComplexArray) -> list[list[int]]:
    """Positions of equal eigenvalues, of those with positive frequency or none."""
    rounding = 1e-12 * (1.0 + float(np.abs(values).max(initial=0.0)))
    groups: list[list[int]] = []
    for i in np.argsort(-np.abs(values), kind="stable"):
        value = values[i]
        near = _TOGETHER * (1.0 + abs(value))
        # A multiple real eigenvalue may have parted into a conjugate pair by rounding.
        if value.imag < -max(near, rounding):
            continue
        for group in groups:
            if min(abs(values[j] - value) for j in group) <= near:
                group.append(int(i))
                break
        else:
            groups.append([int(i)])
    # What rounding put just below the axis stays only beside its partner.
    return [group for group in groups if values[group].mean().imag >= -rounding]


def _joint(a: FloatArray, values: ComplexArray, value: complex) -> tuple[FloatArray, bool]:
    """Participation of a multiple eigenvalue, and whether it lacks eigenvectors."""
    # The diagonal of a projector does not depend on the balancing's scales.
    balanced = scipy.linalg.matrix_balance(a, permute=False, separate=False)[0]
    reach = 2.0 * max(float(np.abs(values - value).max()), _TOGETHER * (1.0 + abs(value)))
    form, basis, count = scipy.linalg.schur(
        balanced, output="complex", sort=lambda z: abs(z - value) <= reach
    )
    own, rest, cross = form[:count, :count], form[count:, count:], form[:count, count:]
    projector = np.zeros_like(form)
    projector[:count, :count] = np.eye(count)
    if count < len(form):
        projector[:count, count:] = scipy.linalg.solve_sylvester(own, -rest, cross)
    projector = basis @ projector @ basis.conj().T
    chained = np.abs(own - np.diag(np.diag(own))).max(initial=0.0)
    return np.abs(np.diag(projector)), bool(chained > 1e-5 * (1.0 + abs(value)))


def distinct_names(names: Sequence[str], first: str, second: str) -> list[str]:
    """Names, equal ones with what differs: two by a word in their order, more by a number."""
    distinct = list(names)
    for name in set(names):
        same = [i for i, other in enumerate(names) if other == name]
        words = (first, second) if len(same) == 2 else [str(k + 1) for k in range(len(same))]
        for i, word in zip(same, words, strict=True):
            if len(same) > 1:
                distinct[i] = f"{name} ({word})"
    return distinct
