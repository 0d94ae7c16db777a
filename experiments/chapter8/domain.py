"""From which starts the controllers can promise what they promise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.chapter8.laws import Bench
from experiments.chapter8.study import FloatArray, Study, controller, setup_of, start_state
from trms_cli.controllers.controller import ControlSample, Status
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.robust.lmi import certify
from trms_cli.controllers.robust.polytope import box
from trms_cli.models.estimate import Estimate


@dataclass(frozen=True)
class Map:
    """Which starts of the grid are held."""

    yaw: FloatArray  #: (n,) arrays; rad
    pitch: FloatArray  #: (n,) arrays; rad
    #: dict of str to (n_yaw, n_pitch) array of bool; by controller and how the main rotor starts
    domains: dict[str, FloatArray]

    @property
    def shares(self) -> dict[str, float]:
        return {name: float(values.mean()) for name, values in self.domains.items()}


def study_domain(study: Study, *, quick: bool = False) -> Map:
    """Every start, the main rotor at rest and at the speed of the target."""
    (a, b, n), (c, d, m) = study.domain.yaw, study.domain.pitch
    if quick:
        n, m = 5, 4
    yaw, pitch = np.linspace(a, b, n), np.linspace(c, d, m)
    bench = Bench()
    offline = controller("robust_mpc_offline")
    family = offline.init(setup_of(bench.model)).family
    domains: dict[str, FloatArray] = {}
    for hover in (True, False):
        rotor = "main rotor turning" if hover else "main rotor at rest"
        for name in ("online", "offline", "newton_mpc"):
            domains[f"{name}, {rotor}"] = np.zeros((n, m), dtype=bool)
        for i, j in np.ndindex(n, m):
            start = (float(yaw[i]), float(pitch[j]))
            z = bench.deviation(start, hover=hover)
            domains[f"online, {rotor}"][i, j] = _online(bench, z)
            domains[f"offline, {rotor}"][i, j] = family.gain(z)[1] >= 0
            domains[f"newton_mpc, {rotor}"][i, j] = _newton(bench, start, hover=hover)
    return Map(yaw, pitch, domains)


def _online(bench: Bench, z: FloatArray) -> bool:
    r, c, target = bench.regulation, bench.controller, bench.aim.target
    region = r.region_of(target, c.reach * np.abs(z) + c.least_reach)
    polytope = box(r.coefficients.over(target, region), c.principal_components, c.margin)
    task = r.task(polytope, bench.aim, z)
    solution = bench.solve(task)
    if solution is None:
        return False
    certificate = certify(task, solution)
    return certificate.stable and certificate.constrained


def _newton(bench: Bench, start: tuple[float, float], *, hover: bool) -> bool:
    model, steady = bench.model, bench.aim.steady.x
    row = model.state_index("omega_v")
    x = start_state(model, start, float(steady[row]) if hover else 0.0)
    if hover:
        for name in ("S_h", "S_v"):
            x[model.state_index(name)] = steady[model.state_index(name)]
    newton = NewtonMpc()
    state = newton.init(setup_of(model))
    w = np.zeros(model.n_w)
    sample = ControlSample(
        0.0, np.zeros((1, 2)), Estimate(x, np.zeros_like(x), w, w), np.zeros(model.n_u)
    )
    command = newton.step(state, sample, want_prediction=False)
    return command.status in (Status.OK, Status.BUDGET)
