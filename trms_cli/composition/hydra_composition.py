"""Composes by Hydra: the user's folders first, and nothing from outside of the configuration.

Its errors, and OmegaConf's, are told in words that name the key, what was given, what is allowed.

``${sim.duration}`` and ``${oc.select:KEY,DEFAULT}`` are taken in a configuration. Other references
reach out of the experiment: ``${oc.env:NAME}`` would write a secret of the environment into every
log. References also multiply: thirty lines that each name the line above twice stand for a text of
a gigabyte. So what they stand for is measured before anything is resolved.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import hydra
import yaml
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.config_search_path import ConfigSearchPath, SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.version import VersionBase
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict

from trms_cli.composition.catalogue import Groups, Primary, config_folder, yaml_error
from trms_cli.composition.checks import unknown_key
from trms_cli.composition.overrides import parse
from trms_cli.composition.plain_values import value_at
from trms_cli.core.data_file import read_bytes
from trms_cli.core.errors import ConfigurationError, first_line
from trms_cli.core.plugins import nearest
from trms_cli.core.yaml_data import MOST_BYTES, check_yaml

HYDRA_VERSION_BASE = "1.3"  #: whose behaviour the configuration is written for

_KEY = r"\.*[\w@]+(?:\.[\w@]+|\[\w+\])*"
_PLAIN = re.compile(rf"\$\{{\s*({_KEY})\s*\}}")
_SELECT = re.compile(
    rf"\$\{{\s*oc\.select\s*:\s*({_KEY})\s*"
    rf"(?:,\s*(?:\$\{{\s*({_KEY})\s*\}}|\{{\}}|\[\]|[^${{}}\[\],]*))?\s*\}}"
)
#: Letters and values that a configuration may stand for; those of an experiment are some 5000.
_MOST = 20_000_000
#: References that lead to references.
_DEEPEST = 30


class UserFolder(FileConfigSource):
    """A folder of ``--config-dir``: its YAML is anybody's, and none of it steers Hydra."""

    @staticmethod
    def scheme() -> str:
        """How its path begins."""
        return "config-dir"

    def load_config(self, config_path: str) -> ConfigResult:
        """Read an option, once it is known to be plain and not too large.

        Raises ConfigurationError for a document that is no YAML, or larger or deeper than is read;
        for keys of Hydra's own, a path out of the folder, and a choice that is made by something
        outside of the configuration.
        """
        name = self._normalize_file_name(config_path)
        where = str(Path(self.path, name))
        if ".." in Path(name).parts:
            raise ConfigurationError(
                f"{config_path!r} leads out of the folder",
                where=self.path,
                remedy="an option lies in the folder of its group",
            )
        if Path(name).parts[0] == "hydra":
            raise _steers_hydra(where)
        try:
            check_yaml(read_bytes(Path(where), MOST_BYTES))
        except yaml.YAMLError as error:
            raise yaml_error(error, Path(where)) from None
        try:
            result = super().load_config(config_path)
        except ValueError as error:  # a header that is none, a value that is no plain data
            raise ConfigurationError(
                f"it cannot be read ({str(error).splitlines()[0][:200]})",
                where=where,
                remedy="a header is a line of its own: # @package _global_",
            ) from error
        package = str(result.header.get("package") or "")
        if package.split(".")[0] == "hydra" or "hydra" in result.config:
            raise _steers_hydra(where)
        defaults = result.config._get_node("defaults") if "defaults" in result.config else None
        if defaults is not None and not isinstance(defaults, ListConfig):
            raise ConfigurationError(
                "defaults is no list",
                where=where,
                remedy="write each choice on a line of its own: - override /ref: sine",
            )
        refuse_outward(str(defaults), f"{where}, defaults")
        return result


def _steers_hydra(where: str) -> ConfigurationError:
    return ConfigurationError(
        "keys of Hydra's own are not taken from a file",
        where=where,
        remedy="remove what begins with hydra; a sweep has sampler=… and launcher=…",
    )


class UserFolders(SearchPathPlugin):
    """The folders of ``--config-dir``, in their order: an own option hides a built-in namesake."""

    folders: ClassVar[tuple[Path, ...]] = ()

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Put the folders before the program's own (Hydra's ``main``)."""
        for folder in self.folders:
            search_path.prepend(
                provider="--config-dir",
                path=f"{UserFolder.scheme()}://{folder}",
                anchor=SearchPathQuery(provider="main"),
            )


@contextmanager
def user_folders(folders: Sequence[Path]) -> Iterator[None]:
    """Hydra is started inside; it is left as it was found, also where a notebook has started it."""
    state, version = GlobalHydra.instance(), VersionBase.instance()
    hydra, base = state.hydra, version.getbase()
    state.clear()
    if UserFolders not in Plugins.instance().discover(SearchPathPlugin):
        Plugins.instance().register(UserFolders)
        Plugins.instance().register(UserFolder)
    before = UserFolders.folders
    UserFolders.folders = tuple(folders)
    try:
        yield
    finally:
        UserFolders.folders = before
        GlobalHydra.instance().hydra = hydra
        version.version_base = base


def compose_by_hydra(
    primary: str, overrides: Sequence[str], config_dirs: Sequence[Path]
) -> tuple[DictConfig, dict[Any, Any]]:
    """Compose by Hydra: the ``DictConfig``, unresolved, and the option chosen in each group.

    What the configuration refers to has been looked at; Hydra's own groups are among the choices.
    """
    with user_folders(config_dirs):
        hydra.initialize_config_dir(
            str(config_folder()), job_name=primary, version_base=HYDRA_VERSION_BASE
        )
        try:
            composed = hydra.compose(primary, overrides=list(overrides), return_hydra_config=True)
        except (TypeError, AttributeError, KeyError, IndexError, AssertionError) as error:
            # Hydra's own surprise at a YAML of an unexpected form
            raise ConfigurationError(
                f"the configuration cannot be composed ({type(error).__name__}: {error})",
                where="the configuration",
                remedy="`trms list` shows what options look like",
            ) from error
    choices = OmegaConf.to_container(composed.hydra.runtime.choices)
    assert isinstance(choices, dict)
    with open_dict(composed):
        del composed["hydra"]
    content = OmegaConf.to_container(composed)
    assert isinstance(content, dict)
    check_interpolations({str(key): value for key, value in content.items()})
    return composed, choices


def check_interpolations(config: Mapping[str, Any]) -> None:
    """Refuse references out of the configuration, in a circle, or to more than there is room for.

    ``config``: plain and unresolved. Raises ConfigurationError: it names the key.
    """
    _Measure(config).node(config, (), 0)


def refuse_outward(text: str, where: str) -> None:
    """Refuse a text with a reference that is no key of the configuration.

    Raises ConfigurationError with what may stand there.
    """
    rest = _PLAIN.sub("", _SELECT.sub("", text))
    if "${" in rest:
        raise ConfigurationError(
            f"{text[:200]!r} refers to something outside of the configuration",
            where=where,
            remedy="write ${KEY} for another key, or ${oc.select:KEY,DEFAULT}; what stands in the "
            "environment is given on the command line: KEY=$NAME",
        )


class _Measure:
    """How much each key stands for, counted once."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        self._config = config
        self._sizes: dict[tuple[str, ...], int] = {}

    def node(self, node: Any, key: tuple[str, ...], depth: int) -> int:
        if key in self._sizes:
            return self._sizes[key]
        if isinstance(node, str):
            size = self.text(node, key, depth) if "${" in node else 1 + len(node)
        elif isinstance(node, Mapping):
            inside = (self.node(item, (*key, str(k)), depth) for k, item in node.items())
            size = 1 + sum(inside)
        elif isinstance(node, (list, tuple)):
            size = 1 + sum(self.node(item, (*key, str(i)), depth) for i, item in enumerate(node))
        else:
            size = 1
        if size > _MOST:
            raise ConfigurationError(
                "its references stand for more than there is room for",
                where=".".join(key) or "the configuration",
                remedy="refer to each key once",
            )
        self._sizes[key] = size
        return size

    def text(self, text: str, key: tuple[str, ...], depth: int) -> int:
        where = ".".join(key)
        refuse_outward(text, where)
        if depth > _DEEPEST:
            raise ConfigurationError(
                f"{text[:200]!r} leads in a circle, or through more than {_DEEPEST} references",
                where=where,
                remedy="give the value where it is used",
            )
        size = len(text)
        for match in (*_SELECT.finditer(text), *_PLAIN.finditer(text)):
            for name in filter(None, match.groups()):
                target = _absolute(name, key)
                size += self.node(_at(self._config, target), target, depth + 1)
        return size


def _absolute(name: str, key: tuple[str, ...]) -> tuple[str, ...]:
    """The key that a reference names; a leading dot is the mapping that it stands in."""
    path = name.lstrip(".")
    parts = tuple(part for part in re.split(r"[.\[\]]+", path) if part)
    dots = len(name) - len(path)
    return (*key[: max(0, len(key) - dots)], *parts) if dots else parts


def _at(config: Any, key: tuple[str, ...]) -> Any:
    for part in key:
        if isinstance(config, Mapping):
            config = config.get(part)
        elif isinstance(config, (list, tuple)) and part.isdigit() and int(part) < len(config):
            config = config[int(part)]
        else:
            return None
    return config


Compose = Callable[[Sequence[str]], Mapping[str, Any]]


@contextmanager
def explain_errors(
    overrides: Sequence[str], declared: Primary, groups: Groups, compose: Compose
) -> Iterator[None]:
    """Turn what Hydra, OmegaConf and YAML raise inside into a `ConfigurationError`.

    `compose` composes with fewer overrides than those given to Hydra, for finding the keys that a
    misspelt one is near to.
    """
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
        raise _override_error(error, overrides, declared, compose) from error
    except yaml.YAMLError as error:
        raise yaml_error(error) from error


def _unreadable(error: Any) -> ConfigurationError:
    return ConfigurationError(
        f"cannot read {error.override!r}: {first_line(error.message)}",
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
        f"cannot be resolved: {first_line(error)}",
        where=str(key),
        remedy="`--cfg job` shows the configuration; an interpolation ${a.b} needs the key a.b",
    )


def _override_error(
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
        node = value_at(_with_choices_only(overrides, declared, compose), where.rpartition(".")[0])
        if node is not None and not isinstance(node, Mapping | list):
            return _unknown_key(where, overrides, declared, compose)
        return ConfigurationError(
            f"{value} cannot be set: {first_line(error.__context__ or error.__cause__)}",
            where=where,
            remedy="`--cfg job` without this override shows what stands there",
        )
    if message.startswith(("no viable alternative", "missing ", "mismatched input")):
        return ConfigurationError(
            f"cannot read {' '.join(overrides)!r}: a bracket or a quote is not closed, or a sign "
            "stands where none can",
            where="the command line",
            remedy="write KEY=VALUE, or 'KEY=range(3)' with -m",
        )
    cause = error.__cause__
    detail = f": {first_line(cause)}" if cause and str(cause) not in message else ""
    return ConfigurationError(
        f"the configuration cannot be composed: {first_line(message)}{detail}",
        where="the configuration",
        remedy="see `trms list` for what can be chosen, `--cfg job` for what was composed",
    )


def _unknown_key(
    key: str, overrides: Sequence[str], declared: Primary, compose: Compose
) -> ConfigurationError:
    """The key's deepest part that exists, and what stands there."""
    override = next((text for text in overrides if parse(text, {}).key == key), key)
    value = override.partition("=")[2]
    parts = key.split(".")
    node: Any = _with_choices_only(overrides, declared, compose)
    depth = 0
    while depth < len(parts) and isinstance(node, Mapping) and parts[depth] in node:
        node = node[parts[depth]]
        depth += 1
    if isinstance(declared.defaults.get(parts[0]), list) and depth <= 1:
        name = parts[1] if len(parts) > 1 else "NAME"
        return ConfigurationError(
            f"{parts[0]} {name!r} is not chosen (given: {override})",
            where=key,
            remedy=f"choose it with '{parts[0]}=[{name}]'; chosen: "
            f"{', '.join(node) if isinstance(node, Mapping) and depth else 'none'}",
        )
    where = ".".join(parts[:depth])
    if not isinstance(node, Mapping):
        return ConfigurationError(
            f"{where} is a single value ({node!r}) without keys (given: {override})",
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


def _with_choices_only(
    overrides: Sequence[str], declared: Primary, compose: Compose
) -> Mapping[str, Any]:
    choices = []
    for text in overrides:
        override = parse(text, {})
        generated = (override.value or "").startswith("{_target_:")  # an effect on a port
        if override.package or generated or override.key in declared.defaults:
            choices.append(text)
    try:
        return compose(choices)
    except Exception:  # the choices alone fail too: no keys to tell
        return {}
