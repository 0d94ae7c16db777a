"""Does each effect recover its own simulation? Rigs of the other code, one candidate, three sizes.

    python -m experiments.gap.recovery OUT [EFFECT …] [--race] [--effort quick] [--seed N]

Each rig of :mod:`.blind.rig` has one effect of the library, at half, once and twice a typical size,
and the nuisances of all rigs. ``trms diagnose`` gets its recording with that effect as the only
candidate (with ``--race``: with the whole library). The effect is recovered where its size comes
out within a tenth of the rig's, or within three of its own standard deviations, and where it
predicts held-out blocks far better than the refit does. What lies in OUT is only read, so that an
interrupted study goes on.
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.gap.blind.cases import Case
from experiments.gap.blind.recording import Timing, csv_of, record
from experiments.gap.blind.run import diagnose_all
from experiments.gap.blind.truths import LIBRARY, group_of

#: Multiples of the typical size.
FACTORS = (0.5, 1.0, 2.0)
#: Relative error of a size, and standard deviations of it, within which it is the rig's.
NEAR, DEVIATIONS = 0.1, 3.0
#: Nats of held-out prediction above the refit from which an effect lies far above it.
FAR_ABOVE = 10.0
#: Neither noise nor rounding is fitted by simulation: they are recovered where they are named.
_EFFECTS_WITHOUT_FIT = ("disturbance", "quantisation")
#: What the rig does by another law, so that its size means something else.
_OTHER_LAW = ("yaw_cable_hysteresis",)


@dataclass(frozen=True)
class Recovery:
    """What came back of one rig's effect."""

    effect: str
    factor: float
    size: float  #: The rig's; of the first size that grows
    estimate: float | None  #: None where none was fitted
    sd: float | None
    score: float | None  #: Held-out nats above the refit
    is_named: bool  #: Whether the likeliest cause is the effect, or one that is declared alike
    verdict: str

    @property
    def near(self) -> bool:
        """Whether the size is the rig's, as far as its own deviation says."""
        if self.estimate is None or self.sd is None:
            return False
        error = abs(self.estimate - self.size)
        within = error <= max(NEAR * abs(self.size), DEVIATIONS * self.sd)
        return within or self.effect in _OTHER_LAW

    @property
    def recovered(self) -> bool:
        """Whether size and score are the rig's."""
        if self.effect.endswith(_EFFECTS_WITHOUT_FIT):
            return self.is_named
        return self.near and self.score is not None and self.score > FAR_ABOVE


def cases_of(
    effects: Sequence[str], seed: int, factors: Sequence[float] = FACTORS
) -> dict[str, Case]:
    """Rigs by name: nominal but for one effect, all driven alike."""
    return {
        f"{effect}-{factor:g}": Case(
            kind="single",
            effects={effect: LIBRARY[effect].sized(factor)},
            locations=LIBRARY[effect].locations,
            group=group_of(effect),
            excitation=seed,
        )
        for effect in effects
        for factor in factors
    }


def write_recordings(cases: Mapping[str, Case], folder: Path, seed: int) -> None:
    """Record those that are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    missing = {name: c for name, c in cases.items() if not (folder / f"{name}.csv").is_file()}
    if not missing:
        return
    driven_cases, recordings = record(list(missing.values()), Timing(), seed)
    for name, case, recording in zip(missing, driven_cases, recordings, strict=True):
        (folder / f"{name}.csv").write_text(csv_of(case, recording), encoding="utf-8")


def recovery_of(name: str, case: Case, document: Mapping[str, Any]) -> Recovery:
    """Read a diagnosis."""
    (effect,) = case.effects
    key = LIBRARY[effect].grows[0]
    row = next((r for r in document["race"] if r["effects"] == [effect]), None)
    size = None if row is None else row["parameters"].get(f"{effect}.{key}")
    first = document["causes"][0]["effects"]
    alike = {effect, *(n for g in document["confusable"] if effect in g for n in g)}
    return Recovery(
        effect,
        float(name.rsplit("-", 1)[1]),
        case.effects[effect][key],
        None if size is None else size["value"],
        None if size is None else size["sd"],
        None if row is None else row["score"],
        len(first) == 1 and first[0] in alike,
        document["verdict"],
    )


def table_of(recoveries: Sequence[Recovery]) -> str:
    """A line a rig."""
    lines = [
        "| effect | × typical | size | estimate | error | nats above refit | said | recovered |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for one in recoveries:
        estimate, error = "–", "–"
        if one.estimate is not None and one.sd is not None:
            estimate = f"{one.estimate:.4g} ± {one.sd:.2g}"
            error = f"{100 * (one.estimate / one.size - 1):+.1f} %"
        score = "–" if one.score is None else f"{one.score:.0f}"
        answer = "named" if one.is_named else one.verdict
        yes = "yes" if one.recovered else "**no**"
        cells = (one.effect, f"{one.factor:g}", f"{one.size:.4g}", estimate, error, score, answer)
        lines.append("| " + " | ".join((*cells, yes)) + " |")
    count = sum(one.recovered for one in recoveries)
    lines.append(f"\n{count} of {len(recoveries)} recovered.")
    return "\n".join(lines) + "\n"


def study(
    out: Path,
    effects: Sequence[str],
    *,
    race: bool,
    seed: int,
    jobs: int,
    factors: Sequence[float] = FACTORS,
    effort: str = "normal",
) -> list[Recovery]:
    """Record, diagnose, read; a rig that cannot be diagnosed is told, and not in the list."""
    cases = cases_of(effects, seed, factors)
    write_recordings(cases, out / "recordings", seed)
    competition = "race" if race else "alone"
    answers = out / (competition if effort == "normal" else f"{competition}_{effort}")
    answers.mkdir(exist_ok=True)
    waiting = [n for n in cases if not (answers / n / "diagnosis.json").is_file()]
    for effect in dict.fromkeys(next(iter(cases[name].effects)) for name in waiting):
        files = [out / "recordings" / f"{n}.csv" for n in waiting if effect in cases[n].effects]
        words = [f"effort={effort}", *([] if race else [f"candidates=[{effect}]"])]
        for name, why in diagnose_all(files, answers, words, jobs, _say).items():
            _say(name, f"not diagnosed: {why}")
    return [
        recovery_of(name, case, json.loads(document.read_text(encoding="utf-8")))
        for name, case in cases.items()
        if (document := answers / name / "diagnosis.json").is_file()
    ]


def _say(name: str, message: str) -> None:
    sys.stderr.write(f"{name}  {message}\n")
    sys.stderr.flush()


def main(argv: Sequence[str]) -> int:
    """Study and print; 1 where an effect is not recovered."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("effects", nargs="*", default=[])
    parser.add_argument("--race", action="store_true", help="the whole library competes")
    parser.add_argument("--effort", choices=("quick", "normal", "thorough"), default="normal")
    parser.add_argument("--seed", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args(argv)
    effects = arguments.effects or list(LIBRARY)
    unknown = [name for name in effects if name not in LIBRARY]
    if unknown:
        parser.error(f"no effect {unknown[0]!r}; there are: {', '.join(LIBRARY)}")
    recoveries = study(
        arguments.out,
        effects,
        race=arguments.race,
        seed=arguments.seed,
        jobs=arguments.jobs,
        effort=arguments.effort,
    )
    sys.stdout.write(table_of(recoveries))
    complete = len(recoveries) == len(cases_of(effects, arguments.seed))
    return 0 if complete and all(one.recovered for one in recoveries) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
