"""What is typed after ``-m`` as the space of a sweep: choices, ranges, priors, and what is fixed.

Choices are written in Hydra's grammar: ``a,b``, ``choice(a,b)``, ``range(5)``, ``glob(yaw_*)``,
``sort(…)``, ``shuffle(…)`` (in an order that is the same each time). Numbers between bounds are
``interval(a,b)`` and ``tag(log,interval(a,b))``. ``KEY=prior`` is what a sweep draws from the
distributions that parameters and effects state:

============================================  ====================================================
``plant.parameters.k_g=prior``                a parameter of the rig: normal about its value, its
                                              tails cut as ``plant.prior_seed`` cuts them
``plant.parameters=prior``                    all of the rig's parameters that have a prior and
                                              are not given a value of their own
``model.parameters…=prior``                   the same for what controller and observer believe
``effect.yaw_coulomb_friction.torque=prior``  a size of an effect over the range that rigs span,
                                              equal ratios alike where the range is above zero
``effect.yaw_coulomb_friction=prior``         all sizes of the effect that state such a range
============================================  ====================================================
"""

import math
import random
import re
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from trms_cli.composition import catalogue
from trms_cli.composition.checks import DeclaredKeys, plain_names, prepare
from trms_cli.composition.composer import Composition, compose
from trms_cli.composition.overrides import PATH_KEYS, ComposeRequest, Override, parse
from trms_cli.composition.plain_values import value_at, whole_number
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build, nearest, require_known
from trms_cli.models.model import Model
from trms_cli.models.parameters import DRAW_LIMIT_SD, Parameter
from trms_cli.sweeps.space import Choice, PriorOfKey, Range, Space

PRIMARY = "sweep"
#: What the runs of a sweep are given unless it is typed: nobody looks at a thousand pictures.
_OF_RUNS = {"run": {"picture": "false", "sim.scene_every": "0", "sim.estimate_every": "10"}}
#: What Hydra's own keys were for, and what to write instead.
_INSTEAD = {
    "hydra/launcher": "choose where runs are made: launcher=local, launcher=dask, launcher=slurm "
    "(`trms list launcher`)",
    "hydra/sweeper": "choose how values are chosen: sampler=grid, sampler=latin_hypercube, … "
    "(`trms list sampler`)",
    "hydra.launcher": "write launcher.workers=4; `trms list launcher local` tells the keys",
    "hydra.sweeper": "write sampler.samples=100; `trms list sampler` tells the samplers",
    "hydra.sweep": "write out=FOLDER",
}


class SweepOverrides(NamedTuple):
    """The overrides of ``-m``."""

    runs: tuple[str, ...]
    settings: tuple[str, ...]  #: of the sweep
    out: str | None  #: its folder; None: a dated one


class Settings(NamedTuple):
    """What steers a sweep, composed."""

    sampler: dict[str, Any]
    launcher: dict[str, Any]
    retries: int


def divide_overrides(
    overrides: Sequence[str], primary: str, config_dirs: Sequence[Path]
) -> SweepOverrides:
    """Take the sweep's own overrides off.

    Raises ConfigurationError for Hydra's own keys; it tells what to write instead.
    """
    groups = catalogue.read_groups(config_dirs)
    own = catalogue.read_primary(PRIMARY, config_dirs).names
    runs: list[str] = []
    settings: list[str] = []
    out: str | None = None
    for text in overrides:
        override = parse(text, groups)
        first = override.key.split(".")[0].split("/")[0]
        if first == "hydra":
            raise _of_hydra(text)
        if first in own:
            settings.append(text)
        elif override.key == "out":
            value = (override.value or "").strip("'\"")
            out = None if value in ("", "null") else value
        else:
            runs.append(text)
    return SweepOverrides(
        (*_additions(runs, primary, groups, config_dirs), *runs), tuple(settings), out
    )


def settings_of(settings: Sequence[str], config_dirs: Sequence[Path]) -> Settings:
    """Compose what steers the sweep; raises ConfigurationError for the first key that is wrong."""
    for text in settings:
        value = text.partition("=")[2]
        if "," in value and value[:1] not in "[{'\"":
            raise ConfigurationError(
                f"{value!r} are alternatives, and a sweep has one",
                where=text.partition("=")[0],
                remedy="make two sweeps",
            )
    config = compose(settings, PRIMARY, config_dirs=config_dirs).config
    retries = whole_number(config["retries"], "retries")
    return Settings(config["sampler"], config["launcher"], retries)


def sampler_and_launcher(settings: Settings) -> tuple[Any, Any]:
    """The sampler and the launcher; raises ConfigurationError for the first key that is wrong."""
    return build(settings.sampler, "sampler"), build(settings.launcher, "launcher")


def _additions(
    typed: Sequence[str], primary: str, groups: catalogue.Groups, config_dirs: Sequence[Path]
) -> list[str]:
    """What is laid under the typed overrides of the runs."""
    keys = {parse(text, groups).key for text in typed}
    declared = catalogue.read_primary(primary, config_dirs)
    additions = []
    for key, value in _OF_RUNS.get(primary, {}).items():
        if value_at(declared.body, key) is not None and key not in keys:
            additions.append(f"{key}={value}")
    return additions


def _of_hydra(text: str) -> ConfigurationError:
    key = text.partition("=")[0].lstrip("+~")
    remedy = next(
        (words for begin, words in _INSTEAD.items() if key.startswith(begin)),
        "sweeps have keys of their own: sampler, launcher, retries, out (`trms help sweep`)",
    )
    return ConfigurationError("Hydra's own keys steer nothing here", where=key, remedy=remedy)


_WHOLE = re.compile(r"interval\(\s*[+-]?\d+\s*,\s*[+-]?\d+\s*\)")
_LOG_TAG = "log"
#: Significant digits of a number that ``range(0,1,0.1)`` gives, and of the bounds of a prior.
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
    declared = catalogue.read_primary(primary, request.config_dirs)
    groups = catalogue.read_groups(request.config_dirs)
    typed = _last_of_each([_read(text, declared, groups) for text in request.overrides])
    # Names of keys and options are checked before anything is composed.
    plain = tuple(each.text for each in typed if not (each.interval or each.prior))
    prepare(request._replace(overrides=plain, multirun=True), declared, groups)
    catalogue.make_importable(request.config_dirs)

    choices = tuple(Choice(each.key, each.values) for each in typed if each.values)
    fixed = tuple(each.text for each in typed if not each.varies)
    if not any(each.interval or each.prior for each in typed):
        return Space(fixed, choices)

    keys = DeclaredKeys(declared, groups, plain)
    # Whole numbers only where the key does not hold a fraction by default.
    ranges = {
        each.key: replace(
            each.interval,
            whole=each.interval.whole and not isinstance(keys.value(each.key), float),
        )
        for each in typed
        if each.interval
    }
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
        try:
            present = composer({}, ranges=False).config
        except ConfigurationError:  # it needs a value that only a range gives
            present = {}
        continuous = [_with_present(each, present) for each in continuous]
    return Space(fixed, choices, tuple(continuous))


def _with_present(varied: Range | PriorOfKey, config: Mapping[str, Any]) -> Range | PriorOfKey:
    """A range that knows the value its key has without it."""
    node = value_at(config, varied.key)
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
        words = []
        for each in self.typed:
            value = otherwise.get(each.key) or (each.values[0] if each.values else None)
            if each.prior or (each.interval and not ranges):
                continue
            if each.interval:
                value = middle_of(each.interval)
            words.append(each.text if value is None else f"{each.key}={value}")
        return compose(words, self.primary, config_dirs=self.request.config_dirs)


def _last_of_each(typed: Sequence[_Typed]) -> list[_Typed]:
    """What was typed twice counts as it was typed last."""
    last = {each.key: each for each in typed}
    return [each for each in typed if last[each.key] is each]


def _read(text: str, declared: catalogue.Primary, groups: catalogue.Groups) -> _Typed:
    override = parse(text, groups)
    if override.key.split("/")[0].split(".")[0] == "hydra":
        raise _of_hydra(text)
    value = (override.value or "").strip()
    if override.prefix == "~" or not value:
        return _Typed(text, override)
    if value == PRIOR:
        return _Typed(text, override, prior=True)
    names = plain_names(value) if override.key in declared.defaults else None
    if names is not None:  # names and paths: these may hold what Hydra's grammar forbids
        return _Typed(text, override, _each_once(names) if len(names) > 1 else ())
    if override.key.split(".")[-1] in PATH_KEYS and "," not in value and "(" not in value:
        return _Typed(text, override)
    return _swept(text, override, declared, groups)


def _swept(
    text: str, override: Override, declared: catalogue.Primary, groups: catalogue.Groups
) -> _Typed:
    """An override whose value may be a sweep in Hydra's grammar."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.core.override_parser.types import (
        ChoiceSweep,
        Glob,
        IntervalSweep,
        RangeSweep,
        Transformer,
    )

    from trms_cli.composition.hydra_composition import explain_errors

    try:
        with explain_errors([text], declared, groups, lambda _: {}):
            sweep_override = OverridesParser.create().parse_override(text)
    except ConfigurationError as error:  # a function with wrong arguments names no key
        error.where = override.key + override.package
        raise
    sweep: Any = sweep_override._value
    if isinstance(sweep, IntervalSweep):
        return _Typed(text, override, interval=_range(text, override, sweep))
    if isinstance(sweep, Glob):
        values = sweep.filter(list(groups.get(override.key, {})))
    elif isinstance(sweep, ChoiceSweep):
        values = [Transformer.str(value) for value in sweep.list]
    elif isinstance(sweep, RangeSweep):
        numbers = list(sweep.range())
        # Without the digits that adding up steps leaves: 0.7000000000000001.
        values = [
            str(n) if isinstance(n, int) else repr(float(f"{n:.{_DIGITS}g}")) for n in numbers
        ]
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


PRIOR = "prior"
_TABLES = ("plant", "model")
_EFFECTS = "effect"
#: Choices of these can change what a prior is: an option may have another table.
_DECIDING = ("model", "plant", "effect", "experiment", "parameters")
_DECIDING_KEYS = ("parameter_set", "path", "prior_scale")


class PriorTables:
    """Looks priors up in the first configuration of a sweep, composed when it is first asked for.

    `composed` composes a run, given other values for some choices than the first; `fixed` are the
    overrides of every run.
    """

    def __init__(
        self,
        composed: Callable[[Mapping[str, str]], Composition],
        fixed: Sequence[str],
        choices: Sequence[Choice],
        groups: catalogue.Groups,
    ) -> None:
        self._composed = composed
        self._fixed = tuple(fixed)
        self._deciding = [each for each in choices if _decides(each.key, groups)]
        self._configs: list[tuple[str, Mapping[str, Any]]] = []

    def compose(self) -> None:
        """Compose the first run, and with each other choice that may change a prior."""
        if not self._configs:
            self._configs = [("", self._composed({}).config)]

    def of(self, key: str, named: Iterable[str]) -> list[Range | PriorOfKey]:
        """What a key varies over: a parameter or size, or the mapping that holds several.

        A mapping leaves out the keys `named`, which were typed themselves. Raises
        ConfigurationError if there is no such parameter, it has no prior, or its prior is another
        under another choice of the same sweep.
        """
        self.compose()
        if len(self._configs) == 1:
            others = [(each.key, value) for each in self._deciding for value in each.values[1:]]
            self._configs += [(f"{k}={v}", self._composed({k: v}).config) for k, v in others]
        typed = set(named) - {key}
        priors: list[Range | PriorOfKey] = []
        for place, config in self._configs:
            here = [each for each in _priors(config, key) if each.key not in typed]
            if not place:
                priors = here
            elif here != priors:
                raise ConfigurationError(
                    f"the priors are others under {place}, and all runs are to see the same draws",
                    where=key,
                    remedy="sweep one of them at a time"
                    + (
                        ", or give all runs one rig: model@plant.model=newtonian"
                        if key.startswith("plant.")
                        else ""
                    ),
                )
        if not priors:
            raise ConfigurationError(
                "nothing is left to be drawn: each has a value of its own",
                where=key,
                remedy=f"leave {key}={PRIOR} out",
            )
        return priors


def _decides(key: str, groups: catalogue.Groups) -> bool:
    name, _, place = key.partition("@")
    first = (place or name).split(".")[0]
    is_option = name in groups or name.split(".")[-1] in _DECIDING_KEYS
    return is_option and first in _DECIDING


def _priors(config: Mapping[str, Any], key: str) -> list[Range | PriorOfKey]:
    parts = key.split(".")
    if parts[0] in _TABLES and parts[1:2] == ["parameters"]:
        return _of_table(config, key, parts[0], ".".join(parts[2:]))
    if parts[0] == _EFFECTS and len(parts) in (2, 3):
        return _of_effect(config, key, parts[1], parts[2] if len(parts) > 2 else "")
    raise ConfigurationError(
        "this key has no prior",
        where=key,
        remedy="parameters of plant and model have (plant.parameters.NAME=prior), and sizes of "
        f"effects (effect.NAME.SIZE=prior); else write {key}=interval(LOW,HIGH)",
    )


def _of_table(
    config: Mapping[str, Any], key: str, owner: str, name: str
) -> list[Range | PriorOfKey]:
    """Priors of a parameter table: of one parameter, or of all that have one."""
    table = _parameters(config, key, owner)
    scale = float(config["plant"].get("prior_scale", 1.0)) if owner == "plant" else 1.0
    if name:
        if name not in table:
            problem = f"there is no parameter {name!r} to be drawn"
            require_known(name, _with_prior(table), problem, key)
        return [_prior(key, table[name], scale, _with_prior(table))]
    values = config[owner].get("parameters") or {}
    names = [each for each in _with_prior(table) if each not in values]
    if not names and not values:
        raise ConfigurationError(
            "no parameter has a prior",
            where=key,
            remedy="a parameter file states them as prior_sd; else write "
            f"{key}.NAME=interval(LOW,HIGH)",
        )
    return [_prior(f"{key}.{each}", table[each], scale, ()) for each in names]


def _parameters(config: Mapping[str, Any], key: str, owner: str) -> dict[str, Parameter]:
    model = build(config[owner], owner)
    if owner == "plant":
        if not hasattr(model, "true_model"):
            raise ConfigurationError(
                "this rig has no parameters to be drawn",
                where=key,
                remedy="choose plant=simulated, or leave the prior out",
            )
        model = model.true_model()
    return {parameter.name: parameter for parameter in model.parameters}


def _with_prior(table: Mapping[str, Parameter]) -> list[str]:
    return [n for n, each in table.items() if (each.prior_sd and each.value) or each.typical]


def _prior(
    key: str, parameter: Parameter, scale: float, alternatives: Sequence[str]
) -> Range | PriorOfKey:
    sd = abs(parameter.value) * (parameter.prior_sd or 0.0) * scale
    if not sd and parameter.typical:
        return _span(key, parameter)
    if not sd:
        raise ConfigurationError(
            f"{parameter.name!r} has no prior: it is taken as known",
            where=key,
            remedy=f"write {key}=interval(LOW,HIGH) in {parameter.unit or '1'}; with a prior: "
            f"{', '.join(alternatives) or 'none'}",
        )
    return PriorOfKey(
        key,
        parameter.value,
        sd,
        max(_round_bound(parameter.value - DRAW_LIMIT_SD * sd), parameter.lower),
        min(_round_bound(parameter.value + DRAW_LIMIT_SD * sd), parameter.upper),
    )


def _round_bound(bound: float) -> float:
    """Where a tail is cut, without the digits that a product leaves: 0.06290000000000001."""
    return float(f"{bound:.{_DIGITS}g}")


def _span(key: str, parameter: Parameter) -> Range:
    assert parameter.typical is not None
    low, high = parameter.typical
    return Range(key, low, high, logarithmic=low > 0)


def _of_effect(
    config: Mapping[str, Any], key: str, name: str, size: str
) -> list[Range | PriorOfKey]:
    effects = config.get(_EFFECTS) or {}
    if name not in effects:
        raise ConfigurationError(
            f"effect {name!r} is not chosen",
            where=key,
            remedy=f"choose it with effect={name}; chosen: {', '.join(effects) or 'none'}",
        )
    effect = build(effects[name], f"{_EFFECTS}.{name}")
    if isinstance(model := build(config["model"], "model"), Model):
        effect = effect.for_model(model)  # what is typical is so of this rig
    sizes = {p.name: p for p in effect.parameters() if p.name in effects[name]}
    ranged = [each for each, parameter in sizes.items() if parameter.typical]
    size_names = [size] if size else ranged
    for each in size_names:
        if each not in ranged:
            raise ConfigurationError(
                f"effect {name} states no range for {each!r}",
                where=key,
                remedy=nearest(each, ranged)
                if ranged
                else f"write effect.{name}.{each}=interval(LOW,HIGH)",
            )
    if not size_names:
        raise ConfigurationError(
            f"effect {name} states no range that rigs span",
            where=key,
            remedy=f"write effect.{name}.SIZE=interval(LOW,HIGH); sizes: {', '.join(sizes)}",
        )
    return [_span(f"{_EFFECTS}.{name}.{each}", sizes[each]) for each in size_names]
