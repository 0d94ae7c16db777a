"""Network files: a trained NARX model as YAML, which ``model=PATH`` takes as any model file.

::

    name: narx_2dof
    model: narx
    source: trained on …                  # a line on how, and on what
    rig: newtonian                        # optional: option of configs/model that a run simulates
    limits: {u_v: 2.5, u_h: 2.5, alpha_v: 1.05, alpha_h: 2.8}
    structure: {outputs: [alpha_v, …], output_lags: [1, 2], sample_time: 0.02, …}
    network: {kind: mlp, regressor_mean: […], …, weights: {W1: [[…]], …}}
    training: {…}                         # optional: a record of the training, of any form
    effects: {…}                          # optional, as in every model file

Networks that travel with the program are in ``configs/networks`` and go by their name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from trms_cli.core.data_file import read_bytes
from trms_cli.core.errors import ConfigurationError, ModelError, TrmsError
from trms_cli.core.plugins import nearest
from trms_cli.core.resources import config_folder
from trms_cli.models.model import Model
from trms_cli.models.narx import Narx
from trms_cli.models.network import NarxStructure, Network

#: Value of ``model`` in a network file.
KIND = "narx"
_REQUIRED = ("name", "model", "structure", "network")
_OPTIONAL = ("source", "rig", "limits", "training", "effects")


@dataclass(frozen=True, kw_only=True, eq=False)
class NarxFile:
    """The content of a network file."""

    name: str
    structure: NarxStructure
    network: Network
    #: Bounds by input, and mechanical stops by angle (rad)
    limits: Mapping[str, float] = field(default_factory=dict)
    source: str = ""  #: How the network was trained, and on what
    #: Option of ``configs/model`` with the rig that it was trained on; empty for none
    rig: str = ""
    #: A record of the training, plain data
    training: Mapping[str, Any] = field(default_factory=dict)
    #: Options of ``configs/effect`` by name, with their sizes
    effects: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def model(self) -> Narx:
        """The model.

        Raises ModelError if structure, network and limits do not fit together.
        """
        return Narx(self.structure, self.network, name=KIND, limits=self.limits)

    def to_data(self) -> dict[str, Any]:
        """Plain data for the YAML; what is empty is left out."""
        data: dict[str, Any] = {"name": self.name, "model": KIND}
        for key in ("source", "rig", "limits", "effects"):
            if getattr(self, key):
                value = getattr(self, key)
                data[key] = value if isinstance(value, str) else dict(value)
        data |= {"structure": self.structure.to_data(), "network": self.network.to_data()}
        if self.training:
            data["training"] = dict(self.training)
        return data


def narx(*, network: str, rig: Model | None = None) -> Narx:
    """The NARX model of a network.

    Parameters
    ----------
    network : str
        A network that travels with the program, by name, or the path of a network file.
    rig : Model, optional
        The rig that it was trained on. A run simulates it in the place of the network; to the
        model itself it means nothing.

    Raises
    ------
    ConfigurationError
        If there is no such network.
    ModelError
        For a file that does not hold one; it names the file and the key.
    """
    content = read_narx_file(network, where="model.network")
    return narx_of(content, network)


def narx_of(content: NarxFile, path: str) -> Narx:
    """The model of a network file, with complaints by the file's keys."""
    try:
        return content.model()
    except TrmsError as error:
        raise ModelError(
            error.problem, where=f"{path}: {error.where}", remedy=error.remedy
        ) from error


def read_narx_file(name_or_path: str, where: str = "model.path") -> NarxFile:
    """Read a network: one that travels with the program by name, or a file by path.

    Raises
    ------
    ConfigurationError
        If there is none.
    ModelError
        If the content is not of the documented form; it names the file and the key.
    """
    path = Path(name_or_path).expanduser()
    if path.suffix not in (".yaml", ".yml"):
        folder = config_folder() / "networks"
        path = folder / f"{name_or_path}.yaml"
        if not path.exists():
            raise ConfigurationError(
                f"there is no network {name_or_path!r}",
                where=where,
                remedy=nearest(name_or_path, (file.stem for file in folder.glob("*.yaml")))
                + ", or the path of a network file",
            )
    data = _plain(path, where)
    shown = name_or_path
    for key in _REQUIRED:
        if key not in data:
            raise ModelError(
                f"key {key!r} is missing",
                where=shown,
                remedy=f"a network file has {', '.join(_REQUIRED)}, and may have "
                f"{', '.join(_OPTIONAL)}",
            )
    for key in data:
        if key not in (*_REQUIRED, *_OPTIONAL):
            raise ModelError(
                f"unknown key {key!r}",
                where=f"{shown}: {key}",
                remedy=nearest(str(key), (*_REQUIRED, *_OPTIONAL)),
            )
    if data["model"] != KIND:
        raise ModelError(
            f"{data['model']!r} given", where=f"{shown}: model", remedy=f"a network is a {KIND!r}"
        )
    return NarxFile(
        name=str(data["name"]),
        structure=NarxStructure.from_data(data["structure"], f"{shown}: structure"),
        network=Network.from_data(data["network"], f"{shown}: network"),
        limits=_numbers(data, "limits", shown),
        source=str(data.get("source") or ""),
        rig=str(data.get("rig") or ""),
        training=_mapping(data, "training", shown),
        effects=_mapping(data, "effects", shown),
    )


def is_network_file(path: str) -> bool:
    """Whether a file that can be read says that it holds a network."""
    try:
        data = _plain(Path(path).expanduser(), "model.path")
    except TrmsError:
        return False
    return data.get("model") == KIND or "network" in data


def write_narx_file(path: Path, content: NarxFile) -> None:
    """Write a network file; read back, every weight has its bits."""
    import yaml

    text = yaml.dump(
        content.to_data(),
        Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper),
        sort_keys=False,
        allow_unicode=True,
        default_flow_style=None,
        width=100,
    )
    path.write_text(text, encoding="utf-8")


def _plain(path: Path, where: str) -> dict[str, Any]:
    import yaml

    from trms_cli.core.yaml_data import MOST_BYTES, load_yaml

    try:
        data = load_yaml(read_bytes(path, MOST_BYTES))
    except OSError as error:
        raise ConfigurationError(
            f"cannot read {str(path)!r}: {error.strerror}",
            where=where,
            remedy="give the path of a network file",
        ) from error
    except yaml.YAMLError as error:
        raise ModelError(
            f"not valid YAML: {str(error).splitlines()[0]}",
            where=str(path),
            remedy="compare it with configs/networks/narx_2dof.yaml",
        ) from error
    if not isinstance(data, dict):
        raise ModelError("not a mapping", where=str(path), remedy=f"give {', '.join(_REQUIRED)}")
    return data


def _mapping(data: Mapping[str, Any], key: str, shown: str) -> dict[str, Any]:
    value = data.get(key) or {}
    if not isinstance(value, dict):
        raise ModelError(f"{value!r} given", where=f"{shown}: {key}", remedy="give a mapping")
    return value


def _numbers(data: Mapping[str, Any], key: str, shown: str) -> dict[str, float]:
    values = {}
    for name, value in _mapping(data, key, shown).items():
        try:
            values[str(name)] = float(value)
        except (TypeError, ValueError):
            raise ModelError(
                f"{value!r} given", where=f"{shown}: {key}.{name}", remedy="give a number"
            ) from None
    return values
