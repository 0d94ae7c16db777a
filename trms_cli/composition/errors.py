"""Hydra's and OmegaConf's errors in words that name the key, what was given and what is allowed."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from trms_cli.composition.catalogue import Groups, Primary, yaml_error
from trms_cli.composition.checks import unknown_key
from trms_cli.composition.overrides import parse
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest

Compose = Callable[[Sequence[str]], Mapping[str, Any]]


@contextmanager
def explained(
    overrides: Sequence[str], declared: Primary, groups: Groups, compose: Compose
) -> Iterator[None]:
    """Turn what Hydra, OmegaConf and YAML raise inside into a `ConfigurationError`.

    `compose` composes with fewer overrides than those given to Hydra, for finding the keys that a
    misspelt one is near to.
    """
    import yaml
    from hydra.errors import HydraException, MissingConfigException, OverrideParseException
    from omegaconf.errors import OmegaConfBaseException

    try:
        yield
    except OverrideParseException as error:
        raise _unreadable(error) from error
    except MissingConfigException as error:
        raise _missing_option(error, groups) from error
    except OmegaConfBaseException as error:
        raise _unresolvable(error) from error
    except HydraException as error:
        raise _refused(error, overrides, declared, compose) from error
    except yaml.YAMLError as error:
        raise yaml_error(error) from error


def _unreadable(error: Any) -> ConfigurationError:
    return ConfigurationError(
        f"cannot read {error.override!r}: {_first_line(error.message)}",
        where="the command line",
        remedy="write KEY=VALUE; quote a value that holds commas, brackets or equals signs: "
        "'KEY=\"VALUE\"'",
    )


def _missing_option(error: Any, groups: Groups) -> ConfigurationError:
    """A YAML (an experiment, or Hydra's own override) chooses an option that does not exist."""
    group, _, option = str(error.missing_cfg_file or "").rpartition("/")
    place = re.match(r"In '([^']+)'", str(error))
    options = error.options or groups.get(group, {})
    return ConfigurationError(
        f"{group or 'the search path'} has no option {option!r}",
        where=f"{group}, chosen by {place[1]}.yaml or a YAML that it includes" if place else group,
        remedy=nearest(option, options),
    )


def _unresolvable(error: Any) -> ConfigurationError:
    missing = re.search(r"Missing mandatory value: (\S+)", str(error))
    if missing:
        return ConfigurationError(
            f"{missing[1]} must be given", where=missing[1], remedy=f"add {missing[1]}=…"
        )
    key = getattr(error, "full_key", None) or "the configuration"
    return ConfigurationError(
        f"cannot be resolved: {_first_line(str(error))}",
        where=str(key),
        remedy="`--cfg job` shows the configuration; an interpolation ${a.b} needs the key a.b",
    )


def _refused(
    error: Exception, overrides: Sequence[str], declared: Primary, compose: Compose
) -> ConfigurationError:
    message = str(error)
    placed = re.search(r"Could not override '([^']+@[^']+)'", message)
    if placed:
        places = re.findall(r"[\w/]+@[\w.]+", message.replace(placed[1], ""))
        return ConfigurationError(
            "nothing is chosen at this place",
            where=placed[1],
            remedy=nearest(placed[1], places)
            if places
            else "`--cfg job` shows the keys that there are",
        )
    double = re.search(r"Multiple values for ([\w/]+@[\w.]+?)\.? ", message)
    if double:
        return ConfigurationError(
            "something is chosen at this place already",
            where=double[1],
            remedy=f"write {double[1]}=OPTION without a +",
        )
    key = re.search(r"Could not (?:override|delete from config\.) '([^']+)'", message)
    if key:
        return _unknown_key(key[1], overrides, declared, compose)
    sweep = re.search(
        r"(?:Sweep parameters|Ambiguous value for argument) '(.+?)'(?: requires|$)", message, re.M
    )
    if sweep:
        name, _, value = sweep[1].partition("=")
        return ConfigurationError(
            f"{value!r} are alternatives",
            where=name,
            remedy="add -m to run one after another, or give one value "
            f"(a list is written '{name}=[{value}]')",
        )
    bad = re.search(r"Error merging override (.+)", message)
    if bad:
        name, _, value = bad[1].partition("=")
        where = name.lstrip("+~")
        cause = error.__context__ or error.__cause__
        return _cannot_be_set(where, value, cause, overrides, declared, compose)
    if message.startswith(("no viable alternative", "missing ", "mismatched input")):
        return ConfigurationError(
            f"cannot read {' '.join(overrides)!r}: a bracket or a quote is not closed, or a sign "
            "stands where none can",
            where="the command line",
            remedy="write KEY=VALUE, or 'KEY=range(3)' with -m",
        )
    cause = error.__cause__
    detail = f": {_first_line(str(cause))}" if cause and str(cause) not in message else ""
    return ConfigurationError(
        f"the configuration cannot be composed: {_first_line(message)}{detail}",
        where="the configuration",
        remedy="see `trms list` for what can be chosen, `--cfg job` for what was composed",
    )


def _unknown_key(
    key: str, overrides: Sequence[str], declared: Primary, compose: Compose
) -> ConfigurationError:
    """The key's deepest part that exists, and what stands there."""
    given = next((text for text in overrides if parse(text, {}).key == key), key)
    value = given.partition("=")[2]
    parts = key.split(".")
    node: Any = _with_choices_only(overrides, declared, compose)
    depth = 0
    while depth < len(parts) and isinstance(node, Mapping) and parts[depth] in node:
        node = node[parts[depth]]
        depth += 1
    if isinstance(declared.defaults.get(parts[0]), list) and depth <= 1:
        name = parts[1] if len(parts) > 1 else "NAME"
        return ConfigurationError(
            f"{parts[0]} {name!r} is not chosen (given: {given})",
            where=key,
            remedy=f"choose it with '{parts[0]}=[{name}]'; chosen: "
            f"{', '.join(node) if isinstance(node, Mapping) and depth else 'none'}",
        )
    where = ".".join(parts[:depth])
    if not isinstance(node, Mapping):
        return ConfigurationError(
            f"{where} is a single value ({node!r}) without keys (given: {given})",
            where=key,
            remedy=f"set {where}=VALUE",
        )
    if depth == len(parts):
        return ConfigurationError(
            f"{value} has a key that {where} has not",
            where=key,
            remedy=f"allowed: {', '.join(map(str, node))}",
        )
    public = [str(name) for name in node if not str(name).startswith("_")]
    return unknown_key(parts[depth], value, key, public)


def _cannot_be_set(
    key: str,
    value: str,
    cause: BaseException | None,
    overrides: Sequence[str],
    declared: Primary,
    compose: Compose,
) -> ConfigurationError:
    node: Any = _with_choices_only(overrides, declared, compose)
    for part in key.split(".")[:-1]:
        node = node.get(part) if isinstance(node, Mapping) else None
    if node is not None and not isinstance(node, Mapping | list):
        return _unknown_key(key, overrides, declared, compose)
    return ConfigurationError(
        f"{value} cannot be set: {_first_line(str(cause or ''))}",
        where=key,
        remedy="`--cfg job` without this override shows what stands there",
    )


def _with_choices_only(
    overrides: Sequence[str], declared: Primary, compose: Compose
) -> Mapping[str, Any]:
    choices = []
    for text in overrides:
        override = parse(text, {})
        if override.package or override.key in declared.defaults:
            choices.append(text)
    try:
        return compose(choices)
    except Exception:  # the choices alone fail too: no keys to tell
        return {}


def _first_line(text: str) -> str:
    return next((line.strip() for line in text.splitlines() if line.strip()), "no reason given")
