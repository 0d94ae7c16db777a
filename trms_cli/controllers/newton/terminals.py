"""Three further ends of the Newton MPC's horizon, made of the terminal region's parts, in NumPy.

With ``ξ = (x − x_s, u₋ − u_s)``, local law ``u = u_s + K ξ``, its ``V(ξ) = ‖L ξ‖²`` and the region
``V ≤ α`` of :mod:`trms_cli.controllers.newton.region`:

- ``dual_mode`` (Michalska & Mayne 1993, IEEE TAC 38): outside of the region the MPC that ends in
  it acts, inside the local law, without any optimisation, where V falls by more than the stage
  cost at every period. Not so while a reference is seen to move within the horizon: the local law
  knows of its end alone.
- ``control_lyapunov`` (Primbs, Nevistić & Doyle 2000, IEEE TAC 45): V is the cost of the end, and
  the prediction must end no higher in it than the trajectory of the law alone, cut to the limits,
  from the present state, nor than the present state itself, ``V(ξ_N) ≤ min(V(ξ_N^K), V(ξ_0))``.
- ``contractive`` (de Oliveira Kothare & Morari 2000, IEEE TAC 45): ``‖x_N − x_s‖_P ≤ c ‖x_0 −
  x_s‖_P`` with a diagonal P of the states' typical sizes, and no cost of the end. It needs no local
  law, so that it holds for targets that have no region. Their algorithm applies the whole plan
  before it asks for the next contraction; here each sample asks for it anew.

The constraints are soft by an exact penalty, as the terminal equality: what misses one is reported
as relaxed. Where a target has no region, the first two end in its steady state.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from trms_cli.controllers.controller import Command, ControlSample, ControlSetup
from trms_cli.controllers.newton.region import TerminalRegion
from trms_cli.controllers.newton.state import NewtonMpcState
from trms_cli.core.arrays import FloatArray

if TYPE_CHECKING:
    from trms_cli.controllers.newton_mpc import NewtonMpc

LOCAL_LAW = "inside of the terminal region: the local law acts"


class _RegionState(NewtonMpcState):
    """The quasi-infinite horizon's, with the local law to go on from any state."""

    def __init__(self, config: NewtonMpc, setup: ControlSetup) -> None:
        super().__init__(replace(config, terminal="quasi_infinite"), setup)

    @property
    def region(self) -> TerminalRegion | None:
        """Of the present target; None without one, and for a sample that is not finite."""
        return self.regions.region if self.regions is not None and self.inputs_finite else None

    @property
    def deviation(self) -> FloatArray:
        """ξ of the present state and the last command, (n,)."""
        centre = self.newton.horizon.arguments["centre"].ravel()
        return np.asarray(np.concatenate([self._full, self._last_command]) - centre)

    def local_trajectory(self, region: TerminalRegion) -> tuple[FloatArray, FloatArray]:
        """States (n_full, N) and inputs (n_u, N) of the local law, cut to the limits, from now."""
        newton, p = self.newton, self.model.parameters.values
        centre = newton.horizon.arguments["centre"].ravel()
        states, inputs = newton.trajectory.copy(), np.zeros((self.model.n_u, 0))
        n_u, largest, x, u = self.model.n_u, newton.largest_moves, self._full, self._last_command
        for k in range(newton.horizon.n_periods):
            wish = centre[-n_u:] + region.gain @ (np.concatenate([x, u]) - centre)
            wish = np.clip(wish, u - largest, u + largest)
            u = np.clip(wish, newton.lower, newton.upper)
            x = self._step.evaluate(x, u, p, self._disturbance)[0].ravel().copy()
            states[:, k] = x
            inputs = np.column_stack([inputs, u])
        return states, inputs


class DualModeState(_RegionState):
    """The MPC outside of the region, the local law inside."""

    def solve(self, *, want_prediction: bool) -> Command:
        """The command of the sample that was taken in."""
        region, newton = self.region, self.newton
        if region is None or np.ptp(newton.reference, axis=1).any():
            return super().solve(want_prediction=want_prediction)
        value = float(np.square(region.root @ self.deviation).sum())
        if value > region.level:
            return super().solve(want_prediction=want_prediction)
        newton.trajectory[:], inputs = self.local_trajectory(region)
        # What the MPC goes on from if a push throws the state out.
        for block in range(newton.horizon.n_blocks):
            newton.plan[:, block] = inputs[:, newton.horizon.blocks == block].mean(axis=1)
        return Command(
            inputs[:, 0].copy(),
            objective=value,
            slack=0.0,
            message=LOCAL_LAW,
            prediction=self.prediction() if want_prediction else None,
            out_of_reach=self.target is not None and self.target.projected,
            terminal_residual=0.0,
        )


class ControlLyapunovState(_RegionState):
    """The end of the prediction is no higher in V than that of the local law alone."""

    def begin_sample(self, sample: ControlSample) -> None:
        """As with a region, whose level is what V the local law would come to."""
        super().begin_sample(sample)
        region = self.region
        if region is None:
            return
        centre = self.newton.horizon.arguments["centre"].ravel().copy()
        states, inputs = self.local_trajectory(region)
        end = np.concatenate([states[:, -1], inputs[:, -1]]) - centre
        values = [float(np.square(region.root @ xi).sum()) for xi in (self.deviation, end)]
        level = min(value if math.isfinite(value) else math.inf for value in values)
        if math.isfinite(level):
            self.newton.set_region(centre, region.root, level)


class ContractiveState(NewtonMpcState):
    """The end of the prediction is nearer to the steady state than the present, by a factor."""

    def __init__(self, config: NewtonMpc, setup: ControlSetup) -> None:
        super().__init__(config, setup)
        self._contraction = config.contraction
        n, n_x = self.discrete.n_x + self.model.n_u, self.model.n_x
        self._root = np.zeros((n, n))
        # What remembers the path has an infinite size: it may stay at any value.
        self._root[range(n_x), range(n_x)] = 1.0 / self.problem.horizon.scale

    def begin_sample(self, sample: ControlSample) -> None:
        """As with the equality, and the distance that the prediction may end at."""
        super().begin_sample(sample)
        if not self.inputs_finite or self.target is None:
            return
        n_x = self.model.n_x
        centre = np.zeros(len(self._root))
        centre[:n_x] = self.target.x
        away = float(np.linalg.norm((self._full[:n_x] - centre[:n_x]) * np.diag(self._root)[:n_x]))
        self.newton.set_region(centre, self._root, (self._contraction * away) ** 2)


#: By ``terminal``; what is not here runs on the compiled engine.
STATES: dict[str, type[DualModeState | ControlLyapunovState | ContractiveState]] = {
    "dual_mode": DualModeState,
    "control_lyapunov": ControlLyapunovState,
    "contractive": ContractiveState,
}
