"""The block diagrams of the chapters: the rig, the loops around it, the diagnosis of its gap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from trms_cli.reporting.block_diagram import (
    Block,
    Point,
    SummingPoint,
    branch,
    diagram_panel,
    draw_block,
    draw_sum,
    wire,
    word,
)
from trms_cli.reporting.style import GREY, INK, LITTLE, PALETTE, SHADES, house_style, save_png

_MAIN, _TAIL = PALETTE["blue"], PALETTE["vermilion"]
#: Of what belongs to the rig, and of what is computed.
_RIG, _PROGRAM = LITTLE, SHADES[0]


def draw_newtonian(path: Path) -> None:
    """The Newtonian model from the commands to the angles, term by term as the equations have it.

    The equations are those of :mod:`trms_cli.models.newtonian`.
    """
    with house_style():
        page, panel = diagram_panel(11.0, (-0.75, -6.45), (16.0, 6.45))
        ends = {side: _chain(panel, side) for side in ("v", "h")}
        _couplings(panel, ends)
        save_png(page, path)


#: Columns of the chains.
_FORK, _FIRST_SUM, _SECOND_SUM, _THIRD_SUM = 5.15, 9.2, 10.15, 13.2
_RATE_FORK, _ANGLE_FORK = 13.68, 15.15


def _chain(panel: Axes, side: str) -> dict[str, Any]:
    """One rotor and its axis: a row of blocks, its feedbacks outside of it."""
    main = side == "v"
    up = 1.0 if main else -1.0
    y, colour = 3.0 * up, _MAIN if main else _TAIL
    r, limit = ("m", "21.5") if main else ("t", "16.5")
    v = side
    inertia = r"$J_v$" if main else r"$J_h(\alpha_v)$"
    blocks = [
        Block(1.05, y, "interface", rf"$k_{{u{v}}}$, ±{limit} V", wide=1.5, high=1.0),
        Block(
            3.55,
            y,
            f"{'main' if main else 'tail'} motor",
            rf"$L\,\dot{{i}} = v - R\,i - k\varphi\,\omega$"
            "\n"
            rf"$J_{{{r}r}}\,\dot{{\omega}} = k\varphi\,i - B_{{{r}r}}\,\omega"
            rf" - k_{{t{v}}}\,\omega|\omega|$",
            wide=2.65,
            high=1.35,
        ),
        Block(6.4, y, "propeller", rf"$k_{{f{v}}}\,\omega|\omega|$", wide=1.45, high=1.0),
        Block(
            8.15,
            y,
            "arm",
            r"$l_m$" if main else r"$l_t\cos\alpha_v$",
            wide=1.05,
            high=1.0,
        ),
        Block(11.5, y, rf"$\int$ / {inertia}", wide=1.45, high=1.0),
    ]
    first, second, third = (
        SummingPoint(_FIRST_SUM, y),
        SummingPoint(_SECOND_SUM, y),
        SummingPoint(_THIRD_SUM, y),
    )
    integrator = Block(14.4, y, r"$\int$", wide=0.7, high=0.9)
    for block in blocks[:-1]:
        draw_block(panel, block)
    beam = blocks[-1]
    draw_block(panel, beam, size=10)
    draw_block(panel, integrator, size=11)
    for node in (first, second, third):
        draw_sum(panel, node)
    _row(panel, [*blocks[:4], first, second, beam, third, integrator])
    wire(panel, [(-0.3, y), blocks[0].left])
    word(panel, -0.52, y, rf"$u_{v}$", color=colour)
    wire(panel, [integrator.right, (15.5, y)])
    word(panel, 15.75, y, rf"$\alpha_{v}$", color=colour)
    for x, name in (
        (2.02, rf"$v_{v}$"),
        (_FORK + 0.3, rf"$\omega_{v}$"),
        (7.38, rf"$F_{v}$"),
        (12.62, rf"$S_{v}$"),
        (_RATE_FORK + 0.19, rf"$\Omega_{v}$"),
    ):
        word(panel, x, y + 0.26 * up, name, size=9, color=colour)
    # outside of the row: what the axis does to itself
    near, far = y + 1.45 * up, y + 2.75 * up
    friction = Block(
        11.9,
        near,
        "friction",
        rf"$M_{v}(\Omega_{v}) = k_{{o{v}}}\,\Omega_{v}$ + dry",
        wide=2.5,
        high=0.95,
    )
    spring = (
        Block(
            11.9,
            far,
            "gravity",
            r"$g\,[(A-B)\cos\alpha_v - C\sin\alpha_v]$",
            wide=3.1,
            high=0.95,
        )
        if main
        else Block(11.9, far, "cable", r"$k_{ch}\,\alpha_h$, $k_{ch}$ by sign", wide=2.5, high=0.95)
    )
    for block, fork, node in ((friction, _RATE_FORK, second), (spring, _ANGLE_FORK, first)):
        draw_block(panel, block)
        branch(panel, (fork, y))
        wire(panel, [(fork, y), (fork, block.y), block.right])
        into = node.top if main else node.bottom
        wire(panel, [block.left, (node.x, block.y), into])
        sign = "+" if main and block is spring else "−"
        word(panel, node.x + 0.2, into[1] + 0.2 * up, sign, size=9)
    return {"y": y, "first": first, "third": third, "beam": beam, "arm": blocks[3]}


def _couplings(panel: Axes, ends: Mapping[str, Mapping[str, Any]]) -> None:
    """Between the rows: what one axis does to the other."""
    main, tail = ends["v"], ends["h"]
    turning = Block(
        6.9,
        -0.85,
        "momentum of the main rotor",
        r"$k_m\,\omega_v\cos\alpha_v\,/\,J_h(\alpha_v)$",
        wide=2.95,
        high=1.0,
    )
    tilting = Block(
        6.9, 0.85, "momentum of the tail rotor", r"$k_t\,\omega_h\,/\,J_v$", wide=2.95, high=1.0
    )
    crossing = Block(
        10.35,
        0.0,
        "gyroscopic, centrifugal",
        r"$k_g F_v\Omega_h\cos\alpha_v - \frac{1}{2}H\Omega_h^2\sin 2\alpha_v$",
        wide=3.2,
        high=1.0,
    )
    for block in (turning, tilting, crossing):
        draw_block(panel, block)
    for fork, row, block in ((_FORK - 0.12, main, turning), (_FORK + 0.12, tail, tilting)):
        branch(panel, (fork, row["y"]))
        wire(panel, [(fork, row["y"]), (fork, block.y), block.left])
    # above and below the block in the middle, to the sums of the rates
    third_v, third_h = main["third"], tail["third"]
    wire(panel, [tilting.right, (8.6, 0.85), (8.6, 1.35), (third_v.x, 1.35), third_v.bottom])
    wire(panel, [turning.right, (8.6, -0.85), (8.6, -1.35), (third_h.x, -1.35), third_h.top])
    for node, side in ((third_v, -1.0), (third_h, 1.0)):
        word(panel, node.x + 0.2, node.y + 0.36 * side, "+", size=9)
    branch(panel, (_RATE_FORK, tail["y"]))
    wire(panel, [(_RATE_FORK, tail["y"]), (_RATE_FORK, 0.0), crossing.right])
    first = main["first"]
    wire(panel, [crossing.top, (crossing.x, 1.0), (first.x, 1.0), first.bottom])
    word(panel, first.x + 0.2, first.y - 0.36, "+", size=9)
    # the pitch enters where yaw's arm and inertia change with it
    for block in (tail["arm"], tail["beam"]):
        top = block.top
        wire(panel, [(top[0], top[1] + 0.5), top])
        word(panel, top[0], top[1] + 0.66, r"$\alpha_v$", size=9, color=_MAIN)


def draw_newton_mpc(path: Path) -> None:
    """What newton_mpc does in a sample: iterations of linearising and solving one QP."""
    y, down = 0.0, -1.75
    target = Block(1.35, y, "steady state", "$f(x_r, u_r) = 0$", 2.1, 1.15, fill=_PROGRAM)
    plan = Block(
        4.7, y, "nominal trajectory", "$x_{k+1} = f(x_k, u_k)$\n$k = 0\\ldots N-1$", 2.5, 1.3
    )
    linear = Block(
        7.95, y, "linearise along it", "$A_k, B_k$ of each period,\nslopes of the cost", 2.35, 1.3
    )
    program = Block(11.2, y, "QP of the horizon", "inputs, states, terminal\nconstraint", 2.75, 1.3)
    step = Block(14.4, y, "step length", "by an exact penalty", 2.15, 1.3)
    rig = Block(14.4, down, "rig", "0.1 s", 1.5, 0.95, fill=_RIG)
    shift = Block(4.7, down, "shift by a period", "the plan of the last sample", 2.8, 0.95)
    plan, linear, program, step, shift = (
        _filled(block, _PROGRAM) for block in (plan, linear, program, step, shift)
    )
    with house_style():
        page, panel = diagram_panel(10.0, (-1.0, -2.55), (16.6, 3.15))
        _enclosure(panel, (3.3, -0.85), (15.65, 2.75), "Newton iterations, one to ten in a sample")
        for block in (target, plan, linear, program, step, rig, shift):
            draw_block(panel, block)
        wire(panel, [(-0.2, y), target.left])
        word(panel, -0.55, y, r"$\alpha_{ref}$")
        _row(panel, [target, plan, linear, program, step])
        word(panel, 2.85, y + 0.26, "$x_r, u_r$", size=8)
        word(panel, 12.93, y + 0.26, r"$\Delta u$", size=8.5)
        wire(panel, [step.top, (step.x, 1.7), (plan.x, 1.7), plan.top])
        word(panel, 9.6, 1.98, r"$u \leftarrow u + t\,\Delta u$, and anew", size=8.5)
        wire(panel, [step.bottom, rig.top])
        word(panel, step.x + 0.35, -1.05, "$u_0$", size=9)
        wire(panel, [rig.left, (8.4, down)], head=False)
        wire(panel, [(8.4, down), shift.right])
        word(panel, 10.2, down + 0.26, "state $x_0$ of the next sample", size=8.5)
        wire(panel, [shift.top, plan.bottom])
        save_png(page, path)


def draw_output_feedback(path: Path) -> None:
    """The loop of chapter 7: what is measured, what is estimated, what is believed."""
    y, low = 0.0, -3.0
    control = Block(2.6, y, "controller", "newton_mpc, 10 Hz", 2.5, 1.15, fill=_PROGRAM)
    path_in = Block(6.2, y, "drives", "hold, dead zone, delay", 2.5, 1.15, fill=_RIG)
    rig = Block(9.6, y, "rig", "$\\dot{x} = f(x, u, w)$", 2.2, 1.15, fill=_RIG)
    sensors = Block(12.9, y, "sensors", "encoders, tachos, noise", 2.5, 1.15, fill=_RIG)
    observer = Block(9.6, low, "observer", "UKF, EKF, …, 50 Hz", 2.6, 1.15, fill=_PROGRAM)
    model = Block(2.6, low, "model", "what is believed of the rig", 2.8, 1.15, dashed=True)
    with house_style():
        page, panel = diagram_panel(10.0, (-1.0, -4.1), (16.0, 2.6))
        _enclosure(panel, (4.7, -0.95), (14.4, 2.2), "what is really there")
        for block in (control, path_in, rig, sensors, observer, model):
            draw_block(panel, block)
        wire(panel, [(-0.2, y), control.left])
        word(panel, -0.55, y, r"$\alpha_{ref}$")
        _row(panel, [control, path_in, rig, sensors])
        word(panel, 4.3, y + 0.28, "$u$")
        word(panel, 11.15, y + 0.28, "$x$")
        wire(panel, [(rig.x, 1.3), rig.top])
        word(panel, rig.x, 1.55, "disturbances, effects that the model lacks $w$", size=8.5)
        wire(panel, [sensors.right, (15.2, y), (15.2, low), observer.right])
        word(panel, 13.0, low + 0.28, r"$y = \alpha_h, \alpha_v, (\omega_h, \omega_v)$", size=9)
        branch(panel, (4.3, y))
        wire(panel, [(4.3, y), (4.3, -1.7), (observer.x, -1.7), observer.top])
        word(panel, 7.0, -1.45, "the command $u$ that was given", size=8.5)
        # the estimate to the controller, above the model
        wire(panel, [observer.left, (5.3, low), (5.3, -2.05), (control.x, -2.05)], head=False)
        wire(panel, [(control.x, -2.05), control.bottom])
        word(panel, 6.75, low + 0.3, r"$\hat{x}$, torques $\hat{d}$", size=9)
        model_wire: dict[str, Any] = {"colour": PALETTE["green"]}
        wire(panel, [(1.7, model.top[1]), (1.7, control.bottom[1])], **model_wire)
        wire(
            panel,
            [(3.4, model.bottom[1]), (3.4, -3.85), (observer.x, -3.85), observer.bottom],
            **model_wire,
        )
        word(panel, 6.4, -3.62, "the same equations", size=8.5, color=PALETTE["green"])
        save_png(page, path)


def draw_robust_mpc(path: Path) -> None:
    """What robust_mpc does in a sample: a polytope, linear matrix inequalities, a proof."""
    y, down = 0.0, -1.75
    target = Block(1.3, y, "steady state", "$z_s, v_s$ of $\\alpha_{ref}$, $\\hat{d}$", 2.3, 1.2)
    box = Block(4.45, y, "polytope", "coefficients [A B] in the\nregion, $2^K$ vertices", 2.7, 1.3)
    solve = Block(7.95, y, "LMIs", "least $\\gamma$: cost, limits of\ninputs and angles", 2.75, 1.3)
    proof = Block(11.3, y, "certificate", "by eigenvalues, without\nthe solver", 2.6, 1.3)
    law = Block(14.5, y, "law", "$v_s + K(z - z_s)$", 2.2, 1.2)
    rig = Block(14.5, down, "rig, observer", "", 2.2, 0.8, fill=_RIG)
    last = Block(11.3, down, "last law", "where none is certified", 2.5, 0.95)
    target, box, solve, proof, law, last = (
        _filled(block, _PROGRAM) for block in (target, box, solve, proof, law, last)
    )
    with house_style():
        page, panel = diagram_panel(10.0, (-0.9, -2.75), (16.0, 1.1))
        for block in (target, box, solve, proof, law, rig, last):
            draw_block(panel, block)
        wire(panel, [(-0.6, y), target.left])
        _row(panel, [target, box, solve, proof, law])
        word(panel, 12.95, y + 0.26, "yes", size=8.5)
        wire(panel, [proof.bottom, last.top])
        word(panel, proof.x + 0.28, -0.95, "no", size=8.5)
        wire(panel, [(last.right[0], down + 0.2), (13.0, down + 0.2), (13.0, -0.35), (13.4, -0.35)])
        wire(panel, [law.bottom, rig.top])
        word(panel, law.x + 0.25, -0.95, "$v$", size=9)
        wire(panel, [rig.bottom, (rig.x, -2.5), (box.x, -2.5), box.bottom])
        word(panel, 7.3, -2.26, "present state $z$: the sub-polytope shrinks with it", size=8.5)
        save_png(page, path)


def draw_diagnosis(path: Path) -> None:
    """The stages of ``trms diagnose`` and what they hand on."""
    upper, lower = 0.9, -1.65
    rows = (
        (
            upper,
            (
                ("admit, divide", "noise, blocks,\na sealed part"),
                ("refit", "parameters within\ntheir priors"),
                ("separability", "signatures of all\neffects, whitened"),
                ("race", "each candidate with\nall parameters"),
                ("where", "a disturbance at one\nplace at a time"),
            ),
        ),
        (
            lower,
            (
                ("is there a gap?", "innovations against\nusual errors"),
                ("what it looks like", "the force without\na name"),
                ("how sure", "probabilities of\nall answers"),
                ("how far", "free runs over the\nsealed part"),
                ("what next", "the experiment that\ntells most"),
            ),
        ),
    )
    first, pitch, wide, high = 2.95, 2.85, 2.35, 1.3
    with house_style():
        page, panel = diagram_panel(10.0, (-0.95, -3.6), (15.8, 1.75))
        placed = [
            [
                Block(first + pitch * i, y, title, words, wide, high, fill=_PROGRAM)
                for i, (title, words) in enumerate(stages)
            ]
            for y, stages in rows
        ]
        given = Block(0.15, upper + 0.42, "recordings", "", 1.75, 0.6, fill=_RIG)
        believed = Block(0.15, upper - 0.42, "model, priors", "", 1.75, 0.6, fill=_RIG)
        for block in (given, believed, *placed[0], *placed[1]):
            draw_block(panel, block, size=7.5)
        join = placed[0][0].left
        for block in (given, believed):
            wire(panel, [block.right, (join[0], block.y)])
        for row in placed:
            _row(panel, row)
        turn = (upper + lower) / 2
        begin, end = placed[0][-1].bottom, placed[1][0].top
        wire(panel, [begin, (begin[0], turn), (end[0], turn), end])
        results = (
            (placed[1][2], "diagnosis.json,\nreport.html"),
            (placed[1][3], "corrected_model.yaml:\nback into the loop"),
            (placed[1][4], "the next recording:\ntrms investigate"),
        )
        for block, words in results:
            wire(panel, [block.bottom, (block.x, -2.75)])
            word(panel, block.x, -3.1, words, size=7.5)
        save_png(page, path)


def _filled(block: Block, fill: str) -> Block:
    return replace(block, fill=fill)


def _row(panel: Axes, blocks: Sequence[Block | SummingPoint]) -> None:
    """Wires from each to the next."""
    for left, right in pairwise(blocks):
        wire(panel, [left.right, right.left])


def _enclosure(panel: Axes, low: Point, high: Point, words: str) -> None:
    """A dashed frame around blocks that belong together, with its name at the upper left."""
    (x, y), (right, top) = low, high
    panel.plot([x, right, right, x, x], [y, y, top, top, y], color=GREY, lw=0.8, ls=(0, (4, 3)))
    word(panel, x + 0.15, top - 0.25, words, size=8.5, ha="left", color=INK)
