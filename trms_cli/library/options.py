"""What can be chosen, from Python: options listed, and one built to be looked at."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from trms_cli.composition.arguments import folders_of
from trms_cli.core.errors import ConfigurationError
from trms_cli.library import html
from trms_cli.library.result import Paths

if TYPE_CHECKING:
    from pathlib import Path


class Options(Mapping[str, str]):
    """Names and what each is, in one line; printed and shown as a table."""

    def __init__(self, title: str, lines: Mapping[str, str]) -> None:
        self.title, self._lines = title, dict(lines)

    def __getitem__(self, name: str) -> str:
        return self._lines[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._lines)

    def __len__(self) -> int:
        return len(self._lines)

    def __repr__(self) -> str:
        width = max(map(len, self._lines), default=0) + 2
        return "\n".join([self.title, *(f"  {n:{width}}{t}" for n, t in self._lines.items())])

    def _repr_html_(self) -> str:
        return html.view(html.table(self.title, ["name", "what"], self._lines.items()))


@dataclass(frozen=True, repr=False)
class OptionFile:
    """The YAML of one option, whose comments tell every key's unit and meaning."""

    file: Path
    text: str

    def __repr__(self) -> str:
        return self.text

    def _repr_html_(self) -> str:
        from html import escape

        return f"<pre>{escape(self.text)}</pre>"


def options(
    group: str | None = None, name: str | None = None, *, config_dir: Paths = ()
) -> Options | OptionFile:
    """What can be chosen by name: ``trms list``.

    Parameters
    ----------
    group : str
        ``"controller"``; without it, the groups.
    name : str
        An option of the group: its YAML, with every key.
    config_dir : path or sequence of paths
        Folders with option files of your own.

    Returns
    -------
    Options or OptionFile
        A mapping from names to what each is.

    Raises
    ------
    ConfigurationError
        If there is no such group or option; it names the nearest.

    Examples
    --------
    >>> options("controller")
    >>> options("controller", "lqr")
    """
    from trms_cli.composition import catalogue

    places = folders_of(config_dir, "config_dir")
    groups, about = catalogue.read_groups(places), catalogue.about(places)
    if group is None:
        if name is not None:
            raise ConfigurationError(f"{name!r} of which group?", where="group")
        return Options("groups", {key: about.get(key, "") for key in groups})
    if name is not None:
        option = catalogue.find_option(groups, group, name)
        return OptionFile(option.file, option.file.read_text(encoding="utf-8"))
    group_options = catalogue.find_group(groups, group)
    return Options(group, {key: option.summary for key, option in group_options.items()})


def build(group: str, name: str, *, config_dir: Paths = (), **keys: Any) -> Any:
    """One part as an object: a model to be looked at, a controller to be wrapped.

    Parameters
    ----------
    group : str
        One that ``trms run`` composes from: ``"model"``, ``"controller"``, ``"observer"``, ….
    name : str
        The option.
    config_dir : path or sequence of paths
    **keys
        Values of its keys.

    Returns
    -------
    object
        What :func:`trms_cli.run` takes in place of the name.

    Raises
    ------
    ConfigurationError
        For a group, an option or a key that is not there.

    Examples
    --------
    >>> model = build("model", "newtonian", parameters={"k_g": 0.1})
    >>> model.parameters["k_g"].value
    0.1
    """
    from trms_cli.composition.arguments import arguments_of
    from trms_cli.composition.catalogue import read_primary
    from trms_cli.composition.composer import compose
    from trms_cli.composition.given_object import with_objects
    from trms_cli.core.plugins import build as build_part
    from trms_cli.core.plugins import nearest
    from trms_cli.library.call import turn, words_of

    defaults = read_primary("run", folders_of(config_dir, "config_dir")).defaults
    one = [key for key, option in defaults.items() if option and not isinstance(option, list)]
    if group not in one and group not in ("effect", "fault"):
        raise ConfigurationError(
            f"there is no part {group!r}", where="group", remedy=nearest(group, [*one, "effect"])
        )
    run_arguments = arguments_of("run", (), {group: {name: keys}}, config_dir=config_dir)
    with turn(words_of("run", run_arguments), list(run_arguments.objects.values())):
        config = with_objects(compose(run_arguments.argv, "run"), run_arguments.objects).config[
            group
        ]
        if group not in one:
            return build_part(config[name], f"{group}.{name}")
        return build_part(config, group)
