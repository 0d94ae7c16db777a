"""What a figure of a score is called on an axis: ``rmse_alpha_h`` is *yaw RMSE*."""

from __future__ import annotations

from trms_cli.reporting.style import LABELS

_WORDS = {
    "rmse": "RMSE",
    "iae": "IAE",
    "ise": "ISE",
    "itae": "ITAE",
    "effort": "effort ∫u²dt",
    "total_variation": "total variation Σ|Δu|",
    "merit": "figure of merit",
}


def figure_label(name: str, unit: str = "") -> str:
    """A figure in words, with its unit.

    Parameters
    ----------
    name : str
        As scores and ``trms runs`` have it.
    unit : str
        "" for counts.
    """
    stem, channel = name, ""
    for each, said in LABELS.items():
        if name.endswith(f"_{each}"):
            stem, channel = name.removesuffix(f"_{each}"), f"{said} "
    words = _WORDS.get(stem, stem.replace("_", " "))
    return f"{channel}{words}" + (f" [{unit}]" if unit else "")
