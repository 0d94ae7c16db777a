"""The runs of a tournament: read from YAML, crossed, each one once."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import msgspec
import yaml

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.resources import config_folder

HERE = Path(__file__).parent
TOURNAMENT = HERE / "tournament.yaml"
MAIN, FAULTS, OBSERVERS = "main", "faults", "observers"
BLOCKS = (MAIN, FAULTS, OBSERVERS)
FAULT_CLASS = "fault"


@dataclass(frozen=True, kw_only=True)
class Run:
    """One run of the tournament."""

    controller: str  #: Names in the tournament's YAML
    observer: str  #: Names in the tournament's YAML
    ref: str  #: Names in the tournament's YAML
    rig: str  #: Names in the tournament's YAML
    rig_class: str  #: What kind of rig: nominal, sensor, draw, effect, fault
    blocks: tuple[str, ...]  #: Which tables it is in
    entrant_words: tuple[str, ...]  #: What follows ``trms run``, by what it is of
    ref_words: tuple[str, ...]  #: What follows ``trms run``, by what it is of
    rig_words: tuple[str, ...]  #: What follows ``trms run``, by what it is of
    every: tuple[str, ...]  #: What follows ``trms run``, by what it is of
    outside: str = ""  #: Why it is not ranked; "" if it is

    @property
    def name(self) -> str:
        """``controller+observer/ref/rig``."""
        return f"{self.controller}+{self.observer}/{self.ref}/{self.rig}"

    @property
    def words(self) -> tuple[str, ...]:
        """All that follows ``trms run``."""
        return (*self.rig_words, *self.entrant_words, *self.ref_words, *self.every)

    @property
    def coordinates(self) -> dict[str, str]:
        """What ``trms compare`` tells it apart by."""
        return {
            "controller": self.controller,
            "observer": self.observer,
            "ref": self.ref,
            "class": self.rig_class,
            "rig": self.rig,
        }

    @property
    def fingerprint(self) -> str:
        """Of its words: a run of other words is another run."""
        return hashlib.sha256(json.dumps(self.words).encode()).hexdigest()[:16]


class _Controller(msgspec.Struct, forbid_unknown_fields=True):
    words: list[str]
    observer: str
    few: bool = False


class _Outsider(msgspec.Struct, forbid_unknown_fields=True):
    words: list[str]
    observer: str
    classes: list[str]
    reason: str


class _Draws(msgspec.Struct, forbid_unknown_fields=True):
    seeds: list[int]
    scale: float


class _Rigs(msgspec.Struct, forbid_unknown_fields=True):
    references: list[str]
    rigs: dict[str, list[str]] = {}
    draws: _Draws | None = None
    every_option_of: str | None = None


class _Block(msgspec.Struct, forbid_unknown_fields=True):
    controllers: list[str]
    observers: list[str]
    references: list[str]
    rigs: list[str]


class _Quick(msgspec.Struct, forbid_unknown_fields=True):
    controllers: list[str]
    observers: list[str]
    references: list[str]
    rigs: list[str]
    faults: list[str]
    every: list[str]


class Criteria(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """What the summary holds the results against."""

    champion: str  #: Entrants by name: ``newton_mpc + ukf``
    nominal_class: str
    disturbed_classes: list[str]
    within: float  #: Error over the best's that is allowed on each disturbed rig
    slower_peer: str  #: Entrants by name: ``newton_mpc + ukf``
    faster_by: float  #: Median time of a step of the peer over the champion's


class Plan(msgspec.Struct, forbid_unknown_fields=True):
    """The tournament's YAML as it stands."""

    every: list[str]
    time_limit: float
    controllers: dict[str, _Controller]
    observers: dict[str, list[str]]
    outside: dict[str, _Outsider]
    left_out: dict[str, dict[str, str]]
    references: dict[str, list[str]]
    rigs: dict[str, _Rigs]
    faults: _Rigs
    observers_block: _Block
    few: list[str]
    few_references: list[str]
    quick: _Quick
    criteria: Criteria


def read_plan(path: Path = TOURNAMENT) -> Plan:
    """Read a tournament.

    Raises ConfigurationError if the file is none.
    """
    try:
        return msgspec.convert(yaml.safe_load(path.read_text(encoding="utf-8")), Plan)
    except (OSError, yaml.YAMLError, msgspec.ValidationError) as error:
        raise ConfigurationError(
            f"this is no tournament: {str(error).splitlines()[0]}",
            where=str(path),
            remedy="see experiments/tournament/tournament.yaml",
        ) from error


def runs_of(plan: Plan, *, pattern: str = "*", quick: bool = False) -> list[Run]:
    """Every run whose name matches a pattern, once.

    Parameters
    ----------
    pattern : str
        As a shell matches file names: ``newton_mpc+*``, ``*/sine/*``, ``*/draw_*``; several with
        commas.
    quick : bool
        A small part of it, to see that it works.

    Raises
    ------
    ConfigurationError
        If nothing matches, or a name is unknown.
    """
    runs_by_name: dict[str, Run] = {}
    for run in _all_runs(plan):
        duplicate = runs_by_name.get(run.name)
        if duplicate is not None:
            run = replace(duplicate, blocks=tuple(dict.fromkeys((*duplicate.blocks, *run.blocks))))
        runs_by_name[run.name] = run
    runs = list(runs_by_name.values())
    if quick:
        runs = [_shortened(run, plan) for run in runs if _is_quick(run, plan)]
    patterns = pattern.split(",")
    matches = [run for run in runs if any(fnmatch(run.name, each) for each in patterns)]
    if not matches:
        raise ConfigurationError(
            f"no run matches {pattern!r}",
            where="--only",
            remedy=f"names are like {runs[0].name}, {runs[-1].name}" if runs else "",
        )
    return matches


def rigs_of(plan: Plan) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Class and words of every rig by name, the faults' among them."""
    rigs_by_name: dict[str, tuple[str, tuple[str, ...]]] = {}
    for name, rigs in (*plan.rigs.items(), (FAULT_CLASS, plan.faults)):
        rigs_by_name |= {rig: (name, words) for rig, words in _of_class(rigs)}
    return rigs_by_name


def options(group: str) -> list[str]:
    """Names of the options that come with the program."""
    return sorted(path.stem for path in (Path(config_folder()) / group).glob("*.yaml"))


def _all_runs(plan: Plan) -> Iterator[Run]:
    rigs = rigs_of(plan)

    def run(name: str, observer: str, ref: str, rig: str, block: str, outside: str = "") -> Run:
        who = plan.outside[name] if outside else plan.controllers[name]
        rig_class, words = _table_entry(rig, rigs, "rigs")
        return Run(
            controller=name,
            observer=observer,
            ref=ref,
            rig=rig,
            rig_class=rig_class,
            blocks=(block,),
            entrant_words=(*who.words, *_table_entry(observer, plan.observers, "observers")),
            ref_words=tuple(_table_entry(ref, plan.references, "references")),
            rig_words=words,
            every=tuple(plan.every),
            outside=outside,
        )

    # By rig first: an interrupted tournament then has whole conditions.
    for block, name, classes in (
        *((MAIN, name, of_class) for name, of_class in plan.rigs.items()),
        (FAULTS, FAULT_CLASS, plan.faults),
    ):
        for rig, _ in _of_class(classes):
            for ref in classes.references:
                for controller, who in plan.controllers.items():
                    slow = who.few and not (rig in plan.few and ref in plan.few_references)
                    if not slow:
                        yield run(controller, who.observer, ref, rig, block)
                for outsider, one in plan.outside.items():
                    if name in one.classes:
                        yield run(outsider, one.observer, ref, rig, block, one.reason)
    several = plan.observers_block
    for rig in several.rigs:
        for ref in several.references:
            for controller in several.controllers:
                for observer in several.observers:
                    yield run(controller, observer, ref, rig, OBSERVERS)


def _of_class(rigs: _Rigs) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Names and words of the rigs of a class."""
    for name, words in rigs.rigs.items():
        yield name, tuple(words)
    if rigs.draws is not None:
        for seed in rigs.draws.seeds:
            overrides = (f"plant.prior_seed={seed}", f"plant.prior_scale={rigs.draws.scale}")
            yield f"draw_{seed}", (*overrides, f"seed={seed}")
    if rigs.every_option_of is not None:
        group = rigs.every_option_of
        for option in options(group):
            yield f"{group}_{option}", (f"{group}=[{option}]",)


def _is_quick(run: Run, plan: Plan) -> bool:
    quick = plan.quick
    rigs = (*quick.rigs, *(f"{FAULT_CLASS}_{name}" for name in quick.faults))
    return (
        run.controller in quick.controllers
        and run.observer in quick.observers
        and run.ref in quick.references
        and run.rig in rigs
    )


def _shortened(run: Run, plan: Plan) -> Run:
    return replace(run, every=(*run.every, *plan.quick.every))


def _table_entry(name: str, table: Mapping[str, Any], where: str) -> Any:
    if name not in table:
        raise ConfigurationError(
            f"there is no {name!r}", where=where, remedy=f"there are: {', '.join(table)}"
        )
    return table[name]


def entrants(runs: Sequence[Run]) -> list[str]:
    """Names as ``trms compare`` prints them, in order."""
    return list(dict.fromkeys(f"{run.controller} + {run.observer}" for run in runs))
