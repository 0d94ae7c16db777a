"""A line of ``trms doctor``'s report."""

from typing import NamedTuple

OK, SLOWER, BROKEN = "ok", "note", "broken"


class Check(NamedTuple):
    """One line of the report."""

    what: str
    state: str  #: ok, note (works all the same), broken
    found: str
    remedy: str = ""
