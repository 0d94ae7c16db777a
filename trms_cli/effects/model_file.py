"""Model files: fitted parameters and diagnosed effects as a YAML that stands for a model.

``trms run model=fit.yaml`` takes one anywhere a built-in model is taken. The form is that of a
parameter set (:class:`trms_cli.models.parameters.ParameterFile`)::

    name: rig_7
    model: newtonian                 # an option of configs/model, which the values belong to
    parameters: {k_fvp: {value: 1.7e-5, unit: N*s^2, sd: 2.0e-7}, …}
    limits: {u_v: 2.5, …}
    effects:                         # optional: options of configs/effect, with their sizes
      yaw_coulomb_friction: {torque: 0.004}

The name of a built-in set may stand for all parameters: ``parameters: bench``.

An effect that is not in the library gives its class by ``_target_``, and all its arguments. So
does a model that is none of the options: ``model: {_target_: own_lab.OwnModel, …}``.

The network of :mod:`trms_cli.models.newtonian_with_network` stands under ``torque_network``.

A trained network stands for a model too, and so does a linear model; see
:mod:`trms_cli.models.narx_file` and :mod:`trms_cli.models.linear_file` for their forms.
"""

import re
from collections.abc import Iterator, Mapping
from typing import Any

from trms_cli.core.errors import ModelError, TrmsError
from trms_cli.core.plugins import TARGET, build, nearest, require_known
from trms_cli.core.resources import config_folder
from trms_cli.effects.effect import Effect
from trms_cli.effects.extended_model import extend_model
from trms_cli.models import linear_file, narx_file
from trms_cli.models.black_box import kind_of_file
from trms_cli.models.model import Model
from trms_cli.models.newtonian_with_network import KEY as TORQUE_NETWORK
from trms_cli.models.newtonian_with_network import NewtonianWithNetwork
from trms_cli.models.parameters import ParameterFile, ParameterSet, check_limits, parameter_file

#: Kinds of black box, and the key by which a file of each is known.
_BLACK_BOXES = {narx_file.KIND: "network", linear_file.KIND: "state_space"}
#: Of an option: what leads elsewhere names no file of ours.
_PLAIN_NAME = re.compile(r"[\w+-]{1,100}")


def load_model(
    path: str,
    parameters: Mapping[str, float | Mapping[str, float]] | None = None,
    rig: Model | None = None,
) -> Model:
    """The model that a file describes, with its effects.

    ``path``: a YAML file. ``parameters``: other values for some parameters (``k_fvp``) or sizes
    (``yaw_coulomb_friction.torque``, or nested as a command line has it). ``rig``: what a run
    simulates in the place of the model; it means nothing here.

    Raises ConfigurationError if there is no such file, or ``parameters`` names none or is out of
    range. Raises ModelError if the file's content does not fit; it names the file and the key.
    """
    kind = kind_of_file(path, _BLACK_BOXES)
    if kind == narx_file.KIND:
        network = narx_file.read_narx_file(path)
        model: Model = narx_file.narx_of(network, path)
        described: Mapping[str, Mapping[str, Any]] = network.effects
    elif kind == linear_file.KIND:
        linear = linear_file.read_linear_file(path)
        model, described = linear_file.linear_of(linear, path), linear.effects
    else:
        content = parameter_file(path, where="model.path")
        model = _nominal(content, path)
        _check_parameters(content, model, path)
        if content.torque_network and not isinstance(model, NewtonianWithNetwork):
            raise ModelError(
                f"model {content.model!r} has no place for a network",
                where=f"{path}: {TORQUE_NETWORK}",
                remedy=f"model: {NewtonianWithNetwork.OPTION}, or leave the network out",
            )
        # A model with a locked axis keeps the limits of the whole rig in its file.
        limit_names = {*model.input_limits, *model.stops, "u_v", "u_h", "alpha_v", "alpha_h"}
        check_limits(content.limits, limit_names, f"{path}: limits")
        described = content.effects
    effects = {
        name: _effect(name, sizes, f"{path}: effects.{name}") for name, sizes in described.items()
    }
    try:
        model = extend_model(model, effects)
    except TrmsError as error:
        raise _of_file(error, f"{path}: effects") from error
    if parameters:
        values = dict(_flat(parameters))
        model.parameters = model.parameters.replaced(values, where="model.parameters")
    return model


def _flat(
    values: Mapping[str, float | Mapping[str, float]], prefix: str = ""
) -> Iterator[tuple[str, float]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _nominal(content: ParameterFile, path: str) -> Model:
    """The model with the file's parameters."""
    where = f"{path}: model"
    if not isinstance(content.model, str):
        return _plugin(content, content.model, where)
    node = dict(_option("model", content.model, where))
    if "parameter_set" not in node:
        raise ModelError(
            f"{content.model!r} does not take its parameters from a file",
            where=where,
            remedy=nearest("", _parametric_models()),
        )
    node["parameter_set"] = path
    return _built(node, where, content.parameters, content.model)


def _plugin(content: ParameterFile, node: Mapping[str, Any], where: str) -> Model:
    """A model that is no option, with what the file says of its parameters."""
    model = _built(node, where, content.parameters, node.get(TARGET))
    file_parameters = {parameter.name: parameter for parameter in content.parameter_set()}
    for name in file_parameters:
        problem = f"model {model.name!r} has no parameter {name!r}"
        place = f"{where.removesuffix('model')}parameters.{name}"
        require_known(name, model.parameters.names, problem, place, ModelError)
    model.parameters = ParameterSet(
        (file_parameters.get(parameter.name, parameter) for parameter in model.parameters),
        content.name,
    )
    return model


def _built(
    node: Mapping[str, Any], where: str, parameters: Mapping[str, Any], name: object
) -> Model:
    try:
        model = build(node, where)
    except KeyError as error:
        raise ModelError(
            f"parameter {error} is missing",
            where=where.replace(": model", ": parameters"),
            remedy=f"the file gives: {', '.join(parameters)}",
        ) from None
    except TrmsError as error:
        raise _of_file(error, where) from error
    if not isinstance(model, Model):
        raise ModelError(f"{name!r} is not a model", where=where)
    return model


def _check_parameters(content: ParameterFile, model: Model, path: str) -> None:
    """Refuse parameters that are not those of the built-in model, or out of range."""
    if isinstance(content.model, str):
        option = _option("model", content.model, path)
        reference = build(option, path).parameters
        # A set may serve several models: what its kin has and this one does not, it may give.
        shared = parameter_file(option["parameter_set"]).parameters
        for name in content.parameters:
            if name not in reference and name not in shared:
                raise ModelError(
                    f"model {content.model!r} has no parameter {name!r}",
                    where=f"{path}: parameters.{name}",
                    remedy=nearest(name, reference.names),
                )
        for name in reference.names:
            if name not in model.parameters:
                raise ModelError(
                    "the parameter is missing",
                    where=f"{path}: parameters.{name}",
                    remedy=f"give its value in {reference[name].unit or '1'}, "
                    f"for instance {reference[name].value:g}",
                )
    for parameter in model.parameters:
        if not parameter.lower <= parameter.value <= parameter.upper:  # also refuses NaN
            raise ModelError(
                f"{parameter.value!r} given",
                where=f"{path}: parameters.{parameter.name}",
                remedy=f"give a number from {parameter.lower:g} to {parameter.upper:g}",
            )


def _effect(name: str, sizes: Mapping[str, Any], where: str) -> Effect:
    if TARGET in sizes:
        node = dict(sizes)
    else:
        node = dict(_option("effect", name, where).get(name, {}))
        size_names = [key for key in node if key != TARGET]
        for key in sizes:
            problem = f"effect {name!r} has no size {key!r}"
            require_known(key, size_names, problem, f"{where}.{key}", ModelError)
        node |= sizes
    try:
        effect = build(node, where)
    except TrmsError as error:
        raise _of_file(error, where) from error
    if not isinstance(effect, Effect):
        raise ModelError(f"{node[TARGET]!r} is not an effect", where=f"{where}.{TARGET}")
    return effect


def _option(group: str, name: str, where: str) -> dict[str, Any]:
    """The content of a built-in YAML, as plain data."""
    from trms_cli.core.yaml_data import load_yaml

    folder = config_folder() / group
    path = folder / f"{name}.yaml"
    if name == "from_file" or not _PLAIN_NAME.fullmatch(name) or not path.is_file():
        options = {option.stem for option in folder.glob("*.yaml")} - {"from_file"}
        raise ModelError(
            f"there is no {group} {name!r}", where=where, remedy=nearest(name, options)
        )
    return dict(load_yaml(path.read_bytes()))


def _parametric_models() -> list[str]:
    folder = config_folder() / "model"
    names = [option.stem for option in folder.glob("*.yaml") if option.stem != "from_file"]
    return [name for name in names if "parameter_set" in _option("model", name, "")]


def _of_file(error: TrmsError, where: str) -> ModelError:
    """A plugin's complaint as one about the file."""
    place = error.where if error.where.startswith(where) else where
    return ModelError(error.problem, where=place, remedy=error.remedy)
