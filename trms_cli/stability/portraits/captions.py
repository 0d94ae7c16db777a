"""How a portrait is to be read: its caption, the text beside it, and what limits it."""

from __future__ import annotations

import numpy as np

from trms_cli.stability.portraits.account import Told, commands, held_words, short
from trms_cli.stability.portraits.coordinates import symbol
from trms_cli.stability.portraits.drawing import has_field, is_hidden


def caption(told: Told) -> str:
    """A sentence or two under the figure."""
    picture = told.picture
    hidden = [held for held in picture.sticking if is_hidden(picture, held)]
    sets = " and ".join(held_words(picture.section, held) for held in hidden)
    end = f" Too short to be seen at its marker: dry friction holds {sets}." if hidden else ""
    return f"{_of_the_plane(told)}{end}"


def _of_the_plane(told: Told) -> str:
    """What the axes are, and how exact."""
    section = told.picture.section
    coordinates = section.coordinates
    plane = ", ".join(item.label for item in coordinates.items)
    if told.loop:
        faint = "; grey: the model alone" if told.picture.beside else ""
        return f"{plane} under {told.loop}, {told.duration:g} s from each start{faint}."
    head = f"{plane} at {commands(section)}"
    if not coordinates.others:
        return f"{head}. These are all states of the model: the portrait is exact."
    if told.invariant:
        return (
            f"{head}, with {_others(told)}. No motion leaves this section: the portrait is exact."
        )
    return (
        f"{head}. A projection: the trajectories are those of all {coordinates.model.n_x} states, "
        f"begun with {_others(told)}. "
        + (
            "Stream lines and dashed nullclines are those of that section, which the trajectories "
            "leave; they may cross."
            if len(coordinates) == 2
            else "They may cross."
        )
    )


def of_model(told: Told, rubs: bool) -> list[str]:
    """The text beside the portrait of a model alone."""
    picture = told.picture
    n = len(picture.section.coordinates)
    text = [
        f"Trajectories of {told.duration:g} s with the command held, from starts "
        + (
            "on the edge of the window where the field enters it and inside. They are drawn for "
            "a little more than two widths of the window; what is said of their ends is of the "
            "whole. Grey: stream lines. Dashed: nullclines, on which one of the two rates is zero."
            if n == 2
            else "spread in the box, drawn as far as they stay in it."
        )
    ]
    if n == 2 and not told.invariant:
        text.append(
            "The model has more states than the plane shows. The field is drawn with "
            f"{_others(told)}; a trajectory begins there and then leaves that section, as its "
            "other states move. Where it crosses another or runs against the stream lines, the two "
            "differ in the states that are not seen."
        )
        if not has_field(picture.section, picture.window):
            text.append(
                "In this section a rate is zero everywhere: what moves the coordinates is among "
                "the states that are not seen. So neither stream lines nor nullclines are drawn."
            )
    if picture.separatrices:
        text.append(
            "Out of a saddle and into it run the invariant manifolds, integrated from its "
            "eigenvectors forwards and backwards until they leave the window. Those into it "
            + (
                "part the plane: starts on either side of one end in different places or take "
                "different ways."
                if n == 2
                else "fill a surface that parts the space; some of them are drawn."
            )
        )
    saddles = any(rest.kind == "saddle" for rest in picture.rests)
    if saddles and not picture.separatrices and not rubs:
        text.append(
            "The motions into a saddle of this model fill a surface of more dimensions than the "
            "portrait has: no separatrix is drawn."
        )
    if rubs:
        text.append(
            "Dry friction acts on the trajectories as impulses. It is no part of the stream lines "
            "and the nullclines, and around a saddle it makes a set of rest points out of one: no "
            "separatrices are drawn. A red line is the sticking set: at zero rate the static "
            "moment is within the friction, and what arrives there stays."
        )
    return text


def of_loop(told: Told, observer: str) -> list[str]:
    """The text beside the portrait of a closed loop."""
    return [
        f"Trajectories of the loop with {told.loop} and {observer}, {told.duration:g} s each, its "
        "references at the goal. Controller and observer begin as they do at a rig, with the "
        "command of the goal in force.",
        "The command follows from what controller and observer remember, and not from the point of "
        "the portrait alone. So there is no field in it: nullclines do not exist and are not "
        "drawn, and trajectories may cross.",
    ]


def warnings(told: Told) -> list[str]:
    """What limits the answer."""
    picture = told.picture
    found = []
    coordinates = picture.section.coordinates
    if not told.loop and not told.invariant:
        found.append(
            f"a projection: {_others(told)} at the start of each trajectory, and moving then"
        )
    if not told.loop and not picture.rests:
        found.append("no equilibrium was found in the window; the search is no proof of none")
    found += _switches(told)
    for name, stop in coordinates.model.stops.items():
        index = coordinates.model.state_index(name)
        visited = max(float(np.nanmax(np.abs(run.x[:, index]))) for run in picture.journeys)
        if visited > stop:
            found.append(
                f"trajectories pass the mechanical stop of {symbol(name)} at {short(stop)} rad: "
                "the equations have none"
            )
    return found


def _switches(told: Told) -> list[str]:
    """Where eigenvalues are those of a mean."""
    model = told.picture.section.coordinates.model
    on = [rest for rest in told.picture.rests if rest.switches]
    if not on:
        return []
    states = sorted({state for rest in on for state in rest.switches})
    where = " and ".join(
        f"{symbol(model.state_names[i])} = {short(float(on[0].x[i]))}" for i in states
    )
    return [
        f"at {where} the slopes differ on the two sides: the eigenvalues there, and what is said "
        "of swings and of the kind, are those of the mean of both, as in study=local "
        "(study.side=upper or lower shows each)"
    ]


def _others(told: Told) -> str:
    """``ω_v held at 196.3 rad/s``: what the section does with the states that are not seen."""
    section = told.picture.section
    model = section.coordinates.model
    words = []
    if section.held:
        shown = [
            f"{symbol(model.state_names[i])} = {short(float(section.point.x[i]))}"
            for i in section.held
        ]
        words.append(f"{', '.join(shown)} held")
    if section.settled:
        shown = [symbol(model.state_names[i]) for i in section.settled]
        words.append(f"{', '.join(shown)} settled")
    return " and ".join(words)
