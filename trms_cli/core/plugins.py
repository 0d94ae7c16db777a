"""Builds a plugin from plain configuration: ``{_target_: dotted.name, key: value, …}``.

A plugin is a class (usually a frozen dataclass) or function with annotated arguments, of this
program or of a package that the user allowed (:mod:`trms_cli.core.trust`). Keys, types and ranges
are checked against those annotations before anything is constructed, so that a mistake is reported
by its key and not by a traceback from inside. Ranges stand in the annotations:
``Annotated[float, msgspec.Meta(gt=0)]``.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import inspect
import math
import re
import traceback
import types
import typing
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union

import msgspec

from trms_cli.core import trust
from trms_cli.core.errors import ConfigurationError, SimulationError, TrmsError
from trms_cli.core.invocation import whole_trace

_T = TypeVar("_T")
TARGET = "_target_"
#: Largest size of a number that is not infinite.
_LARGEST = 1e20
#: Keys of Hydra's own that may stand in a plugin's node.
_IGNORED_KEYS = {TARGET, "_convert_", "_recursive_"}
_PLAIN = {
    float: "a number",
    int: "a whole number",
    str: "a text",
    bool: "true or false",
    type(None): "null",
    Path: "a path",
}
_SIGNS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
#: A step of msgspec's path: into a mapping's value, a list's item, an object's field.
_STEP = re.compile(r"\[\.\.\.\]|\[(\d+)\]|\.(\w+)")


def nearest(name: str, allowed: Iterable[str]) -> str:
    """A remedy: the nearest allowed name first, then all of them."""
    names = sorted(allowed)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    hint = f"did you mean {close[0]}? " if close else ""
    return f"{hint}allowed: {', '.join(names) if names else 'nothing'}"


def require_known(
    name: str,
    allowed_names: Collection[str],
    problem: str,
    where: str,
    error: type[TrmsError] = ConfigurationError,
) -> None:
    """Refuse a name that is not among those known, with the nearest of them."""
    if name not in allowed_names:
        raise error(problem, where=where, remedy=nearest(name, allowed_names))


def locate(target: str, where: str) -> Any:
    """Import the class or factory that a dotted name points to.

    Raises ConfigurationError if it is not ours and of no package that is allowed; if no such module
    or attribute exists; if it is not defined in that package.
    """
    key = f"{where}.{TARGET}" if where else TARGET
    return _locate(target, key, "Class", inspect.isclass)


def locate_function(name: str, where: str) -> Callable[..., Any]:
    """Import the function that a dotted name points to, of a package that the user allowed.

    Raises ConfigurationError as :func:`locate` does, and for what is no function, or one of ours.
    """
    function = _locate(name, where, "function", inspect.isfunction)
    if not inspect.isfunction(function) or name.partition(".")[0] == "trms_cli":
        raise ConfigurationError(
            f"{name!r} is no function of yours",
            where=where,
            remedy="name a function of a package of yours: package.module.function",
        )
    return function


def _locate(target: str, key: str, noun: str, is_one: Callable[[Any], bool]) -> Any:
    """What a dotted name points to; a ``noun``, by which ``is_one`` knows what may be meant."""
    module_name, _, attribute = target.rpartition(".")
    if not all(part.isidentifier() for part in target.split(".")) or not module_name:
        raise ConfigurationError(
            f"{target!r} is not a dotted name",
            where=key,
            remedy=f"write it as package.module.{noun}",
        )
    trust.check_allowed(target, key)
    try:
        module = trust.import_trusted(module_name)
    except ModuleNotFoundError as error:
        raise ConfigurationError(
            f"cannot import {module_name!r}: {error}", where=key, remedy=_how_to_find(error)
        ) from error
    if not hasattr(module, attribute):
        public = [name for name in vars(module) if not name.startswith("_")]
        raise ConfigurationError(
            f"module {module_name!r} has no {attribute!r}",
            where=key,
            remedy=nearest(attribute, [n for n in public if is_one(vars(module)[n])]),
        )
    plugin = getattr(module, attribute)
    trust.check_own(plugin, target, key)
    return plugin


def _how_to_find(error: ModuleNotFoundError) -> str:
    missing = (error.name or "").partition(".")[0]
    if missing == "trms_cli":
        return "of trms only its plugins can be named: `trms list` tells which there are"
    return (
        "install the package, or name its folder by --config-dir or PYTHONPATH; a module that it "
        f"imports from the same folder is allowed as well: --allow {missing}"
    )


def is_plugin(value: object) -> bool:
    """Whether a configuration node describes a plugin."""
    return isinstance(value, Mapping) and TARGET in value


def build(node: Any, where: str = "") -> Any:
    """Construct a plugin, and all the plugins nested in it.

    Raises ConfigurationError for a missing or unknown key, a wrong type, a value out of range; it
    names the key.

    Parameters
    ----------
    node : mapping
        ``_target_`` and the arguments; lists and mappings in it may hold further plugins.
    where : str
        Path of the node in the configuration, for messages.
    """
    if not is_plugin(node):
        raise ConfigurationError(
            f"expected a plugin, got {node!r}",
            where=where,
            remedy=f"choose one by name, or give a mapping with {TARGET}",
        )
    target = locate(str(node[TARGET]), where)
    arguments = {key: value for key, value in node.items() if key not in _IGNORED_KEYS}
    return construct(target, arguments, where)


def construct(kind: Callable[..., _T], keys: Mapping[str, Any], where: str = "") -> _T:
    """What a class makes of keys, checked as those of a plugin are; see :func:`build`."""
    arguments = _checked_arguments(kind, keys, where)
    try:
        return kind(**arguments)
    except TrmsError as error:
        if where and not error.where.startswith(where):
            error.where = f"{where}.{error.where}" if error.where else where
        raise


class _Signature(NamedTuple):
    """What a class or function takes."""

    parameters: Mapping[str, inspect.Parameter]
    takes_more: bool  #: Whether any other key is welcome
    hints: Mapping[str, Any]  #: Types by name


@functools.lru_cache(maxsize=512)
def _signature_of(target: Any) -> _Signature:
    every = inspect.signature(target).parameters
    parameters = {
        name: parameter
        for name, parameter in every.items()
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
    }
    takes_more = any(parameter.kind == parameter.VAR_KEYWORD for parameter in every.values())
    annotated = target
    if inspect.isclass(target) and not dataclasses.is_dataclass(target):
        annotated = target.__init__
    return _Signature(parameters, takes_more, typing.get_type_hints(annotated, include_extras=True))


def _checked_arguments(target: Any, arguments: Mapping[str, Any], where: str) -> dict[str, Any]:
    parameters, takes_more, hints = _signature_of(target)
    for key in arguments:
        if key not in parameters and not takes_more:
            raise ConfigurationError(
                f"unknown key {key!r} (given: {arguments[key]!r})",
                where=_join(where, str(key)),
                remedy=nearest(str(key), parameters),
            )
    for name, parameter in parameters.items():
        if parameter.default is parameter.empty and name not in arguments:
            raise _refusal_error(Refusal("", None, "", unknown=name), _join(where, name))
    return {
        key: _converted(value, hints.get(key, Any), _join(where, key))
        for key, value in arguments.items()
    }


def _converted(value: Any, hint: Any, where: str) -> Any:
    """The value with nested plugins built, in the type that the hint asks for."""
    if _holds_plugin(value):
        return _built_inside(value, where)
    if hint is not str:  # a text is asked for where one is meant, not a number
        _refuse_unusable(value, where)
    try:
        return msgspec.convert(value, hint, strict=True)
    except msgspec.ValidationError as error:
        reason = refusal(error, value, hint)
        raise _refusal_error(reason, where + reason.path) from None
    except TypeError:
        # A type that is no data (a protocol, an array, a model): a plain value cannot be one.
        if isinstance(value, (str, int, float, bool, list, Mapping)):
            raise ConfigurationError(
                f"{value!r} given",
                where=where,
                remedy="choose a plugin by its name, or give a mapping with _target_",
            ) from None
        return value


def _refuse_unusable(value: Any, where: str) -> None:
    """Infinity may be a limit that is none; what is not a number passes every range check.

    Nothing real is as large as :data:`_LARGEST`, and the powers of such numbers overflow.
    """
    if isinstance(value, float) and math.isnan(value):
        raise ConfigurationError(f"{value!r} given", where=where, remedy="give a number")
    if isinstance(value, (int, float)) and _LARGEST < abs(value) < math.inf:
        raise ConfigurationError(
            f"{value!r} given",
            where=where,
            remedy=f"give a number up to {_LARGEST:g}; .inf where no limit is meant",
        )
    if isinstance(value, Mapping):
        for key, item in value.items():
            _refuse_unusable(item, _join(where, str(key)))
    elif isinstance(value, (list, tuple)):
        for i, item in enumerate(value):
            _refuse_unusable(item, f"{where}[{i}]")


def _holds_plugin(value: Any) -> bool:
    if isinstance(value, Mapping):
        return TARGET in value or any(_holds_plugin(item) for item in value.values())
    if isinstance(value, (list, tuple)):
        return any(_holds_plugin(item) for item in value)
    return False


def _built_inside(value: Any, where: str) -> Any:
    if isinstance(value, Mapping):
        if TARGET in value:
            return build(value, where)
        return {key: _built_inside(item, _join(where, str(key))) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return tuple(_built_inside(item, f"{where}[{i}]") for i, item in enumerate(value))
    return value


def _refusal_error(reason: Refusal, where: str) -> ConfigurationError:
    if reason.unknown and reason.alternatives:
        return ConfigurationError(
            f"unknown key {reason.unknown!r} (given: {reason.value!r})",
            where=where,
            remedy=nearest(reason.unknown, reason.alternatives),
        )
    if reason.unknown:
        problem = f"{reason.unknown!r} is required and not given"
        return ConfigurationError(problem, where=where, remedy=f"set {where}=…")
    alternatives = reason.alternatives
    remedy = nearest(reason.value, alternatives) if alternatives else f"expected {reason.expected}"
    return ConfigurationError(f"{reason.value!r} given", where=where, remedy=remedy)


def _join(where: str, key: str) -> str:
    return f"{where}.{key}" if where else key


class Refusal(NamedTuple):
    """Why a value does not fit a type."""

    path: str  #: from the value to the part that is wrong: ``.kp``, ``[1]``
    value: Any  #: that part
    expected: str  #: in words
    unknown: str = ""  #: a key that the type has not
    alternatives: tuple[str, ...] = ()  #: the keys or words that could have been given instead


def words(hint: Any) -> str:
    """A type in words: "a number > 0", "auto or a mapping with the keys kp, ki, kd"."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        return words(arguments[0]) + _range(arguments[1:])
    if origin is Literal:
        return " or ".join(map(str, arguments))
    if origin in (Union, types.UnionType):
        return ", or ".join(words(member) for member in arguments)
    if hint in _PLAIN:
        return _PLAIN[hint]
    if origin is tuple and arguments == (float, float):
        return "two numbers [lower, upper]"
    if origin is tuple and arguments[-1:] != (...,):
        return f"a list of {len(arguments)}: {', '.join(map(words, arguments))}"
    if _is_a(hint, Mapping):
        return "a mapping" + (f" from names to {words(arguments[1])}" if arguments else "")
    if _is_a(hint, Sequence):
        return "a list" + (f", each item {words(arguments[0])}" if arguments else "")
    if _fields(hint):
        return f"a mapping with the keys {', '.join(_fields(hint))}"
    return "a plugin: choose one by its name, or give a mapping with _target_"


def refusal(error: msgspec.ValidationError, value: Any, hint: Any) -> Refusal:
    """What `msgspec.convert(value, hint)` found wrong, and where."""
    message, _, place = str(error).partition(" - at `$")
    path = ""
    for step in _STEP.finditer(place):
        index, name = step[1], step[2]
        if step[0] == "[...]":  # msgspec keeps to itself which one it is
            name = _refused_key(value, hint)
        if (name is not None and name not in value) or (name is None and index is None):
            break
        hint = _inside(hint, name if index is None else int(index))
        value = value[name if index is None else int(index)]
        path += f".{name}" if index is None else f"[{index}]"
    unknown = re.search(r"unknown field `(.+)`", message)
    if unknown:
        alternatives = tuple(name for member in _members(hint) for name in _fields(member))
        return Refusal(
            f"{path}.{unknown[1]}", value[unknown[1]], words(hint), unknown[1], alternatives
        )
    missing = re.search(r"missing required field `(.+)`", message)
    if missing:
        return Refusal(f"{path}.{missing[1]}", None, words(hint), missing[1])
    literals = tuple(
        str(word)
        for member in _members(hint)
        if typing.get_origin(member) is Literal
        for word in typing.get_args(member)
    )
    alternatives = literals if isinstance(value, str) and len(_members(hint)) == 1 else ()
    return Refusal(path, value, words(hint), alternatives=alternatives)


def _refused_key(value: Mapping[str, Any], hint: Any) -> Any:
    for key, item in value.items():
        try:
            msgspec.convert({key: item}, hint, strict=True)
        except msgspec.ValidationError:
            return key
    return None


def _inside(hint: Any, step: str | int) -> Any:
    """The type of a field, an item or a mapping's value."""
    for member in _members(hint):
        arguments = typing.get_args(member)
        if isinstance(step, int):
            if typing.get_origin(member) is tuple and arguments[-1:] != (...,):
                return arguments[step]
            if arguments and _is_a(member, Sequence):
                return arguments[0]
        elif _is_a(member, Mapping):
            return arguments[1] if arguments else Any
        elif step in _fields(member):
            return typing.get_type_hints(member, include_extras=True)[step]
    return Any


def _members(hint: Any) -> list[Any]:
    """The members of a union, or the type itself; without annotations."""
    if typing.get_origin(hint) is Annotated:
        hint = typing.get_args(hint)[0]
    if typing.get_origin(hint) in (Union, types.UnionType):
        return [inner for member in typing.get_args(hint) for inner in _members(member)]
    return [hint]


def _is_a(hint: Any, kind: type) -> bool:
    origin = typing.get_origin(hint) or hint
    return isinstance(origin, type) and origin is not str and issubclass(origin, kind)


def _fields(hint: Any) -> list[str]:
    """Keys of a record: a msgspec.Struct, or a dataclass."""
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        return list(hint.__struct_fields__)
    return [f.name for f in dataclasses.fields(hint)] if dataclasses.is_dataclass(hint) else []


def _range(annotations: Sequence[Any]) -> str:
    limits = [
        f"{sign} {getattr(meta, key):g}"
        for meta in annotations
        if isinstance(meta, msgspec.Meta)
        for key, sign in _SIGNS.items()
        if getattr(meta, key) is not None
    ]
    lengths = [
        f" with at {way} {getattr(meta, key)} items"
        for meta in annotations
        if isinstance(meta, msgspec.Meta)
        for key, way in (("min_length", "least"), ("max_length", "most"))
        if getattr(meta, key) is not None
    ]
    return "".join(f" {limit}" for limit in [" and ".join(limits)] if limit) + "".join(lengths)


#: The methods of each kind of plugin, by its key in the configuration.
_METHODS = {
    "controller": ("preview", "init", "step"),
    "observer": ("init", "step"),
    "plant": ("init",),
    "ref": ("restricted_to", "sample"),
    "supervisor": ("init",),
    "gap_watch": ("init",),
}
#: First words of a key that names its place in the whole configuration.
_PLACES = ("model", "plant", "observer", "controller", "ref", "effect", "sim")


def check_contract(plugin: Any, key: str) -> None:
    """Refuse a plugin that lacks a method.

    Raises ConfigurationError: it names the class and what it lacks.
    """
    method_names = _METHODS[key]
    lacking = [name for name in method_names if not callable(getattr(plugin, name, None))]
    if lacking:
        kind = type(plugin)
        raise ConfigurationError(
            f"{key} {kind.__module__}.{kind.__qualname__} lacks {' and '.join(lacking)}",
            where=f"{key}._target_",
            remedy=f"it needs the methods {', '.join(method_names)}: see docs/writing-a-plugin.md",
        )


def plugin_failure(error: Exception, parts: Mapping[str, Any], time: float) -> TrmsError | None:
    """What a plugin has to answer for, in words; None if no plugin was at work.

    ``error``: as it came out of the loop. One that is in words already is returned itself, with the
    plugin's key before the key that it names. ``parts``: the plugins by their key in the
    configuration. ``time``: simulated time that was reached, s.
    """
    key = _at_work(error, parts)
    if isinstance(error, TrmsError):
        first = error.where.partition(".")[0]
        if key is not None and isinstance(error, ConfigurationError) and first not in _PLACES:
            error.where = f"{key}.{error.where}" if error.where else key
        return error
    return None if key is None else _words(error, key, parts[key], time)


def _at_work(error: Exception, parts: Mapping[str, Any]) -> str | None:
    """The key of the plugin that the loop called when the error came."""
    trace = error.__traceback__
    while trace is not None:
        acting = trace.tb_frame.f_locals.get("self")
        for key, part in parts.items():
            if acting is part or (key == "plant" and _is_run_of_a_plant(acting)):
                return key
        trace = trace.tb_next
    return None


def _is_run_of_a_plant(acting: Any) -> bool:
    """Whether it is the run that a user's own plant made; ours tell of themselves."""
    kind = type(acting)
    is_ours = kind.__module__.partition(".")[0] == "trms_cli"
    return not is_ours and all(callable(getattr(kind, m, None)) for m in ("measure", "advance"))


def _words(error: Exception, key: str, part: Any, time: float) -> SimulationError:
    kind = type(part)
    last = traceback.extract_tb(error.__traceback__)[-1]
    moment = f"at {time:.2f} s" if time > 0 else "at the start"
    return SimulationError(
        f"the {key} {kind.__module__}.{kind.__qualname__} failed {moment}: "
        f"{type(error).__name__}: {error}",
        where=f"{last.filename}, line {last.lineno}, in {last.name}",
        remedy=whole_trace(),
    )
