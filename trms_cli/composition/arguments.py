"""From the arguments of a call to what would be typed, and to the objects that cannot be typed.

``run("sim.duration=20", controller="lqr", effect=["main_input_delay"], ref={"alpha_h": signal})``
becomes the words ``sim.duration=20 controller=lqr effect=[main_input_delay]`` and the object
``signal`` at ``ref.alpha_h``.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

from trms_cli.composition.catalogue import Groups, Primary, read_groups, read_primary
from trms_cli.composition.overrides import parse, quote_value
from trms_cli.core.errors import ConfigurationError

#: Words that need no quotes: they cannot be read as a number, a truth value or Hydra's grammar.
_PLAIN = re.compile(r"[A-Za-z_][\w/-]*(\.[A-Za-z_][\w/-]*)*", re.ASCII)
#: The method of a result that names its file for a key (:class:`trms_cli.library.result.Result`).
_OF_RESULT = "file_for"
_OTHER_MEANING = {"true", "false", "null", "none", "inf", "nan", "yes", "no", "on", "off"}


@dataclass(frozen=True)
class Arguments:
    """What a call asks for."""

    words: tuple[str, ...]  #: As they would be typed: ``controller=lqr``
    #: By their place in the configuration: ``controller``, ``ref.alpha_h``, ``effect.draught``
    objects: Mapping[str, Any] = field(default_factory=dict)
    config_dirs: tuple[Path, ...] = ()  #: The user's folders of options

    @property
    def argv(self) -> list[str]:
        """The command line without its objects."""
        folders = [word for folder in self.config_dirs for word in ("--config-dir", str(folder))]
        return [*folders, *self.words]

    def with_more(self, more: Arguments) -> Arguments:
        """These, and `more` on top: a later word and a later object count."""
        objects = {
            place: value
            for place, value in self.objects.items()
            if not any(parse(word, {}).key == place for word in more.words)
        }
        words = tuple(w for w in self.words if not _inside(w, more.objects))
        folders = tuple(dict.fromkeys((*more.config_dirs, *self.config_dirs)))
        return Arguments((*words, *more.words), {**objects, **more.objects}, folders)


def arguments_of(
    primary: str,
    typed: Sequence[str],
    keys: Mapping[str, Any],
    *,
    out: str | PathLike[str] | None = None,
    config_dir: str | PathLike[str] | Sequence[str | PathLike[str]] = (),
) -> Arguments:
    """Read the arguments of a call that composes from `primary`.

    `typed`: ``KEY=VALUE`` as on the command line. `keys`: by name; None stands for what is not
    given (to give null, write ``"KEY=null"``). `out`: the folder to write into; None for a new one.
    Raises ConfigurationError for what cannot be an argument.
    """
    places = folders_of(config_dir, "config_dir")
    for word in typed:
        if not isinstance(word, str) or word.startswith("-"):
            raise ConfigurationError(
                f"{word!r} given",
                where="the arguments",
                remedy='give overrides as text: "sim.duration=20"; options of the command line are '
                "arguments here: config_dir=, out=, and sweep(…) for -m",
            )
    layout = _Layout(read_primary(primary, places), read_groups(places))
    for key, value in keys.items():
        if value is not None:
            layout.lay(key, value)
    if out is not None:
        layout.lay("out", str(path_of(out, "out")))
    words = (*layout.words, *typed)
    _refuse_keys_of_objects(words, layout.objects)
    return Arguments(words, layout.objects, places)


class _Layout:
    """Gathers words and objects, key by key."""

    def __init__(self, declared: Primary, groups: Groups) -> None:
        self._declared, self._groups = declared, groups
        self.words: list[str] = []
        self.objects: dict[str, Any] = {}

    def lay(self, key: str, value: Any) -> None:
        """Take one argument."""
        if key in self._declared.defaults:
            several = isinstance(self._declared.defaults[key], list)
            (self._lay_several if several else self._lay_choice)(key, value)
        else:
            self._lay_value(key, value)

    def _lay_choice(self, group: str, value: Any) -> None:
        if isinstance(value, str | PathLike) or hasattr(value, _OF_RESULT):
            self.words.append(f"{group}={_file_of(value, group)}")
        elif isinstance(value, Mapping):
            option = self._option_with_keys(group, value)
            if option is not None:
                self.words.append(f"{group}={option}")
                value = value[option] or {}
            self._lay_value(group, value)
        else:
            self._lay_value(group, value)

    def _option_with_keys(self, group: str, value: Mapping[Any, Any]) -> str | None:
        """The option that ``{"square": {…}}`` chooses; None for keys of the one that is chosen."""
        if len(value) != 1:
            return None
        (name, inner), options = next(iter(value.items())), self._groups.get(group, {})
        return str(name) if name in options and isinstance(inner, Mapping | None) else None

    def _lay_several(self, group: str, value: Any) -> None:
        named: list[str] = []
        for name, inner in _items(value):
            if isinstance(inner, Mapping | None):
                named.append(name)
            else:
                self.objects[f"{group}.{name}"] = _instance(inner, f"{group}.{name}")
        self.words.append(f"{group}=[{','.join(named)}]")
        for name, inner in _items(value):
            if isinstance(inner, Mapping):
                self._lay_value(f"{group}.{name}", inner)

    def _lay_value(self, key: str, value: Any) -> None:
        if isinstance(value, Mapping):
            for name, inner in value.items():
                self._lay_value(f"{key}.{name}", inner)
            return
        _refuse_samples(key, value)
        try:
            self.words.append(f"{key}={text_of(value, key)}")
        except TypeError:
            if "@" in key:
                raise ConfigurationError(
                    f"{value!r} given",
                    where=key,
                    remedy=f"an object goes to its place: {key.partition('@')[2]}",
                ) from None
            self.objects[key] = _instance(value, key)


def _refuse_samples(key: str, value: Any) -> None:
    """Numbers where a signal is asked for: they lack their times."""
    from trms_cli.references.trajectory import AXES

    group, _, axis = key.partition(".")
    several = isinstance(value, list | tuple | range) or type(value).__name__ == "ndarray"
    if group == "ref" and axis in AXES and several:
        raise ConfigurationError(
            f"{len(value)} values given, and no times",
            where=key,
            remedy=f"give a function of time: "
            f"ref={{'{axis}': lambda t: np.interp(t, times, values)}}",
        )


def _items(value: Any) -> Iterator[tuple[str, Any]]:
    """Names and what is given with each: an object, keys, or None."""
    if isinstance(value, Mapping):
        yield from ((str(name), inner) for name, inner in value.items())
        return
    several = value if isinstance(value, list | tuple) else [value]
    for item in several:
        if isinstance(item, str):
            yield from ((name.strip(), None) for name in item.strip("[]").split(",") if name)
        else:
            kind = item.__name__ if isinstance(item, type) else type(item).__name__
            yield re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", kind).lower(), item


def _instance(value: Any, where: str) -> Any:
    """The object; a function of time as a signal of one axis, a class refused."""
    if isinstance(value, type):
        raise ConfigurationError(
            f"the class {value.__name__} given",
            where=where,
            remedy=f"give an instance: {value.__name__}(…)",
        )
    if inspect.isroutine(value):
        if "." not in where:
            raise ConfigurationError(
                f"the function {getattr(value, '__name__', value)!s} given",
                where=where,
                remedy="name the axis: ref={'alpha_h': …}"
                if where == "ref"
                else "give an object with the methods of its kind (docs/writing-a-plugin.md)",
            )
        from trms_cli.references.time_function import TimeFunction

        return TimeFunction(value)
    return value


def text_of(value: Any, key: str = "") -> str:
    """A value in the grammar of overrides; raises TypeError if it is no data."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(float(value)) if isinstance(value, float) else str(int(value))
    if isinstance(value, PathLike) or hasattr(value, _OF_RESULT):
        value = _file_of(value, key)
    if isinstance(value, str):
        plain = _PLAIN.fullmatch(value) and value.lower() not in _OTHER_MEANING
        return value if plain else quote_value(value)
    if isinstance(value, Mapping):
        inner = (f"{text_of(str(k))}: {text_of(v, key)}" for k, v in value.items())
        return "{" + ", ".join(inner) + "}"
    if type(value).__module__ == "numpy":
        return text_of(value.tolist(), key)
    if isinstance(value, list | tuple | set | frozenset | range):
        return f"[{','.join(text_of(item, key) for item in value)}]"
    raise TypeError(f"{type(value).__name__} is no data")


def _file_of(value: Any, key: str) -> str:
    """A name or a path; of a result the file that a key asks for."""
    if isinstance(value, str):
        return value
    result = hasattr(value, _OF_RESULT)
    path = value.file_for(key.split(".")[0]) if result else Path(value)
    text = str(path.expanduser())
    # a name without a folder would be read as an option's
    return text if "/" in text or key not in ("model",) else f"./{text}"


def _inside(word: str, places: Iterable[str]) -> bool:
    """Whether an override is of a place, or of something in it."""
    override = parse(word, {})
    spot = override.package.lstrip("@") or override.key
    return any(spot == place or spot.startswith(f"{place}.") for place in places)


def _refuse_keys_of_objects(words: Sequence[str], objects: Mapping[str, Any]) -> None:
    for word in words:
        for place in objects:
            if _inside(word, (place,)):
                raise ConfigurationError(
                    f"{word} given, and {place} is an object",
                    where=place,
                    remedy="an object is complete: set its values where it is made",
                )


def path_of(value: Any, where: str) -> Path:
    """A path that was given, with ``~`` as the home folder.

    Raises ConfigurationError if it is no path.
    """
    if not isinstance(value, str | PathLike):
        raise ConfigurationError(
            f"{value!r} given", where=where, remedy=f'give a path: {where}="FOLDER"'
        )
    return Path(value).expanduser()


def folders_of(value: Any, where: str) -> tuple[Path, ...]:
    """One folder or several, from the root; raises ConfigurationError if one is no path."""
    several = list(value) if isinstance(value, list | tuple | set) else [value]
    return tuple(path_of(one, where).resolve() for one in several)
