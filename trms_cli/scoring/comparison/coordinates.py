"""What a run was a run of, as far as it differs from the other runs.

Its coordinates are the options that were chosen (``controller``, ``ref``, …) and, where runs with
the same options have other values, the keys of the configuration in which they differ.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from trms_cli.scoring.comparison.compared_run import ComparedRun

#: Where a run's files go, and what is drawn and logged: no part of what was run.
_NO_COORDINATES = frozenset({"out", "picture", "sim.prediction_every", "sim.scene_every"})
#: Resolved copies of what other groups say.
_COPIES = ("plant.effects", "plant.model", "plant.faults")
_GROUPS = ("model", "plant", "effect", "fault", "observer", "controller", "ref", "supervisor")
_CAPITAL = re.compile(r"(?<!^)(?=[A-Z])")
#: Coordinates that a run without a word of them shares with the others.
_NONE = "–"


def choices_of(config: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """The options of a log that does not name them: from what was typed, else by their classes."""
    typed = of_overrides(overrides)
    found: dict[str, Any] = {}
    for group in _GROUPS:
        content = config.get(group)
        if group in typed:
            found[group] = typed[group]
        elif group in ("effect", "fault") and isinstance(content, Mapping):
            found[group] = list(content)
        elif isinstance(content, Mapping):
            found[group] = _class_name(content if group != "ref" else _first_signal(content))
    return found | {key: value for key, value in typed.items() if "@" in key}


def of_overrides(overrides: Sequence[str]) -> dict[str, str]:
    """Coordinates as typed: ``controller=pid`` and ``plant.prior_seed=3`` alike."""
    found = {}
    for word in overrides:
        key, equals, value = word.lstrip("+").partition("=")
        if equals and key not in _NO_COORDINATES and not key.startswith("hydra"):
            found[key] = value.strip("'\"").strip("[]").replace(",", "+")
    return found


def complete_coordinates(runs: Sequence[ComparedRun]) -> list[ComparedRun]:
    """Give every run a value for each coordinate, and the keys in which configurations differ."""
    runs = _with_settings(runs)
    usual: dict[str, Counter[str]] = {}
    for run in runs:
        for key, value in run.coordinates.items():
            usual.setdefault(key, Counter())[value] += 1
    implied = {key for key in usual if "@" in key and _is_implied(key, runs)}
    whole = []
    for run in runs:
        filled = {key: value for key, value in run.coordinates.items() if key not in implied}
        for key, values in usual.items():
            if key not in filled and key not in implied:
                # a setting of one option's is none of another's; an option left out is the usual
                filled[key] = _NONE if "." in key else values.most_common(1)[0][0]
        whole.append(replace(run, coordinates=filled))
    return whole


def _is_implied(key: str, runs: Sequence[ComparedRun]) -> bool:
    """Whether an option of an option (``signal@ref.alpha_v``) follows from the one it is in."""
    group = key.partition("@")[2].partition(".")[0]
    values: dict[str, set[str]] = {}
    for run in runs:
        if key in run.coordinates:
            values.setdefault(run.coordinates.get(group, ""), set()).add(run.coordinates[key])
    return all(len(found) == 1 for found in values.values())


def differing(runs: Sequence[ComparedRun]) -> list[str]:
    """Coordinates with more than one value, in the order in which runs have them."""
    keys = dict.fromkeys(key for run in runs for key in run.coordinates)
    return [key for key in keys if len({run.coordinates.get(key) for run in runs}) > 1]


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Keys in which two configurations differ, with both values."""
    left, right = flat(one), flat(other)
    found = []
    for key in dict.fromkeys([*left, *right]):
        if key.startswith(_COPIES) or key in _NO_COORDINATES or left.get(key) == right.get(key):
            continue
        found.append((key, left.get(key, _NONE), right.get(key, _NONE)))
    return found


def flat(config: Mapping[str, Any], stem: str = "") -> dict[str, str]:
    """A nested mapping as dotted keys."""
    found: dict[str, str] = {}
    for key, value in config.items():
        place = f"{stem}{key}"
        if isinstance(value, Mapping) and value:
            found |= flat(value, f"{place}.")
        else:
            found[place] = "none" if value in (None, {}, []) else str(value)
    return found


def _with_settings(runs: Sequence[ComparedRun]) -> list[ComparedRun]:
    """Add dotted keys in which runs of the same options differ."""
    flats = [flat(run.config) if run.config else _as_flat(run.typed) for run in runs]
    # of a job without a log only what was typed is known, and nothing can be said of the rest
    partial = [not run.config for run in runs]
    groups: dict[tuple[str, str], list[int]] = {}
    for i, run in enumerate(runs):
        for group in dict.fromkeys(key.partition(".")[0] for key in flats[i]):
            chosen = run.coordinates.get(group, "")
            groups.setdefault((group, chosen), []).append(i)
    settings: list[dict[str, str]] = [{} for _ in runs]
    for (group, _), members in groups.items():
        keys = dict.fromkeys(
            key for i in members for key in flats[i] if key.startswith(f"{group}.")
        )
        for key in keys:
            known = [i for i in members if key in flats[i] or not partial[i]]
            values = {flats[i].get(key, _NONE) for i in known}
            if len(values) > 1 and key not in _NO_COORDINATES and not key.startswith(_COPIES):
                for i in known:
                    settings[i][key] = flats[i].get(key, _NONE)
    return [
        replace(run, coordinates={**run.coordinates, **added})
        for run, added in zip(runs, settings, strict=True)
    ]


def _as_flat(typed: Mapping[str, str]) -> dict[str, str]:
    """Dotted keys as typed, their values as those of a configuration."""
    import yaml

    from trms_cli.core.yaml_data import load_yaml

    found: dict[str, str] = {}
    for key, text in typed.items():
        try:
            value = load_yaml(text)
        except yaml.YAMLError:
            value = text
        found |= flat(value, f"{key}.") if isinstance(value, Mapping) else flat({key: value})
    return found


def _class_name(content: Mapping[str, Any]) -> str:
    """``….newton_mpc.NewtonMpc`` as ``newton_mpc``."""
    name = str(content.get("_target_", "")).rpartition(".")[2]
    return _CAPITAL.sub("_", name).lower() or _NONE


def _first_signal(ref: Mapping[str, Any]) -> Mapping[str, Any]:
    """What the first axis of a reference follows."""
    signals = [
        value for value in ref.values() if isinstance(value, Mapping) and "_target_" in value
    ]
    return signals[0] if signals else ref
