"""Composes an experiment: overrides and YAML groups → one plain, resolved, checked mapping.

Hydra's compose API is used: no folder is made, no logging set up, no directory changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from trms_cli.composition.catalogue import (
    Primary,
    config_folder,
    make_importable,
    read_groups,
    read_primary,
)
from trms_cli.composition.interpolations import check_interpolations
from trms_cli.composition.overrides import Request, prepare, read_request
from trms_cli.composition.placed_choices import drop_foreign_keys
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import TARGET, nearest
from trms_cli.runs.run_folder import new_folder


@dataclass(frozen=True)
class Composition:
    """A composed experiment."""

    #: Plain data, interpolations resolved, every mandatory value given. Top-level keys and the keys
    #: of mappings that are no plugin are checked; a plugin's own are checked when built.
    config: dict[str, Any]
    overrides: tuple[str, ...]  #: What was typed; for a job of a sweep, the job's own
    choices: dict[str, Any]  #: The option chosen in each group (a list where several can be)
    config_dirs: tuple[Path, ...] = ()  #: The user's folders, already importable
    job: int | None = None  #: The number of the job in a sweep; None for a single run

    def folder(self, what: str) -> Path:
        """The folder to write into: a job's own in a sweep, else a new one (``out``, or dated)."""
        if self.job is not None:
            return Path(self.config["out"])
        return new_folder(self.config["out"], what)

    @cached_property
    def yaml(self) -> str:
        """The resolved configuration as a YAML document."""
        import yaml

        # The same text, by C code where PyYAML was built with it: five times as fast.
        dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
        options = {"sort_keys": False, "allow_unicode": True, "width": 100}
        return str(yaml.dump(self.config, Dumper=dumper, **options))


def compose(argv: Sequence[str] = (), primary: str = "run") -> Composition:
    """Compose one experiment from `argv`; ``-m`` and ``--cfg`` are a command's and refused here."""
    request = read_request(argv)
    if request.multirun or request.show:
        raise ConfigurationError(
            "one configuration is composed here",
            where="the command line",
            remedy="leave out -m and --cfg",
        )
    return compose_request(request, primary)


def compose_request(request: Request, primary: str) -> Composition:
    declared = read_primary(primary, request.config_dirs)
    groups = read_groups(request.config_dirs)
    overrides = prepare(request, declared, groups)
    make_importable(request.config_dirs)

    from trms_cli.composition.errors import explained

    def keys(fewer: Sequence[str]) -> Mapping[str, Any]:
        from omegaconf import OmegaConf

        content = OmegaConf.to_container(_hydra_compose(primary, fewer, request.config_dirs))
        assert isinstance(content, dict)
        return content  # type: ignore[return-value]

    with explained(overrides, declared, groups, keys):
        composed = _hydra_compose(primary, overrides, request.config_dirs)
        return finish(composed, declared, request)


def _hydra_compose(primary: str, overrides: Sequence[str], config_dirs: Sequence[Path]) -> Any:
    """The ``DictConfig`` with its ``hydra`` node, unresolved."""
    import hydra
    from omegaconf import OmegaConf

    from trms_cli.composition.hydra_folders import HYDRA_VERSION_BASE, user_folders

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
    content = OmegaConf.to_container(composed)
    assert isinstance(content, dict)
    check_interpolations({str(key): content[key] for key in content if key != "hydra"})
    return composed


def finish(composed: Any, declared: Primary, request: Request) -> Composition:
    """Take the ``hydra`` node off a composed ``DictConfig`` and check the rest."""
    from omegaconf import OmegaConf, open_dict

    choices = OmegaConf.to_container(composed.hydra.runtime.choices)
    assert isinstance(choices, dict)
    with open_dict(composed):
        del composed["hydra"]
    return checked(composed, declared, choices, request)


def checked(
    composed: Any,
    declared: Primary,
    choices: Mapping[Any, Any],
    request: Request,
    job: int | None = None,
) -> Composition:
    """Resolve a ``DictConfig`` and check it: nothing missing, no key that is not declared."""
    from omegaconf import OmegaConf

    drop_foreign_keys(composed, declared, choices, request.overrides, request.config_dirs)
    missing = sorted(OmegaConf.missing_keys(composed))
    if missing:
        raise ConfigurationError(
            f"{', '.join(missing)} must be given",
            where=missing[0],
            remedy=f"add {' '.join(f'{key}=…' for key in missing)}",
        )
    config = OmegaConf.to_container(composed, resolve=True)
    assert isinstance(config, dict)
    for group, option in declared.defaults.items():
        if isinstance(option, list):
            config.setdefault(group, {})
    _check_keys(config, declared)
    return Composition(
        {str(key): value for key, value in config.items()},
        request.overrides,
        _chosen(choices, declared, config),
        request.config_dirs,
        job,
    )


def _chosen(
    choices: Mapping[Any, Any], declared: Primary, config: Mapping[Any, Any]
) -> dict[str, Any]:
    """Hydra's record of choices without its own; where several can be, their names."""
    several = {
        group: list(config[group])
        for group, option in declared.defaults.items()
        if isinstance(option, list)
    }
    ours = {str(key): name for key, name in choices.items() if not str(key).startswith("hydra/")}
    return ours | several


def _check_keys(config: Mapping[Any, Any], declared: Primary) -> None:
    """Hydra's ``+`` and an experiment's YAML can add any key: refuse what is not declared."""
    allowed = {*declared.defaults, *declared.body}
    _refuse_unknown(config, allowed, "")
    for group, option in declared.defaults.items():
        if option is not None and config.get(group) is None:
            raise ConfigurationError(
                f"no {group} is chosen", where=group, remedy=f"`trms list {group}` tells which"
            )
    _check_nested(config, declared.body, "")


def _check_nested(config: Mapping[Any, Any], body: Mapping[str, Any], where: str) -> None:
    for key, default in body.items():
        if not isinstance(default, Mapping) or not default or TARGET in default:
            continue
        place = f"{where}.{key}" if where else key
        if not isinstance(config.get(key), Mapping):
            raise ConfigurationError(
                f"{config.get(key)!r} given",
                where=place,
                remedy=f"set its keys: {', '.join(f'{place}.{name}=…' for name in default)}",
            )
        _refuse_unknown(config[key], default, place)
        _check_nested(config[key], default, place)


def _refuse_unknown(given: Mapping[Any, Any], allowed: Any, where: str) -> None:
    for key, value in given.items():
        if key not in allowed:
            raise ConfigurationError(
                f"there is no key {str(key)!r} (given: {value!r})",
                where=f"{where}.{key}" if where else str(key),
                remedy=nearest(str(key), allowed),
            )
