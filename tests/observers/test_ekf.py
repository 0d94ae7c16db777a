"""The extended Kalman filter is filterpy's on the rig's model."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from observed_rigs import NOISE_SD, SAMPLE_TIME, Rig, commands, setup_for

from trms_cli.models.discretisation import discretise
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.model import Model, names
from trms_cli.models.newtonian import Newtonian
from trms_cli.observers.ekf import Ekf


@pytest.mark.parametrize(
    "model",
    [Newtonian(), Newtonian(currents="dynamic"), Lagrangian()],
    ids=["newtonian", "currents", "lagrangian"],
)
def test_on_the_rigs_model_it_is_filterpys(model: Model) -> None:
    outputs = names(model.outputs)
    observer = Ekf(disturbances=("pitch_moment", "yaw_moment"))
    state = observer.init(setup_for(model))
    linearised, p = discretise(model, SAMPLE_TIME).linearised(), model.parameters.values
    rows = [model.state_index(name) for name in outputs]
    n_x, n = model.n_x, model.n_x + 2
    H = np.eye(n)[rows]
    theirs = ExtendedKalmanFilter(n, 4)
    theirs.x, theirs.P = state.prior_mean.copy(), state.prior_covariance.copy()
    inputs = dict(zip(state.function.function.name_in(), state.function.inputs, strict=True))
    theirs.Q = np.diag(inputs["q"])
    theirs.R = np.diag([NOISE_SD[name] ** 2 for name in outputs])
    rig, u_before = Rig(model, outputs), np.zeros(2)
    for k, u in enumerate(commands(150)):
        y = rig.measure()
        if k > 0:
            w = np.array([*theirs.x[n_x:], 0.0, 0.0])
            after, A, _, _, G = (
                np.array(value) for value in linearised(theirs.x[:n_x], u_before, p, w)
            )
            theirs.F = np.eye(n)
            theirs.F[:n_x, :n_x], theirs.F[:n_x, n_x:] = A, G[:, :2]
            # filterpy's prediction of the mean is linear: the model's own step stands in
            theirs.x = np.concatenate([after[:, 0], theirs.x[n_x:]])
            theirs.P = theirs.F @ theirs.P @ theirs.F.T + theirs.Q
        theirs.update(y, lambda z: H, lambda z: H @ z)
        estimate = observer.step(state, u_before, y, None)
        scale = np.sqrt(np.diag(theirs.P))
        np.testing.assert_allclose(
            estimate.x / scale[:n_x], theirs.x[:n_x] / scale[:n_x], rtol=0, atol=1e-6
        )
        np.testing.assert_allclose(estimate.sd, scale[:n_x], rtol=1e-6)
        np.testing.assert_allclose(
            estimate.disturbance[:2] / scale[n_x:], theirs.x[n_x:] / scale[n_x:], rtol=0, atol=1e-6
        )
        u_before = u
        rig.advance(u, np.zeros(4))
