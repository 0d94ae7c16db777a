"""Bounds of the equations of one block, with their slopes, over boxes of its unknowns."""

from __future__ import annotations

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.stability.equilibria.rest_system import Block, RestSystem
from trms_cli.stability.intervals.enclosure import Enclosure
from trms_cli.stability.intervals.interval import Interval

FloatArray = npt.NDArray[np.float64]

#: Halvings of a box in which the mobility may have to be shown regular.
_REGULARITY_CUTS = 14


class BlockEquations:
    """``g_b`` of a block over boxes.

    Given are all unknowns z (those of blocks before are read) and v, side by side, as intervals:
    what is proved holds for each of their values.

    Parameters
    ----------
    system : RestSystem
    block : Block
    """

    def __init__(self, system: RestSystem, block: Block) -> None:
        self.n = len(block.unknowns)
        n_z, n_v = system.n, len(system.given)
        own, given = ca.SX.sym("own", self.n), ca.SX.sym("given", n_z + n_v)
        p = ca.SX.sym("p", len(system.model.parameters))
        z = given[:n_z]
        for k, j in enumerate(block.unknowns):
            z[j] = own[k]
        g = system.residual(z, given[n_z:], p)[list(block.rows)]
        slopes = ca.densify(ca.jacobian(g, own))
        (g, slopes), constants, bounds = _constants_apart([g, slopes], p, system)
        self._constants = bounds
        arguments = [own, given, constants]
        self._values = Enclosure(ca.Function("values", arguments, [g]))
        self._both = Enclosure(ca.Function("both", arguments, [g, slopes]))

    def values(self, own: Interval, given: Interval) -> Interval:
        """g over boxes, (m, n)."""
        return self._values(own, given, self._constants)[0]

    def with_slopes(self, own: Interval, given: Interval) -> tuple[Interval, Interval]:
        """g over boxes, (m, n), and its slopes in the block's unknowns, (m, n, n)."""
        g, slopes = self._both(own, given, self._constants)
        return g, slopes if slopes.lower.ndim == 3 else slopes[:, :, None]


class PointBounds:
    """Bounds of the whole state and the commands over boxes of z and v.

    Parameters
    ----------
    system : RestSystem
    """

    def __init__(self, system: RestSystem) -> None:
        z, v = ca.SX.sym("z", system.n), ca.SX.sym("v", len(system.given))
        p = ca.SX.sym("p", len(system.model.parameters))
        state, commands, _ = system.point(z, v, p)
        found, constants, self._constants = _constants_apart([state, commands], p, system)
        self._function = Enclosure(ca.Function("point", [z, v, constants], found))

    def __call__(self, z: Interval, v: Interval) -> tuple[Interval, Interval]:
        """x, (m, n_x), and u, (m, n_u)."""
        state, commands = self._function(z, v, self._constants)
        return state, commands


def is_regular(system: RestSystem, box: Interval, v: Interval) -> bool:
    """Whether nothing that the rows of a system were divided by is zero in a box of its unknowns.

    Parameters
    ----------
    box : Interval
        (n,); infinite where there is no bound.
    v : Interval
        (n_v,).
    """
    z, given = ca.SX.sym("z", system.n), ca.SX.sym("v", len(system.given))
    p = ca.SX.sym("p", len(system.model.parameters))
    (w,), constants, bounds = _constants_apart([system.nonzero(z, given, p)], p, system)
    read = [j for j in range(system.n) if ca.depends_on(w, z[j])] if w.numel() else []
    enclosure = Enclosure(ca.Function("nonzero", [z, given, constants], [w]))
    boxes = box[None, :]
    for _ in range(_REGULARITY_CUTS):
        found = enclosure(boxes, v, bounds)[0]
        doubtful = np.any(found.contains_zero() | ~np.isfinite(found.width), axis=1)
        if not doubtful.any():
            return True
        boxes = boxes[doubtful]
        for j in read:
            if not np.all(np.isfinite(boxes.width[:, j])):
                return False
            first, second = boxes.upper.copy(), boxes.lower.copy()
            first[:, j] = second[:, j] = boxes.middle[:, j]
            boxes = Interval(
                np.concatenate([boxes.lower, second]), np.concatenate([first, boxes.upper])
            )
    return False


def _constants_apart(
    expressions: list[ca.SX], p: ca.SX, system: RestSystem
) -> tuple[list[ca.SX], ca.SX, Interval]:
    """Expressions with what depends on parameters alone as constants, and the constants' bounds."""
    shapes = [e.shape for e in expressions]
    together = ca.cse(ca.vertcat(*(ca.vec(e) for e in expressions)))
    symbols: list[ca.SX] = []
    parts: list[ca.SX] = []
    if p.numel():
        together, symbols, parts = ca.extract_parametric(together, p)
    enclosure = Enclosure(ca.Function("constants", [p], [ca.vertcat(p, *parts)]))
    bounds = enclosure(Interval.point(system.model.parameters.values))[0]
    found, at = [], 0
    for rows, columns in shapes:
        found.append(ca.densify(ca.reshape(together[at : at + rows * columns], rows, columns)))
        at += rows * columns
    return found, ca.vertcat(p, *symbols), bounds[0]
