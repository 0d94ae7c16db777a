"""Fit the weights of the belief to simulated rigs whose truth is known.

    python -m experiments.gap.calibrate [SOURCE …] [--blind SET.key DIAGNOSES] [--folds 5]
        [--any-rig] [--write] [--out FILE]

reads what :mod:`.simulate` kept (folders, or ``features.jsonl.gz``) and diagnoses of blind sets
with their keys, maximises the probability that the posterior gives to the truth (the logarithmic
score, which nothing but honest probabilities maximises), and prints how far beliefs can be trusted:
those of the diagnoses as they were, those of the package's weights, and those of weights fitted
to the other folds. With ``--write`` the fit to all goes into ``trms_cli/gap/calibration.json``.
With ``--any-rig`` the rigs are of other models than the twin rotors': an effect is weighed by its
law, whatever port it acts at, errors are usual by the kind of place, and the fit goes into
``calibration_any_rig.json``, or into the file of one model (``--out``). A weak prior holds each
weight near that of ``prior_weights.json``, so that a few dozen rigs cannot drive one to infinity.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import numpy.typing as npt
from msgspec import convert
from scipy.optimize import minimize

from experiments.gap.blind.cases import Case as Rig
from experiments.gap.blind.judgement import right_causes
from experiments.gap.blind.model_rig import law_of
from experiments.gap.blind.sealing import KEY
from experiments.gap.cross_validation import (
    LEAST,
    VERY_SURE,
    cross_validated,
    folds_of,
    sure_and_wrong,
    tables,
)
from experiments.gap.features_file import FeaturesFile, Line, line_of
from trms_cli.core.whole_file import replace_whole
from trms_cli.gap.belief import (
    ACTUATOR,
    ANY_RIG,
    EQUATION,
    LAPSE,
    LAPSE_TEMPERATURE,
    TWIN_ROTOR,
    Calibration,
    Features,
    alternatives,
    calibration,
    own_feature,
    probabilities_of,
)
from trms_cli.gap.diagnosis import NO_EFFECT

FloatArray = npt.NDArray[np.float64]

#: Centre and width of the prior of each weight. The centre is half of what was set by hand before
#: there were rigs to fit to: timid. (Of the first 78 rigs log loss 1.51 in six folds, 1.71 with the
#: whole; the two were chosen by that.)
_PRIOR, _WIDTH = Path(__file__).with_name("prior_weights.json"), 2.0
#: Right causes that an effect has to be part of to have a weight of its own, and the width of its
#: prior: at zero, and narrow, since there are two dozen rigs of each.
_OFTEN, _OWN_WIDTH = 10, 1.0
#: A better score never speaks against a competitor, and a lead of two hundred nats decides; nor
#: does a worse free run speak for one.
_AT_LEAST = {
    "score": 0.075,
    "score.bend": 0.0,
    "parameters.error": -1.5,
}
_NEVER_ABOVE = (
    "effect.rest",
    "effect.error",
    "parameters.error",
    "none.rest",
    "disturbance.sensor",
    "disturbance.force",
    "disturbance.memory",
)
#: What is left over, and what other parameters gain, speaks against no gap (and against parameters
#: alone) at least as it does before any rig: a handful of nulls with large nuisances must not make
#: hundreds of nats no gap. Nor may a cause be believed that makes free runs worse: simulated rigs
#: hardly have such, real ones do; or one that explains nothing but free runs.
_AT_MOST_PRIOR = (
    "no_gap.rest",
    "no_gap.gain",
    "no_gap.bettered",
    "no_gap.error",
    "parameters.rest",
    "effect.worse",
    "effect.constant",
)
#: Effects that the belief does not weigh: they are told by other marks.
_APART = ("quantisation", "dropout")
#: Quantile of the errors of equations, over rigs without an effect, that counts as usual.
_USUAL = 0.9

#: Errors below this are not worth to be called unusual: a rig has more than simulated ones.
_LEAST_USUAL = 0.01
#: The same of rigs that are driven by sensors as fine as theirs: what is seen is their noise.
_LEAST_OF_ANY = 0.005

#: What the posterior knows of a rig, and which of its entries are right.
Case = tuple[Features, frozenset[tuple[str, ...]]]


def features_of(evidence: Mapping[str, Any]) -> Features:
    """As a diagnosis keeps them: each field of :class:`Features` that the evidence has."""
    field_types = get_type_hints(Features)
    values = {
        name: _value(evidence[name], of) for name, of in field_types.items() if name in evidence
    }
    for name in ("errors", "raw_error", "refit_error"):  # a run that diverged: JSON has no infinity
        if name in values:
            values[name] = np.nan_to_num(values[name], nan=np.inf)
    return Features(**values)


def _value(content: Any, field_type: Any) -> Any:
    """Lists of lists as tuples of sorted names, lists of numbers as arrays, not finite as NaN."""
    if content is None and field_type is float:
        return np.nan
    if isinstance(content, Mapping):
        return {name: _value(value, None) for name, value in content.items()}
    if not isinstance(content, (list, tuple)):
        return content
    if any(
        isinstance(item, (list, tuple)) and item and not isinstance(item[0], str)
        for item in content
    ):
        return np.array(content, dtype=float)
    if any(isinstance(item, (list, tuple, str)) for item in content):
        return tuple(item if isinstance(item, str) else tuple(sorted(item)) for item in content)
    return np.array([np.nan if v is None else v for v in content], dtype=float)


def loss(weights: Mapping[str, float], cases: Sequence[Case]) -> float:
    """Mean surprise at the truth, nats a case."""
    total = 0.0
    for features, right in cases:
        believed = probabilities_of(features, weights)
        truth_probability = sum(believed.get(answer, 0.0) for answer in right)
        total -= np.log(LEAST + (1 - LEAST) * truth_probability)
    return total / max(len(cases), 1)


def prior_weights() -> dict[str, float]:
    """Centre of the weights' prior."""
    weights: dict[str, float] = json.loads(_PRIOR.read_text(encoding="utf-8"))
    return weights


def fit_weights(
    prior: Mapping[str, float], cases: Sequence[Case], *, by_law: bool = False
) -> dict[str, float]:
    """Weights that make the truth least surprising; ``prior``: where they are without cases.

    ``by_law``: whether an effect is weighed by its law, at any port, or by its name.
    """
    own = [own_feature(effect) for effect in frequent_effects(cases, by_law=by_law)]
    names = [*prior, *own]
    centre = np.array([*prior.values(), *np.zeros(len(own))])
    width = np.repeat([_WIDTH, _OWN_WIDTH], [len(prior), len(own)])
    tables = []
    for features, right in cases:
        rows = alternatives(features)
        table = np.array([[row.get(name, 0.0) for name in names] for row in rows.values()])
        tables.append((table, np.array([name in right for name in rows])))

    def cost(w: FloatArray) -> tuple[float, FloatArray]:
        away = (w - centre) / width
        total, slope = 0.5 * float(away @ away), away / width
        for table, right in tables:
            logits = table @ w
            truth_probability, of_right = 0.0, np.zeros(len(logits))
            for part, temperature in ((1 - LAPSE, 1.0), (LAPSE, LAPSE_TEMPERATURE)):
                odds = np.exp((logits - logits.max()) / temperature)
                p = odds / odds.sum()
                own = float(p[right].sum())
                truth_probability += part * own
                of_right += part / temperature * (np.where(right, p, 0.0) - own * p)
            believed = LEAST + (1 - LEAST) * truth_probability
            total -= float(np.log(believed))
            slope = slope - (1 - LEAST) / believed * (of_right @ table)
        return total, slope

    bounds = [
        (_AT_LEAST[n], None)
        if n in _AT_LEAST
        else (None, 0.0 if n in _NEVER_ABOVE else prior[n] if n in _AT_MOST_PRIOR else None)
        for n in names
    ]
    solution = minimize(cost, centre, jac=True, method="L-BFGS-B", bounds=bounds)
    return dict(zip(names, solution.x.tolist(), strict=True))


def frequent_effects(cases: Sequence[Case], *, by_law: bool = False) -> list[str]:
    """Effects, or laws, that are part of what is right in many cases, by name."""
    counts = Counter(
        (law_of(effect) or effect) if by_law else effect
        for _, right in cases
        for effect in set().union(*right)
    )
    return sorted(n for n, count in counts.items() if count >= _OFTEN and n not in NO_EFFECT)


def usual_shares(
    nulls: Sequence[Mapping[str, float]], *, by_kind: bool = False
) -> dict[str, float]:
    """Error of each equation, or kind of place, that rigs without an effect seldom exceed."""
    errors = dict[str, list[float]]()
    for null in nulls:
        for name, share in null.items():
            kind = ACTUATOR if name.endswith(f"_{ACTUATOR}") else EQUATION
            errors.setdefault(kind if by_kind else name, []).append(share)
    least = _LEAST_OF_ANY if by_kind else _LEAST_USUAL
    return {
        name: round(max(least, float(np.quantile(shares, _USUAL))), 4)
        for name, shares in errors.items()
    }


def blind_lines(key: Path, diagnoses: Path) -> list[Line]:
    """Rigs of a blind set that have been diagnosed; ``key``: the folder of its key."""
    truths = json.loads((key / KEY).read_text(encoding="utf-8"))["key"]["cases"]
    lines = []
    for name, truth in sorted(truths.items()):
        file = diagnoses / name / "diagnosis.json"
        if file.exists():
            document = json.loads(file.read_text(encoding="utf-8"))
            lines.append(line_of(name, convert(truth, Rig), document))
    return lines


def calibrating(lines: Sequence[Line]) -> list[Line]:
    """Those whose truth the posterior weighs.

    What changed since other recordings is told by a comparison, and so was what begins within one
    as long as no beginnings raced.
    """
    return [
        line
        for line in lines
        if "scores" in line.evidence
        and (line.case.kind != "onset" or "begins" in line.evidence)
        and not any(e.endswith(_APART) for e in line.case.effects)
    ]


def diagnosis_belief(line: Line) -> dict[tuple[str, ...], float]:
    """What the diagnosis said, whatever was done to its probabilities after the fit."""
    return {
        tuple(sorted(cause["effects"])): float(cause["probability"])
        for cause in line.document["causes"]
    }


def study(
    lines: Sequence[Line],
    folds: int,
    seed: int,
    *,
    usual_too: bool = False,
    any_rig: bool = False,
) -> tuple[Calibration, str]:
    """Weights fitted to all, and tables of beliefs that nothing was fitted to.

    ``usual_too``: whether what counts as usual is taken from these rigs, too. What a fit leaves
    beyond that is a feature: their diagnoses have to be made anew then. ``any_rig``: whether the
    rigs are those of other models than the twin rotors'.
    """
    calibration_lines = calibrating(lines)
    feature_sets = [features_of(line.evidence) for line in calibration_lines]
    rights = [frozenset(right_causes(line.case)) for line in calibration_lines]
    rigs = [line.case for line in calibration_lines]
    start, prior = calibration(ANY_RIG if any_rig else TWIN_ROTOR), prior_weights()

    def fit(cases: Sequence[Case]) -> dict[str, float]:
        return fit_weights(prior, cases, by_law=any_rig)

    beliefs = cross_validated(
        feature_sets,
        rights,
        folds_of(rigs, folds, seed),
        fit,
        probabilities_of,
    )
    text = tables(
        rigs,
        rights,
        {
            "as diagnosed": [diagnosis_belief(line) for line in calibration_lines],
            "package": [probabilities_of(features, start.weights) for features in feature_sets],
            f"{folds} folds": beliefs,
        },
    )
    text += f"\nTold with {VERY_SURE} and more, and not right ({folds} folds):\n\n"
    text += sure_and_wrong([line.name for line in calibration_lines], rigs, rights, beliefs)
    nulls = [
        line.evidence["shares"]
        for line in lines
        if "shares" in line.evidence
        and line.case.kind in ("null", "offset")
        and not line.case.imperfect
    ]
    fitted_calibration = replace(start, weights=fit(list(zip(feature_sets, rights, strict=True))))
    usual = {**start.usual_shares, **usual_shares(nulls, by_kind=any_rig)}
    rows = [(name, start.usual(name), share) for name, share in usual.items()]
    text += "\nErrors that are usual, as shares of what acts there: in force, of these rigs\n\n"
    text += "".join(f"{name:16} {now:.4f} {share:.4f}\n" for name, now, share in rows)
    if usual_too:
        fitted_calibration = replace(fitted_calibration, usual_shares=usual)
    return fitted_calibration, text


def write_constants(constants: Calibration, file: str | Path = TWIN_ROTOR) -> None:
    """Make them the package's; or, with a path, those of a rig."""
    content = {
        k: v if isinstance(v, str) else {name: round(w, 4) for name, w in v.items()}
        for k, v in asdict(constants).items()
    }
    text = json.dumps({"command": content.pop("command"), **content}, indent=2) + "\n"
    if isinstance(file, Path):
        file.parent.mkdir(parents=True, exist_ok=True)
        replace_whole(file, text.encode())
        return
    with as_file(files("trms_cli.gap") / file) as path:
        replace_whole(path, text.encode())


def parser_of(module: str, description: str | None) -> argparse.ArgumentParser:
    """What every fit to features is asked."""
    parser = argparse.ArgumentParser(
        prog=f"python -m experiments.gap.{module}",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("sources", nargs="*", type=Path, help="folders of experiments.gap.simulate")
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", action="store_true", help="make the fit the package's")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Fit, tell, and write on request."""
    parser = parser_of("calibrate", __doc__)
    parser.add_argument(
        "--blind", nargs=2, type=Path, action="append", default=[], metavar=("SET.key", "DIAGNOSES")
    )
    parser.add_argument(
        "--usual",
        action="store_true",
        help="what counts as usual as well; the rigs have to be diagnosed anew then",
    )
    parser.add_argument(
        "--any-rig", action="store_true", help="rigs of other models than the twin rotors'"
    )
    parser.add_argument("--out", type=Path, help="where the fit goes, instead of the package")
    arguments = parser.parse_args(argv)
    for key, _ in arguments.blind:
        if not (key / KEY).is_file():
            parser.error(f"--blind: there is no {KEY} in {key}; name the folder that holds the key")
    lines = [line for source in arguments.sources for line in FeaturesFile(source).lines()]
    lines += [line for key, diagnoses in arguments.blind for line in blind_lines(key, diagnoses)]
    calibration_lines = calibrating(lines)
    if len(calibration_lines) < arguments.folds:
        parser.error(
            f"{len(calibration_lines)} diagnosed rigs are too few for {arguments.folds} folds"
        )
    fitted_calibration, text = study(
        lines,
        arguments.folds,
        arguments.seed,
        usual_too=arguments.usual,
        any_rig=arguments.any_rig,
    )
    failed = sum(bool(line.failed) for line in lines)
    sys.stdout.write(
        f"{len(lines)} rigs, {failed} could not be diagnosed, "
        f"{len(calibration_lines)} are weighed\n\n{text}"
    )
    if arguments.write or arguments.out:
        words = [source.as_posix() for source in arguments.sources]
        words += [f"--blind {key.as_posix()} {found.as_posix()}" for key, found in arguments.blind]
        words += ["--any-rig"] * arguments.any_rig + ["--usual"] * arguments.usual
        words += ["--write"] if arguments.write else [f"--out {arguments.out}"]
        command = f"python -m experiments.gap.calibrate {' '.join(words)}"
        file = arguments.out or (ANY_RIG if arguments.any_rig else TWIN_ROTOR)
        write_constants(replace(fitted_calibration, command=command), file)
    return 0


if __name__ == "__main__":
    sys.exit(main())
