"""What a sealed set holds: which rigs, with which effects of which size, driven how.

Everything is drawn from one seed. Development and final sets differ in where the rigs lie, how they
are driven, and in what they have: some effects outside the library and other forms of those inside
occur in the final set alone. The nuisances of each rig are drawn, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Literal

import numpy as np

from experiments.gap.blind import severity
from experiments.gap.blind.nominal import nominal, relative_sds
from experiments.gap.blind.nuisances import (
    curved_laws,
    draw_duration,
    draw_nuisances,
    imperfect_laws,
)
from experiments.gap.blind.sets import SETS, Kind, SetPlan
from experiments.gap.blind.truths import (
    GROUPS,
    LIBRARY,
    SUDDEN,
    TRUTHS,
    UNSEEN,
    group_of,
    same_equation,
)

Drive = Literal["rich", "poor", "closed_loop"]
Channels = Literal["four", "angles"]
Random = np.random.Generator


@dataclass(frozen=True, kw_only=True)
class Case:
    """One rig and its recording: a line of the key."""

    kind: Kind
    #: Sizes of each effect that is to be named, in the rig's units
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
    duration: float = 120.0  #: s
    #: By the names of :class:`experiments.gap.blind.rig.Nuisances`; the usual where not named
    nuisances: Mapping[str, float] = field(default_factory=dict)
    imperfect: bool = False  #: Whether its laws are others than the nominal model's
    #: s, from when an effect is there; always, where it is not named
    onset: Mapping[str, float] = field(default_factory=dict)
    references: int = 0  #: Number of recordings of the same rig in a known state
    #: Sizes of effects that the rig has in the known state as well
    standing: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    #: What ``parameters`` are further off than in the known state, in the same unit
    moved: Mapping[str, float] = field(default_factory=dict)
    excitation: int = 0  #: Seed of the commands

    def parameter_values(self) -> dict[str, float]:
        """The rig's own parameters by name, SI units."""
        sds = relative_sds()

        def deviations(name: str) -> float:
            return self.parameters.get(name, 0.0) + self.moved.get(name, 0.0)

        return {
            name: value * (1 + sds.get(name, 0.0) * deviations(name))
            for name, value in nominal().items()
        }


#: Shares of rigs that a controller drives, and that record angles only.
_CLOSED, _ANGLES = 0.12, 0.12
#: Prior standard deviations by which rigs with an effect scatter, and the share that does.
_SCATTER, _SCATTERING = 1 / 3, 0.7
_FARTHEST = 2.5  # prior standard deviations of an offset
#: Share of the final set's single effects that take another form.
_OTHER_FORM = 0.5
#: Strong and medium cases are what the measures are about.
_LEVELS = ("medium", "strong", "medium", "strong", "weak")
#: Levels of twins, the first that both reach.
_MATCHED = ("medium", "weak")
#: Without the speed of its rotor nothing tells a lag of its tacho.
_NEEDS_SPEED = ("main_tacho_lag", "tail_tacho_lag")
#: Shares of a recording between which an effect begins.
_BEGINS = (0.3, 0.7)
#: Of rigs with recordings of a known state: how much of the imperfect laws they have, their
#: parameters' standard deviation in those of the priors, sizes of a standing effect in those of a
#: weak one.
_STANDING_LAWS, _STANDING_OFFSET, _STANDING = 0.5, 0.7, (0.4, 1.0)
#: Parameters that change, and by how many prior standard deviations.
_CHANGING = ("m_cb", "l_cb", "k_fvp", "k_fhp", "k_fhn", "k_uv", "k_uh", "k_oh", "k_ov", "k_chp")
_CHANGE = (2.5, 4.0)
#: s. Durations of recordings that have others to be compared with.
_COMPARED = (60.0, 120.0)


def plan(name: str, seed: int, cases: int | None = None) -> list[Case]:
    """The cases of a set, in an order that tells nothing.

    ``name``: of :data:`.sets.SETS`. ``cases``: instead of the set's own number.
    """
    set_plan = SETS[name]
    number = set_plan.cases if cases is None else cases
    random = np.random.default_rng([seed, list(SETS).index(name)])
    draw = _Draw(set_plan, random)
    planned_cases: list[Case] = []
    for kind, count in _counts(set_plan.shares, number).items():
        planned_cases += islice(draw.kinds[kind](), count)
    seeds = iter(random.choice(2**31, size=len(planned_cases), replace=False).tolist())
    of_twins: dict[int, int] = {}
    for i, case in enumerate(planned_cases):
        own = next(seeds)
        if case.twin:  # the same commands, so that nothing but the effect differs
            own = of_twins.setdefault(case.twin, own)
        planned_cases[i] = replace(case, excitation=own)
    return [planned_cases[i] for i in random.permutation(len(planned_cases))]


def _counts(shares: Mapping[Kind, float], number: int) -> dict[Kind, int]:
    """Whole numbers that add up; largest remainders first."""
    exact = {kind: share * number / sum(shares.values()) for kind, share in shares.items()}
    counts = {kind: int(value) for kind, value in exact.items()}
    rest = sorted(exact, key=lambda kind: counts[kind] - exact[kind])
    for kind in rest[: number - sum(counts.values())]:
        counts[kind] += 1
    odd = counts.get("matched", 0) % 2  # twins come in pairs
    if odd:
        counts["matched"] -= odd
        counts["single"] += odd
    return counts


class _Draw:
    """Endless cases of each kind."""

    def __init__(self, set_plan: SetPlan, random: Random) -> None:
        self._plan, self._random = set_plan, random
        self._priors = tuple(relative_sds())
        self._shift = set_plan.shift * random.choice([-1.0, 1.0], size=len(self._priors))
        self.kinds: Mapping[Kind, Callable[[], Iterator[Case]]] = {
            "null": self._nulls,
            "offset": self._offsets,
            "single": self._singles,
            "pair": self._pairs,
            "outside": self._outsides,
            "unexcited": self._unexcited,
            "matched": self._matched,
            "triple": self._triples,
            "onset": self._onsets,
            "against": self._against,
        }

    def _nulls(self) -> Iterator[Case]:
        while True:
            yield self._with_excitation(Case(kind="null"))

    def _offsets(self) -> Iterator[Case]:
        while True:
            away = self._random.standard_normal(len(self._priors)).clip(-_FARTHEST, _FARTHEST)
            yield self._with_excitation(
                Case(kind="offset", parameters=self._offsets_by_parameter(away))
            )

    def _singles(self) -> Iterator[Case]:
        for effect, level in self._effects(self._plan.effects, weak=self._plan.weak):
            yield self._with("single", {effect: level}, group=group_of(effect))

    def _pairs(self) -> Iterator[Case]:
        return self._together("pair", 2)

    def _triples(self) -> Iterator[Case]:
        return self._together("triple", 3)

    def _together(self, kind: Kind, number: int) -> Iterator[Case]:
        effects = self._effects(tuple(LIBRARY), weak=False)
        while True:
            levels: dict[str, str] = {}
            while len(levels) < number:
                effect, level = next(effects)
                if all(_apart(effect, other) for other in levels):
                    levels[effect] = level
            yield self._with(kind, levels, group=tuple(levels))

    def _onsets(self) -> Iterator[Case]:
        for effect, level in self._effects(SUDDEN, weak=False):
            case = self._with("onset", {effect: level}, group=group_of(effect))
            duration = max(case.duration, self._compared())
            begins = duration * self._random.uniform(*_BEGINS)
            yield replace(case, duration=duration, onset={effect: round(begins, 2)})

    def _against(self) -> Iterator[Case]:
        effects = self._effects(tuple(LIBRARY), weak=False)
        standing = self._effects(tuple(LIBRARY))
        while True:
            for what in self._random.permutation(["effect", "effect", "effect", "parameter", "no"]):
                effect, level = next(effects)
                other, _ = next(standing)
                while not _apart(effect, other) or "weak" not in severity.levels_reached(other):
                    other, _ = next(standing)
                levels = {effect: level} if what == "effect" else {}
                group = group_of(effect) if levels else ()
                yield self._with_known_state(self._with("against", levels, group), other, what)

    def _with_known_state(self, case: Case, standing: str, what: str) -> Case:
        random = self._random
        away = _STANDING_OFFSET * random.standard_normal(len(self._priors))
        parameter_changes = {}
        if what == "parameter":
            change = random.uniform(*_CHANGE) * random.choice([-1.0, 1.0])
            parameter_changes = {str(random.choice(_CHANGING)): round(float(change), 4)}
        standing_sizes = self._sized(standing, "weak", random.uniform(*_STANDING))
        laws = case.nuisances
        if not case.imperfect:
            laws = {**laws, **imperfect_laws(random, _STANDING_LAWS)}
        return replace(
            case,
            parameters=self._offsets_by_parameter(away.clip(-2, 2)),
            duration=self._compared(),
            nuisances=laws,
            references=int(random.integers(1, 4)),
            standing={standing: standing_sizes},
            moved=parameter_changes,
        )

    def _compared(self) -> float:
        return round(self._random.uniform(*_COMPARED))

    def _outsides(self) -> Iterator[Case]:
        for effect, level in self._effects(self._plan.outside, weak=False):
            yield self._with("outside", {effect: level})

    def _unexcited(self) -> Iterator[Case]:
        for effect, level in self._effects(UNSEEN, weak=False):
            case = self._with("unexcited", {effect: level}, group=group_of(effect))
            yield replace(case, drive="poor", channels="four")

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
                        duration=rig.duration,
                        nuisances=rig.nuisances,
                    )

    def _effects(self, names: tuple[str, ...], *, weak: bool = True) -> Iterator[tuple[str, str]]:
        """Effects in rounds of random order, each with a level that it reaches."""
        turn = int(self._random.integers(len(_LEVELS)))
        while True:
            for i in self._random.permutation(len(names)):
                levels = [lv for lv in severity.levels_reached(names[i]) if weak or lv != "weak"]
                turn += 1
                next_level = _LEVELS[turn % len(_LEVELS)]
                if next_level in levels:
                    yield names[i], next_level
                elif "medium" in levels:
                    yield names[i], levels[-1]
                # what is never more than weak comes when it is weak's turn

    def _with(self, kind: Kind, levels: Mapping[str, str], group: tuple[str, ...] = ()) -> Case:
        random = self._random
        effects = {effect: self._sized(effect, level) for effect, level in levels.items()}
        away = np.zeros(len(self._priors))
        if random.uniform() < _SCATTERING:
            away = self._shift + _SCATTER * random.standard_normal(len(self._priors))
        case = Case(
            kind=kind,
            effects=effects,
            severity=dict(levels),
            parameters=self._offsets_by_parameter(away) if away.any() else {},
            locations=tuple(dict.fromkeys(at for e in levels for at in TRUTHS[e].locations)),
            group=group,
        )
        return self._with_excitation(case)

    def _sized(self, effect: str, level: str, share: float = 1.0) -> dict[str, float]:
        truth, random = TRUTHS[effect], self._random
        factor = share * severity.factor_of(effect, level) * random.uniform(*self._plan.stretch)
        if truth.either_sign:
            factor *= random.choice([-1.0, 1.0])
        others: Mapping[str, float] = {}
        if self._plan.final and truth.variants and random.uniform() < _OTHER_FORM:
            others = truth.variants[random.integers(len(truth.variants))]
        return {n: float(f"{v:.5g}") for n, v in truth.sized(factor, **others).items()}

    def _offsets_by_parameter(self, away: np.ndarray) -> dict[str, float]:
        return dict(zip(self._priors, away.round(4).tolist(), strict=True))

    def _with_excitation(self, case: Case) -> Case:
        random = self._random
        nuisances = draw_nuisances(random)
        if any(effect.endswith("_quantisation") for effect in case.effects):
            for axis in ("pitch", "yaw"):  # of which the other axis has nothing
                nuisances[f"{axis}_quantum"] = min(nuisances[f"{axis}_quantum"], 1.0)
        if self._plan.laws == "powers":
            nuisances |= imperfect_laws(random)
        elif self._plan.laws == "curves":
            nuisances |= curved_laws(random)
        drive, channels = self._watched(case)
        return replace(
            case,
            centre=round(float(random.uniform(*self._plan.centre)), 4),
            amplitude=round(float(random.uniform(*self._plan.amplitude)), 4),
            duration=draw_duration(random),
            nuisances=nuisances,
            imperfect=self._plan.laws != "nominal",
            drive=drive,
            channels=channels,
        )

    def _watched(self, case: Case) -> tuple[Drive, Channels]:
        """In open loop with four outputs, but for some."""
        lot = self._random.uniform()
        if case.kind == "matched" or self._plan.alike:
            return "rich", "four"
        if lot < _CLOSED:
            return "closed_loop", "four"
        if lot < _CLOSED + _ANGLES and not set(case.effects) & set(_NEEDS_SPEED):
            return "rich", "angles"
        return "rich", "four"


def _apart(first: str, second: str) -> bool:
    """Whether two effects may be asked for together: not at one place."""
    places = {p for at in TRUTHS[first].locations for p in same_equation(at)}
    return not places & set(TRUTHS[second].locations)
