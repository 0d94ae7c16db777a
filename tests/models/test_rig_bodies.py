"""The derived M, C and G against another derivation, and against the published lines."""

from functools import cache

import casadi as ca
import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from trms_cli.models.newtonian import geometry
from trms_cli.models.parameters import parameter_file
from trms_cli.models.rig_bodies import Shields, bodies, energies

from .sympy_of_casadi import in_sympy

NAMES = (
    *("m_t", "m_tr", "m_ts", "m_m", "m_mr", "m_ms", "m_b", "m_cb"),
    *("l_t", "l_m", "l_b", "l_cb", "r_ms", "r_ts", "g", "h"),
)
#: As published (Rahideh & Shaheed 2007), s and c the sine and cosine of α_v, a and b the rates
#: of α_h and α_v.
J1 = "(m_t/3 + m_tr + m_ts)*l_t**2 + (m_m/3 + m_mr + m_ms)*l_m**2 + m_ms*r_ms**2/2 + m_ts*r_ts**2"
J2 = "m_b*l_b**2/3 + m_cb*l_cb**2"
LEVER_1 = "(m_m/2 + m_mr + m_ms)*l_m - (m_t/2 + m_tr + m_ts)*l_t"  # m_T1 l_T1
LEVER_2 = "m_b*l_b/2 + m_cb*l_cb"  # m_T2 l_T2
MASS = "m_t + m_tr + m_ts + m_m + m_mr + m_ms + m_b + m_cb"


@cache
def derived(shields: Shields) -> tuple[sp.Matrix, sp.Matrix, sp.Matrix, dict[str, sp.Expr]]:
    """M, C and G of the program, in sympy."""
    c = {name: ca.SX.sym(name) for name in NAMES}
    rig = energies(bodies(c, shields), c["g"])
    inertia = rig.inertia
    every = {**c, **{name: ca.SX.sym(name) for name in ("yaw", "pitch", "a", "b")}}
    at = [ca.vertcat(every["yaw"], every["pitch"]), ca.vertcat(every["a"], every["b"])]
    parts = ca.substitute(
        [inertia, rig.coriolis(inertia), rig.gravity], [rig.angles, rig.rates], at
    )
    found = [in_sympy(part, every) for part in parts]
    own = found[0][1]
    return found[0][0], found[1][0], found[2][0], own


@cache
def by_integration() -> tuple[sp.Matrix, sp.Expr]:
    """M and V by integrals over rods and rings, at any yaw: what the program takes as known."""
    p = {name: sp.Symbol(name, real=True) for name in NAMES}
    yaw, pitch = sp.Symbol("yaw", real=True), sp.Symbol("pitch", real=True)
    s, x, y = sp.symbols("s x y", real=True)
    up = sp.Matrix([0, 0, 1])
    along = sp.Matrix([sp.cos(pitch) * sp.cos(yaw), sp.cos(pitch) * sp.sin(yaw), sp.sin(pitch)])
    across = sp.Matrix([-sp.sin(yaw), sp.cos(yaw), 0])
    down = along.cross(across) * -1

    inertia, potential = sp.zeros(2, 2), sp.Integer(0)

    def mean(density):
        """Over a rod, s from 0 to 1, or around a ring, with the cosine x and the sine y."""
        total = sp.Integer(0)
        for (i, j, k), factor in sp.Poly(density, s, x, y).terms():
            ring = {(0, 0): 1, (2, 0): sp.Rational(1, 2), (0, 2): sp.Rational(1, 2)}
            total += factor * sp.integrate(s**i, (s, 0, 1)) * ring.get((j, k), 0)
        return total

    def add(mass, place):
        nonlocal potential
        slopes = [place.diff(angle) for angle in (yaw, pitch)]
        for i in range(2):
            for j in range(2):
                inertia[i, j] += mass * mean(slopes[i].dot(slopes[j]))
        potential += mass * p["g"] * mean(place.dot(up))

    arm = p["h"] * across
    add(p["m_t"], arm - s * p["l_t"] * along)
    add(p["m_tr"], arm - p["l_t"] * along)
    add(p["m_m"], arm + s * p["l_m"] * along)
    add(p["m_mr"], arm + p["l_m"] * along)
    add(p["m_b"], arm + s * p["l_b"] * down)
    add(p["m_cb"], arm + p["l_cb"] * down)
    add(p["m_ms"], arm + p["l_m"] * along + p["r_ms"] * (x * along + y * across))
    add(p["m_ts"], arm - p["l_t"] * along + p["r_ts"] * (x * along + y * down))
    return inertia, potential


def same(first: sp.Expr, second: sp.Expr) -> bool:
    """Whether two polynomials in sines and cosines of the angles are identical."""
    difference = first - second
    for angle in ("yaw", "pitch"):
        sine, cosine = sp.symbols(f"s_{angle} c_{angle}")
        q = sp.Symbol(angle, real=True)
        circle = sine**2 + cosine**2 - 1
        inside = sp.expand(difference.subs({sp.sin(q): sine, sp.cos(q): cosine}))
        difference = sp.rem(inside, circle, sine)
    return sp.expand(difference) == 0


def published(own: dict[str, sp.Expr]) -> dict[str, sp.Expr]:
    c, s = sp.cos(own["pitch"]), sp.sin(own["pitch"])
    names = {**own, "c": c, "s": s}
    names |= {n: sp.sympify(t, locals=names) for n, t in (("J1", J1), ("J2", J2))}
    names |= {n: sp.sympify(t, locals=names) for n, t in (("B1", LEVER_1), ("B2", LEVER_2))}
    names |= {"mass": sp.sympify(MASS, locals=names)}
    lines = {
        "M11": "J1*c**2 + J2*s**2 + h**2*mass",
        "M12": "h*(B1*s - B2*c)",
        "M22": "J1 + J2",
        "C11": "2*(J2 - J1)*s*c*b",
        "C12": "h*(B1*c + B2*s)*b",
        "C21": "(J1 - J2)*s*c*a",
        "G2": "g*(B1*c + B2*s)",
    }
    return {name: sp.sympify(line, locals=names) for name, line in lines.items()}


class TestAgainstAnotherDerivation:
    def test_inertia_and_gravity_are_those_of_integrals_over_the_bodies(self):
        inertia, _, gravity, own = derived("rings")
        expected, potential = by_integration()
        for i in range(2):
            for j in range(2):
                assert same(inertia[i, j], expected[i, j]), (i, j)
        for i, angle in enumerate(("yaw", "pitch")):
            assert same(gravity[i], potential.diff(own[angle]))

    def test_lagranges_equations_are_what_m_and_c_say(self):
        # d/dt ∂T/∂q̇ − ∂T/∂q = M q̈ + C q̇ with T = ½ q̇ᵀ M q̇.
        inertia, coriolis, _, own = derived("rings")
        rates = sp.Matrix([own["a"], own["b"]])
        angles = (own["yaw"], own["pitch"])
        kinetic = (rates.T * inertia * rates)[0] / 2
        turning = sum(
            (inertia.diff(q) * v for q, v in zip(angles, rates, strict=True)), sp.zeros(2)
        )
        for i in range(2):
            left = (turning * rates)[i] - kinetic.diff(angles[i])
            assert same(left, (coriolis * rates)[i])


class TestAgainstThePublishedLines:
    def test_shields_spread_along_the_beam_give_every_published_line(self):
        inertia, coriolis, gravity, own = derived("as_printed")
        lines = published(own)
        assert same(inertia[0, 0], lines["M11"])
        assert same(inertia[0, 1], lines["M12"]) and same(inertia[1, 0], lines["M12"])
        assert same(inertia[1, 1], lines["M22"])
        assert gravity[0] == 0 and same(gravity[1], lines["G2"])
        # The published C is another factor of the same vector.
        a, b = own["a"], own["b"]
        assert same((coriolis * sp.Matrix([a, b]))[0], lines["C11"] * a + lines["C12"] * b)
        assert same((coriolis * sp.Matrix([a, b]))[1], lines["C21"] * a)
        # Nor does it make Ṁ − 2 C skew.
        turning = lines["M11"].diff(own["pitch"]) * own["b"]
        assert not same(turning, 2 * lines["C11"])

    def test_rings_move_inertia_of_the_shields_and_nothing_else(self):
        inertia, _, gravity, own = derived("rings")
        lines = published(own)
        c, s = sp.cos(own["pitch"]), sp.sin(own["pitch"])
        main, tail = own["m_ms"] * own["r_ms"] ** 2, own["m_ts"] * own["r_ts"] ** 2
        # Half of the tail shield goes from J1 to J2; the main one's half across the beam is J3.
        moved = lines["M11"] - tail / 2 * c**2 + tail / 2 * s**2 + main / 2
        assert same(inertia[0, 0], moved)
        assert same(inertia[0, 1], lines["M12"])
        assert same(inertia[1, 1], lines["M22"])
        assert same(gravity[1], lines["G2"])

    def test_newtonian_inertias_are_those_of_rings_but_for_half_of_the_tail_shield(self):
        inertia, _, _, own = derived("rings")
        g = geometry(own)
        level = inertia[0, 0].subs({own["pitch"]: 0, own["h"]: 0})
        assert same(level, g["D"] + g["F"])
        missing = own["m_ts"] * own["r_ts"] ** 2 / 2
        assert same(inertia[1, 1], g["J_v"] + missing)


@cache
def numeric() -> ca.Function:
    c = {name: ca.SX.sym(name) for name in NAMES}
    rig = energies(bodies(c), c["g"])
    inertia = rig.inertia
    turning = ca.reshape(ca.jtimes(ca.vec(inertia), rig.angles, rig.rates), 2, 2)
    p = ca.vertcat(*c.values())
    parts = [inertia, rig.coriolis(inertia), turning, rig.kinetic, rig.gravity]
    return ca.Function("parts", [p, rig.angles, rig.rates], parts)


angle = st.floats(-3.2, 3.2)
rate = st.floats(-20.0, 20.0)
share = st.floats(0.2, 3.0)


@settings(max_examples=40)
@given(st.tuples(angle, angle), st.tuples(rate, rate), st.lists(share, min_size=16, max_size=16))
def test_at_random_rigs_and_points(q, v, factors):
    bench = parameter_file("bench").parameters
    p = np.array([bench[name].value for name in NAMES]) * factors
    inertia, coriolis, turning, kinetic, gravity = (np.array(part) for part in numeric()(p, q, v))
    scale = np.abs(inertia).max() * (1.0 + np.abs(v).max())
    assert np.allclose(inertia, inertia.T, atol=1e-14 * scale)
    assert np.linalg.eigvalsh(inertia).min() > 0
    skew = turning - 2 * coriolis
    assert np.allclose(skew, -skew.T, atol=1e-12 * scale)
    assert kinetic.item() == pytest.approx(0.5 * np.array(v) @ inertia @ np.array(v), abs=1e-12)
    assert gravity[0] == 0
