"""Parameters as data: name, value, unit, prior, bounds, source."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.core.data_file import read_bytes
from trms_cli.core.errors import ConfigurationError, ModelError
from trms_cli.core.plugins import nearest, require_known
from trms_cli.core.resources import config_folder

#: Draws from a prior stay within this many standard deviations, so that a mass or a resistance
#: keeps its sign.
DRAW_LIMIT_SD = 2.5
_NONE_TO_SET = (
    "this model has none (the weights of a network are constants): choose one with equations, as "
    "newtonian, for model or model@plant.model"
)


@dataclass(frozen=True)
class Parameter:
    """One physical constant of a model."""

    name: str
    value: float  #: In SI units (``unit``)
    unit: str = ""
    #: Standard deviation of the prior relative to the value; None for a constant that is known
    prior_sd: float | None = None
    lower: float = -np.inf  #: Hard bounds, in the same unit
    upper: float = np.inf  #: Hard bounds, in the same unit
    source: str = ""
    description: str = ""
    #: Range that rigs of this kind span, in the same unit, where the value itself says nothing of a
    #: prior: an effect may be absent, with a size of zero
    typical: tuple[float, float] | None = None


class ParameterSet:
    """Parameters in a fixed order, by name.

    Iterating gives the :class:`Parameter` objects; ``values`` is the vector that a model's
    functions take as ``p``.
    """

    def __init__(self, parameters: Iterable[Parameter], name: str = "") -> None:
        self._by_name = {parameter.name: parameter for parameter in parameters}
        self.name = name

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self._by_name.values())

    def __len__(self) -> int:
        return len(self._by_name)

    def __contains__(self, name: str) -> bool:
        return name in self._by_name

    def __getitem__(self, name: str) -> Parameter:
        return self._by_name[name]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._by_name)

    @property
    def values(self) -> FloatArray:
        """Values in order, shape (n_p,)."""
        return np.array([parameter.value for parameter in self], dtype=float)

    def replaced(self, values: Mapping[str, float], where: str = "parameters") -> ParameterSet:
        """The same set with other values for some names.

        Raises ConfigurationError for a name that the set does not have, or a value that is not a
        finite number.
        """
        changed = dict(self._by_name)
        for name, value in values.items():
            key = f"{where}.{name}"
            if name not in changed:
                raise ConfigurationError(
                    f"unknown parameter {name!r} (given: {value!r})",
                    where=key,
                    remedy=nearest(name, changed) if changed else _NONE_TO_SET,
                )
            old = changed[name]
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise ConfigurationError(
                    f"{value!r} given", where=key, remedy=f"give a number in {old.unit or '1'}"
                )
            if not np.isfinite(value) or not old.lower <= value <= old.upper:
                raise ConfigurationError(
                    f"{value!r} given",
                    where=key,
                    remedy=f"give a finite number{_range_of(old)} in {old.unit or '1'}",
                )
            changed[name] = replace(old, value=float(value))
        return ParameterSet(changed.values(), self.name)

    def draw(self, seed: int, scale: float = 1.0) -> ParameterSet:
        """A draw from the priors: ``value·(1 + scale·prior_sd·n)``, n normal and truncated.

        ``scale``: multiplies every prior standard deviation.
        """
        generator = np.random.default_rng(seed)
        draws = []
        for parameter in self:
            # One number is drawn for each parameter, with or without a prior, so that adding a
            # prior to one does not change the draw of another.
            normal = float(np.clip(generator.standard_normal(), -DRAW_LIMIT_SD, DRAW_LIMIT_SD))
            spread = (parameter.prior_sd or 0.0) * scale
            value = parameter.value * (1.0 + spread * normal)
            draws.append(
                replace(parameter, value=float(np.clip(value, parameter.lower, parameter.upper)))
            )
        return ParameterSet(draws, self.name)

    def concatenate(self, others: Iterable[Parameter]) -> ParameterSet:
        """This set followed by further parameters."""
        return ParameterSet([*self, *others], self.name)


def _range_of(parameter: Parameter) -> str:
    low, high = np.isfinite(parameter.lower), np.isfinite(parameter.upper)
    words = [f"at least {parameter.lower:g}"] * bool(low) + [f"at most {parameter.upper:g}"] * bool(
        high
    )
    return ", " + " and ".join(words) + "," if words else ""


#: Keys of a parameter file that are text whatever stands there.
_TEXTS = ("name", "source")


class _Entry(msgspec.Struct, forbid_unknown_fields=True):
    value: float
    unit: str = ""
    prior_sd: float | None = None
    lower: float = -np.inf
    upper: float = np.inf
    source: str = ""
    description: str = ""
    sd: float | None = None  # a fitted parameter's standard deviation, absolute


class ParameterFile(msgspec.Struct, forbid_unknown_fields=True):
    """The content of a parameter or model file; a model of one's own stands there as a plugin."""

    name: str
    model: str | dict[str, Any]
    parameters: dict[str, _Entry]
    limits: dict[str, float] = {}
    effects: dict[str, dict[str, Any]] = {}
    #: Of :mod:`trms_cli.models.newtonian_with_network`, which reads it
    torque_network: dict[str, Any] = {}
    source: str = ""

    def require(self, names: Iterable[str], sets: str) -> None:
        """Refuse a set that lacks one of a model's own parameters.

        Raises ModelError; ``sets``: those that have them.
        """
        if not self.parameters.keys() >= set(names):
            raise ModelError(
                f"the set {self.name!r} belongs to model {self.model!r}, whose equations are "
                "others",
                where="model.parameter_set",
                remedy=f"choose {sets}, or model={self.model}",
            )

    def parameter_set(self) -> ParameterSet:
        return ParameterSet(
            (
                Parameter(
                    name,
                    entry.value,
                    entry.unit,
                    entry.prior_sd,
                    entry.lower,
                    entry.upper,
                    entry.source or self.source,
                    entry.description,
                )
                for name, entry in self.parameters.items()
            ),
            self.name,
        )


def check_limits(limits: Mapping[str, float], valid_names: Collection[str], where: str) -> None:
    """Refuse limits of no input or angle, and such as are not above zero.

    Raises ModelError with the key, under ``where``.
    """
    for name, limit in limits.items():
        key = f"{where}.{name}"
        require_known(name, valid_names, f"there is no input or angle {name!r}", key, ModelError)
        if not limit > 0:
            raise ModelError(f"{limit!r} given", where=key, remedy="give a positive number")


def parameter_file(name_or_path: str, where: str = "model.parameter_set") -> ParameterFile:
    """Read a parameter set: a built-in one by name, or a YAML file by path.

    Raises ConfigurationError if there is no such set, or the file's content is not of the
    documented form.
    """
    what = ("parameters", "parameter set", "YAML file")
    path, text = read_named(name_or_path, where, *what, " with name, model and parameters")
    return parse_parameter_file(text, str(path))


def read_named(
    name_or_path: str, where: str, folder: str, what: str, kind: str, content: str = ""
) -> tuple[Path, bytes]:
    """The file of a name, in a folder that travels with the program, or at a path; what it holds.

    Raises ConfigurationError if there is none, or it cannot be read.
    """
    from trms_cli.core.yaml_data import MOST_BYTES

    path = Path(name_or_path).expanduser()
    if path.suffix not in (".yaml", ".yml"):
        path = config_folder() / folder / f"{name_or_path}.yaml"
        if not path.exists():
            ours = nearest(name_or_path, (file.stem for file in path.parent.glob("*.yaml")))
            raise ConfigurationError(
                f"there is no {what} {name_or_path!r}",
                where=where,
                remedy=f"{ours}, or the path of a {kind}",
            )
    try:
        return path, read_bytes(path, MOST_BYTES)
    except OSError as error:
        raise ConfigurationError(
            f"cannot read {str(path)!r}: {error.strerror}",
            where=where,
            remedy=f"give the path of a {kind}{content}",
        ) from error


def parse_parameter_file(text: str | bytes, source: str) -> ParameterFile:
    """Check the text of a parameter file.

    Where a set's name stands in the place of parameters, they are that set's, and so are the limits
    unless the file has its own.

    Raises ModelError with the place in the file. Raises ConfigurationError for a set that there is
    not.
    """
    import yaml

    try:
        # A copy: what is kept stays as it was read.
        content: Any = deepcopy(_content_of(text))
        if isinstance(content, dict) and isinstance(content.get("parameters"), str):
            return _with_values_of(content, source)
        return msgspec.convert(content, ParameterFile)
    except yaml.YAMLError as error:
        raise ModelError(
            f"not valid YAML: {str(error).splitlines()[0]}",
            where=source,
            remedy="compare it with what `trms list parameters bench` prints",
        ) from error
    except msgspec.ValidationError as error:
        raise ModelError(
            str(error),
            where=source,
            remedy="a model file has name, model, parameters: {NAME: {value, unit, …}}, limits",
        ) from None


def _with_values_of(content: dict[str, Any], source: str) -> ParameterFile:
    """A file that names a built-in set in the place of parameters."""
    name, where = content["parameters"], f"{source}: parameters"
    known = [file.stem for file in (config_folder() / "parameters").glob("*.yaml")]
    require_known(name, known, f"there is no parameter set {name!r}", where)
    values = parameter_file(name)
    own = msgspec.convert(content | {"parameters": {}}, ParameterFile)
    return msgspec.structs.replace(
        own,
        parameters=values.parameters,
        limits=own.limits or values.limits,
        source=own.source or values.source,
    )


@lru_cache(maxsize=16)
def _content_of(text: str | bytes) -> object:
    """The content of a parameter file's text as plain data; a process reads few of them, often."""
    from trms_cli.core.yaml_data import load_yaml

    content = load_yaml(text)
    if isinstance(content, dict):
        # A rig may be called 7, or 1e5.
        return {k: str(v) if k in _TEXTS else _numbers(v) for k, v in content.items()}
    return content


def _numbers(node: object) -> object:
    """YAML 1.1 reads ``1e-5`` as text; everyone who writes it means a number."""
    if isinstance(node, dict):
        return {key: _numbers(value) for key, value in node.items()}
    if isinstance(node, str):
        try:
            return float(node)
        except ValueError:
            return node
    return node
