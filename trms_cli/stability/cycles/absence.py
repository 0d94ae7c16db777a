"""Proofs that there is no periodic orbit: Bendixson's criterion on a cascade of small blocks.

The states fall into blocks that drive one another in one direction only (the strongly connected
parts of the graph of ∂f/∂x: the rotors drive the beam, not the other way round). On a periodic
orbit of the whole, taken in the order of the cascade, with what drives a block constant:

- a block of one state is a scalar autonomous equation: its periodic solutions are constant;
- a block of two states is a planar autonomous field: if its divergence has one sign on a simply
  connected region, there is no closed orbit in it (Bendixson 1901; Khalil, "Nonlinear Systems",
  3rd ed., lemma 2.2; for Lipschitz fields with the divergence almost everywhere). Its periodic
  solutions are constant too.

So every periodic orbit is an equilibrium if all blocks are of these kinds. Of a block of more
states :mod:`trms_cli.stability.cycles.contracting_areas` finds a part of the box without a closed
orbit. The divergence is bounded by interval arithmetic on the model's own equations, first over all
of the state space, then over the box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ModelError
from trms_cli.models.model import Model
from trms_cli.models.vector_field import VectorField
from trms_cli.stability.cycles.contracting_areas import share_without_orbits
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval

FloatArray = npt.NDArray[np.float64]

#: Boxes that a region is cut into, along each of a block's two states and the ones that drive it.
_CUTS = 8
#: Equilibria are known to this part.
_ROUNDING = 1e-8


@dataclass(frozen=True)
class Block:
    """States that drive one another."""

    states: tuple[str, ...]
    divergence: tuple[float, float] | None  #: Bounds, 1/s, of a block of two states
    everywhere: bool  #: Whether they hold for all states; else in the box
    constant: bool  #: Whether its periodic solutions are proved to be constant
    driven: bool = False  #: Whether a block that is not proved constant acts on it
    #: Of a block of more than two states: part of the box that holds no periodic orbit, from 0
    share: float = 0.0

    @property
    def reason(self) -> str:
        """Why, in a few words."""
        if self.driven:
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

    blocks: Sequence[Block]  #: In the order in which they drive one another

    @property
    def proved(self) -> bool:
        """No periodic orbit but the equilibria."""
        return all(block.constant for block in self.blocks)

    @property
    def everywhere(self) -> bool:
        """For all states, not only in the box."""
        return all(block.everywhere for block in self.blocks)


def absence(model: Model, x_rest: FloatArray, u: FloatArray, widths: FloatArray) -> Absence:
    """Whether the model has no periodic orbit with a command held.

    Parameters
    ----------
    model : Model
        With equations; impulses are no part of what is proved.
    x_rest : (n_x,)
        The equilibrium.
    u : (n_u,)
        Its command.
    widths : (n_x,)
        Half-widths of the box around it, where nothing can be said for all states.
    """
    box = x_rest - widths, x_rest + widths
    field = VectorField(model)
    x, command, p, w = model.symbols()
    f = model.dynamics(x, command, p, w)
    at = [x, ca.SX(u), ca.SX(field.parameters), ca.SX.zeros(model.n_w)]
    f = ca.Function("f", [x, command, p, w], [f])(*at)
    slope = ca.jacobian(f, x)
    blocks: list[Block] = []
    not_constant: set[int] = set()
    # Half-widths within which the constants of the blocks before are known.
    known = widths.copy()
    pattern = ca.DM(slope.sparsity(), 1.0).full() > 0
    for members in _cascade(slope.sparsity()):
        named = tuple(model.state_names[i] for i in members)
        if blocks and not blocks[-1].constant:
            not_constant |= {model.state_index(name) for name in blocks[-1].states}
        if any(pattern[i, j] for i in members for j in not_constant):
            blocks.append(Block(named, None, False, False, driven=True))
            continue
        if len(members) == 1:
            blocks.append(Block(named, None, True, True))
            own = ca.Function("own", [x], [ca.densify(slope[members, members])])
            if _falls(own, box):
                # Its equilibrium is the only one in the box.
                known[members] = _ROUNDING * (1.0 + np.abs(x_rest[members]))
            continue
        if len(members) > 2:
            own = ca.Function("own", [x], [ca.densify(slope[members, members])])
            share = share_without_orbits(own, members, x_rest, known)
            blocks.append(Block(named, None, False, False, share=share))
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
) -> Block:
    """A block of two states with bounds of its divergence."""
    try:
        enclosure = Enclosure(divergence)
    except ModelError:
        return Block(named, None, False, False)
    n = len(box[0])
    everything = Interval.of(np.full((1, n), -np.inf), np.full((1, n), np.inf))
    for region, everywhere in ((everything, True), (_cut(divergence, box), False)):
        bounds = enclosure(region)[0]
        low, high = float(bounds.lower.min()), float(bounds.upper.max())
        if high < 0.0 or low > 0.0:
            return Block(named, (low, high), everywhere, True)
    return Block(named, (low, high), False, False)


def _cut(divergence: ca.Function, box: tuple[FloatArray, FloatArray]) -> Interval:
    """The box in pieces along the states that the divergence depends on."""
    low, high = box
    acting = sorted(set(divergence.sparsity_jac(0, 0).get_triplet()[1]))
    cuts = [
        np.linspace(low[i], high[i], _CUTS + 1) if i in acting else np.array([low[i], high[i]])
        for i in range(len(low))
    ]
    lower = np.stack([g.ravel() for g in np.meshgrid(*(c[:-1] for c in cuts))], axis=1)
    upper = np.stack([g.ravel() for g in np.meshgrid(*(c[1:] for c in cuts))], axis=1)
    return Interval.of(lower, upper)
