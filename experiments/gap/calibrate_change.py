"""Fit what is believed of a change, before it is seen, to simulated rigs that changed or did not.

    python -m experiments.gap.calibrate_change experiments/gap/features/calibration [--write]

Of rigs that :mod:`.simulate` diagnosed those of the kind ``against``. Tables are as those of
:mod:`.calibrate`; ``--write`` makes the fit the package's. Constants stay near those that were set
before there were rigs to fit to, within a factor of two or three: a few dozen rigs tell no more.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize
from scipy.special import expit, logit

from experiments.gap.blind.judgement import right_causes
from experiments.gap.calibrate import parser_of, write_constants
from experiments.gap.cross_validation import LEAST, Belief, cross_validated, folds_of, tables
from experiments.gap.features_file import FeaturesFile, Line
from trms_cli.gap.belief import (
    UNNAMED,
    calibration,
    change_probabilities,
    unnamed_gain,
    usual_gains,
)

FloatArray = npt.NDArray[np.float64]

#: Where each constant is without rigs, and the width of the prior of its logarithm (of its logit,
#: where it is a probability).
PRIOR: Mapping[str, float] = {
    "unchanged": 0.6,
    "unnamed": 0.1,
    "effect": 0.6,
    "torque": 0.2,
    "parameter": 0.1,
    "nat": 0.35,
    "believed": 2.0,
    "usual_gain": 8.0,
}
_WIDTH = 1.0
#: Rounding is told by the steps of the sensor, not by gains.
_APART = "_quantisation"


@dataclass(frozen=True)
class ChangeFeatures:
    """What a comparison with a known state knows before it believes anything."""

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    #: ``gains``, ``beliefs``: (k,) arrays; nats above that nothing changed, and what is believed
    #: besides of each
    gains: FloatArray
    beliefs: FloatArray
    unnamed: float  #: nats of a force without a name
    usual: tuple[float, ...]  #: nats between recordings of the known state

    @classmethod
    def of(cls, line: Line) -> ChangeFeatures:
        """Of a line of a features file."""
        evidence = line.evidence
        gains = {name: entry["nats"] for name, entry in evidence["gains"].items()}
        unnamed = unnamed_gain(np.array(list(evidence["free_force"].values())))
        return cls(
            names=tuple(gains),
            kinds=tuple(entry["kind"] for entry in evidence["gains"].values()),
            gains=np.array(list(gains.values())),
            beliefs=np.array([entry.get("belief", 0.0) for entry in evidence["gains"].values()]),
            unnamed=unnamed,
            usual=usual_gains({**gains, UNNAMED: unnamed}, evidence["usual"]),
        )


def believed(features: ChangeFeatures, constants: Mapping[str, float]) -> Belief:
    """Probabilities of causes."""
    each, unchanged, unnamed = change_probabilities(
        features.kinds,
        features.gains,
        features.beliefs,
        features.unnamed,
        features.usual,
        constants,
    )
    belief: dict[tuple[str, ...], float] = {
        ("no_change",): unchanged,
        ("none_of_these",): unnamed,
        ("parameters_only",): 0.0,
    }
    for name, kind, probability in zip(features.names, features.kinds, each.tolist(), strict=True):
        key = ("parameters_only",) if kind == "parameter" else (name,)
        belief[key] = belief.get(key, 0.0) + probability
    return belief


def fit(
    cases: Sequence[tuple[ChangeFeatures, frozenset[tuple[str, ...]]]],
) -> dict[str, float]:
    """Constants that make the truth least surprising, near the prior."""
    names = list(PRIOR)
    centre = np.array([_outward(name, PRIOR[name]) for name in names])

    def cost(v: FloatArray) -> float:
        constants = {name: _inward(name, x) for name, x in zip(names, v, strict=True)}
        total = 0.5 * float(np.sum(((v - centre) / _WIDTH) ** 2))
        for features, right in cases:
            belief = believed(features, constants)
            share = sum(belief.get(cause, 0.0) for cause in right)
            total -= float(np.log(LEAST + (1 - LEAST) * share))
        return total

    solution = minimize(cost, centre, method="L-BFGS-B")
    return {name: _inward(name, x) for name, x in zip(names, solution.x.tolist(), strict=True)}


def _outward(name: str, value: float) -> float:
    return float(logit(value) if name == "unchanged" else np.log(value))


def _inward(name: str, x: float) -> float:
    return float(expit(x) if name == "unchanged" else np.exp(x))


def comparison_lines(lines: Sequence[Line]) -> list[Line]:
    """Those that were compared with a known state.

    What is told to have begun within a recording is compared, too, but only where it is clear.
    """
    return [
        line
        for line in lines
        if line.case.kind == "against"
        and "gains" in line.evidence
        and not any(e.endswith(_APART) for e in line.case.effects)
    ]


def study(lines: Sequence[Line], folds: int, seed: int) -> tuple[dict[str, float], str]:
    """Constants fitted to all, and tables of beliefs that nothing was fitted to."""
    comparisons = comparison_lines(lines)
    feature_sets = [ChangeFeatures.of(line) for line in comparisons]
    rights = [frozenset(right_causes(line.case)) for line in comparisons]
    rigs = [line.case for line in comparisons]
    beliefs = cross_validated(feature_sets, rights, folds_of(rigs, folds, seed), fit, believed)
    now = calibration().change
    package = [believed(features, now) for features in feature_sets]
    text = tables(rigs, rights, {"package": package, f"{folds} folds": beliefs})
    return fit(list(zip(feature_sets, rights, strict=True))), text


def main(argv: Sequence[str] | None = None) -> int:
    """Fit, tell, and write on request."""
    parser = parser_of("calibrate_change", __doc__)
    arguments = parser.parse_args(argv)
    lines = [line for source in arguments.sources for line in FeaturesFile(source).lines()]
    if len(comparison_lines(lines)) < arguments.folds:
        parser.error(
            f"{len(comparison_lines(lines))} compared rigs are too few for {arguments.folds} folds"
        )
    constants, text = study(lines, arguments.folds, arguments.seed)
    sys.stdout.write(f"{len(comparison_lines(lines))} rigs were compared\n\n{text}\n")
    sys.stdout.writelines(f"{name:12} {value:.3g}\n" for name, value in constants.items())
    if arguments.write:
        write_constants(replace(calibration(), change=constants))
    return 0


if __name__ == "__main__":
    sys.exit(main())
