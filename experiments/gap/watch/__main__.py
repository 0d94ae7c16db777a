"""``python -m experiments.gap.watch``: how often the gap watch is wrong, and how soon it is right.

``calibrate`` counts how often the statistic passes each threshold on rigs that do not change;
``prove`` counts alarms with the standard configuration on other rigs, and delays and onsets where
an effect of medium size begins. Recordings are simulated once; whatever is done is kept in the
folder, and called again it goes on.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.command_line import exit_code_of
from experiments.gap.watch import tables
from experiments.gap.watch.evaluate import evaluate_all, without_threshold
from experiments.gap.watch.recordings import make, read
from trms_cli.core.errors import EXIT_OK
from trms_cli.core.threads import take_one_thread

#: s, of each recording.
DURATION = 120.0
#: Seed and rigs of each kind; a hundred seconds of each are watched.
CALIBRATION = {"steady": (11, 120)}
PROOF = {"onset": (102, 64), "steady": (101, 260), "offset": (103, 40)}


def main(argv: Sequence[str] | None = None) -> int:
    """Simulate, watch, and print the tables."""
    parser = argparse.ArgumentParser(prog="python -m experiments.gap.watch", description=__doc__)
    parser.add_argument("what", choices=("calibrate", "prove"))
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
    sets = CALIBRATION if calibrates else PROOF
    folder = arguments.out / arguments.what
    _tell("simulating")
    shares = {kind: (seed, max(2, round(n * arguments.share))) for kind, (seed, n) in sets.items()}
    make(folder, shares, DURATION)
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
