"""``python -m experiments.gap.watch``: how often the gap watch is wrong, and how soon it is right.

``calibrate`` counts how often the statistic passes each threshold on rigs that do not change;
``prove`` counts alarms with the standard configuration on other rigs, and delays and onsets where
an effect of medium size begins; ``long`` counts alarms in runs of ten minutes. Recordings are
simulated once; whatever is done is kept in the folder, and called again it goes on.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from experiments.command_line import exit_code_of
from experiments.gap.watch import tables
from experiments.gap.watch.evaluate import evaluate_all, without_threshold
from experiments.gap.watch.recordings import make, read
from trms_cli.core.errors import EXIT_OK
from trms_cli.core.threads import take_one_thread

#: By task: s of each recording, and by kind the seed and number of the rigs.
TASKS: Mapping[str, tuple[float, Mapping[str, tuple[int, int]]]] = {
    "calibrate": (120.0, {"steady": (11, 120)}),
    "prove": (120.0, {"onset": (102, 64), "steady": (101, 260), "offset": (103, 40)}),
    "long": (600.0, {"steady": (104, 20)}),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Simulate, watch, and print the tables."""
    parser = argparse.ArgumentParser(prog="python -m experiments.gap.watch", description=__doc__)
    parser.add_argument("what", choices=tuple(TASKS))
    parser.add_argument("--share", type=float, default=1.0, help="of the rigs: 0.1 for a trial")
    parser.add_argument("--out", type=Path, default=Path("outputs/gap_watch"))
    arguments = parser.parse_args(argv)
    take_one_thread()
    return exit_code_of(lambda: _study(arguments))


def _study(arguments: argparse.Namespace) -> int:
    from trms_cli.composition.composer import compose
    from trms_cli.core.plugins import build

    config = build(compose(["gap_watch=standard"]).config["gap_watch"], "gap_watch")
    calibrates = arguments.what == "calibrate"
    duration, sets = TASKS[arguments.what]
    folder = arguments.out / arguments.what
    _tell("simulating")
    shares = {kind: (seed, max(2, round(n * arguments.share))) for kind, (seed, n) in sets.items()}
    make(folder, shares, duration)
    rows = evaluate_all(
        read(folder),
        without_threshold(config) if calibrates else config,
        folder / "results.jsonl",
        _tell,
    )
    _tell("")
    text = tables.calibration(rows, config) if calibrates else tables.proof(rows, config)
    print(text)
    (folder / "tables.txt").write_text(text + "\n", encoding="utf-8")
    return EXIT_OK


def _tell(words: str) -> None:
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\033[K{words}")
        sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
