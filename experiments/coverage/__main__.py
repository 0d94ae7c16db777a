"""``python -m experiments.coverage``: fit many rigs, count how often the truth is inside."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence

import numpy as np

from experiments.coverage.study import Coverage, coverage


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study and print its tables."""
    parser = argparse.ArgumentParser(prog="python -m experiments.coverage", description=__doc__)
    parser.add_argument("--rigs", type=int, default=240, help="how many (default 240)")
    parser.add_argument("--first", type=int, default=1000, help="first seed (default 1000)")
    parser.add_argument("--duration", type=float, default=60.0, help="of each recording, s")
    parser.add_argument("--without-priors", action="store_true", help="identifiable ones only")
    parser.add_argument("--jobs", type=int, default=1, help="threads of each fit")
    parser.add_argument("--json", action="store_true", help="print trms.coverage/1")
    arguments = parser.parse_args(argv)
    seeds = range(arguments.first, arguments.first + arguments.rigs)

    def report(count: int) -> None:
        if sys.stderr.isatty():
            sys.stderr.write(f"\r{count} of {arguments.rigs} rigs")

    result = coverage(
        seeds,
        duration=arguments.duration,
        with_priors=not arguments.without_priors,
        jobs=arguments.jobs,
        told=report,
    )
    print(json.dumps(document(result)) if arguments.json else table(result))
    return 0


def document(result: Coverage) -> dict[str, object]:
    """The figures as JSON has them."""
    share, error = result.overall
    learnt, learnt_error = result.of_learnt
    return {
        "schema": "trms.coverage/1",
        "rigs": len(result.errors),
        "left_out": result.left_out,
        "unsettled": result.unsettled,
        "inside_95": {"share": share, "standard_error": error},
        "inside_95_of_learnt": {"share": learnt, "standard_error": learnt_error},
        "seconds_median": float(np.median(result.seconds)),
        "parameters": {
            name: {
                "inside_95": float(result.inside[i]),
                "error_rms": float(np.sqrt(np.mean(result.errors[:, i] ** 2))),
                "prior_remaining": float(np.median(result.remaining[:, i])),
            }
            for i, name in enumerate(result.names)
        },
    }


def table(result: Coverage) -> str:
    """The same for people, in Markdown."""
    rows = [
        f"| {name} | {100 * result.inside[i]:.1f} "
        f"| {np.sqrt(np.mean(result.errors[:, i] ** 2)):.2f} "
        f"| {np.median(result.remaining[:, i]):.3g} |"
        for i, name in enumerate(result.names)
    ]
    share, error = result.overall
    learnt, learnt_error = result.of_learnt
    return "\n".join(
        [
            f"{len(result.errors)} rigs; {result.left_out} left out that hit a stop, "
            f"{result.unsettled} fits unsettled; median {np.median(result.seconds):.2f} s a fit",
            f"inside the 95 % interval: {100 * share:.1f} ± {100 * error:.1f} %, of parameters "
            f"that the data told of {100 * learnt:.1f} ± {100 * learnt_error:.1f} %",
            "",
            "| parameter | inside [%] | RMS error [sd] | deviation left of the prior's |",
            "|---|---|---|---|",
            *rows,
        ]
    )


if __name__ == "__main__":
    sys.exit(main())
