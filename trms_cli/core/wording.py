"""Numbers, intervals, units and names as a person reads them, the same on screen and page.

Each value has one way of being written: three digits, a true minus, a dash for what does not
exist, ``N m`` for ``N*m``, *pitch* for ``alpha_v``.
"""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from types import MappingProxyType
from typing import Any

MISSING = "–"

#: What the channels of the twin rotor are called in words.
SIGNALS = MappingProxyType(
    {
        "alpha_v": "pitch",
        "alpha_h": "yaw",
        "omega_v": "main rotor",
        "omega_h": "tail rotor",
        "u_v": "main rotor",
        "u_h": "tail rotor",
    }
)
_LETTERS = MappingProxyType({"alpha": "α", "omega": "ω", "tau": "τ", "psi": "ψ", "phi": "φ"})
#: Units in which figures of this rig have few digits, and the factors to them.
_SMALL_UNITS = {u: (f"m{u}", 1e3) for u in ("rad", "N*m", "N", "m")}
_SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
_PROPER = (("coulomb", "Coulomb"), ("stribeck", "Stribeck"))


def number(value: float | int | None, digits: int = 3, *, sd: float | None = None) -> str:
    """A number with a few digits; a dash for None and NaN.

    Parameters
    ----------
    value : float, int or None
        Whole numbers are written out.
    digits : int
        Significant digits.
    sd : float or None
        Standard deviation, to whose second digit the value is then written: at least `digits`,
        at most six.
    """
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return MISSING
    if isinstance(value, float):
        if math.isinf(value):
            return "∞" if value > 0 else "−∞"
        significant_digits = _known_digits(value, sd, digits)
        if value != 0 and not 1e-3 <= abs(value) < 1e5:
            return f"{value:.{significant_digits - 1}e}".replace("-", "−").replace("e+", "e")
        if significant_digits > digits:  # the zeros at the end are known ones
            text = f"{value:#.{significant_digits}g}".rstrip(".")
        else:
            whole = abs(value) >= 10**digits
            text = f"{value:.0f}" if whole else f"{value:.{digits}g}"
        return text.replace("-", "−")
    return str(value).replace("-", "−")


def _known_digits(value: float, sd: float | None, digits: int) -> int:
    """Digits down to the second one of a standard deviation, at most six."""
    if not value or not sd or not math.isfinite(sd):
        return digits
    significant_digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(sd)) + 2
    return min(max(significant_digits, digits), 6)


def cell(value: str | float | int | None, sd: float | None = None) -> str:
    """What stands in a cell of a table: text as it is, numbers as of :func:`number`."""
    return value if isinstance(value, str) else number(value, sd=sd)


def unit(text: str) -> str:
    """A unit as it is printed: ``N*m*s^2`` as ``N m s²``; nothing for ``1``."""
    if text in ("", "1"):
        return ""
    raised = re.sub(r"(?:\^|\*\*)(-?\d+)", lambda m: m[1].translate(_SUPERSCRIPTS), text)
    return raised.replace("*", " ")


def small_unit(text: str) -> tuple[str, float]:
    """A unit in which errors and small forces have few digits, and the factor to it: mrad, mN m."""
    return _SMALL_UNITS.get(text, (text, 1.0))


def quantity(value: float | int | None, unit_text: str, digits: int = 3) -> str:
    """A number with its unit."""
    return f"{number(value, digits)} {unit(unit_text)}".rstrip()


def with_unit(label: str, unit_text: str = "") -> str:
    """The head of a column or an axis: ``RMSE [rad]``."""
    symbol = unit(unit_text)
    return f"{label} [{symbol}]" if symbol else label


def percent(share: float | None, decimals: int = 0) -> str:
    """A share in per cent, never rounded up to all or down to nothing."""
    if share is None or math.isnan(share):
        return MISSING
    value, step = 100 * share, 10.0**-decimals
    if share < 1 and round(value, decimals) >= 100:
        return f"over {100 - step:.{decimals}f} %"
    if share > 0 and round(value, decimals) == 0:
        return f"under {step:.{decimals}f} %"
    # a little below nothing is nothing
    return f"{round(value, decimals) + 0.0:.{decimals}f} %".replace("-", "−")


def interval(low: float, high: float, unit_text: str = "", digits: int = 3) -> str:
    """Two ends: ``0.12 to 0.15 rad``."""
    return f"{number(low, digits)} to {quantity(high, unit_text, digits)}"


def percent_interval(low: float, high: float, decimals: int = 0) -> str:
    """An interval of a share: ``18 to 46 %``."""
    return f"{percent(low, decimals).removesuffix(' %')} to {percent(high, decimals)}"


def gap_share(
    share: float, ends: tuple[float, float] | None = None, of: str = "", where: str = ""
) -> str:
    """A share of a gap: ``91 %``; with `ends` and `of`, ``91 % of the gap (86 to 94 %)``.

    ``where``: what the interval is of, told behind it.

    An estimate beyond all of the gap is no more than all of it. An interval that says the same as
    the share is left out.
    """
    text = "none: it grows" if share <= -1 else percent(min(share, 1.0))
    spread = text if ends is None else gap_interval(ends)
    interval = f" ({spread} {where}".rstrip() + ")"
    return f"{text} {of}".rstrip() + (interval if spread != text else "")


def gap_interval(ends: tuple[float, float]) -> str:
    """The interval of a share of a gap: ``86 to 94 %``; one figure where both ends read alike."""
    low, high = (min(end, 1.0) for end in ends)
    if low < -1.0:  # the model without the correction was close to the floor by chance
        return f"up to {percent(high)}"
    if percent(low) == percent(high):
        return percent(low)
    return percent_interval(low, high)


def listing(names: Sequence[str], word: str = "and", most: int | None = None) -> str:
    """Names as prose lists them: ``a, b and c``; beyond `most`, how many more there are."""
    entries = list(names)
    if most is not None and len(entries) > most:
        entries = [*entries[:most], f"{len(entries) - most} more"]
    if len(entries) < 2:
        return "".join(entries)
    return f"{', '.join(entries[:-1])} {word} {entries[-1]}"


def count(amount: int, noun: str, plural: str = "") -> str:
    """``1 step``, ``2 steps``, ``no step``."""
    if amount == 1:
        return f"1 {noun}"
    return f"{amount or 'no'} {plural or noun + 's' if amount else noun}"


def signal(name: str) -> str:
    """What a channel is called in words: ``alpha_v`` is pitch; others keep their name."""
    return SIGNALS.get(name, name)


def symbol(name: str) -> str:
    """A channel with its Greek letter: ``alpha_v`` as ``α_v``."""
    first, _, rest = name.partition("_")
    letter = _LETTERS.get(first, first)
    return f"{letter}_{rest}" if rest else letter


def readable(name: str) -> str:
    """A plugin's name as prose has it: ``yaw_coulomb_friction`` as yaw Coulomb friction."""
    words = name.replace("_", " ")
    for plain, proper in _PROPER:
        words = words.replace(plain, proper)
    return words


def seconds(value: float) -> str:
    """A duration: ``820 ms``, ``12.3 s``, ``4 min 10 s``, ``2 h 05 min``."""
    if value < 1:
        return f"{1e3 * value:.3g} ms"
    if value < 60:
        return f"{value:.3g} s"
    minutes, rest = divmod(round(value), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def option(choice: object, node: object = None) -> str:
    """What the option of a group is called: a model of a file by its file, or the fit's folder.

    Parameters
    ----------
    choice : object
        As a configuration has it: ``newtonian``, ``from_file``; several are joined.
    node : object
        The group's part of the configuration, which names the file: ``fit/model.yaml`` is *fit*,
        ``diagnosis/corrected_model.yaml`` *diagnosis corrected*.
    """
    if isinstance(choice, list | tuple):
        return ", ".join(map(str, choice))
    path = node.get("path") if isinstance(node, Mapping) else None
    if choice != "from_file" or not isinstance(path, str):
        return "none" if choice is None else str(choice)
    file = PurePath(path)
    kind = file.stem.removesuffix("model").rstrip("_")
    folder = file.parent.name
    if file.stem.endswith("model") and folder not in ("", ".", ".."):
        return f"{folder} {kind}".rstrip()
    return file.stem


def model_name(text: str) -> str:
    """What a model is called that was asked for as `text`: an option, or a file."""
    return option("from_file", {"path": text}) if text.endswith((".yaml", ".yml")) else text


def file_stem(text: str) -> str:
    """A name as part of a file's: letters, digits, ``_`` and ``-``."""
    return re.sub(r"[^\w-]+", "_", text).strip("_")


_FILE = "from_file"
_SIMULATED = ("simulated", "ideal")
#: Groups that say which equations a simulated rig has, the first that does.
_OF_RIG = ("model@plant.model", "model@model.rig", "model")
_NOBODY = ("", "none")
#: Parameters of a rig's own that are named; of more their number is told.
_MOST_VALUES = 2


def plant_name(choices: Mapping[str, str], own: str = "") -> str:
    """``simulated (newtonian)``: the plant and, of a simulated rig, its equations.

    Those of the model, unless ``model@plant.model`` names others, or the model, a network, has a
    rig (``model@model.rig``). ``choices``: as :func:`choice_labels` gives them. ``own``: what the
    model of a user's own plant calls itself; "" if it is not known.
    """
    plant = choices.get("plant", "")
    rig = next((name for group in _OF_RIG if (name := choices.get(group, "")) not in _NOBODY), "")
    rig = rig if plant in _SIMULATED else own
    return f"{plant} ({rig})" if rig else plant


def plant_in_full(choices: Mapping[str, str], plant: object = None, own: str = "") -> str:
    """``simulated (newtonian + yaw_coulomb_friction, prior_seed 3)``: with what is not the model's.

    ``choices``, ``own``: as for :func:`plant_name`. ``plant``: the plant's part of the
    configuration, which says where its parameters are its own.
    """
    name = plant_name(choices, own)
    effects = choices.get("effect", "")
    extras = [] if effects in _NOBODY else effects.split(", ")
    parameters = _own_parameters(plant if isinstance(plant, Mapping) else {})
    if not name.endswith(")"):  # nothing is known of its equations
        return f"{name} ({', '.join([*extras, *parameters])})" if extras or parameters else name
    equations = " + ".join([name.removesuffix(")"), *extras])
    return f"{', '.join([equations, *parameters])})"


def _own_parameters(plant: Mapping[str, Any]) -> list[str]:
    """How a rig's parameters differ from those of its equations, in a few words."""
    values, seed = plant.get("parameters"), plant.get("prior_seed")
    words = [] if seed is None else [f"prior_seed {seed}"]
    if isinstance(values, Mapping) and values:
        plain = len(values) <= _MOST_VALUES and not any(
            isinstance(v, Mapping) for v in values.values()
        )
        named = [f"{name} {value}" for name, value in values.items()]
        words += named if plain else [count(len(values), "own parameter")]
    return words


def headline(
    choices: Mapping[str, str], *, follows: bool = True, rig: str = "", plant: object = None
) -> str:
    """``lqr · ref square · observer ukf · model fit · plant simulated (newtonian)``.

    Which model controller and observer believe, and which plant acts. ``choices``: as
    :func:`choice_labels` gives them. ``follows``: whether the controller follows a reference.
    ``rig``: what the model of a user's own plant calls itself; "" if it is not known. ``plant``:
    as for :func:`plant_in_full`.
    """
    parts = [choices.get("controller", "")]
    parts += [f"ref {choices.get('ref', '')}"] if follows else []
    parts += [f"{group} {choices.get(group, '')}" for group in ("observer", "model")]
    parts.append(f"plant {plant_in_full(choices, plant, rig)}")
    faults = choices.get("fault", "")
    parts += [] if faults in _NOBODY else [f"fault {faults}"]
    return " · ".join(parts)


def choice_labels(choices: Mapping[str, Any], config: Mapping[str, Any] | str) -> dict[str, str]:
    """The option of each group as it is called; a model of a file by its file or fit.

    ``choices``: the option chosen in each group, as a log has them. ``config``: the resolved
    configuration, or its YAML, which is read only where it is needed.
    """
    node: Any = config
    if isinstance(config, str):
        from trms_cli.core.yaml_data import mapping_in

        node = mapping_in(config) if _FILE in choices.values() else {}
    return {
        str(group): option(choice, _node(node, str(group))) if choice else ""
        for group, choice in choices.items()
    }


def named_files(choices: Mapping[str, Any], config: Mapping[str, Any] | str) -> dict[str, Any]:
    """The options as a log has them, but each model of a file by its name."""
    labels = choice_labels(choices, config) if _FILE in choices.values() else {}
    return {
        group: labels[group] if choice == _FILE else choice for group, choice in choices.items()
    }


def typed_models(choices: Mapping[str, Any], typed: Mapping[str, Any]) -> dict[str, str]:
    """What the models of files are called of a job that left no log: by the paths typed for them.

    ``choices``: the option of each group. ``typed``: what was typed, by its key.
    """
    return {key: model_name(path) for key, path in typed_files(choices, typed).items()}


def typed_files(choices: Mapping[str, Any], typed: Mapping[str, Any]) -> dict[str, str]:
    """The files of models that were typed, by their keys; arguments as of :func:`typed_models`."""
    files = {}
    for key, text in typed.items():
        if key.partition("@")[0] != "model" or not isinstance(text, str):
            continue
        if text.endswith((".yaml", ".yml")):
            files[key] = text
        elif choices.get(key) == _FILE:  # the folder of a fit
            files[key] = f"{text.rstrip('/')}/model.yaml"
    return files


def _node(config: Mapping[str, Any], group: str) -> Any:
    """What an option was composed to: of ``model@plant.model`` what stands at ``plant.model``."""
    node: Any = config
    for name in group.rpartition("@")[2].split("."):
        node = node.get(name) if isinstance(node, Mapping) else None
    return node
