"""The rig's body in space, from the lengths among a model's parameters.

The beam's frame is that of :mod:`trms_cli.models.rig_bodies` with its third axis up: x along the
beam to the main rotor, y along the axis of pitch, z up when the beam is level. Positive commands
push the main rotor along z, and the tail rotor along −y, which turns the beam to positive yaw.

What no parameter tells is drawn by proportion (pillar, base, thickness of bars), and said in
:attr:`~trms_cli.core.scene.Scene.assumed` where a length of the rig itself is missing.
"""

from collections.abc import Collection, Mapping

from trms_cli.core.scene import BASE, BEAM, YAW, Arrow, Cylinder, Ring, Scene, Vector

#: A beam of which nothing is known, and guards of which nothing is known over their arms; m, 1.
_ARM, _MAIN_GUARD, _TAIL_GUARD = 0.25, 0.63, 0.35
_UP: Vector = (0.0, 0.0, 1.0)
_ACROSS: Vector = (0.0, 1.0, 0.0)
_ALONG: Vector = (1.0, 0.0, 0.0)
_TAIL_PUSH: Vector = (0.0, -1.0, 0.0)
_ANGLES = ("alpha_v", "alpha_h")


def moves(names: Collection[str]) -> bool:
    """Whether signals of these names tell an attitude: a motor alone has none to be shown."""
    return any(angle in names for angle in _ANGLES)


def rig_shape(parameters: Mapping[str, float]) -> Scene:
    """The body of a rig.

    ``parameters``: SI values by name. A TRMS has ``l_m, l_t`` (arms), ``l_b, l_cb``
    (counterweight), ``r_ms, r_ts`` (guards), ``h`` (offset of the beam); a Quanser Aero ``d_t``
    (both arms), ``l_t`` (rod), ``d_x`` (how far the hanging mass is below), ``r_y`` (yoke). Others
    are not looked at.
    """
    return _aero(parameters) if "d_t" in parameters else _twin_rotor(parameters)


def _twin_rotor(c: Mapping[str, float]) -> Scene:
    missing = [
        words
        for names, words in (
            (("l_m", "l_t"), "the beam's arms"),
            (("r_ms", "r_ts"), "the rotors' guards"),
            (("l_b", "l_cb"), "the counterweight (left out)"),
        )
        if any(name not in c for name in names)
    ]
    main_arm, tail_arm = c.get("l_m", _ARM), c.get("l_t", _ARM)
    main_guard = c.get("r_ms", _MAIN_GUARD * main_arm)
    tail_guard = c.get("r_ts", _TAIL_GUARD * tail_arm)
    offset, bar = c.get("h", 0.0), 0.03 * main_arm
    has_weight = "l_b" in c and "l_cb" in c
    below = max(c["l_b"], c["l_cb"]) if has_weight else 0.6 * max(main_arm, tail_arm)
    # High enough that neither the counterweight nor a steep beam reaches the floor.
    height = 1.35 * max(below, main_arm, tail_arm)
    parts: list[Cylinder | Ring] = [*_stand(height, bar), *_bearing(offset, bar)]
    parts += [
        _bar("beam", (-tail_arm, 0.0, 0.0), (main_arm, 0.0, 0.0), bar),
        *_rotor("main rotor", (main_arm, 0.0, 0.0), _UP, main_guard, "main", bar),
        *_rotor("tail rotor", (-tail_arm, 0.0, 0.0), _ACROSS, tail_guard, "tail", bar),
    ]
    if has_weight:
        parts += [
            _bar("counterweight's rod", (0.0, 0.0, 0.0), (0.0, 0.0, -c["l_b"]), 0.7 * bar),
            Cylinder(
                "counterweight", BEAM, (0.0, 0.0, -c["l_cb"]), _UP, 5 * bar, 3 * bar, "weight"
            ),
        ]
    return Scene(
        tuple(parts),
        _arrows(main_arm, tail_arm, bar),
        height,
        offset,
        max(main_arm + main_guard, tail_arm + tail_guard),
        _sentence(missing),
    )


def _aero(c: Mapping[str, float]) -> Scene:
    """Two equal rotors on a rod, the tail's turned to the side, a mass below the axis."""
    arm, rod, yoke = c["d_t"], c.get("l_t", 2 * c["d_t"]), c.get("r_y", 0.12 * c["d_t"])
    bar = 0.05 * arm
    guard, below, height = _MAIN_GUARD * arm, c.get("d_x", 0.1 * arm), 1.7 * arm
    half = max(arm, 0.5 * rod)
    parts: list[Cylinder | Ring] = [*_stand(height, yoke), *_bearing(0.0, bar)]
    parts += [
        _bar("rod", (-half, 0.0, 0.0), (half, 0.0, 0.0), bar),
        *_rotor("main rotor", (arm, 0.0, 0.0), _UP, guard, "main", bar),
        *_rotor("tail rotor", (-arm, 0.0, 0.0), _ACROSS, guard, "tail", bar),
        Cylinder("hanging mass", BEAM, (0.0, 0.0, -below), _ALONG, 0.5 * arm, 1.5 * bar, "weight"),
    ]
    return Scene(
        tuple(parts),
        _arrows(arm, arm, bar),
        height,
        0.0,
        arm + guard,
        _sentence(["the rotors' guards"]),
    )


def _sentence(missing: list[str]) -> str:
    if not missing:
        return ""
    return f"drawn by proportion, because no parameter gives it: {', '.join(missing)}"


def _stand(height: float, radius: float) -> list[Cylinder]:
    """Base plate and pillar."""
    plate = 0.04 * height
    return [
        Cylinder("base", BASE, (0.0, 0.0, 0.5 * plate), _UP, plate, 0.28 * height, "grey"),
        Cylinder(
            "pillar", BASE, (0.0, 0.0, 0.5 * height), _UP, height, max(1.6 * radius, 0.01), "pale"
        ),
    ]


def _bearing(offset: float, bar: float) -> list[Cylinder]:
    """The axis of pitch, from the pillar to the beam."""
    if not offset:
        return [Cylinder("pitch axis", YAW, (0.0, 0.0, 0.0), _ACROSS, 8 * bar, 1.2 * bar, "ink")]
    centre = (0.0, 0.5 * offset, 0.0)
    return [Cylinder("pitch axis", YAW, centre, _ACROSS, abs(offset) + 2 * bar, 1.2 * bar, "ink")]


def _bar(name: str, one: Vector, other: Vector, radius: float) -> Cylinder:
    """A round bar of the beam between two points on one of its axes."""
    along = tuple(b - a for a, b in zip(one, other, strict=True))
    length = sum(abs(part) for part in along)
    x, y, z = (0.5 * (a + b) for a, b in zip(one, other, strict=True))
    ax, ay, az = (part / length for part in along)
    return Cylinder(name, BEAM, (x, y, z), (ax, ay, az), length, radius, "ink")


def _rotor(
    name: str, at: Vector, axis: Vector, guard: float, tone: str, bar: float
) -> list[Cylinder | Ring]:
    """Motor, the disc that the blades sweep, and the guard around it."""
    return [
        Cylinder(f"{name}'s motor", BEAM, at, axis, 5 * bar, 2 * bar, tone),
        Cylinder(f"{name}'s disc", BEAM, at, axis, 0.5 * bar, 0.9 * guard, tone, 0.25),
        Ring(f"{name}'s guard", BEAM, at, axis, guard, bar, tone),
    ]


def _arrows(main_arm: float, tail_arm: float, bar: float) -> tuple[Arrow, ...]:
    foot = 3 * bar
    return (
        Arrow("u_v", BEAM, (main_arm, 0.0, foot), _UP, main_arm, "main"),
        Arrow("u_h", BEAM, (-tail_arm, -foot, 0.0), _TAIL_PUSH, tail_arm, "tail"),
    )
