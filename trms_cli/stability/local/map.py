"""Stability over two numbers at once: the largest growth rate on a grid, and its boundary."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

from trms_cli.core.errors import TrmsError
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.stability.local.modes import rate_of
from trms_cli.stability.local.parts import STILL
from trms_cli.stability.local.sweep import Path

FloatArray = npt.NDArray[np.float64]

#: Boundary points are located to this share of a cell.
_EXACT = 1e-10


@dataclass(frozen=True)
class StabilityMap:
    """The largest growth rate over two numbers."""

    over: FloatArray  #: (n,), (m,) arrays
    against: FloatArray  #: (n,), (m,) arrays
    #: (m, n) array; largest Re λ of what is not at rest on the imaginary axis throughout, 1/s; NaN
    #: where there is no operating point within the rig's limits
    growth: FloatArray
    #: (k, 2) array; points (over, against) where it is zero, each located along ``over``
    boundary: FloatArray


def stability_map(
    path: Path,
    against: str,
    over_range: tuple[float, float],
    against_range: tuple[float, float],
    size: tuple[int, int],
    tell: Callable[[str], None],
) -> StabilityMap:
    """Evaluate the grid, row by row along the operating points.

    Parameters
    ----------
    path : Path
        Over the first number.
    against : str
        The second: a controlled state, an input or a parameter.
    size : (int, int)
        Values of each.

    Raises
    ------
    TrmsError
        Where the grid has no operating point to begin at.
    """
    over = np.linspace(*over_range, size[0])
    levels = np.linspace(*against_range, size[1])
    growth = np.full((len(levels), len(over)), np.nan)
    found: list[tuple[float, float]] = []
    begin: OperatingPoint | None = None
    held = None
    for i, level in enumerate(levels):
        if i % 8 == 0:
            tell(f"map, {100 * i // len(levels)} %")
        row = path.moved(against, float(level))
        following = row.held(float(over[0]))
        if begin is None:
            begin = _anywhere(row, float(over[0]))
        elif held is not None:
            begin = row.balance.advance(held, following, begin) or _anywhere(row, float(over[0]))
        held = following
        if begin is not None:
            _fill(row, over, begin, growth[i], float(level), found)
    return StabilityMap(over, levels, growth, np.array(found).reshape(-1, 2))


def _anywhere(path: Path, value: float) -> OperatingPoint | None:
    try:
        return path.first(value, value).point
    except TrmsError:
        return None


def _fill(
    path: Path,
    over: FloatArray,
    begin: OperatingPoint,
    row: FloatArray,
    level: float,
    found: list[tuple[float, float]],
) -> None:
    """One row of the map, and its boundary points."""
    point: OperatingPoint | None = begin
    last = path.held(float(over[0]))
    for k, value in enumerate(over):
        held = path.held(float(value))
        before = point
        point = path.balance.advance(last, held, before) if before is not None else None
        if point is None:
            return
        if path.balance.within_limits(point):
            row[k] = _growth(path, float(value), point)
        if k and row[k - 1] * row[k] < 0 and before is not None:
            here, start = last, before

            def rate(v: float, here=here, start=start) -> float:  # type: ignore[no-untyped-def]
                at = path.balance.advance(here, path.held(v), start)
                return np.nan if at is None else _growth(path, v, at)

            try:
                cell = float(over[k] - over[k - 1])
                root = brentq(rate, over[k - 1], value, xtol=_EXACT * abs(cell))
            except (ValueError, RuntimeError):
                root = None
            if root is not None and abs(rate(root)) < 1e-6:
                found.append((float(root), level))
        last = held


def _growth(path: Path, value: float, point: OperatingPoint) -> float:
    a = path.linear.a(point.x, point.u, path.side, path.held(value).p)
    rates = [rate_of(v, path.model.sample_time) for v in np.linalg.eigvals(a)]
    moving = [rate.real for rate in rates if abs(rate) > STILL and np.isfinite(rate.real)]
    return max(moving, default=0.0)
