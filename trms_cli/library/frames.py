"""Tables as pandas frames, with their units; pandas is asked for only here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from trms_cli.core.errors import TrmsError

if TYPE_CHECKING:
    import pandas  # type: ignore[import-untyped,unused-ignore]


def frame_of(
    columns: Mapping[Any, Any], units: Mapping[str, str], index: Any = None, name: str = ""
) -> pandas.DataFrame:
    """A pandas frame; the units of its columns go to ``frame.attrs["units"]``, `name` to its index.

    Raises TrmsError if pandas is not installed: it is no dependency of this package.
    """
    frames = load_pandas()
    made = frames.DataFrame(dict(columns), index=index)
    if name:
        made.index.name = name
    made.attrs["units"] = dict(units)
    return made


def load_pandas() -> Any:
    """The package pandas; raises TrmsError if it is not installed."""
    from importlib import import_module
    from importlib.util import find_spec

    if find_spec("pandas") is None:
        raise TrmsError(
            "a frame needs pandas, which is not installed",
            remedy="pip install 'trms-cli[notebook]', or pip install pandas",
        )
    return import_module("pandas")
