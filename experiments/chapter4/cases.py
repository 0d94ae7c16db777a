"""The cases of the study, from ``cases.yaml``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import yaml

from trms_cli.core.errors import ConfigurationError

CASES = Path(__file__).with_name("cases.yaml")


@dataclass(frozen=True)
class Case:
    """One rig, its recordings, what is fitted."""

    number: int  #: From 1
    name: str
    #: ``fit``, ``held_out``: Overrides of ``trms run`` that make the recordings
    fit: tuple[str, ...]
    held_out: tuple[str, ...]
    identify: tuple[str, ...]  #: Overrides of ``trms identify``, without recordings and method


@dataclass(frozen=True)
class Study:
    """What is to be done."""

    cases: list[Case]
    methods: dict[str, tuple[str, ...]]  #: Overrides by name, for white against grey
    compared: list[Case]  #: Some of the cases, and, of the whole study, rigs of one axis
    comparison: dict[str, tuple[str, ...]]  #: Methods that are compared on them
    seeds: tuple[int, ...]


def read_study(only: str = "*", quick: bool = False, file: Path = CASES) -> Study:
    """The study, its cases restricted to those whose number or name fits a pattern.

    ``quick``: recordings of 20 s and small searches, to see that everything works.
    """
    content = yaml.safe_load(file.read_text(encoding="utf-8"))
    every = content["every"]
    short = ["sim.duration=20"] if quick else []

    def case_of(number: int, node: dict[str, Any]) -> Case:
        return Case(
            number,
            str(node["name"]),
            _words(every["rig"], node["rig"], every["fit"], node["fit"], short),
            _words(every["rig"], node["rig"], every["held_out"], node["held_out"], short),
            _words(every["identify"], node.get("identify", ())),
        )

    def is_chosen(case: Case) -> bool:
        return fnmatch(case.name, only) or fnmatch(str(case.number), only)

    cases = [case_of(number, node) for number, node in enumerate(content["cases"], start=1)]
    matches = [case for case in cases if is_chosen(case)]
    if not matches:
        raise ConfigurationError(
            f"no case is called {only!r}",
            where="--only",
            remedy="a number or a pattern: " + ", ".join(f"{c.number} ({c.name})" for c in cases),
        )
    comparison = content["comparison"]
    further = [
        case_of(number, node)
        for number, node in enumerate(comparison["cases"], start=len(cases) + 1)
    ]
    return Study(
        matches,
        _methods(content["methods"], quick),
        [case for case in further if only == "*"]
        + [case for case in matches if case.number in comparison["numbers"]],
        _methods(comparison["methods"], quick),
        tuple(comparison["seeds"][: 1 if quick else None]),
    )


def _methods(node: dict[str, Any], quick: bool) -> dict[str, tuple[str, ...]]:
    small = {
        "genetic": ("method.individuals=10", "method.generations=3"),
        "cma_es": ("method.evaluations=30",),
    }
    return {
        name: _words(words) + (small.get(name, ()) if quick else ()) for name, words in node.items()
    }


def _words(*lists: Sequence[Any]) -> tuple[str, ...]:
    return tuple(str(word) for words in lists for word in words)
