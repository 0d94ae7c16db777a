"""What an entry of A is, in words: row i is an equation, column j what it depends on."""

from __future__ import annotations

from trms_cli.models.model import Model
from trms_cli.stability.local.parts import Part, parts_of


def entry_words(model: Model, i: int, j: int) -> str:
    """``pitch moment per yaw rate`` for the entry (Ṡ_v, S_h)."""
    parts, states = parts_of(model), model.state_names
    return f"{_equation(parts[i], states[i])} per {state_words(model, j)}"


def entry_symbol(model: Model, i: int, j: int) -> str:
    """``∂(dS_v/dt)/∂S_h``, or ``∂alpha_v⁺/∂u_v`` of a model that steps."""
    row, column = model.state_names[i], model.state_names[j]
    after = f"d{row}/dt" if model.sample_time is None else f"{row}⁺"
    return f"∂({after})/∂{column}"


def state_words(model: Model, j: int) -> str:
    """``yaw rate`` for S_h: what a state stands for."""
    part, name = parts_of(model)[j], model.state_names[j]
    if part.role in ("angle", "rate"):
        return f"{part.name} {part.role}"
    if part.name.endswith("rotor"):
        return f"speed of the {part.name}"
    if part.name.startswith("armature"):
        return part.name
    return name


def _equation(part: Part, name: str) -> str:
    if part.role == "rate":
        return f"{part.name} moment"
    if part.role == "angle":
        return f"{part.name} rate"
    if part.name.endswith("rotor"):
        return f"torque on the {part.name}"
    return f"rate of {name}"
