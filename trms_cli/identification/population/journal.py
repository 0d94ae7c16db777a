"""What a population method has tried, generation by generation, to go on from there.

A search is a pure function of its seed and of the costs that it was told. So the costs are all
that has to be kept: a search that goes on from a journal asks for the same points again, is told
the costs that stand there without a simulation, and is then where it was, bit for bit. The points'
digests tell when it is not the same search: other settings, another version of a library.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError

FloatArray = npt.NDArray[np.float64]

_WHERE = "resume"


class Entry(msgspec.Struct, frozen=True):
    """One generation."""

    points: str  #: Digest of the points that were asked for
    costs: list[float | None]  #: Of each point; None where the simulation failed
    seconds: float  #: Of computing up to the end of this generation

    def told(self) -> FloatArray:
        """The costs, infinite where a simulation failed."""
        return np.array([np.inf if cost is None else cost for cost in self.costs])


class _State(msgspec.Struct):
    about: dict[str, Any]
    generations: list[Entry]


class Journal:
    """The generations of a search.

    Parameters
    ----------
    about : mapping
        All that the points and their costs depend on, as plain data.
    saved : mapping or None
        The :attr:`state` of an earlier search that is to go on; None begins.

    Raises
    ------
    ConfigurationError
        If the earlier search was another one.
    """

    def __init__(
        self, about: Mapping[str, Any] | None = None, saved: Mapping[str, Any] | None = None
    ) -> None:
        # As JSON reads it back: a tuple is a list there.
        self._about = msgspec.json.decode(msgspec.json.encode(dict(about or {})))
        self._entries: list[Entry] = []
        if saved is not None:
            self._entries = self._of_this_search(saved).generations

    @property
    def state(self) -> dict[str, Any]:
        """All of it as JSON has it."""
        found = msgspec.to_builtins(_State(self._about, self._entries))
        assert isinstance(found, dict)
        return found

    def recorded(self, number: int, points: FloatArray) -> Entry | None:
        """The generation `number` (from 0 on) if it stands here.

        Raises ConfigurationError if other points were asked for then.
        """
        if number >= len(self._entries):
            return None
        entry = self._entries[number]
        if entry.points != digest(points) or len(entry.costs) != len(points):
            raise ConfigurationError(
                f"generation {number + 1} does not come out as it was then: another version of "
                "NumPy or of the optimiser draws other points",
                where=_WHERE,
                remedy="fit anew into another folder",
            )
        return entry

    def keep(self, points: FloatArray, costs: FloatArray, seconds: float) -> None:
        """Add a generation."""
        values = [float(cost) if np.isfinite(cost) else None for cost in costs]
        self._entries.append(Entry(digest(points), values, seconds))

    def _of_this_search(self, saved: Mapping[str, Any]) -> _State:
        try:
            then = msgspec.convert(dict(saved), _State)
        except msgspec.ValidationError as error:
            raise ConfigurationError(
                f"what was kept there is of another method or version: {error}",
                where=_WHERE,
                remedy="fit anew into another folder",
            ) from None
        for key in {**then.about, **self._about}:
            before, now = then.about.get(key), self._about.get(key)
            if before != now:
                raise ConfigurationError(
                    f"{key} was {before!r} and is {now!r} now, so what was tried then is no "
                    "beginning of this search",
                    where=_WHERE,
                    remedy="go on with the settings of then, or fit anew into another folder",
                )
        return then


def digest(points: FloatArray) -> str:
    """Of every bit of the points."""
    return hashlib.sha256(np.ascontiguousarray(points, dtype=float).tobytes()).hexdigest()[:16]
