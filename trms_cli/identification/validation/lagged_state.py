"""The state of a model whose states are remembered outputs and inputs, straight from the record.

A NARX network's state at a sample is what was measured and commanded before it. No observer is
needed, and none would do: the one-step prediction of such a model is one step from measured values.
"""

from __future__ import annotations

import numpy as np

from trms_cli.identification.dataset import Dataset, FloatArray
from trms_cli.models.discrete import copied_states
from trms_cli.models.model import Model, names


def measured_states(model: Model, dataset: Dataset) -> FloatArray | None:
    """The states at every sample, as far as measured.

    Parameters
    ----------
    model : Model
    dataset : Dataset

    Returns
    -------
    (n, n_x) array or None
        NaN where something is missing or lies before the recording; None for a model that has a
        derivative, or a state that is neither a measured output nor a copy of one or of an input.
    """
    if getattr(model, "sample_time", None) is None:
        return None
    copies = copied_states(model)
    measured = {name: column for column, name in enumerate(names(dataset.outputs))}
    states = np.full((len(dataset), model.n_x), np.nan)
    for i in range(model.n_x):
        kind, at, delay = "x", i, 0
        while kind == "x" and at in copies and delay <= model.n_x:
            kind, at = copies[at]
            delay += 1
        if kind == "u":
            source = dataset.commands[:, at]
        elif model.states[at].name in measured:
            source = dataset.measurements[:, measured[model.states[at].name]]
        else:
            return None
        states[delay:, i] = source[: len(dataset) - delay]
    return states
