"""What is typed after ``-m`` as the space of a sweep: choices, ranges, priors, and what is fixed.

Choices are written in Hydra's grammar: ``a,b``, ``choice(a,b)``, ``range(5)``, ``glob(yaw_*)``,
``sort(…)``, ``shuffle(…)`` (in an order that is the same each time). Numbers between bounds are
``interval(a,b)`` and ``tag(log,interval(a,b))``; ``prior`` is read by
:mod:`trms_cli.composition.sweep_priors`.
"""

from __future__ import annotations

import math
import random
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from trms_cli.composition.catalogue import (
    Groups,
    Primary,
    make_importable,
    read_groups,
    read_primary,
)
from trms_cli.composition.checks import DeclaredKeys, prepare
from trms_cli.composition.composer import Composition, compose
from trms_cli.composition.errors import explained
from trms_cli.composition.overrides import PATH_KEYS, ComposeRequest, Override, parse
from trms_cli.composition.sweep_priors import PRIOR, PriorTables
from trms_cli.core.errors import ConfigurationError
from trms_cli.sweeps.space import Choice, PriorOfKey, Range, Space

_WHOLE = re.compile(r"interval\(\s*[+-]?\d+\s*,\s*[+-]?\d+\s*\)")
_PLAIN_NAMES = re.compile(r"[^\"'(){}$]*")
_ITEMS = re.compile(r"\[[^\]]*\]|[^,\[\]]+")
_LOG_TAG = "log"
#: Significant digits of a number that ``range(0,1,0.1)`` gives.
_DIGITS = 12


class _Typed(NamedTuple):
    """One override, and what it varies over."""

    text: str
    override: Override
    values: tuple[str, ...] = ()  #: several: a choice
    interval: Range | None = None
    prior: bool = False

    @property
    def key(self) -> str:
        """The key with the place of a choice, without ``+``."""
        return self.override.key + self.override.package

    @property
    def varies(self) -> bool:
        return bool(self.values or self.interval or self.prior)


def space_of(request: ComposeRequest, primary: str) -> Space:
    """The space that a command line asks for; without choices and ranges where nothing varies.

    The overrides of `request` are those of the runs, composed from `primary`: what steers the sweep
    itself (``sampler``, ``launcher``, ``retries``, ``out``) has been taken off. They stand in the
    space as they were typed, so that each run can be repeated by typing its own. Raises
    ConfigurationError for a key or an option that does not exist, a value that cannot be read, a
    prior of what has none.
    """
    declared = read_primary(primary, request.config_dirs)
    groups = read_groups(request.config_dirs)
    typed = _last_of_each([_read(text, declared, groups) for text in request.overrides])
    # Names of keys and options are checked before anything is composed.
    plain = tuple(each.text for each in typed if not (each.interval or each.prior))
    prepare(request._replace(overrides=plain, multirun=True), declared, groups)
    make_importable(request.config_dirs)

    choices = tuple(Choice(each.key, each.values) for each in typed if each.values)
    fixed = tuple(each.text for each in typed if not each.varies)
    if not any(each.interval or each.prior for each in typed):
        return Space(fixed, choices)

    keys = DeclaredKeys(declared, groups, plain)
    ranges = {each.key: _suited(each.interval, keys) for each in typed if each.interval}
    composer = _Composer(request, primary, typed)
    tables = PriorTables(composer, fixed, choices, groups)
    continuous: list[Range | PriorOfKey] = []
    named = {each.key for each in typed}
    for each in typed:
        if each.interval:
            continuous.append(ranges[each.key])
        elif each.prior:
            continuous += tables.of(each.key, named)
    if not any(each.prior for each in typed):
        tables.compose()  # a misspelt key of a range is told now, with those that are near
    if ranges:
        present = _without_ranges(composer)
        continuous = [_with_present(each, present) for each in continuous]
    return Space(fixed, choices, tuple(continuous))


def _without_ranges(composer: _Composer) -> Mapping[str, Any]:
    """The configuration without the sweep; empty where it needs a value that only a range gives."""
    try:
        return composer({}, ranges=False).config
    except ConfigurationError:
        return {}


def _with_present(varied: Range | PriorOfKey, config: Mapping[str, Any]) -> Range | PriorOfKey:
    """A range that knows the value its key has without it."""
    node: Any = config
    for name in varied.key.split("."):
        node = node.get(name) if isinstance(node, Mapping) else None
    number = isinstance(node, (int, float)) and not isinstance(node, bool)
    if not isinstance(varied, Range) or varied.now is not None or not number:
        return varied
    return replace(varied, now=float(node))


def first_of(space: Space) -> tuple[str, ...]:
    """Overrides of one run of the space, the first: for a check before anything is started."""
    firsts = (f"{choice.key}={choice.values[0]}" for choice in space.choices)
    middles = (f"{each.key}={middle_of(each)}" for each in space.continuous)
    return (*space.fixed, *firsts, *middles)


def middle_of(varied: Range | PriorOfKey) -> str:
    """A value that a range or prior allows, as it would be typed: today's where there is one."""
    if isinstance(varied, PriorOfKey):
        return repr(varied.mean)
    value = varied.low if varied.now is None else min(max(varied.now, varied.low), varied.high)
    return str(int(value)) if varied.whole else repr(value)


@dataclass(frozen=True)
class _Composer:
    """Composes a run of the sweep without priors."""

    request: ComposeRequest
    primary: str
    typed: Sequence[_Typed]

    def __call__(self, otherwise: Mapping[str, str], ranges: bool = True) -> Composition:
        """The first of each choice, but as `otherwise` says; the least of each range, or none."""
        folders = [word for place in self.request.config_dirs for word in ("--config-dir", place)]
        words = []
        for each in self.typed:
            value = otherwise.get(each.key) or (each.values[0] if each.values else None)
            if each.prior or (each.interval and not ranges):
                continue
            if each.interval:
                value = middle_of(each.interval)
            words.append(each.text if value is None else f"{each.key}={value}")
        return compose([*map(str, folders), *words], self.primary)


def _last_of_each(typed: Sequence[_Typed]) -> list[_Typed]:
    """What was typed twice counts as it was typed last."""
    last = {each.key: each for each in typed}
    return [each for each in typed if last[each.key] is each]


def _read(text: str, declared: Primary, groups: Groups) -> _Typed:
    override = parse(text, groups)
    first = override.key.split(".")[0].split("/")[0]
    if first == "hydra":
        raise ConfigurationError(
            f"{text!r}: sweeps have samplers and launchers of their own",
            where=override.key,
            remedy="choose with sampler=… and launcher=… (`trms list sampler`)",
        )
    value = (override.value or "").strip()
    if override.prefix == "~" or not value:
        return _Typed(text, override)
    if value == PRIOR:
        return _Typed(text, override, prior=True)
    if override.key in declared.defaults and _PLAIN_NAMES.fullmatch(value):
        # Names and paths: these may hold what Hydra's grammar forbids.
        items = tuple(item.strip() for item in _ITEMS.findall(value) if item.strip())
        return _Typed(text, override, _each_once(items) if len(items) > 1 else ())
    if override.key.split(".")[-1] in PATH_KEYS and "," not in value and "(" not in value:
        return _Typed(text, override)
    return _swept(text, override, declared, groups)


def _swept(text: str, override: Override, declared: Primary, groups: Groups) -> _Typed:
    """An override whose value may be a sweep in Hydra's grammar."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.core.override_parser.types import (
        ChoiceSweep,
        Glob,
        IntervalSweep,
        RangeSweep,
        Transformer,
    )

    try:
        with explained([text], declared, groups, lambda _: {}):
            parsed = OverridesParser.create().parse_override(text)
    except ConfigurationError as error:  # a function with wrong arguments names no key
        error.where = override.key + override.package
        raise
    sweep: Any = parsed._value
    if isinstance(sweep, IntervalSweep):
        return _Typed(text, override, interval=_range(text, override, sweep))
    if isinstance(sweep, Glob):
        values = sweep.filter(list(groups.get(override.key, {})))
    elif isinstance(sweep, ChoiceSweep):
        values = [Transformer.str(value) for value in sweep.list]
    elif isinstance(sweep, RangeSweep):
        numbers = list(sweep.range())
        values = [str(n) if isinstance(n, int) else _typed_number(n) for n in numbers]
    else:
        return _Typed(text, override)
    key = override.key + override.package
    if not values:
        raise ConfigurationError(
            f"{override.value} is empty: no value to try",
            where=key,
            remedy=f"`trms list {override.key}` tells the options"
            if override.key in groups
            else f"write {key}=A,B,… or {key}=range(START,STOP)",
        )
    if PRIOR in values:
        raise ConfigurationError(
            f"{override.value} given, and a prior is no value among others",
            where=key,
            remedy=f"write {key}={PRIOR} alone",
        )
    if getattr(sweep, "shuffle", False):
        # The order is a function of the key, so that a sweep can be repeated.
        random.Random(zlib.crc32(key.encode())).shuffle(values)
    return _Typed(text, override, _each_once(values))


def _each_once(values: Sequence[str]) -> tuple[str, ...]:
    """A value that is typed twice would make the same run twice."""
    return tuple(dict.fromkeys(values))


def _typed_number(value: float) -> str:
    """A number of a range without the digits that adding up steps leaves: 0.7000000000000001."""
    return repr(float(f"{value:.{_DIGITS}g}"))


def _range(text: str, override: Override, sweep: Any) -> Range:
    key = override.key + override.package
    low, high = float(sweep.start), float(sweep.end)
    whole = isinstance(sweep.start, int) or _WHOLE.search(text) is not None
    logarithmic = _LOG_TAG in sweep.tags
    unknown = sorted(set(sweep.tags) - {_LOG_TAG})
    form = f"{key}=interval(LOW,HIGH)"
    if unknown:
        raise ConfigurationError(
            f"tag {unknown[0]!r} means nothing here",
            where=key,
            remedy=f"{form}, or {key}=tag({_LOG_TAG},interval(LOW,HIGH)) for equal ratios",
        )
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ConfigurationError(
            f"{override.value} given, which holds no range of numbers",
            where=key,
            remedy=f"write {form} with LOW below HIGH",
        )
    if logarithmic and low <= 0:
        raise ConfigurationError(
            f"{override.value} given, and equal ratios begin above zero",
            where=key,
            remedy=f"write {form}, or a LOW above zero",
        )
    return Range(key, low, high, logarithmic, whole)


def _suited(given: Range | None, keys: DeclaredKeys) -> Range:
    """A range of whole numbers only where the key does not hold a fraction by default."""
    assert given is not None
    fractional = isinstance(keys.value(given.key), float)
    return Range(
        given.key, given.low, given.high, given.logarithmic, given.whole and not fractional
    )
