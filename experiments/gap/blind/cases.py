"""What a sealed set holds: which rigs, with which effects of which size, driven how.

Everything is drawn from one seed. Development and final sets differ in where the rigs lie, how they
are driven, and in what they have: some effects outside the library and other forms of those inside
occur in the final set alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import cycle, islice
from typing import Literal

import numpy as np

from experiments.gap.blind import severity
from experiments.gap.blind.nominal import relative_sds
from experiments.gap.blind.truths import (
    GROUPS,
    LIBRARY,
    OUTSIDE,
    TRUTHS,
    UNSEEN,
    group_of,
    same_equation,
)

Kind = Literal["null", "offset", "single", "pair", "outside", "unexcited", "matched"]
Drive = Literal["rich", "poor", "closed_loop"]
Channels = Literal["four", "angles"]
Random = np.random.Generator


@dataclass(frozen=True, kw_only=True)
class Case:
    """One rig and its recording: a line of the key."""

    kind: Kind
    #: Sizes of each effect that the rig has, in the rig's units
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    severity: Mapping[str, str] = field(default_factory=dict)  #: Level of each effect
    drive: Drive = "rich"
    channels: Channels = "four"  #: Whether rotor speeds are recorded
    #: Deviations from the nominal values, in standard deviations of the priors
    parameters: Mapping[str, float] = field(default_factory=dict)
    #: Where a gap lies; any of them is right. Empty for a rig without effect.
    locations: tuple[str, ...] = ()
    #: Effects among which no recording of this kind decides, the true one among them
    group: tuple[str, ...] = ()
    twin: int = 0  #: Number of the matched pair that this rig is half of, from 1; 0 for others
    centre: float = 1.25  #: V and 1, of the excitation
    amplitude: float = 0.8  #: see :mod:`experiments.gap.blind.drivers`
    jitter: float = 2e-4  #: s, of the sampling
    excitation: int = 0  #: Seed of the commands


@dataclass(frozen=True, kw_only=True)
class SetPlan:
    """What a set is made of."""

    cases: int  #: Unless another number is asked for
    final: bool  #: Whether forms and effects occur that development sets do not have
    outside: tuple[str, ...]  #: Effects outside the library
    centre: tuple[float, float]  #: (low, high); ranges of the excitation's
    amplitude: tuple[float, float]  #: (low, high); ranges of the excitation's
    #: (low, high); factor by which sizes scatter about those of their severity
    stretch: tuple[float, float]
    #: By how many prior standard deviations the rigs with effects lie beside the nominal on
    #: average, in a direction that the seed decides; 0: about it
    shift: float
    shares: Mapping[Kind, float]  #: Of the kinds


_SHARES: Mapping[Kind, float] = {
    "null": 0.12,
    "offset": 0.12,
    "single": 0.40,
    "pair": 0.12,
    "outside": 0.12,
    "unexcited": 0.05,
    "matched": 0.07,
}
_KNOWN_OUTSIDE = ("pitch_encoder_eccentricity", "main_thrust_loss_with_pitch", "pitch_cogging")
_DEVELOPMENT = SetPlan(
    cases=200,
    final=False,
    outside=_KNOWN_OUTSIDE,
    centre=(1.22, 1.28),
    amplitude=(0.74, 0.82),
    stretch=(0.9, 1.1),
    shift=0.0,
    shares=_SHARES,
)

SETS: Mapping[str, SetPlan] = {
    "small": replace(_DEVELOPMENT, cases=24),
    "development": _DEVELOPMENT,
    "final": replace(
        _DEVELOPMENT,
        cases=300,
        final=True,
        outside=tuple(OUTSIDE),
        centre=(1.12, 1.22),
        amplitude=(0.66, 0.8),
        stretch=(0.85, 1.25),
        shift=0.3,
    ),
}

#: Shares of rigs with one effect that a controller drives, and that record angles only.
_CLOSED, _ANGLES = 0.12, 0.12
#: Prior standard deviations by which rigs with an effect scatter, and the share that does.
_SCATTER, _SCATTERING = 1 / 3, 0.7
_FARTHEST = 2.5  # prior standard deviations of an offset
#: Share of the final set's single effects that take another form, and that jitter more.
_OTHER_FORM, _JITTERY, _JITTER = 0.5, 0.15, 8e-4
#: Strong and medium cases are what the measures are about.
_LEVELS = ("medium", "strong", "medium", "strong", "weak")
#: Levels of twins, the first that both reach.
_MATCHED = ("medium", "weak")
#: Without the speed of its rotor nothing tells a lag of its tacho.
_NEEDS_SPEED = ("main_tacho_lag", "tail_tacho_lag")


def plan(name: str, seed: int, cases: int | None = None) -> list[Case]:
    """The cases of a set, in an order that tells nothing.

    ``name``: of :data:`SETS`. ``cases``: instead of the set's own number.
    """
    made_of = SETS[name]
    number = made_of.cases if cases is None else cases
    random = np.random.default_rng([seed, list(SETS).index(name)])
    draw = _Draw(made_of, random)
    found: list[Case] = []
    for kind, count in _counts(made_of.shares, number).items():
        found += islice(draw.kinds[kind](), count)
    seeds = iter(random.choice(2**31, size=len(found), replace=False).tolist())
    of_twins: dict[int, int] = {}
    for i, case in enumerate(found):
        own = next(seeds)
        if case.twin:  # the same commands, so that nothing but the effect differs
            own = of_twins.setdefault(case.twin, own)
        found[i] = replace(case, excitation=own)
    return [found[i] for i in random.permutation(len(found))]


def _counts(shares: Mapping[Kind, float], number: int) -> dict[Kind, int]:
    """Whole numbers that add up; largest remainders first."""
    exact = {kind: share * number / sum(shares.values()) for kind, share in shares.items()}
    counts = {kind: int(value) for kind, value in exact.items()}
    rest = sorted(exact, key=lambda kind: counts[kind] - exact[kind])
    for kind in rest[: number - sum(counts.values())]:
        counts[kind] += 1
    odd = counts["matched"] % 2  # twins come in pairs
    counts["matched"] -= odd
    counts["single"] += odd
    return counts


class _Draw:
    """Endless cases of each kind."""

    def __init__(self, made_of: SetPlan, random: Random) -> None:
        self._set, self._random = made_of, random
        self._priors = tuple(relative_sds())
        self._shift = made_of.shift * random.choice([-1.0, 1.0], size=len(self._priors))
        self.kinds: Mapping[Kind, Callable[[], Iterator[Case]]] = {
            "null": self._nulls,
            "offset": self._offsets,
            "single": self._singles,
            "pair": self._pairs,
            "outside": self._outsides,
            "unexcited": self._unexcited,
            "matched": self._matched,
        }

    def _nulls(self) -> Iterator[Case]:
        for i in cycle(range(8)):  # one in eight in closed loop, one with angles alone
            drive: Drive = "closed_loop" if i == 3 else "rich"
            channels: Channels = "angles" if i == 5 else "four"
            yield self._driven(Case(kind="null", drive=drive, channels=channels))

    def _offsets(self) -> Iterator[Case]:
        while True:
            away = self._random.standard_normal(len(self._priors)).clip(-_FARTHEST, _FARTHEST)
            yield self._driven(Case(kind="offset", parameters=self._named(away)))

    def _singles(self) -> Iterator[Case]:
        for effect, level in self._effects(tuple(LIBRARY)):
            drive: Drive = "rich"
            channels: Channels = "four"
            lot = self._random.uniform()
            if lot < _CLOSED:
                drive = "closed_loop"
            elif lot < _CLOSED + _ANGLES and effect not in _NEEDS_SPEED:
                channels = "angles"
            case = self._with("single", {effect: level}, group=group_of(effect))
            yield replace(case, drive=drive, channels=channels)

    def _pairs(self) -> Iterator[Case]:
        effects = self._effects(tuple(LIBRARY), weak=False)
        while True:
            (first, level), (second, other) = next(effects), next(effects)
            while not _apart(first, second):
                second, other = next(effects)
            yield self._with("pair", {first: level, second: other}, group=(first, second))

    def _outsides(self) -> Iterator[Case]:
        for effect, level in self._effects(self._set.outside, weak=False):
            yield self._with("outside", {effect: level})

    def _unexcited(self) -> Iterator[Case]:
        for effect, level in self._effects(UNSEEN, weak=False):
            case = self._with("unexcited", {effect: level}, group=group_of(effect))
            yield replace(case, drive="poor")

    def _matched(self) -> Iterator[Case]:
        twin = 0
        while True:
            for number in self._random.permutation(len(GROUPS)):
                group = GROUPS[number]
                common = [
                    lv for lv in _MATCHED if all(lv in severity.levels_reached(e) for e in group)
                ]
                if not common:
                    continue
                twin += 1
                cases = [self._with("matched", {e: common[0]}, group=group) for e in group]
                for case in cases:
                    rig = cases[0]  # one rig, one excitation
                    yield replace(
                        case,
                        twin=twin,
                        parameters=rig.parameters,
                        centre=rig.centre,
                        amplitude=rig.amplitude,
                        jitter=rig.jitter,
                    )

    def _effects(self, names: tuple[str, ...], *, weak: bool = True) -> Iterator[tuple[str, str]]:
        """Effects in rounds of random order, each with a level that it reaches."""
        turn = int(self._random.integers(len(_LEVELS)))
        while True:
            for i in self._random.permutation(len(names)):
                levels = [lv for lv in severity.levels_reached(names[i]) if weak or lv != "weak"]
                turn += 1
                wanted = _LEVELS[turn % len(_LEVELS)]
                if wanted in levels:
                    yield names[i], wanted
                elif "medium" in levels:
                    yield names[i], levels[-1]
                # what is never more than weak comes when it is weak's turn

    def _with(self, kind: Kind, levels: Mapping[str, str], group: tuple[str, ...] = ()) -> Case:
        random = self._random
        effects = {effect: self._sized(effect, level) for effect, level in levels.items()}
        away = np.zeros(len(self._priors))
        if random.uniform() < _SCATTERING:
            away = self._shift + _SCATTER * random.standard_normal(len(self._priors))
        jittery = self._set.final and random.uniform() < _JITTERY
        case = Case(
            kind=kind,
            effects=effects,
            severity=dict(levels),
            parameters=self._named(away) if away.any() else {},
            locations=tuple(dict.fromkeys(at for e in levels for at in TRUTHS[e].locations)),
            group=group,
            jitter=_JITTER if jittery else Case.jitter,
        )
        return self._driven(case)

    def _sized(self, effect: str, level: str) -> dict[str, float]:
        truth, random = TRUTHS[effect], self._random
        factor = severity.factor_of(effect, level) * random.uniform(*self._set.stretch)
        if truth.either_sign:
            factor *= random.choice([-1.0, 1.0])
        others: Mapping[str, float] = {}
        if self._set.final and truth.variants and random.uniform() < _OTHER_FORM:
            others = truth.variants[random.integers(len(truth.variants))]
        return {n: float(f"{v:.5g}") for n, v in truth.sized(factor, **others).items()}

    def _named(self, away: np.ndarray) -> dict[str, float]:
        return dict(zip(self._priors, away.round(4).tolist(), strict=True))

    def _driven(self, case: Case) -> Case:
        centre = float(self._random.uniform(*self._set.centre))
        amplitude = float(self._random.uniform(*self._set.amplitude))
        return replace(case, centre=round(centre, 4), amplitude=round(amplitude, 4))


def _apart(first: str, second: str) -> bool:
    """Whether two effects may be asked for together: not at one place."""
    places = {p for at in TRUTHS[first].locations for p in same_equation(at)}
    return not places & set(TRUTHS[second].locations)
