"""Margins as data: what a program reads of them."""

from __future__ import annotations

import math
from typing import Any

from trms_cli.stability.loops.crossings import Crossings, Limit
from trms_cli.stability.loops.disk_margin import DiskMargin
from trms_cli.stability.loops.frequency_response import Measured
from trms_cli.stability.loops.margins import Margins


def results_of(margins: Margins) -> dict[str, Any]:
    """The margins as data; angles in rad."""
    m = margins.measured
    return {
        "holds": True,
        "loops": {
            loop.name: {
                **_crossings_data(loop.crossings),
                "peak_sensitivity": loop.sensitivity.value,
                "modulus_margin": 1 / loop.sensitivity.value,
                "peak_complementary": loop.complementary.value,
                "disk": _disk_data(loop.disk),
            }
            for loop in margins.loops
        },
        "alike": _crossings_data(margins.together),
        "disk_each": _disk_data(margins.disk_each),
        "disk_any": _disk_data(margins.disk_any),
        "peak_sensitivity": margins.sensitivity.value,
        "least_return_difference": 1 / margins.sensitivity.value,
        "peak_complementary": margins.complementary.value,
        "response": _response_data(m),
        "quality": {
            "drift": m.drift,
            "nonlinearity": m.nonlinearity,
            "beside": m.beside,
            "interpolation": margins.interpolation,
            "limited": m.limited,
            "reversed": list(m.reversed),
            "held_by_dry_friction": list(m.held),
            "statuses": dict(m.statuses),
        },
    }


def _crossings_data(c: Crossings) -> dict[str, float | None]:
    return {
        "gain_up": value_of(c.up),
        "gain_down": value_of(c.down),
        "phase": value_of(c.phase),
        "delay": value_of(c.delay),
        "crossover": c.crossover,
    }


def _disk_data(disk: DiskMargin) -> dict[str, float | None]:
    up = None if math.isinf(disk.gain_up) else disk.gain_up
    return {
        "alpha": disk.alpha,
        "omega": disk.omega,
        "gain_down": disk.gain_down,
        "gain_up": up,
        "phase": disk.phase,
    }


def _response_data(m: Measured) -> dict[str, Any]:
    """L at the lines, row by column: real and imaginary parts."""
    L = m.L
    return {
        "omega": m.omega.tolist(),
        "control_period": m.step,
        "inputs": list(m.inputs),
        "L_real": L.real.tolist(),
        "L_imaginary": L.imag.tolist(),
    }


def value_of(limit: Limit | None, degrees: bool = False) -> float | None:
    """A limit's value; None where there is none."""
    if limit is None:
        return None
    return math.degrees(limit.value) if degrees else limit.value
