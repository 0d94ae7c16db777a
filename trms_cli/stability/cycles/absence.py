"""Proofs that there is no periodic orbit: Bendixson's criterion on a cascade of small blocks.

The states fall into blocks that drive one another in one direction only (the strongly connected
parts of the graph of ∂f/∂x: the rotors drive the beam, not the other way round). On a periodic
orbit of the whole, taken in the order of the cascade, with what drives a block constant:

- a block of one state is a scalar autonomous equation: its periodic solutions are constant;
- a block of two states is a planar autonomous field: if its divergence has one sign on a simply
  connected region, there is no closed orbit in it (Bendixson 1901; Khalil, "Nonlinear Systems",
  3rd ed., lemma 2.2; for Lipschitz fields with the divergence almost everywhere). Its periodic
  solutions are constant too.

So every periodic orbit is an equilibrium if all blocks are of these kinds. The divergence is
bounded by interval arithmetic on the model's own equations, first over all of the state space, then
over the box. Of a block of more states :func:`share_without_orbits` finds a part of the box without
a closed orbit.

That is Bendixson's criterion in more dimensions (R. A. Smith 1986, Proc. R. Soc. Edinburgh 104A;
Muldowney 1990, Rocky Mountain J. Math. 20): let D be convex, and in some coordinates z = W x let

    λ₁ + λ₂ < 0 on D,    λ₁ ≥ λ₂ ≥ … the eigenvalues of the symmetric part of W J(x) W⁻¹.

Then the flow shrinks every small piece of surface, and no closed orbit lies in D: the surface of
least area that it spans, which lies in D, would be shrunk while its edge stays. For two states
λ₁ + λ₂ is the divergence.

J is enclosed by interval arithmetic on small boxes that cover D; with J = J_c ± J_r,

    λ₁ + λ₂ ≤ (λ₁ + λ₂)(S_c) + 2 ρ(S_r),    S the symmetric parts of W J_c W⁻¹ and |W| J_r |W⁻¹|

(Ky Fan: the sum of the largest eigenvalues is subadditive). W are the modal coordinates of the
equilibrium, its modes scaled against each other. The eigenvalues are computed in floating point,
with a margin that is far above its error.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ModelError
from trms_cli.models.model import Model
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval

#: Boxes that a region is cut into, along each of a block's two states and the ones that drive it.
_CUTS = 8
#: Equilibria are known to this part.
_ROUNDING = 1e-8


@dataclass(frozen=True)
class StateBlock:
    """States that drive one another."""

    states: tuple[str, ...]
    divergence: tuple[float, float] | None  #: Bounds, 1/s, of a block of two states
    everywhere: bool  #: Whether they hold for all states; else in the box
    constant: bool  #: Whether its periodic solutions are proved to be constant
    is_driven: bool = False  #: Whether a block that is not proved constant acts on it
    #: Of a block of more than two states: part of the box that holds no periodic orbit, from 0
    share: float = 0.0

    @property
    def reason(self) -> str:
        """Why, in a few words."""
        if self.is_driven:
            return "driven by a block that stays open"
        if len(self.states) == 1:
            return "one state: periodic only if constant"
        if self.share > 0.0:
            return (
                f"areas shrink (λ₁ + λ₂ < 0) in {100 * self.share:.0f} % of the box's widths: "
                "no closed orbit there"
            )
        if self.divergence is None:
            return f"{len(self.states)} states: Bendixson's criterion is for two"
        low, high = self.divergence
        where = "for all states" if self.everywhere else "in the box"
        if self.constant:
            return f"divergence within [{low:.4g}, {high:.4g}] 1/s {where}: no closed orbit"
        return f"divergence within [{low:.4g}, {high:.4g}] 1/s {where}: its sign is not settled"


@dataclass(frozen=True)
class Absence:
    """What is proved."""

    blocks: Sequence[StateBlock]  #: In the order in which they drive one another

    @property
    def proved(self) -> bool:
        """No periodic orbit but the equilibria."""
        return all(block.constant for block in self.blocks)

    @property
    def everywhere(self) -> bool:
        """For all states, not only in the box."""
        return all(block.everywhere for block in self.blocks)


def absence(model: Model, x_rest: FloatArray, u: FloatArray, widths: FloatArray) -> Absence:
    """Whether a model with equations has no periodic orbit with the command of a rest held.

    Impulses are no part of what is proved. ``widths`` (n_x,) are half those of the box around the
    rest, where nothing can be said for all states.
    """
    box = x_rest - widths, x_rest + widths
    field = VectorField(model)
    x, command, p, w = model.symbols()
    f = model.dynamics(x, command, p, w)
    at = [x, ca.SX(u), ca.SX(field.parameters), ca.SX.zeros(model.n_w)]
    f = ca.Function("f", [x, command, p, w], [f])(*at)
    slope = ca.jacobian(f, x)
    blocks: list[StateBlock] = []
    not_constant: set[int] = set()
    # Half-widths within which the constants of the blocks before are known.
    half_widths = widths.copy()
    pattern = ca.DM(slope.sparsity(), 1.0).full() > 0
    for members in _cascade(slope.sparsity()):
        named = tuple(model.state_names[i] for i in members)
        if blocks and not blocks[-1].constant:
            not_constant |= {model.state_index(name) for name in blocks[-1].states}
        if any(pattern[i, j] for i in members for j in not_constant):
            blocks.append(StateBlock(named, None, False, False, is_driven=True))
            continue
        if len(members) == 1:
            blocks.append(StateBlock(named, None, True, True))
            own = ca.Function("own", [x], [ca.densify(slope[members, members])])
            if _falls(own, box):
                # Its equilibrium is the only one in the box.
                half_widths[members] = _ROUNDING * (1.0 + np.abs(x_rest[members]))
            continue
        if len(members) > 2:
            own = ca.Function("own", [x], [ca.densify(slope[members, members])])
            share = share_without_orbits(own, members, x_rest, half_widths)
            blocks.append(StateBlock(named, None, False, False, share=share))
            continue
        divergence = ca.densify(ca.simplify(ca.trace(slope[members, members])))
        blocks.append(_bounded(named, ca.Function("divergence", [x], [divergence]), box))
    return Absence(blocks)


def _falls(slope: ca.Function, box: tuple[FloatArray, FloatArray]) -> bool:
    """Whether the slope of a scalar equation is negative in the box."""
    try:
        bounds = Enclosure(slope)(Interval.of(box[0][None], box[1][None]))[0]
    except ModelError:
        return False
    return bool(bounds.upper.max() < 0.0)


def _cascade(sparsity: ca.Sparsity) -> list[list[int]]:
    """Strongly connected parts of the graph "state j acts on state i", drivers first."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    rows, columns = sparsity.get_triplet()
    n = sparsity.size1()
    graph = csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    count, label = connected_components(graph, directed=True, connection="strong")
    drivers: list[set[int]] = [set() for _ in range(count)]
    for i, j in zip(rows, columns, strict=True):
        if label[i] != label[j]:
            drivers[label[i]].add(int(label[j]))
    order: list[int] = []
    while len(order) < count:
        ready = [k for k in range(count) if k not in order and drivers[k] <= set(order)]
        order += ready
    return [np.flatnonzero(label == k).tolist() for k in order]


def _bounded(
    named: tuple[str, ...], divergence: ca.Function, box: tuple[FloatArray, FloatArray]
) -> StateBlock:
    """A block of two states with bounds of its divergence."""
    try:
        enclosure = Enclosure(divergence)
    except ModelError:
        return StateBlock(named, None, False, False)
    n = len(box[0])
    everything = Interval.of(np.full((1, n), -np.inf), np.full((1, n), np.inf))
    # The box in pieces along the states that the divergence depends on.
    acting = set(divergence.sparsity_jac(0, 0).get_triplet()[1])
    count = [_CUTS + 1 if i in acting else 2 for i in range(n)]
    pieces = _pieces([np.linspace(*ends) for ends in zip(*box, count, strict=True)])
    for region, everywhere in ((everything, True), (pieces, False)):
        bounds = enclosure(region)[0]
        low, high = float(bounds.lower.min()), float(bounds.upper.max())
        if high < 0.0 or low > 0.0:
            return StateBlock(named, (low, high), everywhere, True)
    return StateBlock(named, (low, high), False, False)


def _pieces(cuts: Sequence[FloatArray]) -> Interval:
    """The boxes between the cuts of each state."""
    lower = np.stack([g.ravel() for g in np.meshgrid(*(c[:-1] for c in cuts))], axis=1)
    upper = np.stack([g.ravel() for g in np.meshgrid(*(c[1:] for c in cuts))], axis=1)
    return Interval.of(lower, upper)


#: 1/s, above the rounding of eigenvalues and of the change of coordinates.
_MARGIN = 1e-6
#: Pieces of the box, by how many states the slopes depend on.
_PIECES = {0: 1, 1: 400, 2: 48, 3: 12, 4: 7}
#: Half-widths that are not cut.
_NARROW = 1e-4
#: Halvings that find the largest share of the box.
_HALVINGS = 6
_SCALES = np.geomspace(0.2, 5.0, 5)


def share_without_orbits(
    slope: ca.Function, members: Sequence[int], x: FloatArray, widths: FloatArray
) -> float:
    """Largest share of a box around an equilibrium that is proved to hold no periodic orbit.

    ``slope`` is ``x → ∂f/∂x`` of the block whose states are the ``members`` of x, (k, k). A
    half-width of zero keeps a state. From 0 (nothing is proved) to 1 (the whole box).
    """
    try:
        enclosure = Enclosure(slope)
        J = np.array(slope(x), dtype=float).reshape(len(members), len(members))
        candidates = _coordinates(J)
    except (np.linalg.LinAlgError, ModelError):
        return 0.0
    acting = sorted({int(j) for j in slope.sparsity_jac(0, 0).get_triplet()[1]})
    acting = [i for i in acting if widths[i] > _NARROW]
    if len(acting) not in _PIECES:
        return 0.0

    def bound(T: FloatArray, share: float) -> float:
        """The largest λ₁ + λ₂ over a share of the box, 1/s."""
        cuts = [np.array([a - share * w, a + share * w]) for a, w in zip(x, widths, strict=True)]
        for i in acting:
            ends = np.linspace(float(cuts[i][0]), float(cuts[i][1]), _PIECES[len(acting)] + 1)
            # A kink at zero is met by boxes on either side of it, not across.
            cuts[i] = np.unique(np.append(ends, 0.0)) if ends[0] < 0.0 < ends[-1] else ends
        J = enclosure(_pieces(cuts))[0]
        W = np.linalg.inv(T)
        middle, radius = 0.5 * (J.lower + J.upper), 0.5 * (J.upper - J.lower)
        if not np.all(np.isfinite(radius)):
            return float("inf")
        centre = W @ middle @ T
        around = np.abs(W) @ radius @ np.abs(T)
        values = np.linalg.eigvalsh(0.5 * (centre + centre.transpose(0, 2, 1)))
        reach = np.linalg.eigvalsh(0.5 * (around + around.transpose(0, 2, 1)))
        return float((values[:, -1] + values[:, -2] + 2.0 * np.abs(reach).max(axis=1)).max())

    best = 0.0
    for T in candidates:
        if bound(T, best or 1e-3) >= -_MARGIN:
            continue
        low, high = best, 1.0
        if bound(T, 1.0) < -_MARGIN:
            return 1.0
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            shrinks = bound(T, middle) < -_MARGIN
            low, high = (middle, high) if shrinks else (low, middle)
        best = max(best, low)
    return best


def _coordinates(J: FloatArray) -> list[FloatArray]:
    """Real modal coordinates, the first mode scaled against the others."""
    values, vectors = np.linalg.eig(J)
    columns, visited = list[FloatArray](), set[int]()
    groups: list[list[int]] = []
    for i in np.argsort(values.real):
        if int(i) in visited:
            continue
        visited.add(int(i))
        if abs(values[i].imag) < 1e-12:
            groups.append([len(columns)])
            columns.append(vectors[:, i].real)
            continue
        visited.add(int(np.argmin(np.abs(values - values[i].conj()))))
        groups.append([len(columns), len(columns) + 1])
        columns += [vectors[:, i].real, vectors[:, i].imag]
    T = np.column_stack(columns)
    if len(groups) == 1:
        return [T]
    candidates = []
    for scale in _SCALES:
        scaled = T.copy()
        scaled[:, groups[-1]] *= scale
        np.linalg.inv(scaled)
        candidates.append(scaled)
    return candidates
