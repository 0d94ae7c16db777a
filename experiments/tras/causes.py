"""``python -m experiments.tras.causes tras/``: several causes at once on the real TRAS.

What ``trms diagnose real=closed_loop.csv model=tras data.command_delay=1`` fits one to three
effects with, given more of them: each set of ``study.yaml`` by the same metric, its score over the
refit's, the parameters that lie beyond two deviations of their priors, and free runs of 6 s on the
sealed quarter, driven by the measured rotor speeds. ``--model`` shows the free runs of models that
nothing is fitted of: ``tras``, the maker's values, or the ``corrected_model.yaml`` of a diagnosis.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.tras.study import errors, read_study
from trms_cli.effects.model_file import load_model
from trms_cli.gap.competing_model import (
    FittedModel,
    ModelStructure,
    Refit,
    about_priors,
    nominal_parameters,
    refit,
)
from trms_cli.gap.problem import CandidateEffect, Parts, applicable_candidates, divide
from trms_cli.identification.data import DataOptions, load_datasets
from trms_cli.identification.problem import FreeParameter
from trms_cli.library.tasks.diagnose import candidates_of
from trms_cli.models.driven_model import DrivenModel
from trms_cli.models.model import Model
from trms_cli.models.tras import Tras

_ITERATIONS, _TOLERANCE = 25, 0.3
#: Standard deviations of its prior from which on a parameter is listed.
_FAR = 2.0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(prog="python -m experiments.tras.causes", description=__doc__)
    parser.add_argument("folder", type=Path, help="closed_loop.csv")
    parser.add_argument(
        "--model", nargs="+", default=[], metavar="MODEL", help="names or files; nothing is fitted"
    )
    arguments = parser.parse_args(argv)
    if not (arguments.folder / "closed_loop.csv").is_file():
        print(f"skipped: there is no closed_loop.csv in {arguments.folder}", file=sys.stderr)
        return 0
    settings = read_study()
    causes = settings["causes"]
    options = DataOptions(command_delay=settings["command_delay"])
    model = Tras()
    datasets = tuple(load_datasets(str(arguments.folder / "closed_loop.csv"), model, options))
    parts = divide(datasets, causes["block"], causes["sealed"], model.stops)
    if arguments.model:
        print("| model | pitch, yaw: from before | start fitted |\n|---|---|---|")
        for name in arguments.model:
            rms_errors = free_runs_of(load_model(name), parts, settings)
            print(f"| {name} | {' | '.join(_errors_of(rms_errors))} |", flush=True)
        return 0
    candidates, _ = applicable_candidates(model, candidates_of(["all"], model).effects)
    nominal = refit(model, nominal_parameters(model), parts.fitted, parts.block)
    centre = about_priors(nominal) or nominal
    heads = ("effects", "held", "nats", "pitch, yaw: from before", "start fitted", "beyond 2 sd")
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    for effect_set in causes["sets"]:
        effects = [candidates[name] for name in effect_set["effects"]]
        prior_means = causes["held"] if effect_set.get("held") else {}
        fitted = (
            fit_together(nominal, centre, effects, prior_means, causes["held_sd"])
            if effects
            else nominal
        )
        print(_row(fitted, nominal, parts, settings, prior_means), flush=True)
    return 0


def fit_together(
    nominal: Refit,
    centre: FittedModel,
    effects: Sequence[CandidateEffect],
    prior_means: Mapping[str, float],
    sd: float,
) -> FittedModel:
    """Effects fitted with the nominal parameters, from the refit and from the priors' centre.

    ``centre``: the model there, whose metric excuses most. ``prior_means``: parameters that are
    known to a relative deviation ``sd``.
    """

    def free(parameters: Sequence[FreeParameter]) -> tuple[FreeParameter, ...]:
        return tuple(
            _with_prior(p, prior_means[p.name], sd) if p.name in prior_means else p
            for p in parameters
        )

    problem = nominal.structure.problem
    own = free(problem.free)
    plain = ModelStructure(problem.model, own, (), problem.datasets, problem.window_length)
    structure = plain.with_effects(*[replace(e, free=free(e.free)) for e in effects])
    points = []
    for values in (nominal.values, {p.name: p.prior_mean for p in own}):
        theta = structure.theta({**values, **prior_means})
        points.append((theta, structure.starts(theta, nominal.fit.starts)))
    metric = nominal.metric if prior_means else centre.metric
    fitted = structure.fit(
        metric,
        points,
        centres=nominal.centres,
        gains=nominal.fit.gains,
        iterations=_ITERATIONS,
        tolerance=_TOLERANCE,
    )
    return fitted.in_own_metric()


def _with_prior(parameter: FreeParameter, value: float, sd: float) -> FreeParameter:
    return replace(parameter, prior_mean=value, prior_sd=abs(value) * sd, start=value)


def free_runs_of(model: Model, parts: Parts, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Errors on the sealed part, rad, driven by the measured rotor speeds."""
    rotor_speeds = settings["fits"]["rotors"]["driven"]
    number, first, last = parts.sealed[0]
    sealed = parts.whole[number].driven_by(rotor_speeds).part(first, last)
    return errors(DrivenModel(model, rotor_speeds), sealed, settings)


def _errors_of(rms_errors: Mapping[str, Any]) -> list[str]:
    """mrad, of pitch and yaw, by how the windows start."""
    return [
        ", ".join(f"{1e3 * rms_errors[angle][kind]:.3g}" for angle in ("alpha_v", "alpha_h"))
        for kind in ("estimated", "fitted")
    ]


def _row(
    fitted: FittedModel,
    nominal: Refit,
    parts: Parts,
    settings: Mapping[str, Any],
    prior_means: Mapping[str, float],
) -> str:
    before, own = _errors_of(free_runs_of(fitted.model, parts, settings))
    usual = {p.name: p for p in nominal.structure.problem.free}
    far = {
        name: (fitted.values[name] - p.prior_mean) / p.prior_sd
        for name, p in usual.items()
        if p.prior_sd
    }
    shifts = ", ".join(f"{name} {z:+.1f}" for name, z in far.items() if abs(z) > _FAR)
    nats = fitted.fit.score - nominal.fit.score
    cells = (
        " + ".join(fitted.names) or "–",
        "yes" if prior_means else "no",
        f"{nats:+.0f}",
        before,
        own,
    )
    return f"| {' | '.join((*cells, shifts))} |"


if __name__ == "__main__":
    sys.exit(main())
