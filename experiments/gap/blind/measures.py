"""The measures of a proof, from judged cases to a table with intervals and targets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Literal

import numpy as np

from experiments.gap.blind.between_recordings import Spread, between_recordings
from experiments.gap.blind.judgement import JudgedCase
from experiments.gap.blind.severity import LEVELS
from experiments.gap.blind.statistics import (
    Estimate,
    Reliability,
    bootstrapped,
    calibration_error,
    quantile,
    reliability,
    share,
)

#: A wrong name is serious when it is told with more than this probability.
SURE = 0.7
#: What is said with this probability and more should be right nearly always.
VERY_SURE = 0.9
#: s. An onset is found where it is told as near; shorter recordings than the other are not rich.
NEAR, SHORT = 1.0, 60.0
#: A shrink relative to the oracle's is told where the oracle's is at least this.
_LEAST_SHRINK = 0.2

#: Kinds whose shrink is compared with the oracle's.
_SHRINKING = ("single", "pair", "triple", "matched")

Judge = Callable[[JudgedCase], bool]


@dataclass(frozen=True, kw_only=True)
class Target:
    """What is to be reached."""

    kind: Literal["at least", "at most", "within"]
    low: float = 0.0  #: "at least" heeds ``low``, "at most" ``high``
    high: float = 1.0  #: "at least" heeds ``low``, "at most" ``high``

    def is_met(self, value: float) -> bool:
        """Whether a figure reaches it."""
        return (self.kind == "at most" or value >= self.low) and (
            self.kind == "at least" or value <= self.high
        )


@dataclass(frozen=True, kw_only=True)
class Row:
    """A line of the table."""

    measure: str  #: In words
    estimate: Estimate
    unit: Literal["%", "1", "s"] = "%"  #: Shares are shown in per cent
    target: Target | None = None

    @property
    def is_reached(self) -> bool | None:
        """Whether the target is; None where there is no target, or no case."""
        if self.target is None or self.estimate.value is None:
            return None
        return self.target.is_met(self.estimate.value)


@dataclass(frozen=True, kw_only=True)
class Table:
    """All that is told of one method."""

    rows: tuple[Row, ...]
    #: Share of exact names: effect, then level and ``all``; singles with rich excitation
    by_effect: Mapping[str, Mapping[str, Estimate]]
    confusions: Mapping[str, Mapping[str, int]]  #: Truth, then what was said
    reliability: Reliability  #: Of the likeliest cause's probability
    spreads: Sequence[Spread]  #: Of errors, from the sealed part to the second recording
    seconds: float | None  #: Mean time of a diagnosis


def table(
    judged_cases: Sequence[JudgedCase],
    oracle: Mapping[str, JudgedCase] | None = None,
    *,
    draws: int = 2000,
    seed: int = 0,
) -> Table:
    """All measures of one method.

    ``oracle``: answers of one who was told the effect, by case. ``draws``, ``seed``: of the
    bootstrap.
    """
    took = [j.answer.seconds for j in judged_cases if j.answer.seconds is not None]
    return Table(
        rows=(*_shares(judged_cases), *_amounts(judged_cases, oracle or {}, draws, seed)),
        by_effect=_by_effect(judged_cases),
        confusions=_confusions(judged_cases),
        spreads=between_recordings(judged_cases),
        reliability=reliability(
            [j.answer.first[1] for j in judged_cases], [j.right for j in judged_cases]
        ),
        seconds=fmean(took) if took else None,
    )


def _full(j: JudgedCase) -> bool:
    """Four outputs, open loop, rich excitation for a minute at least."""
    rich = j.case.drive == "rich" and j.case.duration >= SHORT
    return rich and j.case.channels == "four"


def _plain(j: JudgedCase) -> bool:
    """What the first measures are about: singles that are well seen."""
    return j.case.kind == "single" and _full(j) and "weak" not in j.case.severity.values()


def _weak(j: JudgedCase) -> bool:
    return j.case.kind == "single" and _full(j) and "weak" in j.case.severity.values()


def _kind(*kinds: str) -> Judge:
    return lambda j: j.case.kind in kinds


def _names_effect(j: JudgedCase) -> bool:
    return j.answer.verdict == "effect"


def _sure_and_wrong(j: JudgedCase) -> bool:
    return j.answer.effects != frozenset(j.case.effects) and _sure_of_effect(j)


def _sure_of_effect(j: JudgedCase) -> bool:
    return bool(j.answer.effects) and j.answer.first[1] > SURE


def _wrong_name(j: JudgedCase) -> bool:
    return bool(j.answer.named_effects - frozenset(j.case.effects))


def _of_change(what: str) -> Judge:
    """Rigs with recordings of a known state in which an effect, a parameter or nothing changed."""

    def among(j: JudgedCase) -> bool:
        changed = "effect" if j.case.effects else "parameter" if j.case.moved else "nothing"
        return j.case.kind == "against" and changed == what

    return among


def _names_something(j: JudgedCase) -> bool:
    return j.answer.verdict in ("effect", "parameters_only")


def _without_cause(j: JudgedCase) -> bool:
    """Nothing that could be named: exact nulls, parameter offsets, nothing changed."""
    return j.case.kind in ("null", "offset") or _of_change("nothing")(j)


def _very_sure(j: JudgedCase) -> bool:
    return j.answer.first[1] >= VERY_SURE


def _names_parameter(j: JudgedCase) -> bool:
    first = j.answer.first[0] == ("parameters_only",)
    return first and j.answer.moved[:1] == tuple(j.case.moved)


def _none_or_undecided(j: JudgedCase) -> bool:
    return j.answer.verdict in ("none_of_these", "undecided")


def _at_least(low: float) -> Target:
    return Target(kind="at least", low=low)


def _at_most(high: float) -> Target:
    return Target(kind="at most", high=high)


_Shares = tuple[tuple[str, Judge, Judge, Target | None], ...]

_OF_SINGLES: _Shares = (
    ("single, medium and strong: exact", _plain, lambda j: j.exact, _at_least(0.92)),
    (
        "single, medium and strong: up to the declared confusion group",
        _plain,
        lambda j: j.in_group,
        _at_least(0.97),
    ),
    ("single, medium and strong: place named", _plain, lambda j: j.located, _at_least(0.96)),
    ("single, medium and strong: equation named", _plain, lambda j: j.equation, None),
    ("single, medium and strong: sure of a wrong name", _plain, _sure_and_wrong, None),
    ("single, weak: exact", _weak, lambda j: j.exact, None),
    ("single, weak: sure of a wrong name", _weak, _sure_and_wrong, None),
    (
        "single in closed loop: exact",
        lambda j: j.case.kind == "single" and j.case.drive == "closed_loop",
        lambda j: j.exact,
        None,
    ),
    (
        "single, angles alone: exact",
        lambda j: j.case.kind == "single" and j.case.channels == "angles",
        lambda j: j.exact,
        None,
    ),
    (
        "single, shorter than a minute: exact",
        lambda j: j.case.kind == "single" and j.case.duration < SHORT,
        lambda j: j.exact,
        None,
    ),
    ("single, all: exact", _kind("single"), lambda j: j.exact, None),
    ("single, all: sure of a wrong name", _kind("single"), _sure_and_wrong, None),
)
_OF_NOTHING: _Shares = (
    ("effect named on an exact null", _kind("null"), _names_effect, _at_most(0.01)),
    ("effect named on a parameter offset", _kind("offset"), _names_effect, _at_most(0.01)),
    (
        "no change: an effect or a parameter named",
        _of_change("nothing"),
        _names_something,
        _at_most(0.01),
    ),
    ("null, offset, no change: effect named", _without_cause, _names_effect, _at_most(0.01)),
    (
        f"null, offset, no change: wrong with probability over {VERY_SURE}",
        _without_cause,
        lambda j: _very_sure(j) and not j.right,
        None,
    ),
)
_OF_OUTSIDE: _Shares = (
    (
        f"outside the library: wrong name, probability over {SURE}",
        _kind("outside"),
        _sure_of_effect,
        _at_most(0.02),
    ),
    (
        "outside the library: none of these, or undecided",
        _kind("outside"),
        _none_or_undecided,
        _at_least(0.90),
    ),
)
_OF_SEVERAL: _Shares = (
    ("two effects: both", _kind("pair"), lambda j: j.both, _at_least(0.85)),
    ("two effects: at least one", _kind("pair"), lambda j: j.any_right, _at_least(0.95)),
    ("three effects: two of them", _kind("triple"), lambda j: j.two_right, _at_least(0.85)),
    ("three effects: all", _kind("triple"), lambda j: j.both, None),
    ("three effects: at least one", _kind("triple"), lambda j: j.any_right, None),
    (
        "two or three effects: a wrong one with them",
        _kind("pair", "triple"),
        lambda j: bool(j.answer.effects - frozenset(j.case.effects)),
        None,
    ),
)
_OF_MOMENTS: _Shares = (
    ("begins within: exact", _kind("onset"), lambda j: j.exact, None),
    (
        f"begins within: moment told to {NEAR:g} s",
        _kind("onset"),
        lambda j: _near(j),
        _at_least(0.90),
    ),
    (
        f"begins within, effect named: moment told to {NEAR:g} s",
        lambda j: j.case.kind == "onset" and j.exact,
        lambda j: _near(j),
        None,
    ),
    (
        "there all the time: a moment told nevertheless",
        lambda j: j.case.kind in ("single", "pair", "triple") and j.exact,
        lambda j: j.answer.onset is not None,
        None,
    ),
)
_OF_CHANGES: _Shares = (
    ("what changed, an effect: exact", _of_change("effect"), lambda j: j.exact, None),
    (
        "what changed, an effect: up to the declared confusion group",
        _of_change("effect"),
        lambda j: j.in_group,
        None,
    ),
    ("what changed, an effect: place named", _of_change("effect"), lambda j: j.located, None),
    (
        "what changed, a parameter: parameters only",
        _of_change("parameter"),
        lambda j: j.right,
        None,
    ),
    ("what changed, a parameter: which", _of_change("parameter"), _names_parameter, None),
    ("no change: said so", _of_change("nothing"), lambda j: j.right, None),
)
_OF_LIMITS: _Shares = (
    ("matched pairs: exact", _kind("matched"), lambda j: j.exact, None),
    (
        "matched pairs: up to the declared confusion group",
        _kind("matched"),
        lambda j: j.in_group,
        None,
    ),
    ("present but not excited: wrong name", _kind("unexcited"), _wrong_name, None),
    (
        "present but not excited: named, or said not to be testable",
        _kind("unexcited"),
        lambda j: j.exact or frozenset(j.case.effects) <= frozenset(j.answer.not_testable),
        None,
    ),
    (f"said with {VERY_SURE} and more: right", _very_sure, lambda j: j.right, _at_least(0.93)),
)
_SHARES: _Shares = (
    *_OF_SINGLES,
    *_OF_NOTHING,
    *_OF_OUTSIDE,
    *_OF_SEVERAL,
    *_OF_MOMENTS,
    *_OF_CHANGES,
    *_OF_LIMITS,
)


def _near(j: JudgedCase) -> bool:
    return j.onset_error is not None and j.onset_error <= NEAR


def _shares(judged_cases: Sequence[JudgedCase]) -> list[Row]:
    return [
        Row(
            measure=measure,
            estimate=share([hit(j) for j in judged_cases if among(j)]),
            target=target,
        )
        for measure, among, hit, target in _SHARES
    ]


def _amounts(
    judged_cases: Sequence[JudgedCase], oracle: Mapping[str, JudgedCase], draws: int, seed: int
) -> list[Row]:
    ratios = [r for j in judged_cases if (r := _relative_shrink(j, oracle.get(j.name))) is not None]
    errors = [e for j in judged_cases if j.case.kind == "single" for e in j.size_errors.values()]
    fresh_cases = [j for j in judged_cases if j.fresh is not None]
    took = [j.answer.seconds for j in judged_cases if j.answer.seconds is not None]
    first = np.array([j.answer.first[1] for j in judged_cases])
    right = np.array([j.right for j in judged_cases], dtype=bool)
    parts = [
        (p, effect in j.case.effects)
        for j in judged_cases
        for effect, p in j.answer.inclusion.items()
    ]
    of_parts = np.array([p for p, _ in parts])
    there = np.array([t for _, t in parts], dtype=bool)
    return [
        Row(
            measure="expected calibration error",
            estimate=bootstrapped(
                lambda some: calibration_error(first[some], right[some]),
                len(judged_cases),
                draws,
                seed,
            ),
            unit="1",
            target=_at_most(0.04),
        ),
        Row(
            measure="expected calibration error of each effect's part",
            estimate=bootstrapped(
                lambda some: calibration_error(of_parts[some], there[some]), len(parts), 100, seed
            ),
            unit="1",
        ),
        Row(
            measure="shrink relative to the oracle: median",
            estimate=quantile(ratios, 0.5, draws, seed),
            unit="1",
            target=_at_least(0.97),
        ),
        Row(
            measure="shrink relative to the oracle: 10th percentile",
            estimate=quantile(ratios, 0.1, draws, seed),
            unit="1",
            target=_at_least(0.80),
        ),
        Row(
            measure="95 % interval of the shrink covers",
            estimate=share([c for j in judged_cases if (c := _covered(j)) is not None]),
            target=Target(kind="within", low=0.94, high=0.96),
        ),
        Row(
            measure="effect size error: median",
            estimate=quantile(errors, 0.5, draws, seed),
            target=_at_most(0.08),
        ),
        Row(
            measure="a channel made worse by over 2 %",
            estimate=share([bool(j.fresh and j.fresh.worse) for j in fresh_cases]),
            target=_at_most(0.005),
        ),
        Row(
            measure="time of a diagnosis: median",
            estimate=quantile(took, 0.5, draws, seed),
            unit="s",
            target=_at_most(30.0),
        ),
    ]


def _relative_shrink(j: JudgedCase, oracle: JudgedCase | None) -> float | None:
    """Of rigs with library effects; on second recordings where both have one."""
    if oracle is None or j.case.kind not in _SHRINKING:
        return None
    if "weak" in j.case.severity.values():
        return None
    both = j.fresh is not None and oracle.fresh is not None
    own = j.fresh.shrink if both and j.fresh else j.answer.shrink
    best = oracle.fresh.shrink if both and oracle.fresh else oracle.answer.shrink
    if best is None or best < _LEAST_SHRINK:
        return None
    return (own or 0.0) / best


def _covered(j: JudgedCase) -> bool | None:
    """Whether the told interval holds the shrink on the second recording."""
    ci95 = j.answer.shrink_ci95
    if j.fresh is None or j.fresh.shrink is None or ci95 is None or not j.answer.named_effects:
        return None
    return ci95[0] <= j.fresh.shrink <= ci95[1]


def _by_effect(judged_cases: Sequence[JudgedCase]) -> dict[str, dict[str, Estimate]]:
    hits: dict[str, dict[str, list[bool]]] = {}
    for j in judged_cases:
        if j.case.kind != "single" or not _full(j):
            continue
        for effect, level in j.case.severity.items():
            for row in (effect, "all effects"):
                for column in (level, "all"):
                    hits.setdefault(row, {}).setdefault(column, []).append(j.exact)
    order = (*LEVELS, "all")
    return {
        effect: {level: share(hits[effect][level]) for level in order if level in hits[effect]}
        for effect in sorted(hits)
    }


def _confusions(judged_cases: Sequence[JudgedCase]) -> dict[str, dict[str, int]]:
    counts: dict[str, dict[str, int]] = {}
    for j in judged_cases:
        row = counts.setdefault(j.label, {})
        row[j.answer_label] = row.get(j.answer_label, 0) + 1
    return {
        truth: dict(sorted(row.items(), key=lambda item: -item[1]))
        for truth, row in sorted(counts.items())
    }
