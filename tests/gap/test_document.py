"""``diagnosis.json``: the contract's keys exactly, and nothing that JSON cannot hold."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np

from trms_cli.gap.diagnosis import Gap, LocationShare, document_of

from .diagnosis_case import diagnosis

CONTRACT = {
    "schema",
    "recordings",
    "model",
    "seed",
    "versions",
    "verdict",
    "where",
    "region",
    "causes",
    "confusable",
    "not_testable",
    "detectable",
    "parameters",
    "gap",
    "shrink",
    "next_experiment",
}


def test_has_the_keys_of_the_contract() -> None:
    document = document_of(diagnosis())
    assert set(document) >= CONTRACT and next(iter(document)) == "schema"
    assert document["schema"] == "trms.diagnosis/1"
    assert set(document["recordings"][0]) == {
        "file",
        "sha256",
        "duration_s",
        "sample_time_s",
        "channels",
    }
    assert set(document["where"][0]) == {"location", "share", "ci95"}
    assert set(document["causes"][0]) == {"effects", "probability", "parameters"}
    size = document["causes"][0]["parameters"]["yaw_coulomb_friction.torque"]
    assert size == {"value": 0.00412, "sd": 0.00018, "unit": "N*m"}
    assert document["confusable"] == [["yaw_coulomb_friction", "yaw_stribeck_friction"]]
    assert set(document["not_testable"][0]) == {"effect", "reason"}
    assert document["detectable"]["yaw_coulomb_friction"]["minimum_size"] == 0.0008
    assert set(document["parameters"]["k_fvp"]) >= {"prior", "fitted", "sd", "unit"}
    assert set(document["next_experiment"]) == {"why", "command"}
    assert set(document["region"][0]) == {"location", "condition", "share"}


def test_horizons_are_seconds_with_a_decimal_in_order() -> None:
    row = Gap(raw=1.0, refit=1.0, corrected=1.0, floor=1.0, unit="rad")
    document = document_of(diagnosis(gap={"alpha_h": {"10": row, "2": row, "0.10": row}}))
    assert list(document["gap"]["alpha_h"]) == ["0.1", "2.0", "10.0"]
    assert list(document["shrink"]["all"]) == ["0.5", "2.0", "10.0"]
    assert document["shrink"]["all"]["2.0"] == {"fraction": 0.91, "ci95": [0.86, 0.94]}


def test_what_is_not_finite_is_null_and_numpy_is_plain() -> None:
    case = diagnosis()
    row = replace(case.gap["alpha_h"]["2.0"], raw=math.nan, refit=np.float64(math.inf))
    place = LocationShare(location="yaw_moment", share=np.float32(0.5), ci95=(np.float64(0.1), 1.0))
    document = document_of(replace(case, gap={"alpha_h": {"2.0": row}}, where=(place,)))
    assert document["gap"]["alpha_h"]["2.0"]["raw"] is None
    assert document["gap"]["alpha_h"]["2.0"]["refit"] is None
    assert document["where"][0] == {"location": "yaw_moment", "share": 0.5, "ci95": [0.1, 1.0]}
    assert json.loads(json.dumps(document, allow_nan=False)) == document


def test_pictures_stay_out() -> None:
    assert "traces" not in document_of(diagnosis())
