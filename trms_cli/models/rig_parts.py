"""What a model calls the parts of its rig: axes, drives, places, units, and the words for them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import casadi as ca

from trms_cli.core import wording
from trms_cli.core.chart import DiagramRow
from trms_cli.models import beam_rig
from trms_cli.models.model import Model, RigAxis, RigRotor, names

#: What the variable of an axis and its rate are called: of one that turns, of one that slides.
ANGLES, RATES = ("angle", "position"), ("rate", "velocity")
#: Units of what an axis moves through, and their words.
TRAVELS = {"rad": "radian", "m": "metre"}


@dataclass(frozen=True)
class RigParts:
    """Axes and drives of a rig by name, and what sentences call them."""

    axes: Mapping[str, RigAxis]
    rotors: Mapping[str, RigRotor]
    units: Mapping[str, str]  #: Of inputs and states
    #: Input of each drive: by its rotor, or by its own name where it moves none
    drives: Mapping[str, str]
    tilting: str = ""  #: Axis about which weight acts
    beam: str = ""  #: Axis of a beam that it raises; empty: there is none
    rates: Mapping[str, str] = field(default_factory=dict)  #: State that is an axis' rate, if any

    def part_of(self, location: str) -> str:
        """Name of the axis, rotor or signal that a place belongs to."""
        owners = {axis.moment: name for name, axis in self.axes.items()}
        owners |= {rotor.torque: name for name, rotor in self.rotors.items()}
        return owners.get(location, location.rpartition("_")[0])

    def kind_of(self, location: str) -> str:
        """``moment``, ``motor``, or what the place's name ends in: ``actuator``, ``sensor``…"""
        if location in (axis.moment for axis in self.axes.values()):
            return "moment"
        is_motor = location in (rotor.torque for rotor in self.rotors.values())
        return "motor" if is_motor else location.rpartition("_")[2]

    def axis_at(self, location: str) -> str:
        """The axis that a force at a place moves."""
        part = self.part_of(location)
        return self.rotors[part].axis if part in self.rotors else part

    def drive_of(self, axis: str) -> str:
        """The rotor that moves an axis; without rotors the first drive; empty: there is none."""
        rotors = (name for name, rotor in self.rotors.items() if axis and rotor.axis == axis)
        return next(rotors, "" if self.rotors else next(iter(self.drives), ""))

    def other_drive(self, drive: str) -> str:
        """The first other one; empty: there is none."""
        return next((name for name in self.drives if name != drive), "")

    def other_axis(self, axis: str) -> str:
        """The first other one; empty: there is none."""
        return next((name for name in self.axes if name != axis), "")

    def unit(self, axis: str) -> str:
        """Of the axis' angle or position."""
        return self.units[self.axes[axis].angle]

    def turns(self, axis: str) -> bool:
        """Whether it is an angle that the axis moves through."""
        return self.unit(axis) == "rad"

    def nouns(self, axis: str) -> tuple[str, str]:
        """What is measured of it, and the word of its unit."""
        unit = self.unit(axis)
        return ANGLES[not self.turns(axis)], TRAVELS.get(unit, unit)

    def angle(self, axis: str) -> str:
        """*yaw angle*, *carriage position*; empty for no axis."""
        return f"{axis} {ANGLES[not self.turns(axis)]}" if axis in self.axes else ""

    def rate(self, axis: str) -> str:
        """*yaw rate*, *carriage velocity*; empty for no axis."""
        return f"{axis} {RATES[not self.turns(axis)]}" if axis in self.axes else ""

    def symbol(self, axis: str) -> str:
        """α_v."""
        return wording.symbol(self.axes[axis].angle)

    def rate_symbol(self, axis: str) -> str:
        """Ω_v; a model's own name of the rate."""
        angle = self.symbol(axis)
        return angle.replace("α", "Ω") if "α" in angle else self.rates.get(axis, f"d{angle}/dt")

    def speed_symbol(self, rotor: str) -> str:
        """ω_v."""
        return wording.symbol(self.rotors[rotor].speed)

    def command_symbol(self, drive: str) -> str:
        """u_v."""
        return wording.symbol(self.drives[drive])

    def command_unit(self, drive: str) -> str:
        """V; empty for a normalised command."""
        return wording.unit(self.units[self.drives[drive]])


def _drives(rotors: Mapping[str, RigRotor], inputs: Iterable[str]) -> dict[str, str]:
    driven = {rotor.input for rotor in rotors.values()}
    return {name: r.input for name, r in rotors.items()} | {n: n for n in inputs if n not in driven}


@lru_cache(maxsize=64)
def parts_of(model: Model) -> RigParts:
    """The parts of a model's rig."""
    model = model.without_effects()
    units = {s.name: s.unit for s in (*model.inputs, *model.states)}
    x, u, p, w = model.symbols()
    turning = {a.angle: name for name, a in model.axes.items() if units[a.angle] == "rad"}
    tilting = next(iter(turning.values()), "")
    weight, rates = model.quantities(x, u, p).get("gravity_moment"), {}
    if weight is not None:
        acts = ca.jacobian(weight, x).sparsity().get_col()
        tilting = next((n for a, n in turning.items() if model.state_index(a) in acts), "")
    if model.sample_time is None:
        f = model.dynamics(x, u, p, w)
        for name, axis in model.axes.items():
            row = f[model.state_index(axis.angle)]
            same = (s.name for i, s in enumerate(model.states) if ca.is_equal(row, x[i]))
            if rate := next(same, ""):
                rates[name] = rate
    beam = tilting if weight is not None else ""
    drives = _drives(model.rotors, names(model.inputs))
    return RigParts(model.axes, model.rotors, units, drives, tilting, beam, rates)


#: Of a beam that pitches and yaws under two rotors.
BEAM = RigParts(
    beam_rig.AXES,
    beam_rig.ROTORS,
    {s.name: s.unit for s in (*beam_rig.INPUTS.values(), *beam_rig.STATES.values())},
    _drives(beam_rig.ROTORS, ()),
    *("pitch", "pitch"),
)


def diagram_rows(parts: RigParts) -> tuple[DiagramRow, ...]:
    """The rig's block diagram: a row for each drive with its axis, then one for each other axis."""
    left_axes, paths = list(parts.axes), []
    for drive, command in parts.drives.items():
        rotor = parts.rotors.get(drive, RigRotor(command, axis=next(iter(left_axes), "")))
        places = {"actuator": f"{drive}_actuator", "motor": rotor.torque}
        if drive in parts.rotors:
            places["thrust"] = f"{drive}_thrust" if rotor.axis in parts.axes else ""
            places["tacho"] = f"{drive}_tacho" if rotor.speed else ""
        paths.append((places, rotor))
        left_axes = [axis for axis in left_axes if axis != rotor.axis]
    rows = []
    for places, rotor in (*paths, *(({}, RigRotor("", axis=axis)) for axis in left_axes)):
        axis = parts.axes.get(rotor.axis)
        if axis is not None:
            places |= {"moment": axis.moment, "sensor": f"{rotor.axis}_sensor"}
        real = {kind: place for kind, place in places.items() if place}
        output = "" if axis is None else axis.angle
        rows.append(DiagramRow(real, rotor.input, output, rotor.speed))
    return tuple(rows)
