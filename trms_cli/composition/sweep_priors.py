"""``KEY=prior``: what a sweep draws from the distributions that parameters and effects state.

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

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from trms_cli.composition.catalogue import Groups
from trms_cli.composition.composer import Composition
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build, nearest
from trms_cli.models.parameters import DRAW_LIMIT_SD, Parameter
from trms_cli.sweeps.space import Choice, PriorOfKey, Range

PRIOR = "prior"
_TABLES = ("plant", "model")
_EFFECTS = "effect"
#: Choices of these can change what a prior is: an option may have another table.
_DECIDING = ("model", "plant", "effect", "experiment", "parameters")
_DECIDING_KEYS = ("parameter_set", "path", "prior_scale")
#: Significant digits of the bounds of a prior.
_DIGITS = 12


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
        groups: Groups,
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
        found: list[Range | PriorOfKey] = []
        for place, config in self._configs:
            here = [each for each in _priors(config, key) if each.key not in typed]
            if not place:
                found = here
            elif here != found:
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
        if not found:
            raise ConfigurationError(
                "nothing is left to be drawn: each has a value of its own",
                where=key,
                remedy=f"leave {key}={PRIOR} out",
            )
        return found


def _decides(key: str, groups: Groups) -> bool:
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
            raise ConfigurationError(
                f"there is no parameter {name!r} to be drawn",
                where=key,
                remedy=nearest(name, _with_prior(table)),
            )
        return [_prior(key, table[name], scale, _with_prior(table))]
    given = config[owner].get("parameters") or {}
    names = [each for each in _with_prior(table) if each not in given]
    if not names and not given:
        raise ConfigurationError(
            "no parameter has a prior",
            where=key,
            remedy="a parameter file states them as prior_sd; else write "
            f"{key}.NAME=interval(LOW,HIGH)",
        )
    return [_prior(f"{key}.{each}", table[each], scale, ()) for each in names]


def _parameters(config: Mapping[str, Any], key: str, owner: str) -> dict[str, Parameter]:
    built = build(config[owner], owner)
    if owner == "plant":
        if not hasattr(built, "true_model"):
            raise ConfigurationError(
                "this rig has no parameters to be drawn",
                where=key,
                remedy="choose plant=simulated, or leave the prior out",
            )
        built = built.true_model()
    return {parameter.name: parameter for parameter in built.parameters}


def _with_prior(table: Mapping[str, Parameter]) -> list[str]:
    return [n for n, each in table.items() if (each.prior_sd and each.value) or each.typical]


def _prior(
    key: str, parameter: Parameter, scale: float, known: Sequence[str]
) -> Range | PriorOfKey:
    sd = abs(parameter.value) * (parameter.prior_sd or 0.0) * scale
    if not sd and parameter.typical:
        return _span(key, parameter)
    if not sd:
        raise ConfigurationError(
            f"{parameter.name!r} has no prior: it is taken as known",
            where=key,
            remedy=f"write {key}=interval(LOW,HIGH) in {parameter.unit or '1'}; with a prior: "
            f"{', '.join(known) or 'none'}",
        )
    return PriorOfKey(
        key,
        parameter.value,
        sd,
        max(_cut(parameter.value - DRAW_LIMIT_SD * sd), parameter.lower),
        min(_cut(parameter.value + DRAW_LIMIT_SD * sd), parameter.upper),
    )


def _cut(bound: float) -> float:
    """Where a tail is cut, without the digits that a product leaves: 0.06290000000000001."""
    return float(f"{bound:.{_DIGITS}g}")


def _span(key: str, parameter: Parameter) -> Range:
    assert parameter.typical is not None
    low, high = parameter.typical
    return Range(key, low, high, logarithmic=low > 0)


def _of_effect(
    config: Mapping[str, Any], key: str, name: str, size: str
) -> list[Range | PriorOfKey]:
    chosen = config.get(_EFFECTS) or {}
    if name not in chosen:
        raise ConfigurationError(
            f"effect {name!r} is not chosen",
            where=key,
            remedy=f"choose it with effect={name}; chosen: {', '.join(chosen) or 'none'}",
        )
    built = build(chosen[name], f"{_EFFECTS}.{name}")
    sizes = {p.name: p for p in built.parameters() if p.name in chosen[name]}
    ranged = [each for each, parameter in sizes.items() if parameter.typical]
    wanted = [size] if size else ranged
    for each in wanted:
        if each not in ranged:
            raise ConfigurationError(
                f"effect {name} states no range for {each!r}",
                where=key,
                remedy=nearest(each, ranged)
                if ranged
                else f"write effect.{name}.{each}=interval(LOW,HIGH)",
            )
    if not wanted:
        raise ConfigurationError(
            f"effect {name} states no range that rigs span",
            where=key,
            remedy=f"write effect.{name}.SIZE=interval(LOW,HIGH); sizes: {', '.join(sizes)}",
        )
    return [_span(f"{_EFFECTS}.{name}.{each}", sizes[each]) for each in wanted]
