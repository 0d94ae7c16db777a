"""``python -m experiments.gap.baselines method=NAME in=SET out=DIR``: a baseline over a set."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from trms_cli.core.errors import ConfigurationError, TrmsError

_KEYS = ("method", "in", "out", "jobs", "cases", "key")
_USAGE = """\
usage: python -m experiments.gap.baselines method=NAME in=SET out=DIR [jobs=2] [cases=N]
                                              [key=DIR.key]
       python -m experiments.gap.baselines train [outputs=4|2] [rigs=40] [sample_time=0.02]

Answers every recording of a set that `trms blind make` wrote; `trms blind score` judges the
answers in DIR like diagnoses. Only the methods oracle and true_values are given the key. `train`
trains the classifier and keeps it in the cache folder; without it the first use does.
methods: """


def main(argv: Sequence[str]) -> int:
    """Run; exit code 2 for words that mean nothing."""
    from experiments.gap.baselines.run import METHODS, WITH_KEY, run_baseline, truths_of

    if not argv or argv[0] in ("-h", "--help"):
        print(_USAGE + ", ".join(METHODS))
        return 0
    try:
        if argv[0] == "train":
            return _train(_words(argv[1:], ("outputs", "rigs", "jobs", "sample_time")))
        options = _words(argv, _KEYS)
        for key in ("method", "in", "out"):
            if key not in options:
                raise ConfigurationError(f"{key} is not given", where=key, remedy=f"{key}=…")
        folder = Path(options["in"])
        truths = None
        if options["method"] in WITH_KEY and "key" in options:
            truths = truths_of(Path(options["key"]), folder)
        failed = run_baseline(
            options["method"],
            folder,
            Path(options["out"]),
            int(options.get("jobs", 2)),
            truths=truths,
            cases=int(options["cases"]) if "cases" in options else None,
        )
    except TrmsError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    for name, why in failed.items():
        sys.stderr.write(f"{name}: {why}\n")
    return 1 if failed else 0


def _words(argv: Sequence[str], keys: Sequence[str]) -> dict[str, str]:
    options = {}
    for word in argv:
        key, equals, value = word.partition("=")
        if key not in keys or not equals:
            raise ConfigurationError(
                f"{word!r} given", where="the command line", remedy=f"keys are {', '.join(keys)}"
            )
        options[key] = value
    return options


def _train(options: dict[str, str]) -> int:
    """Train for the bench's model at 50 Hz, four channels or the angles alone."""
    from experiments.gap.baselines.classifier import RIGS, train_classifier
    from experiments.gap.baselines.run import bench_effects
    from trms_cli.models.model import names
    from trms_cli.models.newtonian import Newtonian

    model = Newtonian()
    outputs = names(model.outputs)[: int(options.get("outputs", 4))]
    classifier = train_classifier(
        model,
        bench_effects(),
        outputs,
        float(options.get("sample_time", 0.02)),
        rigs_each=int(options.get("rigs", RIGS)),
        jobs=int(options.get("jobs", 2)),
        tell=print,
    )
    print(f"right on rigs that it was not trained on: {classifier.accuracy:.0%}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
