"""Networks of known behaviour for tests: no training, weights from a few lines of physics."""

from collections.abc import Sequence

import numpy as np

from trms_cli.models.narx_file import Narx
from trms_cli.models.network import NarxStructure, Network

SAMPLE_TIME = 0.02
LIMITS = {"u_v": 2.5, "u_h": 2.5, "alpha_v": 1.05, "alpha_h": 2.8}
OUTPUTS, INPUTS = ("alpha_v", "alpha_h", "omega_v", "omega_h"), ("u_v", "u_h")
#: Per axis: spring, damping (1/s², 1/s), pull of the rotor (1/s), its gain (rad/(s V)) and lag (s).
_PHYSICS = ((1.6, 1.2, 0.012, 140.0, 0.6), (0.5, 0.9, 0.006, 250.0, 0.3))


def structure(
    output_lags: Sequence[int] = (1, 2),
    input_lags: Sequence[int] = (1,),
    *,
    incremental: bool = True,
    differences: bool = True,
) -> NarxStructure:
    units = ("rad", "rad", "rad/s", "rad/s"), ("V", "V")
    lags = tuple(output_lags), tuple(input_lags)
    return NarxStructure(OUTPUTS, INPUTS, *units, *lags, SAMPLE_TIME, incremental, differences)


def rig_like(
    output_lags: Sequence[int] = (1, 2),
    input_lags: Sequence[int] = (1,),
    *,
    bend: float = 0.2,
    seed: int = 0,
    **kinds: bool,
) -> Narx:
    """Two damped axes, each driven by a lagged rotor, bent a little by hidden units.

    ``bend`` is the size of the hidden units' part of the accelerations; 0 makes it linear.
    """
    made = structure(output_lags, input_lags, **kinds)
    rng = np.random.default_rng(seed)
    n_phi, T = made.n_regressors, SAMPLE_TIME
    # On the lagged values themselves: y(k), y(k−1), …, then u(k).
    linear = np.zeros((4, n_phi))
    gap = made.output_lags[1] - made.output_lags[0]
    for axis, (spring, damping, pull, gain, lag) in enumerate(_PHYSICS):
        keep = (1 - damping * T) / gap
        linear[axis, axis] = keep - spring * T**2
        linear[axis, 4 + axis] = -keep
        linear[axis, 2 + axis] = pull * T**2
        linear[2 + axis, 2 + axis] = -T / lag
        linear[2 + axis, 4 * len(made.output_lags) + axis] = T * gain / lag
    if not made.incremental:
        linear[:, :4] += np.eye(4)
    on_regressors = linear @ np.linalg.inv(made.arrangement())
    regressor_sd = np.exp(rng.normal(0, 0.3, n_phi))
    regressor_mean = rng.normal(0, 0.2, n_phi)
    output_sd = np.array([T**2, T**2, T, T])
    hidden = 5
    W1 = rng.normal(0, 0.3, (hidden, n_phi))
    W2 = bend * rng.normal(0, 1, (4, hidden))
    network = Network(
        "mlp",
        {
            "W1": W1,
            "b1": rng.normal(0, 0.3, hidden),
            "W2": W2,
            "b2": np.zeros(4),
            "A": on_regressors * regressor_sd / output_sd[:, None],
        },
        regressor_mean,
        regressor_sd,
        on_regressors @ regressor_mean,
        output_sd,
    )
    return Narx(made, network, limits=LIMITS)
