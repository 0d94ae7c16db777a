"""``python -m experiments.tras tras/``: fit the first part of the record, judge on the rest."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.command_line import exit_code_of
from experiments.tras.study import (
    TrasFit,
    cross_validated,
    errors,
    fit_first_part,
    model_of,
    parts_of,
    read_study,
)
from trms_cli.core.errors import EXIT_OK


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study and print its tables, or one JSON document."""
    parser = argparse.ArgumentParser(prog="python -m experiments.tras", description=__doc__)
    parser.add_argument("folder", type=Path, help="closed_loop.csv and the static curves")
    parser.add_argument("--fit-only", action="store_true", help="leave the held-out part alone")
    parser.add_argument("--folds", action="store_true", help="cross-validate over the whole record")
    parser.add_argument("--only", default=None, help="one of the fits: rotors, commands")
    parser.add_argument("--jobs", type=int, default=2, help="threads")
    parser.add_argument("--json", action="store_true", help="print trms.tras_fit/1")
    arguments = parser.parse_args(argv)
    if not (arguments.folder / "closed_loop.csv").is_file():
        print(f"skipped: there is no closed_loop.csv in {arguments.folder}", file=sys.stderr)
        return 0
    return exit_code_of(lambda: _study(arguments))


def _study(arguments: argparse.Namespace) -> int:
    settings = read_study()
    document: dict[str, Any] = {"schema": "trms.tras_fit/1", "fits": {}}
    for name, fit in settings["fits"].items():
        if arguments.only in (None, name):
            document["fits"][name] = _fit_document(arguments, settings, fit)
    print(json.dumps(document, indent=1) if arguments.json else _table(document))
    return EXIT_OK


def _fit_document(
    arguments: argparse.Namespace, settings: dict[str, Any], fit: dict[str, Any]
) -> Any:
    if arguments.folds:
        return cross_validated(arguments.folder, settings, fit, arguments.jobs)
    tras_fit = fit_first_part(arguments.folder, settings, fit, arguments.jobs)
    first, rest = parts_of(arguments.folder, settings, fit)
    parts = {"fitted": first} if arguments.fit_only else {"fitted": first, "held_out": rest}
    before = model_of(arguments.folder, settings, fit)
    return {
        "outcome": tras_fit.result.outcome.value,
        "seconds": tras_fit.result.seconds,
        "starts": tras_fit.result.details["starts"],
        "outputs": tras_fit.result.details["outputs"],
        "on_bounds": tras_fit.result.details["on_bounds"],
        "confounded": tras_fit.result.details["identifiability"]["confounded"],
        "parameters": _parameters(tras_fit),
        "errors": {name: errors(tras_fit.model, part, settings) for name, part in parts.items()},
        "errors_before": {name: errors(before, part, settings) for name, part in parts.items()},
    }


def _parameters(fit: TrasFit) -> dict[str, Any]:
    assert fit.result.covariance is not None
    sd = np.sqrt(np.diag(fit.result.covariance))
    return {
        p.name: {
            "value": fit.result.values[p.name],
            "sd": float(sd[i]),
            "prior": p.prior_mean if p.prior_sd is not None else None,
            "prior_sd": p.prior_sd,
            "unit": p.unit,
        }
        for i, p in enumerate(fit.problem.free)
    }


def _table(document: dict[str, Any]) -> str:
    rows = []
    for name, fit in document["fits"].items():
        if "pooled" in fit:
            rows += _folds_table(name, fit)
            continue
        behind = [s["behind_best"] for s in fit["starts"]]
        rows += [
            f"## {name}: {fit['outcome']}, {fit['seconds']:.0f} s, nats behind the best start: "
            + ", ".join("–" if b is None else f"{b:.1f}" for b in behind),
            "",
            "| part | model | output | estimated | moving_horizon | fitted | unchanged |",
            "|---|---|---|---|---|---|---|",
        ]
        for which, key in (("maker's", "errors_before"), ("fitted", "errors")):
            for part, outputs in fit[key].items():
                for output, e in outputs.items():
                    figures = [e["estimated"], e["moving_horizon"], e["fitted"], e["unchanged"]]
                    cells = " | ".join(f"{v:.4g}" for v in figures)
                    rows.append(f"| {part} | {which} | {output} | {cells} |")
        rows += [
            "",
            "| parameter | fitted | ± sd | prior | ± sd | unit |",
            "|---|---|---|---|---|---|",
        ]
        for parameter, p in fit["parameters"].items():
            prior = "– | –" if p["prior"] is None else f"{p['prior']:.4g} | {p['prior_sd']:.2g}"
            rows.append(
                f"| `{parameter}` | {p['value']:.4g} | {p['sd']:.2g} | {prior} | {p['unit']} |"
            )
        rows += ["", f"on bounds: {', '.join(fit['on_bounds']) or 'none'}", ""]
        rows += [
            f"- cannot be told apart (γ = {c['index']:.0f}): {', '.join(c['names'])}"
            for c in fit["confounded"][:8]
        ]
        rows.append("")
    return "\n".join(rows)


def _folds_table(name: str, fit: dict[str, Any]) -> list[str]:
    rows = [
        f"## {name}, {len(fit['folds'])} parts, each fitted without itself",
        "",
        "| part | output | estimated | moving_horizon | fitted | unchanged |",
        "|---|---|---|---|---|---|",
    ]
    parts = [(str(k + 1), fold) for k, fold in enumerate(fit["folds"])]
    for part, outputs in (*parts, ("all", fit["pooled"])):
        for output, e in outputs.items():
            figures = [e["estimated"], e["moving_horizon"], e["fitted"], e["unchanged"]]
            rows.append(f"| {part} | {output} | {' | '.join(f'{v:.4g}' for v in figures)} |")
    return [*rows, ""]


if __name__ == "__main__":
    sys.exit(main())
