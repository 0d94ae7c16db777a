"""Fit the weights of the belief to development rigs whose truth is known.

    python -m experiments.gap.calibrate KEY DIAGNOSES

reads the key of a blind set and the ``diagnosis.json`` of its recordings, maximises the probability
that the posterior gives to the truth (the logarithmic score, which nothing but honest probabilities
maximises), and writes ``trms_cli/gap/calibration.json``. A weak prior holds each constant near
where it was, so that a few dozen rigs cannot drive one to infinity.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from trms_cli.core.whole_file import replace_whole
from trms_cli.gap.belief import Features, alternatives, calibration, probabilities_of

FloatArray = npt.NDArray[np.float64]

#: Width of the prior of each weight about where it was.
_WIDTH = 2.0
#: A better score never speaks against a competitor, nor a worse free run for one.
_NEVER_BELOW = ("score", "score.bend")
_NEVER_ABOVE = ("effect.rest", "effect.error", "no_gap.error", "parameters.error")
#: Belief that is always left for what was not thought of.
_LEAST = 1e-3
#: Effects that the posterior does not weigh: noise and rounding are told from "none of these"
#: and from "no gap" by other marks.
_APART = ("disturbance", "quantisation")
#: Quantile of the errors of equations, over rigs without an effect, that counts as usual.
_USUAL = 0.9

#: Errors below this are not worth to be called unusual: a rig has more than simulated ones.
_LEAST_USUAL = 0.01

#: What the posterior knows of a rig, and which of its entries are right.
Case = tuple[Features, frozenset[tuple[str, ...]]]


def right_answers(truth: Mapping[str, Any]) -> frozenset[tuple[str, ...]]:
    """Entries of the posterior that are right for a case of a blind set's key."""
    kind = truth["kind"]
    if kind == "null":
        return frozenset({("no_gap",)})
    if kind == "offset":
        return frozenset({("parameters_only",)})
    if kind == "unexcited":
        return frozenset({("no_gap",), ("parameters_only",)})
    if kind == "outside":
        return frozenset({("none_of_these",)})
    return frozenset({tuple(sorted(truth["effects"]))})


def features_of(evidence: Mapping[str, Any]) -> Features:
    """As a diagnosis keeps them."""
    return Features(
        gained=evidence["gained"],
        behind=evidence["behind"],
        names=tuple(tuple(sorted(n)) for n in evidence["names"]),
        scores=_array(evidence["scores"]),
        behinds=_array(evidence["behinds"]),
        sizes=_array(evidence["sizes"]),
        surprises=_array(evidence["surprises"]),
        errors=_array(evidence["errors"]),
        raw_error=_number(evidence["raw_error"]),
        refit_error=_number(evidence["refit_error"]),
    )


def loss(weights: Mapping[str, float], cases: Sequence[Case]) -> float:
    """Mean surprise at the truth, nats a case."""
    total = 0.0
    for features, right in cases:
        believed = probabilities_of(features, weights)
        named = sum(believed.get(answer, 0.0) for answer in right)
        total -= np.log(_LEAST + (1 - _LEAST) * named)
    return total / max(len(cases), 1)


def fit_weights(start: Mapping[str, float], cases: Sequence[Case]) -> dict[str, float]:
    """Weights that make the truth least surprising."""
    names = list(start)
    centre = np.array([start[name] for name in names])
    tables = []
    for features, right in cases:
        rows = alternatives(features)
        table = np.array([[row.get(name, 0.0) for name in names] for row in rows.values()])
        tables.append((table, np.array([name in right for name in rows])))

    def cost(w: FloatArray) -> tuple[float, FloatArray]:
        away = (w - centre) / _WIDTH
        total, slope = 0.5 * float(away @ away), away / _WIDTH
        for table, right in tables:
            logits = table @ w
            odds = np.exp(logits - logits.max())
            p = odds / odds.sum()
            named = float(p[right].sum())
            believed = _LEAST + (1 - _LEAST) * named
            total -= float(np.log(believed))
            of_right = np.where(right, p, 0.0) - named * p
            slope = slope - (1 - _LEAST) / believed * (of_right @ table)
        return total, slope

    bounds = [
        (0.0, None) if n in _NEVER_BELOW else (None, 0.0) if n in _NEVER_ABOVE else (None, None)
        for n in names
    ]
    found = minimize(cost, centre, jac=True, method="L-BFGS-B", bounds=bounds)
    return dict(zip(names, found.x.tolist(), strict=True))


def usual_shares(nulls: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Error of each equation that rigs without an effect seldom exceed."""
    if not nulls:
        return {}
    return {
        name: round(max(_LEAST_USUAL, float(np.quantile([n[name] for n in nulls], _USUAL))), 4)
        for name in nulls[0]
    }


def read_cases(key: Path, diagnoses: Path) -> tuple[list[Case], list[Mapping[str, float]]]:
    """Cases of a set that have been diagnosed, and the errors of those without an effect."""
    truths = json.loads(key.read_text(encoding="utf-8"))["key"]["cases"]
    cases: list[Case] = []
    nulls: list[Mapping[str, float]] = []
    for name, truth in sorted(truths.items()):
        file = diagnoses / name / "diagnosis.json"
        if not file.exists():
            continue
        evidence = json.loads(file.read_text(encoding="utf-8"))["evidence"]
        if not any(name.endswith(_APART) for name in truth["effects"]):
            cases.append((features_of(evidence), right_answers(truth)))
        if truth["kind"] in ("null", "offset"):
            nulls.append(evidence["shares"])
    return cases, nulls


def _number(value: float | None) -> float:
    return np.nan if value is None else value


def _array(values: Sequence[float | None]) -> FloatArray:
    return np.array([np.nan if v is None else v for v in values], dtype=float)


def main(argv: Sequence[str]) -> int:
    """Fit and write."""
    key, diagnoses = map(Path, argv)
    cases, nulls = read_cases(key, diagnoses)
    start = calibration()
    after = replace(
        start,
        weights=fit_weights(start.weights, cases),
        usual_shares={**start.usual_shares, **usual_shares(nulls)},
    )
    sys.stdout.write(
        f"{len(cases)} cases: surprise {loss(start.weights, cases):.3f} before, "
        f"{loss(after.weights, cases):.3f} nats a case after\n"
    )
    content = {
        k: v if isinstance(v, str) else {name: round(w, 4) for name, w in v.items()}
        for k, v in asdict(after).items()
    }
    text = json.dumps({"command": content.pop("command"), **content}, indent=2) + "\n"
    with as_file(files("trms_cli.gap") / "calibration.json") as path:
        replace_whole(path, text.encode())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
