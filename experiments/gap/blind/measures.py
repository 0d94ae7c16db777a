"""The measures of a proof, from judged cases to a table with intervals and targets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Literal

from experiments.gap.blind.judgement import JudgedCase
from experiments.gap.blind.severity import LEVELS
from experiments.gap.blind.statistics import Estimate, Reliability, quantile, reliability, share

#: A wrong name is serious when it is told with more than this probability.
SURE = 0.7
#: A shrink relative to the oracle's is told where the oracle's is at least this.
_LEAST_SHRINK = 0.2

Judge = Callable[[JudgedCase], bool]


@dataclass(frozen=True, kw_only=True)
class Target:
    """What is to be reached."""

    kind: Literal["at least", "at most", "within"]
    low: float = 0.0  #: "at least" heeds ``low``, "at most" ``high``
    high: float = 1.0  #: "at least" heeds ``low``, "at most" ``high``

    def met(self, value: float) -> bool:
        """Whether a figure reaches it."""
        return (self.kind == "at most" or value >= self.low) and (
            self.kind == "at least" or value <= self.high
        )


@dataclass(frozen=True, kw_only=True)
class Row:
    """A line of the table."""

    measure: str  #: In words
    estimate: Estimate
    unit: Literal["%", "1"] = "%"  #: Shares are shown in per cent
    target: Target | None = None

    @property
    def reached(self) -> bool | None:
        """Whether the target is; None where there is no target, or no case."""
        if self.target is None or self.estimate.value is None:
            return None
        return self.target.met(self.estimate.value)


@dataclass(frozen=True, kw_only=True)
class Table:
    """All that is told of one method."""

    rows: tuple[Row, ...]
    #: Share of exact names: effect, then level and ``all``; singles with rich excitation
    by_effect: Mapping[str, Mapping[str, Estimate]]
    confusions: Mapping[str, Mapping[str, int]]  #: Truth, then what was said
    reliability: Reliability  #: Of the likeliest cause's probability
    seconds: float | None  #: Mean time of a diagnosis


def table(
    judged: Sequence[JudgedCase],
    oracle: Mapping[str, JudgedCase] | None = None,
    *,
    draws: int = 2000,
    seed: int = 0,
) -> Table:
    """All measures of one method.

    ``oracle``: answers of one who was told the effect, by case. ``draws``, ``seed``: of the
    bootstrap.
    """
    took = [j.answer.seconds for j in judged if j.answer.seconds is not None]
    return Table(
        rows=(*_shares(judged), *_amounts(judged, oracle or {}, draws, seed)),
        by_effect=_by_effect(judged),
        confusions=_confusions(judged),
        reliability=reliability([j.answer.first[1] for j in judged], [j.right for j in judged]),
        seconds=fmean(took) if took else None,
    )


def _full(j: JudgedCase) -> bool:
    """Four outputs, open loop, rich excitation."""
    return j.case.drive == "rich" and j.case.channels == "four"


def _plain(j: JudgedCase) -> bool:
    """What the first measures are about: singles that are well seen."""
    return j.case.kind == "single" and _full(j) and "weak" not in j.case.severity.values()


def _weak(j: JudgedCase) -> bool:
    return j.case.kind == "single" and _full(j) and "weak" in j.case.severity.values()


def _kind(*kinds: str) -> Judge:
    return lambda j: j.case.kind in kinds


def _effect_named(j: JudgedCase) -> bool:
    return j.answer.verdict == "effect"


def _sure_and_wrong(j: JudgedCase) -> bool:
    return j.answer.effects != frozenset(j.case.effects) and _sure_of_effect(j)


def _sure_of_effect(j: JudgedCase) -> bool:
    return bool(j.answer.effects) and j.answer.first[1] > SURE


def _wrong_name(j: JudgedCase) -> bool:
    return bool(j.answer.named - frozenset(j.case.effects))


def _none_or_undecided(j: JudgedCase) -> bool:
    return j.answer.verdict in ("none_of_these", "undecided")


def _at_least(low: float) -> Target:
    return Target(kind="at least", low=low)


def _at_most(high: float) -> Target:
    return Target(kind="at most", high=high)


_SHARES: tuple[tuple[str, Judge, Judge, Target | None], ...] = (
    ("single, medium and strong: exact", _plain, lambda j: j.exact, _at_least(0.90)),
    (
        "single, medium and strong: up to the declared confusion group",
        _plain,
        lambda j: j.in_group,
        _at_least(0.96),
    ),
    ("single, medium and strong: place named", _plain, lambda j: j.located, _at_least(0.95)),
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
    ("effect named on an exact null", _kind("null"), _effect_named, _at_most(0.02)),
    ("effect named on a parameter offset", _kind("offset"), _effect_named, _at_most(0.02)),
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
    ("two effects: both", _kind("pair"), lambda j: j.both, _at_least(0.75)),
    ("two effects: at least one", _kind("pair"), lambda j: j.any_right, _at_least(0.95)),
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
)


def _shares(judged: Sequence[JudgedCase]) -> list[Row]:
    return [
        Row(measure=measure, estimate=share([hit(j) for j in judged if among(j)]), target=target)
        for measure, among, hit, target in _SHARES
    ]


def _amounts(
    judged: Sequence[JudgedCase], oracle: Mapping[str, JudgedCase], draws: int, seed: int
) -> list[Row]:
    ratios = [r for j in judged if (r := _relative_shrink(j, oracle.get(j.name))) is not None]
    errors = [e for j in judged if j.case.kind == "single" for e in j.size_errors.values()]
    seen = [j for j in judged if j.fresh is not None]
    return [
        Row(
            measure="shrink relative to the oracle: median",
            estimate=quantile(ratios, 0.5, draws, seed),
            unit="1",
            target=_at_least(0.95),
        ),
        Row(
            measure="shrink relative to the oracle: 10th percentile",
            estimate=quantile(ratios, 0.1, draws, seed),
            unit="1",
            target=_at_least(0.80),
        ),
        Row(
            measure="95 % interval of the shrink covers",
            estimate=share([c for j in judged if (c := _covered(j)) is not None]),
            target=Target(kind="within", low=0.94, high=0.96),
        ),
        Row(
            measure="effect size error: median",
            estimate=quantile(errors, 0.5, draws, seed),
            target=_at_most(0.08),
        ),
        Row(
            measure="a channel made worse by over 2 %",
            estimate=share([bool(j.fresh and j.fresh.worse) for j in seen]),
            target=_at_most(0.005),
        ),
    ]


def _relative_shrink(j: JudgedCase, told: JudgedCase | None) -> float | None:
    """Of rigs with library effects; on second recordings where both have one."""
    if told is None or j.case.kind not in ("single", "pair", "matched"):
        return None
    if "weak" in j.case.severity.values():
        return None
    both = j.fresh is not None and told.fresh is not None
    own = j.fresh.shrink if both and j.fresh else j.answer.shrink
    best = told.fresh.shrink if both and told.fresh else told.answer.shrink
    if best is None or best < _LEAST_SHRINK:
        return None
    return (own or 0.0) / best


def _covered(j: JudgedCase) -> bool | None:
    """Whether the told interval holds the shrink on the second recording."""
    ci95 = j.answer.shrink_ci95
    if j.fresh is None or j.fresh.shrink is None or ci95 is None or not j.answer.named:
        return None
    return ci95[0] <= j.fresh.shrink <= ci95[1]


def _by_effect(judged: Sequence[JudgedCase]) -> dict[str, dict[str, Estimate]]:
    hits: dict[str, dict[str, list[bool]]] = {}
    for j in judged:
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


def _confusions(judged: Sequence[JudgedCase]) -> dict[str, dict[str, int]]:
    found: dict[str, dict[str, int]] = {}
    for j in judged:
        row = found.setdefault(j.label, {})
        row[j.said] = row.get(j.said, 0) + 1
    return {
        truth: dict(sorted(row.items(), key=lambda item: -item[1]))
        for truth, row in sorted(found.items())
    }
