"""Which motions of a model repeat themselves while its commands are held."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.chart import Axis, Chart, Colour, Curve, Line, Mark, Marker, Panel, Points, Style
from trms_cli.core.findings import (
    Cell,
    Column,
    Datum,
    Findings,
    Measure,
    Section,
    Table,
    json_data,
    table,
)
from trms_cli.core.plugins import require_known
from trms_cli.core.wording import symbol, with_unit
from trms_cli.models.model import Model, by_name, names
from trms_cli.models.operating_point import OperatingPoint
from trms_cli.models.vector_field import has_impulses
from trms_cli.stability.cycles.absence import Absence, absence
from trms_cli.stability.cycles.branch import Branch, Hopf, OverCommand, at_the_point, follow_over
from trms_cli.stability.cycles.orbits import (
    FATES,
    STEP,
    Fate,
    Orbit,
    OrbitSearch,
    Shooting,
    different,
    half_widths,
    search_orbits,
    starts_in,
)
from trms_cli.stability.local.linear import Linear
from trms_cli.stability.study import Tell
from trms_cli.stability.subject import Subject, not_level, usual_point


@dataclass(frozen=True, kw_only=True)
class LimitCycles:
    """A search for periodic orbits, a proof of their absence where one is possible."""

    #: Operating point by angles (rad) or by commands (V); nothing: level, at a yaw of 0.3 rad
    at: Mapping[str, float] = field(default_factory=dict)
    #: Input over which Hopf points are sought and cycles are followed; None: the first
    over: str | None = None
    #: Half-widths of the box of starts, by state
    box: Mapping[str, Annotated[float, Meta(ge=0)]] = field(default_factory=dict)
    starts: Annotated[int, Meta(ge=1, le=1000)] = 24  #: Motions
    duration: Annotated[float, Meta(ge=10, le=10000)] = 150.0  #: s, of each
    orbits: Annotated[int, Meta(ge=10, le=2000)] = 90  #: Most cycles of a branch

    def run(self, subject: Subject, tell: Tell) -> Findings:
        """Search, prove, follow.

        Raises TrmsError for a controller, an unknown name, an operating point that does not exist,
        and a model without equations.
        """
        subject.require_no_loop(
            "limit_cycles", "study=hunting looks for the cycles of a loop with friction"
        )
        model = subject.require_equations("limit_cycles")
        for name in self.box:
            unknown = f"{name!r} is not a state of this model"
            require_known(name, model.state_names, unknown, f"box.{name}")
        inputs = names(model.inputs)
        over = inputs[0] if self.over is None else self.over
        require_known(over, inputs, f"{over!r} is not an input of this model", "over")
        channel = inputs.index(over)
        point = usual_point(model, self.at)
        widths = half_widths(model, point.x, self.box)
        smooth = not has_impulses(model)
        tell("is a cycle possible at all")
        proof = absence(model, point.x, point.u, widths)
        tell(f"{self.starts} motions of {self.duration:g} s")
        shooting = Shooting(model) if smooth and not (proof.proved and proof.everywhere) else None
        search = search_orbits(
            model, starts_in(point.x, widths, self.starts), point.u, self.duration, shooting
        )
        over_command = None
        if smooth:
            tell(f"Hopf points over {over}")
            over_command = follow_over(model, point, channel, search.orbits, shooting, self.orbits)
            if shooting is not None:
                more = at_the_point(shooting, over_command.branches, channel, point.u)
                search = replace(search, orbits=different([*search.orbits, *more]))
        result = LimitCycleResult(
            model, point, widths, self.duration, smooth, proof, search, channel, over_command
        )
        lead = [*_answer(result), *_hopf_words(result)]
        sections = [_proof_section(result), _search_section(result)]
        if over_command is not None:
            sections.append(_over_section(result, over_command))
        warnings = [*not_level(model, self.at, point), *_warnings(result)]
        data, measures = json_data(_results(result)), _measures(result)
        return Findings("Limit cycles", lead, sections, data, warnings, measures)


#: Orbits with a multiplier along themselves that is further from 1 are told with a warning.
_DOUBTFUL = 1e-3
#: The first cycle of a branch lies this close to its Hopf point where the model is smooth, V.
_SHIFTED = 2e-3


@dataclass(frozen=True)
class LimitCycleResult:
    """What a search for periodic orbits gave, and the proofs beside it."""

    model: Model
    point: OperatingPoint
    widths: FloatArray  #: (n_x,) array; half-widths of the box of starts
    duration: float  #: s, of each motion
    smooth: bool  #: Whether there were slopes for Newton's method
    proof: Absence
    search: OrbitSearch
    channel: int  #: Of the command that is varied
    over: OverCommand | None  #: None where there are no slopes

    @property
    def state(self) -> int:
        """The controlled state that moves most."""
        rows = [self.model.state_index(name) for name in self.model.controlled]
        orbits = [*self.search.orbits, *self.search.continuum] or [
            orbit
            for branch in (self.over.branches if self.over else ())
            for orbit in branch.orbits[-1:]
        ]
        if not orbits:
            return rows[0]
        return max(rows, key=lambda row: max(float(orbit.swing[row]) for orbit in orbits))

    @property
    def excluded(self) -> bool:
        """No cycle can be: proved for all states, and nothing acts that the proof leaves out."""
        return self.proof.proved and self.proof.everywhere and self.smooth


def _measures(result: LimitCycleResult) -> list[Measure]:
    """How many cycles there are, what that rests on, and the Hopf points over the command."""
    orbits, row = result.search.orbits, result.state
    how = "proved" if result.proof.proved and result.smooth else "searched"
    if result.search.continuum:
        measures = [Measure("limit cycles", "a continuum")]
    else:
        measures = [Measure("limit cycles", len(orbits), "", "", "" if orbits else how)]
    signal = result.model.states[row]
    for orbit in orbits[:2]:
        kind = "stable" if orbit.stable else "unstable"
        measures += [
            Measure("swing", float(orbit.swing[row]), signal.unit, "", f"{signal.name}, {kind}"),
            Measure("period", orbit.period, "s", "", kind),
        ]
    if result.over is not None:
        over = result.model.inputs[result.channel].name
        measures.append(Measure("Hopf points", len(result.over.hopfs), "", "", f"over {over}"))
    return measures


def _answer(result: LimitCycleResult) -> list[str]:
    words = result.point.words(result.model)
    if result.excluded:
        return [
            "There is no limit cycle, whatever the start: proved by Bendixson's criterion "
            f"({words}).",
            f"In simulation, {len(result.search.motions)} motions of {result.duration:g} s: "
            f"{_fates(result.search)}.",
        ]
    orbits = result.search.orbits
    if result.search.continuum:
        return [*_continuum_words(result), *(_orbit_words(result, orbit) for orbit in orbits)]
    if not orbits:
        proved = (
            "In the box of starts none exists: proved by Bendixson's criterion. "
            if result.proof.proved and result.smooth
            else ""
        )
        means = " and Newton's method on their returns" if result.smooth else ""
        return [
            f"{proved}No limit cycle was found at {words}, by {len(result.search.motions)} motions "
            f"of {result.duration:g} s from the box of starts{means} ({_fates(result.search)})."
            + ("" if proved else _how_sure(result)),
            *_share_words(result),
        ]
    stable = sum(orbit.stable for orbit in orbits)
    return [
        f"{len(orbits)} limit cycle{'s' * (len(orbits) > 1)} at {words}: "
        f"{stable} stable, {len(orbits) - stable} unstable.",
        *(_orbit_words(result, orbit) for orbit in orbits),
    ]


def _how_sure(result: LimitCycleResult) -> str:
    """What a search that found nothing is worth."""
    if not result.proof.proved:
        return " That is a search, not a proof."
    where = "whatever the start" if result.proof.everywhere else "in the box of starts"
    return (
        f" Without the dry friction none exists, {where}: proved by Bendixson's criterion. With it "
        "that is a search, not a proof."
    )


def _continuum_words(result: LimitCycleResult) -> list[str]:
    """Periodic orbits that are no limit cycles."""
    signal, orbits = result.model.states[result.state], result.search.continuum
    swings = sorted(float(orbit.swing[result.state]) for orbit in orbits)
    periods = sorted(orbit.period for orbit in orbits)
    isolated = result.search.orbits
    count = (
        f"{len(isolated)} isolated limit cycle{'s' * (len(isolated) > 1)} beside a continuum"
        if isolated
        else "No limit cycle was found, but a continuum"
    )
    return [
        f"{count} of periodic orbits at {result.point.words(result.model)}: {len(orbits)} of "
        f"different size were closed, swings of {symbol(signal.name)} from {swings[0]:.3g} to "
        f"{swings[-1]:.3g} {signal.unit}, periods from {periods[0]:.4g} to {periods[-1]:.4g} s.",
        "They are not isolated: besides the multiplier along the orbit a second one is 1 within "
        "what the computation resolves. None of them attracts or repels its neighbours, the start "
        "decides which one is gone round: a centre, as of a model that loses no energy there.",
    ]


def _share_words(result: LimitCycleResult) -> list[str]:
    """The part of the box in which a proof is had after all."""
    blocks = [block for block in result.proof.blocks if not block.constant]
    if not result.smooth or len(blocks) != 1 or not blocks[0].share:
        return []
    model, share = result.model, blocks[0].share
    rows = [model.state_index(name) for name in model.controlled if name in blocks[0].states]
    within = ", ".join(
        f"{symbol(model.state_names[i])} within {result.point.x[i] + 0.0:.3f} ± "
        f"{share * result.widths[i]:.2g} {model.states[i].unit}"
        for i in rows
    )
    return [
        f"In {100 * share:.0f} % of the box's widths around the equilibrium ({within}) there is "
        "none: certified, as areas shrink."
    ]


def _orbit_words(result: LimitCycleResult, orbit: Orbit) -> str:
    signal = result.model.states[result.state]
    kind = "A stable" if orbit.stable else "An unstable"
    path = orbit.path[:, result.state]
    stop = result.model.stops.get(signal.name)
    beyond = (
        f"; it passes the mechanical stop at {stop:g} {signal.unit}, so that a rig strikes it"
        if stop is not None and float(np.abs(path).max()) > stop
        else ""
    )
    return (
        f"{kind} cycle of {orbit.period:.3f} s swings {symbol(signal.name)} from {path.min():.3f} "
        f"to {path.max():.3f} {signal.unit}; a deviation is multiplied by {abs(orbit.largest):.3g} "
        f"in each period{beyond}."
    )


def _hopf_words(result: LimitCycleResult) -> list[str]:
    if result.over is None:
        return []
    command = result.model.inputs[result.channel]
    signal = result.model.states[result.state]
    low, high = (float(v) for v in result.over.curve.commands[[0, -1]])
    if low == high:
        return [
            f"Over {symbol(command.name)} alone the equilibrium does not go on: the other commands "
            "would have to follow."
        ]
    reach = f"{symbol(command.name)} from {low:.3g} to {high:.3g} {command.unit}"
    if not result.over.hopfs:
        return [f"Over {reach} the equilibrium has no Hopf point: no cycle is born from it."]
    words = []
    for hopf, branch in zip(result.over.hopfs, result.over.branches, strict=False):
        place = (
            f"at {symbol(command.name)} = {hopf.u[result.channel]:.3f} {command.unit} "
            f"({symbol(signal.name)} = {hopf.x[result.state]:.3f} {signal.unit})"
        )
        switches = Linear(result.model).switches(hopf.x, hopf.u)
        if switches:
            on = ", ".join(symbol(result.model.state_names[switch.state]) for switch in switches)
            place += f" (on a switch of {on}: by the mean of both sides' slopes)"
        if not branch.orbits:
            words.append(f"Hopf point {place}; {branch.stop_reason}.")
            continue
        kind = _criticality(result, hopf, branch)
        changes = branch.changes(result.channel, result.state)
        first = changes[0] if changes else None
        then = (
            f"; the branch reaches a {first.kind} at {symbol(command.name)} = {first.command:.3f} "
            f"{command.unit} with a swing of {first.swing:.2f} {signal.unit}"
            if first is not None
            else ""
        )
        shift = float(branch.orbits[0].u[result.channel] - hopf.u[result.channel])
        jump = (
            f" (the model's slope jumps there, and the smallest cycle closed lies "
            f"{abs(shift):.3f} {command.unit} beside it)"
            if abs(shift) > _SHIFTED
            else ""
        )
        words.append(f"Hopf point {place}{jump}, {kind}{then}.")
    return words


def _criticality(result: LimitCycleResult, hopf: Hopf, branch: Branch) -> str:
    if branch.orbits[min(2, len(branch.orbits) - 1)].stable:
        return "supercritical: a stable cycle grows out of the equilibrium that loses its stability"
    return (
        "subcritical: the cycle that is born is unstable and lies around the stable equilibrium, "
        "which a push across it leaves for good"
    )


def _fates(search: OrbitSearch) -> str:
    words: dict[Fate, str] = {
        "rest": "at rest",
        "settling": "settling",
        "cycle": "repeating themselves" if search.continuum else "on a cycle",
        "moves on": "moving on without repeating",
        "leaves": "over the top or beyond all bounds",
    }
    counted = [(search.count(fate), word) for fate, word in words.items()]
    return ", ".join(f"{count} {word}" for count, word in counted if count)


def _proof_section(result: LimitCycleResult) -> Section:
    columns = [
        Column("states", lambda block: ", ".join(symbol(name) for name in block.states)),
        Column(
            "periodic solutions",
            lambda block: Datum("constant", "good") if block.constant else Datum("open"),
        ),
        Column("why", "reason"),
    ]
    return Section(
        "Can there be a cycle?",
        (
            "Blocks of states that drive one another in one direction only, drivers first. On a "
            "periodic orbit a block of one state is constant; so is a block of two whose "
            "divergence has one sign (Bendixson), bounded by interval arithmetic.",
            "All blocks constant: there is no periodic orbit but the equilibria. Of an open block "
            "of more states, a part of the box may be proved to hold none: where the flow shrinks "
            "every area (Smith 1986), no closed orbit lies.",
        ),
        (table(result.proof.blocks, columns),),
    )


def _search_section(result: LimitCycleResult) -> Section:
    model, search = result.model, result.search
    box = ", ".join(
        f"{symbol(name)} {value:.3g} ± {width:.3g}"
        for name, value, width in zip(model.state_names, result.point.x, result.widths, strict=True)
    )
    text = [
        f"{len(search.motions)} motions of {result.duration:g} s from starts spread evenly over "
        f"the box {box}, the commands held: {_fates(search)}."
    ]
    if result.excluded:
        text.append("No cycle can be, so that none was sought by Newton's method.")
    elif result.smooth:
        text.append(
            "Where a motion returns close to where it was, Newton's method (multiple shooting, "
            "slopes by the variational equations, the period unknown) closes the orbit, stable or "
            "not. One Floquet multiplier is 1; how far the computed one is off tells how well the "
            "orbit is known."
        )
    else:
        text.append(
            "Dry friction acts: a motion has no slopes where the axis sticks, and only motions "
            "were looked at."
        )
    blocks: list[Table | Chart] = []
    if search.orbits or search.continuum:
        blocks.append(_orbit_table(result))
    words = f"Motions with the commands held ({result.point.words(model)})" + (
        " and the periodic orbits."
        if search.orbits or search.continuum
        else ": none repeats itself."
    )
    blocks.append(_plane(result, words))
    if search.orbits:
        blocks.append(_multipliers(search.orbits))
    return Section("The search", text, blocks)


def _orbit_table(result: LimitCycleResult) -> Table:
    model, isolated = result.model, result.search.orbits

    def kind(orbit: Orbit) -> Cell:
        if not any(orbit is one for one in isolated):
            return Datum("of a continuum")
        return Datum("stable", "good") if orbit.stable else Datum("unstable", "bad")

    def span(i: int) -> Callable[[Orbit], Cell]:
        return lambda orbit: f"{orbit.path[:, i].min():.3f} … {orbit.path[:, i].max():.3f}"

    angles = [model.state_index(name) for name in model.controlled]
    columns = [
        Column("cycle", kind),
        Column("period [s]", lambda orbit: f"{orbit.period:.4f}"),
        *(
            Column(with_unit(symbol(model.states[i].name), model.states[i].unit), span(i))
            for i in angles
        ),
        Column("largest multiplier", lambda orbit: _multiplier_text(orbit.largest)),
        Column("error of the trivial one", lambda orbit: f"{orbit.trivial_error:.1e}"),
    ]
    orbits = [*isolated, *result.search.continuum]
    return table(orbits, columns, "Periodic orbits at the operating point's commands.")


def _multiplier_text(value: complex) -> str:
    if abs(value.imag) < 1e-9:
        return f"{value.real:.4g}"
    return f"{abs(value):.4g} ∠ {np.degrees(abs(np.angle(value))):.0f}°"


def _over_section(result: LimitCycleResult, over: OverCommand) -> Section:
    model, command = result.model, result.model.inputs[result.channel]
    signal = model.states[result.state]
    events: list[tuple[str, float, float, float | None]] = []
    for hopf, branch in zip_longest(over.hopfs, over.branches):
        if hopf is not None:
            at = float(hopf.u[result.channel])
            events.append(("Hopf point", at, 2 * np.pi / hopf.omega, None))
        changes = [] if branch is None else branch.changes(result.channel, result.state)
        events += [(c.kind, c.command, c.period, c.swing) for c in changes]
    text = [
        f"Equilibria within the stops over {symbol(command.name)}, the other commands held; cycles "
        "followed by pseudo-arclength from each Hopf point, and from each cycle found that lies on "
        "none of these branches."
    ]
    text += [f"Branch {i + 1} ended: {b.stop_reason}." for i, b in enumerate(over.branches)]
    blocks: list[Table | Chart] = []
    if events:
        swing = f"swing of {symbol(signal.name)} [{signal.unit}]"
        columns = [
            Column("what", lambda event: event[0]),
            Column(f"{symbol(command.name)} [{command.unit}]", lambda event: f"{event[1]:.4f}"),
            Column("period [s]", lambda event: f"{event[2]:.3f}"),
            Column(swing, lambda event: "0" if event[3] is None else f"{event[3]:.3f}"),
        ]
        blocks.append(table(events, columns, "What happens along the branches."))
    blocks.append(_diagram(result, over))
    return Section(f"Over {symbol(command.name)}", text, blocks)


def _warnings(result: LimitCycleResult) -> list[str]:
    words = []
    worst = max((orbit.trivial_error for orbit in result.search.orbits), default=0.0)
    if worst > _DOUBTFUL:
        words.append(
            f"the multiplier along a cycle is off by {worst:.1e}: the integration meets a kink of "
            "the model (a coefficient that depends on the sign) or the cycle is very unstable"
        )
    if not result.smooth:
        words.append(
            "dry friction has no slopes: no Newton's method, no multipliers, no Hopf points"
        )
    if result.search.count("leaves"):
        words.append(
            f"{result.search.count('leaves')} motions go over the top or beyond all bounds: on a "
            "rig the stops end them"
        )
    return words


def _results(result: LimitCycleResult) -> dict[str, Any]:
    model, proof, over = result.model, result.proof, result.over
    results: dict[str, Any] = {
        "at": {
            "x": by_name(model.states, result.point.x),
            "u": by_name(model.inputs, result.point.u),
        },
        "box": by_name(model.states, result.widths),
        "proof": {
            "no_cycle": proof.proved and result.smooth,
            "everywhere": proof.everywhere,
            "blocks": [
                {
                    "states": block.states,
                    "constant": block.constant,
                    "divergence": block.divergence,
                    "share": block.share,
                }
                for block in proof.blocks
            ],
        },
        "motions": {fate.replace(" ", "_"): result.search.count(fate) for fate in FATES},
        "cycles": [_orbit_data(model, orbit) for orbit in result.search.orbits],
        "continuum": [_orbit_data(model, orbit) for orbit in result.search.continuum],
    }
    if over is not None:
        results["over"] = {
            "command": model.inputs[result.channel].name,
            "hopf": [
                {"u": hopf.u[result.channel], "x": hopf.x, "omega": hopf.omega}
                for hopf in over.hopfs
            ],
            "branches": [_branch_data(result, branch) for branch in over.branches],
            "swing_of": model.states[result.state].name,
        }
    return results


def _branch_data(result: LimitCycleResult, branch: Branch) -> dict[str, Any]:
    return {
        "ended": branch.stop_reason,
        "u": branch.commands(result.channel),
        "period": [orbit.period for orbit in branch.orbits],
        "swing": [orbit.swing[result.state] for orbit in branch.orbits],
        "stable": branch.stable(),
        "changes": [
            {"kind": c.kind, "u": c.command, "period": c.period, "swing": c.swing}
            for c in branch.changes(result.channel, result.state)
        ],
    }


def _orbit_data(model: Model, orbit: Orbit) -> dict[str, Any]:
    return {
        "period": orbit.period,
        "stable": orbit.stable,
        "lowest": by_name(model.states, orbit.path.min(axis=0)),
        "highest": by_name(model.states, orbit.path.max(axis=0)),
        "multipliers": orbit.multipliers,
        "trivial_error": orbit.trivial_error,
        "misfit": orbit.misfit,
    }


#: Motions drawn beside the orbits, and how long, s.
_DRAWN, _SHOWN = 5, 40.0
#: Orbits drawn of a continuum, spread over their sizes.
_OF_MANY = 7
_STABLE: tuple[Colour, Style, str] = ("blue", "solid", "stable cycle")
_UNSTABLE: tuple[Colour, Style, str] = ("vermilion", "dashed", "unstable cycle")
_MARKERS: dict[str, Marker] = {"fold": "square", "period doubling": "triangle", "torus": "cross"}


def _plane(result: LimitCycleResult, words: str) -> Chart:
    """Orbits and motions in the plane of a state and its rate, and the orbits over time."""
    search, state = result.search, result.state
    signal = result.model.states[state]
    label = symbol(signal.name)
    marks: list[Mark] = []
    sample_count = round(_SHOWN / STEP)
    all_orbits = [*search.orbits, *search.continuum]
    grey: Colour = "pale" if all_orbits else "grey"
    moving = [motion for motion in search.motions if motion.fate != "leaves"]
    for i, motion in enumerate(moving[:_DRAWN]):
        path = motion.path[:sample_count, state]
        rate = np.gradient(path, STEP)
        marks.append(Curve(path, rate, "motions" if i == 0 else "", grey, width=0.6))
    over_time: list[Mark] = []
    many = sorted(search.continuum, key=lambda orbit: float(orbit.swing[state]))
    indices = np.linspace(0, len(many) - 1, min(len(many), _OF_MANY)).round().astype(int)
    several: list[tuple[Orbit, tuple[Colour, Style, str]]] = [
        (many[i], ("purple", "solid", "orbits of a continuum")) for i in indices
    ]
    for orbit, look in [*((one, _look(one)) for one in search.orbits), *several]:
        colour, style, words_of = look
        path = orbit.path[:, state]
        rate = np.gradient(path, orbit.period / (len(path) - 1))
        marks.append(Curve(path, rate, words_of, colour, style, width=2.0, arrow=True))
        over_time.append(Curve(orbit.time, path, words_of, colour, style, width=1.8))
    marks.append(Points([result.point.x[state]], [0.0], "equilibrium", "dot", "ink"))
    stop = result.model.stops.get(signal.name)
    if stop is not None and all_orbits:
        low = min(float(orbit.path[:, state].min()) for orbit in all_orbits) - 0.05
        high = max(float(orbit.path[:, state].max()) for orbit in all_orbits) + 0.05
        for at in (-stop, stop):
            if low < at < high:
                marks.append(Line(x=at, label="mechanical stop", colour="alarm"))
                over_time.append(Line(y=at, label="mechanical stop", colour="alarm"))
    panels = [
        Panel(Axis(label, signal.unit), Axis(f"d{label}/dt", f"{signal.unit}/s"), marks, "Plane")
    ]
    if over_time:
        panels.append(Panel(Axis("time", "s"), Axis(label, signal.unit), over_time, "One period"))
    return Chart("limit_cycles", panels, words)


def _look(orbit: Orbit) -> tuple[Colour, Style, str]:
    return _STABLE if orbit.stable else _UNSTABLE


def _multipliers(orbits: Sequence[Orbit]) -> Chart:
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    marks: list[Mark] = [Curve(np.cos(turn), np.sin(turn), "", "grey", "solid", 1.0)]
    for orbit in orbits:
        colour, _, words = _look(orbit)
        others = orbit.multipliers[1:]
        shape: Marker = "stable" if orbit.stable else "unstable"
        words = f"of the {words}"
        marks.append(Points(others.real, others.imag, words, shape, colour, size=7.0))
    marks.append(Points([1.0], [0.0], "trivial, 1", "cross", "ink", size=8.0))
    caption = (
        "Floquet multipliers of the cycles found: what a deviation is multiplied by in one period. "
        "A cycle is stable if all but the trivial one lie within the circle."
    )
    panel = Panel(Axis("real part"), Axis("imaginary part"), marks, equal=True)
    return Chart("floquet_multipliers", [panel], caption, columns=1, height=4.2)


def _diagram(result: LimitCycleResult, over: OverCommand) -> Chart:
    channel, state, curve = result.channel, result.state, over.curve
    signal, command = result.model.states[state], result.model.inputs[channel]
    at = float(result.point.u[channel])
    marks: list[Mark] = []
    values = curve.x[:, state]
    steady = curve.growth < 0
    marks.append(Curve(curve.commands, np.where(steady, values, np.nan), "stable rest", "ink"))
    if not np.all(steady):
        unsteady = np.where(steady, np.nan, values)
        marks.append(Curve(curve.commands, unsteady, "unstable rest", "grey", "dashed"))
    periods: list[Mark] = []
    for branch in over.branches:
        if not branch.orbits:
            continue
        commands = branch.commands(channel)
        high = np.array([orbit.path[:, state].max() for orbit in branch.orbits])
        low = np.array([orbit.path[:, state].min() for orbit in branch.orbits])
        lengths = np.array([orbit.period for orbit in branch.orbits])
        changes = branch.changes(channel, state)
        stable, unstable = branch.stable(), ~branch.stable()
        # Both curves go to the change between two orbits, and neither beyond it.
        for change in reversed(changes):
            k = change.after + 1
            commands = np.insert(commands, k, change.command)
            high, low = np.insert(high, k, change.highest), np.insert(low, k, change.lowest)
            lengths = np.insert(lengths, k, change.period)
            ends = [side[k - 1] or side[k] for side in (stable, unstable)]
            stable, unstable = (
                np.insert(side, k, end) for side, end in zip((stable, unstable), ends, strict=True)
            )
        for selection, (colour, style, words) in ((stable, _STABLE), (unstable, _UNSTABLE)):
            if not selection.any():
                continue
            for edge in (high, low):
                part = np.where(selection, edge, np.nan)
                marks.append(Curve(commands, part, words, colour, style, 1.8))
            part = np.where(selection, lengths, np.nan)
            periods.append(Curve(commands, part, "", colour, style, 1.8))
        for change in changes:
            shape = _MARKERS[change.kind]
            edges = [change.lowest, change.highest]
            marks.append(Points([change.command] * 2, edges, change.kind, shape, "purple"))
            periods.append(Points([change.command], [change.period], "", shape, "purple"))
    if over.hopfs:
        born = np.array([[hopf.u[channel], hopf.x[state]] for hopf in over.hopfs])
        marks.append(Points(born[:, 0], born[:, 1], "Hopf point", "star", "green", size=9.0))
    marks.append(Line(x=at, label="commands asked about", colour="grey"))
    stop = result.model.stops.get(signal.name)
    if stop is not None:
        for place in (-stop, stop):
            marks.append(Line(y=place, label="mechanical stop", colour="alarm"))
    spread = np.concatenate([[at], *(branch.commands(channel) for branch in over.branches)])
    near = (float(spread.min()) - 0.4, float(spread.max()) + 0.15) if len(spread) > 1 else None
    x_axis = Axis(symbol(command.name), command.unit)
    angle = Axis(symbol(signal.name), signal.unit)
    panels = [Panel(replace(x_axis, limits=near), angle, marks, "Rest and cycles")]
    if periods:
        panels.append(Panel(x_axis, Axis("period", "s"), periods, "Period of the cycles"))
    caption = f"Equilibria and cycles over {symbol(command.name)}, the other commands held."
    return Chart("cycles_over_command", panels, caption, width=5.0, height=3.8)
