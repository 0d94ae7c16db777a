"""What a search for periodic orbits found, in sentences, tables and figures."""

from __future__ import annotations

import numpy as np

from trms_cli.core.chart import Chart
from trms_cli.core.findings import Findings, Judged, Section, Table, Value
from trms_cli.stability.cycles.branch import Branch, Hopf, OverCommand
from trms_cli.stability.cycles.found_orbits import Found, results_of
from trms_cli.stability.cycles.orbit_charts import diagram, multipliers, plane, symbol
from trms_cli.stability.cycles.search import Fate, Search
from trms_cli.stability.cycles.shooting import Orbit
from trms_cli.stability.local.linear import Linear

#: Orbits with a multiplier along themselves that is further from 1 are told with a warning.
_DOUBTFUL = 1e-3
#: The first cycle of a branch lies this close to its Hopf point where the model is smooth, V.
_SHIFTED = 2e-3


def findings_of(found: Found) -> Findings:
    """The findings."""
    lead = [*_answer(found), *_hopf_words(found)]
    sections = [_proof_section(found), _search_section(found)]
    if found.over is not None:
        sections.append(_over_section(found, found.over))
    return Findings("Limit cycles", lead, sections, results_of(found), _warnings(found))


def _answer(found: Found) -> list[str]:
    words = found.point.words(found.model)
    if found.excluded:
        return [
            "There is no limit cycle, whatever the start: proved by Bendixson's criterion "
            f"({words}).",
            f"In simulation, {len(found.search.motions)} motions of {found.duration:g} s: "
            f"{_fates(found.search)}.",
        ]
    orbits = found.search.orbits
    if found.search.continuum:
        return [*_continuum_words(found), *(_orbit_words(found, orbit) for orbit in orbits)]
    if not orbits:
        proved = (
            "In the box of starts none exists: proved by Bendixson's criterion. "
            if found.proof.proved and found.smooth
            else ""
        )
        means = " and Newton's method on their returns" if found.smooth else ""
        return [
            f"{proved}No limit cycle was found at {words}, by {len(found.search.motions)} motions "
            f"of {found.duration:g} s from the box of starts{means} ({_fates(found.search)})."
            + ("" if proved else _how_sure(found)),
            *_share_words(found),
        ]
    count = {True: 0, False: 0}
    for orbit in orbits:
        count[orbit.stable] += 1
    return [
        f"{len(orbits)} limit cycle{'s' * (len(orbits) > 1)} at {words}: "
        f"{count[True]} stable, {count[False]} unstable.",
        *(_orbit_words(found, orbit) for orbit in orbits),
    ]


def _how_sure(found: Found) -> str:
    """What a search that found nothing is worth."""
    if not found.proof.proved:
        return " That is a search, not a proof."
    where = "whatever the start" if found.proof.everywhere else "in the box of starts"
    return (
        f" Without the dry friction none exists, {where}: proved by Bendixson's criterion. With it "
        "that is a search, not a proof."
    )


def _continuum_words(found: Found) -> list[str]:
    """Periodic orbits that are no limit cycles."""
    signal, orbits = found.model.states[found.state], found.search.continuum
    swings = sorted(float(orbit.swing[found.state]) for orbit in orbits)
    periods = sorted(orbit.period for orbit in orbits)
    isolated = found.search.orbits
    count = (
        f"{len(isolated)} isolated limit cycle{'s' * (len(isolated) > 1)} beside a continuum"
        if isolated
        else "No limit cycle was found, but a continuum"
    )
    return [
        f"{count} of periodic orbits at {found.point.words(found.model)}: {len(orbits)} of "
        f"different size were closed, swings of {symbol(signal.name)} from {swings[0]:.3g} to "
        f"{swings[-1]:.3g} {signal.unit}, periods from {periods[0]:.4g} to {periods[-1]:.4g} s.",
        "They are not isolated: besides the multiplier along the orbit a second one is 1 within "
        "what the computation resolves. None of them attracts or repels its neighbours, the start "
        "decides which one is gone round: a centre, as of a model that loses no energy there.",
    ]


def _share_words(found: Found) -> list[str]:
    """The part of the box in which a proof is had after all."""
    blocks = [block for block in found.proof.blocks if not block.constant]
    if not found.smooth or len(blocks) != 1 or not blocks[0].share:
        return []
    model, share = found.model, blocks[0].share
    rows = [model.state_index(name) for name in model.controlled if name in blocks[0].states]
    within = ", ".join(
        f"{symbol(model.state_names[i])} within {found.point.x[i] + 0.0:.3f} ± "
        f"{share * found.widths[i]:.2g} {model.states[i].unit}"
        for i in rows
    )
    return [
        f"In {100 * share:.0f} % of the box's widths around the equilibrium ({within}) there is "
        "none: certified, as areas shrink."
    ]


def _orbit_words(found: Found, orbit: Orbit) -> str:
    signal = found.model.states[found.state]
    kind = "A stable" if orbit.stable else "An unstable"
    path = orbit.path[:, found.state]
    stop = found.model.stops.get(signal.name)
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


def _hopf_words(found: Found) -> list[str]:
    if found.over is None:
        return []
    command = found.model.inputs[found.channel]
    signal = found.model.states[found.state]
    low, high = (float(v) for v in found.over.curve.commands[[0, -1]])
    if low == high:
        return [
            f"Over {symbol(command.name)} alone the equilibrium does not go on: the other commands "
            "would have to follow."
        ]
    reach = f"{symbol(command.name)} from {low:.3g} to {high:.3g} {command.unit}"
    if not found.over.hopfs:
        return [f"Over {reach} the equilibrium has no Hopf point: no cycle is born from it."]
    words = []
    for hopf, branch in zip(found.over.hopfs, found.over.branches, strict=False):
        place = (
            f"at {symbol(command.name)} = {hopf.u[found.channel]:.3f} {command.unit} "
            f"({symbol(signal.name)} = {hopf.x[found.state]:.3f} {signal.unit})"
        )
        switches = Linear(found.model).switches(hopf.x, hopf.u)
        if switches:
            on = ", ".join(symbol(found.model.state_names[switch.state]) for switch in switches)
            place += f" (on a switch of {on}: by the mean of both sides' slopes)"
        if not branch.orbits:
            words.append(f"Hopf point {place}; {branch.ended}.")
            continue
        kind = _criticality(found, hopf, branch)
        changes = branch.changes(found.channel, found.state)
        first = changes[0] if changes else None
        then = (
            f"; the branch reaches a {first.kind} at {symbol(command.name)} = {first.command:.3f} "
            f"{command.unit} with a swing of {first.swing:.2f} {signal.unit}"
            if first is not None
            else ""
        )
        shift = float(branch.orbits[0].u[found.channel] - hopf.u[found.channel])
        jump = (
            f" (the model's slope jumps there, and the smallest cycle closed lies "
            f"{abs(shift):.3f} {command.unit} beside it)"
            if abs(shift) > _SHIFTED
            else ""
        )
        words.append(f"Hopf point {place}{jump}, {kind}{then}.")
    return words


def _criticality(found: Found, hopf: Hopf, branch: Branch) -> str:
    early = branch.orbits[min(2, len(branch.orbits) - 1)]
    if early.stable:
        return "supercritical: a stable cycle grows out of the equilibrium that loses its stability"
    return (
        "subcritical: the cycle that is born is unstable and lies around the stable equilibrium, "
        "which a push across it leaves for good"
    )


def _fates(search: Search) -> str:
    words: dict[Fate, str] = {
        "rest": "at rest",
        "settling": "settling",
        "cycle": "repeating themselves" if search.continuum else "on a cycle",
        "moves on": "moving on without repeating",
        "leaves": "over the top or beyond all bounds",
    }
    counted = [(search.count(fate), word) for fate, word in words.items()]
    return ", ".join(f"{count} {word}" for count, word in counted if count)


def _proof_section(found: Found) -> Section:
    rows: list[list[Value | Judged]] = [
        [
            ", ".join(symbol(name) for name in block.states),
            Judged("constant" if block.constant else "open", "good" if block.constant else ""),
            block.reason,
        ]
        for block in found.proof.blocks
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
        (Table(["states", "periodic solutions", "why"], rows),),
    )


def _search_section(found: Found) -> Section:
    model, search = found.model, found.search
    box = ", ".join(
        f"{symbol(name)} {value:.3g} ± {width:.3g}"
        for name, value, width in zip(model.state_names, found.point.x, found.widths, strict=True)
    )
    text = [
        f"{len(search.motions)} motions of {found.duration:g} s from starts spread evenly over the "
        f"box {box}, the commands held: {_fates(search)}.",
    ]
    if found.excluded:
        text.append("No cycle can be, so that none was sought by Newton's method.")
    elif found.smooth:
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
        blocks.append(_orbit_table(found))
    words = f"Motions with the commands held ({found.point.words(model)})" + (
        " and the periodic orbits found."
        if search.orbits or search.continuum
        else ": none repeats itself."
    )
    blocks.append(plane(model, search, found.point.x, found.state, words))
    if search.orbits:
        blocks.append(multipliers(search.orbits))
    return Section("The search", text, blocks)


def _orbit_table(found: Found) -> Table:
    angles = [found.model.state_index(name) for name in found.model.controlled]
    columns = [
        "cycle",
        "period [s]",
        *(f"{symbol(found.model.states[i].name)} [{found.model.states[i].unit}]" for i in angles),
        "largest multiplier",
        "error of the trivial one",
    ]
    isolated = [
        (orbit, Judged("stable", "good") if orbit.stable else Judged("unstable", "bad"))
        for orbit in found.search.orbits
    ]
    others = [(orbit, Judged("of a continuum", "")) for orbit in found.search.continuum]
    rows: list[list[Value | Judged]] = [
        [
            kind,
            f"{orbit.period:.4f}",
            *(f"{orbit.path[:, i].min():.3f} … {orbit.path[:, i].max():.3f}" for i in angles),
            _written(orbit.largest),
            f"{orbit.trivial_error:.1e}",
        ]
        for orbit, kind in [*isolated, *others]
    ]
    return Table(columns, rows, "Periodic orbits at the operating point's commands.")


def _written(value: complex) -> str:
    if abs(value.imag) < 1e-9:
        return f"{value.real:.4g}"
    return f"{abs(value):.4g} ∠ {np.degrees(abs(np.angle(value))):.0f}°"


def _over_section(found: Found, over: OverCommand) -> Section:
    model, command = found.model, found.model.inputs[found.channel]
    signal = model.states[found.state]
    rows = []
    for i, hopf in enumerate(over.hopfs):
        rows.append(
            ["Hopf point", f"{hopf.u[found.channel]:.4f}", f"{2 * np.pi / hopf.omega:.3f}", "0"]
        )
        if i < len(over.branches):
            rows += _change_rows(found, over.branches[i])
    for branch in over.branches[len(over.hopfs) :]:
        rows += _change_rows(found, branch)
    text = [
        f"Equilibria within the stops over {symbol(command.name)}, the other commands held; cycles "
        "followed by pseudo-arclength from each Hopf point, and from each cycle found that lies on "
        "none of these branches."
    ]
    text += [f"Branch {i + 1} ended: {b.ended}." for i, b in enumerate(over.branches)]
    blocks: list[Table | Chart] = []
    if rows:
        columns = [
            "what",
            f"{symbol(command.name)} [{command.unit}]",
            "period [s]",
            f"swing of {symbol(signal.name)} [{signal.unit}]",
        ]
        blocks.append(Table(columns, rows, "What happens along the branches."))
    blocks.append(
        diagram(
            model,
            over.curve,
            over.hopfs,
            over.branches,
            found.channel,
            found.state,
            float(found.point.u[found.channel]),
        )
    )
    return Section(f"Over {symbol(command.name)}", text, blocks)


def _change_rows(found: Found, branch: Branch) -> list[list[str]]:
    return [
        [change.kind, f"{change.command:.4f}", f"{change.period:.3f}", f"{change.swing:.3f}"]
        for change in branch.changes(found.channel, found.state)
    ]


def _warnings(found: Found) -> list[str]:
    words = []
    worst = max((orbit.trivial_error for orbit in found.search.orbits), default=0.0)
    if worst > _DOUBTFUL:
        words.append(
            f"the multiplier along a cycle is off by {worst:.1e}: the integration meets a kink of "
            "the model (a coefficient that depends on the sign) or the cycle is very unstable"
        )
    if not found.smooth:
        words.append(
            "dry friction has no slopes: no Newton's method, no multipliers, no Hopf points"
        )
    if found.search.count("leaves"):
        words.append(
            f"{found.search.count('leaves')} motions go over the top or beyond all bounds: on a "
            "rig the stops end them"
        )
    return words
