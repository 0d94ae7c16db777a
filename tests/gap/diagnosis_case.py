"""A diagnosis made by hand, with figures as a rig with yaw friction gives them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from trms_cli.composition.catalogue import read_yaml
from trms_cli.gap.diagnosis import DiagnosisResult, Gap, Shrink, Traces

DOCUMENT = Path(__file__).with_suffix(".yaml")
FRICTION = "yaw_coulomb_friction"
CHANNELS = {"alpha_v": "rad", "alpha_h": "rad", "omega_v": "rad/s", "omega_h": "rad/s"}


def traces() -> Traces:
    """A friction torque on a slow swing of yaw, and free runs of 20 s that miss it."""
    draw = np.random.default_rng(1)
    time = np.arange(0.0, 120.0, 0.1)
    rate = 0.8 * np.sin(0.9 * time) + 0.3 * np.sin(2.3 * time)
    friction = -0.0041 * np.sign(rate)
    wander = np.convolve(draw.standard_normal(len(time)), np.ones(7) / 7, "same")
    run = np.arange(90.0, 110.0, 0.05)
    swing = 0.5 * np.sin(0.9 * run)
    runs: dict[str, Any] = {}
    for name, unit in CHANNELS.items():
        size = 0.4 if unit == "rad" else 150.0
        true = size * swing + (0.0 if name == "alpha_h" else 0.3 * size)
        off = size * (0.5 if name == "alpha_h" else 0.02)
        growth = 1 - np.exp(-(run - run[0]) / 4)
        runs[name] = {
            "measured": true + 0.002 * size * draw.standard_normal(len(run)),
            "raw": true + off * growth * np.cos(0.7 * run),
            "refit": true + 0.6 * off * growth * np.cos(0.7 * run),
            "corrected": true + 0.05 * off * growth * np.cos(0.7 * run),
        }
    return Traces(
        force_time=time,
        force={
            "yaw_moment": friction + 6e-4 * wander,
            "yaw_moment.sd": np.full(len(time), 5e-4),
            "pitch_moment": 4e-4 * wander,
            "pitch_moment.sd": np.full(len(time), 6e-4),
        },
        force_unit={"yaw_moment": "N*m", "pitch_moment": "N*m"},
        explained={"yaw_moment": friction},
        run_time=run,
        runs=runs,
    )


def diagnosis(**changes: Any) -> DiagnosisResult:
    """The diagnosis of an effect that is found; with some fields in other words."""
    gap, shrink = {}, {}
    for name, unit in CHANNELS.items():
        floor = 0.0011 if unit == "rad" else 1.7
        hit = {"alpha_h": 1.0, "alpha_v": 0.15}.get(name, 0.01)
        growth = {"0.1": 0.1, "0.5": 0.8, "2.0": 6.0, "10.0": 30.0}
        gap[name] = {
            h: Gap(
                raw=floor * (1 + 3 * g * hit),
                refit=floor * (1 + 1.4 * g * hit),
                corrected=floor * (1 + 0.12 * g * hit),
                floor=floor,
                unit=unit,
            )
            for h, g in growth.items()
        }
        shrink[name] = {
            h: Shrink(fraction=0.914, ci95=(0.87, 0.945))
            if hit > 0.1
            else Shrink(fraction=None, ci95=None)
            for h in growth
        }
    shrink["all"] = {h: Shrink(fraction=0.91, ci95=(0.86, 0.94)) for h in ("0.5", "2.0", "10.0")}
    document = {**read_yaml(DOCUMENT), "gap": {}, "shrink": {}}
    result = msgspec.convert(document, DiagnosisResult)
    return replace(result, **({"gap": gap, "shrink": shrink, "traces": traces()} | changes))
