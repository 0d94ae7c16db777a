"""A model around an equilibrium, in the states that take part.

With y the deviation of these states from the equilibrium x*,

    ẏ = f(x* + y, ū)        f(x*, ū) = 0

The other states stay at rest: they are chosen so that none of the deviations moves them, and the
set on which they rest is invariant (rotors that have reached their speed, for example). A state
that moves nothing, itself included (a yaw that nothing pulls back), is left out too: its value is
of no consequence, and there is no attraction in its direction.

x* is not a number that a computer has: it lies within :attr:`ReducedSystem.error` of the point x̄
that is computed, which Krawczyk's test proves. All bounds allow for it. The model's constants are
taken as the double precision numbers that the program computes with.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from trms_cli.core.arrays import ComplexArray, FloatArray
from trms_cli.core.errors import ModelError
from trms_cli.core.plugins import require_known
from trms_cli.models.model import Model
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.intervals.branch_and_bound import JUMPS, operations
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval
from trms_cli.stability.local.linear import Linear

#: Real parts of eigenvalues below this share of the largest modulus count as zero.
_MARGINAL = 1e-8
#: Parts of the segment from the equilibrium over which slopes are averaged.
_PARTS = 16
#: Radii tried for the box that holds the exact equilibrium, relative to 1 + |x̄|.
_RADII = (1e-12, 1e-10, 1e-8, 1e-6)


@dataclass(frozen=True)
class ReducedSystem:
    """The equations of a model around an equilibrium."""

    model: Model
    point: OperatingPoint
    positions: tuple[int, ...]  #: Positions in x of the states of y
    neutral: tuple[int, ...] = ()  #: Positions of states that move nothing, left out

    @property
    def n(self) -> int:
        return len(self.positions)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the states of y."""
        return tuple(self.model.state_names[i] for i in self.positions)

    @property
    def settled(self) -> tuple[str, ...]:
        """States that rest, by name."""
        apart = {*self.positions, *self.neutral}
        return tuple(n for i, n in enumerate(self.model.state_names) if i not in apart)

    @cached_property
    def function(self) -> ca.Function:
        """``(y, e) → ẏ``, (n, 1) each but e, the error of the computed equilibrium, (n_x, 1)."""
        y, e = self.symbols()
        full = ca.SX(ca.DM(self.point.x)) + e
        for j, i in enumerate(self.positions):
            full[i] += y[j]
        rates = _rates(self.model, full, self.point.u)
        return ca.Function("around", [y, e], [rates[list(self.positions)]])

    @cached_property
    def slopes(self) -> ca.Function:
        """``(y, e) → ∂ẏ/∂y``, dense."""
        y, e = self.symbols()
        slope = ca.densify(ca.jacobian(self.function(y, e), y))
        return ca.Function("slopes", [y, e], [slope])

    @cached_property
    def A(self) -> FloatArray:
        """∂ẏ/∂y at the equilibrium, (n, n)."""
        return np.array(self.slopes(np.zeros(self.n), np.zeros(self.model.n_x)))

    @cached_property
    def eigenvalues(self) -> ComplexArray:
        """Of the linearisation; where a coefficient switches of the mean of both sides."""
        A = Linear(self.model).a(self.point.x, self.point.u)
        positions = list(self.positions)
        return np.asarray(np.linalg.eigvals(A[np.ix_(positions, positions)]), dtype=np.complex128)

    @cached_property
    def curved(self) -> tuple[int, ...]:
        """Positions in y that the slopes depend on: where the equations are not linear."""
        y, e = self.symbols()
        depends = ca.jacobian_sparsity(ca.vec(self.slopes(y, e)), y)
        return tuple(sorted({int(j) for j in depends.get_triplet()[1]}))

    @cached_property
    def error(self) -> Interval:
        """Where x* − x̄ lies, (n_x,): in this box there is one equilibrium, and one only.

        Raises ModelError if that cannot be proved.
        """
        n_x = self.model.n_x
        everything = tuple(i for i in range(n_x) if i not in self.neutral)
        whole = ReducedSystem(self.model, self.point, everything, self.neutral)
        bounds, zero = Enclosure(whole.function), Interval.point(np.zeros(n_x))
        rate = bounds(Interval.point(np.zeros((1, whole.n))), zero)[0][0]
        inverse = Interval.point(np.linalg.inv(whole.A)[None])
        newton = -(inverse @ rate[None, :, None])
        for size in _RADII:
            r = size * (1.0 + np.abs(self.point.x[list(everything)]))
            box = Interval(-r, r)
            rest = Interval.point(np.eye(whole.n)) - inverse @ whole.slopes_within(box[None], zero)
            image = newton + rest @ box[None, :, None]
            if bool(np.all(image[0, :, 0].within(box))):
                full = np.zeros(n_x)
                full[list(everything)] = r
                return Interval(-full, full)
        raise ModelError(
            "no equilibrium can be proved to lie at the point that was computed",
            where="study.at",
            remedy="choose a point away from a fold (study=equilibria shows where they are)",
        )

    @cached_property
    def _slope_bounds(self) -> Enclosure:
        return Enclosure(self.slopes)

    def slopes_within(self, box: Interval, error: Interval) -> Interval:
        """Bounds of ∂ẏ/∂y in boxes (m, n), (m, n, n)."""
        return self._slope_bounds.matrices(box, error)[0]

    def rates(self, y: FloatArray) -> FloatArray:
        """ẏ at many deviations, (m, n) each."""
        return np.array(self.function(y.T, np.zeros(self.model.n_x))).T

    def symbols(self) -> tuple[ca.SX, ca.SX]:
        """Fresh symbols (y, e)."""
        return ca.SX.sym("y", self.n), ca.SX.sym("e", self.model.n_x)

    def hull(self, radii: FloatArray) -> Interval:
        """Matrices A(y) with ẏ = A(y) y, for all \\|y_i\\| ≤ radii_i: bounds of each entry, (n, n).

        A(y) = ∫₀¹ ∂f(x* + s y) ds, bounded part by part of the segment: the slopes far out count
        for the last part only. Where a coefficient switches, both its values are covered.
        """
        shares = (np.arange(_PARTS) + 1.0) / _PARTS
        r = np.nextafter(shares[:, None] * radii, np.inf)
        with np.errstate(over="ignore", invalid="ignore"):
            slope = self.slopes_within(Interval(-r, r), self.error)
        return slope.mean()


def around(
    model: Model, point: OperatingPoint, states: Sequence[str] | None = None
) -> ReducedSystem:
    """The equations in the states that deviate (default all), and in those that they move.

    Raises ConfigurationError for a name that is no state, ModelError if a rate jumps.
    """
    for name in states or ():
        unknown = f"{name!r} is not a state of model {model.name!r}"
        require_known(name, model.state_names, unknown, "study.states")
    x = ca.SX.sym("x", model.n_x)
    moves = ca.jacobian_sparsity(_rates(model, x, point.u), x)
    pairs = list(zip(*moves.get_triplet(), strict=True))  # (moved, moving)
    neutral = {j for j in range(model.n_x) if all(moving != j for _, moving in pairs)}
    positions = {model.state_index(n) for n in states} if states else set(range(model.n_x))
    # A coefficient that changes with the sign of the very quantity it multiplies does not jump.
    if operations(ca.Function("f", [x], [_rates(model, x, point.u)])) & JUMPS:
        raise ModelError(
            "a rate of this model jumps (a sign in its equations), and a jump has no slopes that "
            "bounds could rest on",
            where="model",
            remedy="smooth it, or take the effect that adds it as impulses (*_friction)",
        )
    while True:
        following = positions | {i for i, j in pairs if j in positions}
        if following == positions:
            break
        positions = following
    if not positions - neutral:  # a position that nothing pulls back moves nothing
        positions = set(range(model.n_x))
    return ReducedSystem(model, point, tuple(sorted(positions - neutral)), tuple(sorted(neutral)))


def require_attractive(system: ReducedSystem) -> None:
    """Refuse an equilibrium that is not asymptotically stable, with its eigenvalues.

    Raises ModelError.
    """
    values = system.eigenvalues
    scale = max(1e-3, float(np.abs(values).max(initial=0.0)))
    worst = float(values.real.max(initial=-np.inf))
    if worst < -_MARGINAL * scale:
        return
    eigenvalue_text = ", ".join(
        complex_text(value) for value in sorted(values, key=lambda v: -v.real)[:4]
    )
    place = system.point.words(system.model)
    if worst > _MARGINAL * scale:
        raise ModelError(
            f"the equilibrium at {place} is unstable (eigenvalues {eigenvalue_text} 1/s): it "
            "attracts only the motions on a surface without volume, and has no region of "
            "attraction",
            where="study.at",
            remedy="choose a stable one (study=equilibria marks them), or close the loop: "
            "controller=lqr",
        )
    raise ModelError(
        f"the equilibrium at {place} is marginal (eigenvalues {eigenvalue_text} 1/s): its "
        "linearisation does not decide, and no quadratic function proves a region",
        where="study.at",
        remedy="choose a point where all modes decay, or give the axis some damping or stiffness "
        "(model.parameters)",
    )


def complex_text(value: complex) -> str:
    """``-0.0467 + 1.61j``; an eigenvalue in a sentence."""
    if abs(value.imag) < 1e-9 * (1.0 + abs(value)):
        return f"{value.real:.3g}"
    return f"{value.real:.3g} {'+' if value.imag > 0 else '−'} {abs(value.imag):.3g}j"


def _rates(model: Model, x: ca.SX, u: FloatArray) -> ca.SX:
    constants = [ca.SX(ca.DM(v)) for v in (u, model.parameters.values, np.zeros(model.n_w))]
    return model.dynamics(x, *constants)
