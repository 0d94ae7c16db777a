"""An index of the runs there are: found in folders, filtered, sorted, exported.

from trms_cli.runs import runs_frame
frame = runs_frame("controller == 'newton_mpc' and rmse_yaw < 0.05")
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from trms_cli.runs.frame import find_runs as find_runs
    from trms_cli.runs.frame import runs_frame as runs_frame
    from trms_cli.runs.frame import runs_table as runs_table

__all__ = ["find_runs", "runs_frame", "runs_table"]


def __getattr__(name: str) -> Any:
    """Import what is asked for: a run that only tells of itself waits for no database."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from trms_cli.runs import frame

    return getattr(frame, name)
