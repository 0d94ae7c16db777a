"""Controllability and observability as JSON data."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.stability.local.found import Along, Found
from trms_cli.stability.local.reach import Reach
from trms_cli.stability.local.told import finite

FloatArray = npt.NDArray[np.float64]


def data_of(found: Found, along: Along) -> dict[str, Any]:
    """The study as JSON data."""
    model = found.model
    inputs = [signal.name for signal in model.inputs]
    with_all = [*inputs, "together"] if model.n_u > 1 else inputs
    sets = [list(one) for one in found.sets]
    gramians = found.gramians
    return {
        "at": {
            "x": dict(zip(model.state_names, map(float, found.point.x), strict=True)),
            "u": dict(zip(inputs, map(float, found.point.u), strict=True)),
        },
        "duration_s": found.duration,
        "scales": {
            "x": dict(zip(model.state_names, map(float, found.scales.x), strict=True)),
            "u": dict(zip(inputs, map(float, found.scales.u), strict=True)),
        },
        "modes": [
            {
                "name": a.mode.name,
                "real": finite(a.mode.eigenvalue.real),
                "imag": finite(a.mode.eigenvalue.imag),
                "by_input": {
                    name: _reach_data(reach)
                    for name, reach in zip(with_all, a.by_input, strict=True)
                },
                "by_sensors": [
                    {"sensors": one} | _reach_data(reach)
                    for one, reach in zip(sets, a.by_sensors, strict=True)
                ],
            }
            for a in found.access
        ],
        "least_rms_command": {
            name: {inputs[j]: finite(float(found.volts[i, j])) for j in range(model.n_u)}
            for i, name in enumerate(model.state_names)
        },
        "gramians": {
            "controllability": _matrix(gramians.reach),
            "observability": _matrix(gramians.sight),
            "controllability_forever": _matrix(gramians.reach_forever),
            "observability_forever": _matrix(gramians.sight_forever),
            "hankel": None if gramians.hankel is None else [float(v) for v in gramians.hankel],
            "lyapunov_residual": finite(gramians.residual),
        },
        "torques": [
            {
                "sensors": list(one),
                "together": found.torques[one].together,
                "alone": {
                    t.name: {
                        "seen": t.seen,
                        "error": finite(t.errors[0]),
                        "errors_over_time": [finite(v) for v in t.errors[1:]],
                    }
                    for t in found.torques[one].torques
                },
            }
            for one in found.sets
        ],
        "torque_times_s": list(found.times),
        "range": {
            "over": along.path.over,
            "unit": along.path.unit,
            "values": [float(v) for v in along.sweep.values],
            "states": {
                name: [float(place.point.x[i]) for place in along.sweep.places]
                for i, name in enumerate(model.state_names)
            },
            "moved_per_unit_rms": {
                name: {
                    inputs[j]: [float(v) for v in along.reach.per_volt[:, i, j]]
                    for j in range(model.n_u)
                }
                for i, name in enumerate(model.controlled)
            },
            "pbh_margin": {
                name: {
                    inputs[j]: [finite(float(v)) for v in along.reach.margin[:, i, j]]
                    for j in range(model.n_u)
                }
                for i, name in enumerate(model.controlled)
            },
            "ended_low": along.sweep.low or None,
            "ended_high": along.sweep.high or None,
        },
    }


def _reach_data(reach: Reach) -> dict[str, Any]:
    return {
        "grade": reach.grade,
        "margin": finite(reach.margin),
        "strength": finite(reach.strength),
    }


def _matrix(matrix: FloatArray | None) -> list[list[float]] | None:
    return None if matrix is None else [[float(v) for v in row] for row in matrix]
