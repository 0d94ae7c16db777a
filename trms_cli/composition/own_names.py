"""Keys by the signals of a model whose names are its own.

Options of the program have entries for rigs with two rotors: ``ref.alpha_v``,
``controller.move_weights.u_v``. A model of the user's names its signals as it likes; where one is
chosen, such mappings take its names as well: ``ref.position.amplitude=0.1``. Whether the model has
a signal of that name, the plugin checks that knows the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from trms_cli.composition.overrides import Override
from trms_cli.core.plugins import TARGET

if TYPE_CHECKING:
    from trms_cli.composition.checks import DeclaredKeys

#: Names that mappings by signal have in the program's own YAML.
_USUAL = frozenset(
    {"alpha_v", "alpha_h", "omega_v", "omega_h", "u_v", "u_h"}
    | {"pitch", "yaw", "pitch_moment", "yaw_moment"}
)
#: What stands in YAML for a value without a default: a file, whose values have their own size.
_MUST_BE_GIVEN = "???"
#: Groups with an option that is a mapping of signals itself.
_OF_SIGNALS = ("ref", "controller")


def takes_own_names(keys: DeclaredKeys, key: str) -> bool:
    """Whether a key is a mapping by signal, or in one, and the model is one of the user's."""
    parts = key.split(".")
    if not (_has_own_names(keys) and _is_ours(keys, parts[0])):
        return False
    if parts[0] in _OF_SIGNALS and _has_usual_names(keys, parts[0]):
        return True
    nodes = [keys.value(".".join(parts[:n])) for n in range(2, len(parts) + 1)]
    return any(isinstance(node, Mapping) and node and {*node} <= _USUAL for node in nodes)


def as_own_signal(placed: Override, keys: DeclaredKeys) -> Override:
    """``signal@ref.position=sine`` of a state that the chosen reference does not name."""
    place = placed.package[1:]
    group, _, name = place.partition(".")
    if group not in _OF_SIGNALS or "." in name or (placed.key, place) in keys.places():
        return placed
    if not (_has_own_names(keys) and _is_ours(keys, group)):
        return placed
    # beside the usual ones it is the signal whose sizes are shares of the state's range
    has_size = _MUST_BE_GIVEN not in keys.of_option(placed.key, str(placed.value)).values()
    inside = ".signal" if has_size and _has_usual_names(keys, group) else ""
    return placed._replace(prefix="+", package=f"@{place}{inside}")


def _has_own_names(keys: DeclaredKeys) -> bool:
    """Whether the model is of a class of the user's, or from a file, which may be one of such."""
    if "model" not in keys.declared.defaults:
        return False
    return keys.value("model.path") is not None or not _is_ours(keys, "model")


def _is_ours(keys: DeclaredKeys, group: str) -> bool:
    """Whether a plugin is of the program, which refuses itself the names that it does not know."""
    return str(keys.value(f"{group}.{TARGET}")).startswith("trms_cli.")


def _has_usual_names(keys: DeclaredKeys, group: str) -> bool:
    node = keys.value(group)
    return isinstance(node, Mapping) and bool(_USUAL & {*node})
