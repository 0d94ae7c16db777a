"""How much of a run the loop was not normal, and why: from the modes that its supervisor logged."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from trms_cli.scoring.metrics import Array

#: Modes other than normal, as the log names them.
MODES = ("degraded", "landing")


def degraded_figures(time: Array, columns: Mapping[str, Any]) -> dict[str, Any] | None:
    """Figures of the modes, or None for a run without a supervisor's words.

    Parameters
    ----------
    time : (n,) array
        s, of the control samples.
    columns : mapping
        With ``mode`` and ``reasons``, (n,) texts.

    Returns
    -------
    dict or None
        ``share`` of the control samples by mode; ``reasons_s``: seconds by reason (``missing
        alpha_h``), which may overlap; ``first_s``, when it first was not normal (None for never);
        ``landings``, how often the rig was landed.
    """
    if "mode" not in columns or len(time) == 0:
        return None
    modes = np.asarray(columns["mode"], dtype=object)
    period = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    seconds: dict[str, float] = {}
    for text in columns["reasons"]:
        for reason in filter(None, text.split("; ")):
            seconds[reason] = seconds.get(reason, 0.0) + period
    strange = np.flatnonzero(modes != "normal")
    landing = modes == "landing"
    return {
        "share": {mode: float(np.mean(modes == mode)) for mode in MODES},
        "reasons_s": {reason: round(value, 9) for reason, value in sorted(seconds.items())},
        "first_s": float(time[strange[0]]) if strange.size else None,
        "landings": int(np.count_nonzero(landing[1:] & ~landing[:-1]) + bool(landing[0])),
    }
