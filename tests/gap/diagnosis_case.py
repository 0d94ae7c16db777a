"""A diagnosis made by hand, with figures as a rig with yaw friction gives them."""

from dataclasses import replace
from typing import Any

import numpy as np

from trms_cli.gap.diagnosis import (
    Cause,
    Detectable,
    DiagnosedRecording,
    DiagnosisResult,
    FittedParameter,
    Gap,
    GapTest,
    LocationShare,
    NextExperiment,
    NotTestable,
    RaceEntry,
    RegionShare,
    Shrink,
    SizeEstimate,
    Traces,
)

FRICTION = "yaw_coulomb_friction"
CHANNELS = {"alpha_v": "rad", "alpha_h": "rad", "omega_v": "rad/s", "omega_h": "rad/s"}
_TORQUE = SizeEstimate(value=0.00412, sd=0.00018, unit="N*m")
_OF_A_TEST = ("channel", "statistic", "p_value", "p_corrected", "rejected")
_TESTS: tuple[Any, ...] = (("alpha_h", 88.1, 1e-9, 4e-8, True), ("alpha_v", 21.0, 0.4, 1.0, False))
_OF_AN_ENTRY = ("effects", "score", "se", "explained", "moved", "parameters")
_RACE: tuple[Any, ...] = (
    ((FRICTION,), 5120.0, 310.0, 0.97, 0.8, {f"{FRICTION}.torque": _TORQUE}),
    (("yaw_stribeck_friction",), 5090.0, 320.0, 0.965, 0.9, {}),
    (("flexible",), 4300.0, 400.0, 0.9, 1.0, {}),
    (("yaw_quadratic_damping",), 2100.0, 350.0, 0.41, 3.1, {}),
    (("tail_input_delay",), -40.0, 60.0, 0.0, 0.4, {}),
    ((), 0.0, 0.0, 0.0, 4.9, {}),
)


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
    found = DiagnosisResult(
        recordings=(
            DiagnosedRecording(
                file="records/monday.csv",
                sha256="5f" * 32,
                duration_s=120.0,
                sample_time_s=0.02,
                channels=tuple(CHANNELS),
            ),
        ),
        model="newtonian",
        seed=0,
        versions={},
        verdict="effect",
        where=(
            LocationShare(location="yaw_moment", share=0.86, ci95=(0.79, 0.91)),
            LocationShare(location="tail_thrust", share=0.05, ci95=(0.01, 0.12)),
            LocationShare(location="pitch_moment", share=0.03, ci95=(0.0, 0.06)),
            LocationShare(location="main_motor", share=0.0, ci95=(0.0, 0.01)),
        ),
        region=(
            RegionShare(location="yaw_moment", condition="|rate of yaw| < 0.05 rad/s", share=0.22),
        ),
        causes=(
            Cause(
                effects=(FRICTION,), probability=0.88, parameters={f"{FRICTION}.torque": _TORQUE}
            ),
            Cause(
                effects=("yaw_stribeck_friction",),
                probability=0.08,
                parameters={"yaw_stribeck_friction.torque": replace(_TORQUE, value=0.0038)},
            ),
            Cause(effects=("none_of_these",), probability=0.03),
            Cause(effects=("parameters_only",), probability=0.01),
            Cause(effects=("no_gap",), probability=0.0),
        ),
        confusable=((FRICTION, "yaw_stribeck_friction"),),
        not_testable=(
            NotTestable(effect="ground_effect", reason="the beam never came near the table"),
            NotTestable(effect="tail_dead_zone", reason="u_h never crosses zero"),
        ),
        detectable={
            FRICTION: Detectable(minimum_size=0.0008, unit="N*m"),
            "main_input_delay": Detectable(minimum_size=0.0041, unit="s"),
        },
        parameters={
            "k_fvp": FittedParameter(
                prior=1.84e-5, fitted=1.79e-5, sd=1e-7, unit="N*s^2", moved=-0.5
            ),
            "k_oh": FittedParameter(
                prior=0.0095, fitted=0.0151, sd=4e-4, unit="N*m*s/rad", moved=4.9
            ),
        },
        gap=gap,
        shrink=shrink,
        next_experiment=NextExperiment(
            why="Coulomb and Stribeck friction of yaw differ only where the axis turns slowly "
            "through rest: swing it by a slow sine.",
            command="trms run controller=open_loop signal@controller.u_h=sine "
            "controller.u_h.frequency=0.05 sim.duration=120",
        ),
        sentence="Dry friction on the yaw axis of 4.1 mN m, which newtonian lacks, causes the gap: "
        "86 % of it lies in the yaw moment, and adding it closes 91 % over 2 s.",
        tests=tuple(
            GapTest(name="whiteness", **dict(zip(_OF_A_TEST, row, strict=True))) for row in _TESTS
        ),
        race=tuple(RaceEntry(**dict(zip(_OF_AN_ENTRY, row, strict=True))) for row in _RACE),
        warnings=("monday: u_h is at its limit for 34% of the time (smaller references)",),
        seconds={"admission": 0.4, "refit": 12.0, "race": 61.0},
        refit={"k_fvp": 1.78e-5, "k_oh": 0.0151},
        traces=traces(),
    )
    return replace(found, **changes)
