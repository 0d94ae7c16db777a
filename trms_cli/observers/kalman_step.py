"""Prediction and update of a Kalman filter over a transition that has a slope.

    m⁻ = F(m)        P⁻ = A P Aᵀ + Q
    K = P⁻ Hᵀ (H P⁻ Hᵀ + R)⁻¹        m = m⁻ + K (y − h(m⁻))
    P = (I − K H) P⁻ (I − K H)ᵀ + K R Kᵀ

The update is in Joseph's form, which stays symmetric and positive semidefinite whatever the gain
is (Bucy & Joseph 1968). What A is makes the filter: the Jacobian at m (the extended Kalman filter),
state-dependent coefficients at m, or a constant.
"""

import casadi as ca

from trms_cli.core.process_cache import call_memoised
from trms_cli.models.discretisation import discretise
from trms_cli.observers.augmentation import AugmentedModel
from trms_cli.observers.recursive_filter import INPUTS, OUTPUTS


def diagonal(values: ca.MX) -> ca.MX:
    """A dense matrix with these values on its diagonal."""
    return ca.densify(ca.diag(values))


def gain_stage(n: int, n_y: int) -> ca.Function:
    """``cross S⁻¹`` by Cholesky factors."""
    cross, S = ca.SX.sym("cross", n, n_y), ca.SX.sym("S", n_y, n_y)
    root = ca.chol(S)
    gain = ca.solve(root, ca.solve(root.T, cross.T)).T
    return ca.Function("gain", [cross, S], [ca.densify(gain)])


def joseph(remainder: ca.MX, gain: ca.MX, variances: ca.MX, floor: ca.MX) -> ca.MX:
    """``remainder + K R Kᵀ`` and the least variances, symmetric: the covariance after an update.

    ``remainder``: (n, n); what is left of the prior's. ``gain``: K, (n, n_y).
    ``variances``: (n_y, 1); the diagonal of R.
    """
    noise = (gain * ca.repmat(variances.T, gain.shape[0], 1)) @ gain.T
    P = remainder + noise + diagonal(floor)
    return (P + P.T) / 2


def gate_channels(mask: ca.MX, innovation: ca.MX, variance: ca.MX, gate: ca.MX) -> ca.MX:
    """1 for each channel that is there and within its gate, else 0, (n_y, 1).

    ``mask``: (n_y, 1); 1 where there is a sample. ``innovation``, ``variance``: (n_y, 1); and what
    is expected of its square. ``gate``: (n_y, 1); squared width in standard deviations; infinite:
    open.
    """
    return mask * (innovation * innovation <= gate * variance)


def added_variances(augmented: AugmentedModel, q: ca.MX, *at: ca.MX) -> ca.MX:
    """Variances that a sample adds to z: none to a torque that dry friction hides, (n, 1).

    Whatever that torque does in the meantime shows only once the axis turns again. Until then its
    estimate stays as sure as it was, or the first motion would overthrow it.

    ``at``: (z, memory, u, p, w_known) at the sample's beginning.
    """
    observable = call_memoised(AugmentedModel.observable, augmented)
    return q if observable is None else q * observable(*at)


def step_inputs(augmented: AugmentedModel, n_p: int) -> list[ca.MX]:
    """Symbols of a step's inputs, in the order of :data:`INPUTS`; ``p`` has n_p entries."""
    n, n_y, model = augmented.n, len(augmented.channels), augmented.model
    rows = {"m": n, "P": n, "memory": augmented.n_m, "u": model.n_u, "advance": 1}
    rows |= {"known": model.n_w, "p": n_p, "q": n, "floor": n}
    return [ca.MX.sym(name, rows.get(name, n_y), n if name == "P" else 1) for name in INPUTS]


def disturbances(
    augmented: AugmentedModel, mean: ca.MX, sd: ca.MX, w_known: ca.MX
) -> tuple[ca.MX, ca.MX]:
    """All disturbances and their standard deviations, (n_w, 1) each."""
    d, d_sd = ca.MX(w_known), ca.MX.zeros(augmented.model.n_w)
    for k, equation in enumerate(augmented.equations):
        d[equation] += mean[augmented.n_s + k]
        d_sd[equation] = sd[augmented.n_s + k]
    return d, d_sd


def kalman_step(
    name: str,
    augmented: AugmentedModel,
    transition: ca.Function,
    measurement: ca.Function,
    restate: ca.Function | None = None,
) -> ca.Function:
    """One sample; see :mod:`trms_cli.observers.recursive_filter` for inputs and outputs.

    ``name``: a valid C identifier. ``transition``: ``(z, memory, u, p, w_known) → z⁺, A, memory⁺``.
    ``measurement``: ``(z, u, p) → y, H``. ``restate``: ``(z, memory, u, p, w_known) → z`` with the
    torques that the estimate is to tell.
    """
    n, n_y, n_m = augmented.n, len(augmented.channels), augmented.n_m
    inputs = step_inputs(augmented, transition.size1_in(3))
    m, P, memory, u, y, mask, advance, w_known, p, q, r, floor, gate = inputs
    z_next, A, memory_next = transition(m, memory, u, p, w_known)
    m_prior = ca.if_else(advance > 0, z_next, m)
    q = added_variances(augmented, q, m, memory, u, p, w_known)
    P_prior = ca.if_else(advance > 0, A @ P @ A.T + diagonal(q), P)
    if n_m:
        memory_next = ca.if_else(advance > 0, memory_next, memory)
    predicted, H = measurement(m_prior, u, p)
    cross = P_prior @ H.T
    S_all = H @ cross
    variance = ca.diag(S_all) + r
    innovation = mask * (y - predicted)
    believed = gate_channels(mask, innovation, variance, gate)
    # A channel that is not there has no slope and a variance of one: it changes nothing.
    H = H * ca.repmat(believed, 1, n)
    S = S_all * (believed @ believed.T) + diagonal(believed * r + (1 - believed))
    gain = gain_stage(n, n_y)(cross * ca.repmat(believed.T, n, 1), S)
    m_next = m_prior + gain @ innovation
    reduction = ca.MX.eye(n) - gain @ H
    P_next = joseph(reduction @ P_prior @ reduction.T, gain, believed * r, floor)
    sd = ca.sqrt(ca.diag(P_next))
    reported_mean = m_next if restate is None else restate(m_next, memory_next, u, p, w_known)
    health = ca.sum1(m_next) + ca.sum1(sd) + ca.sum1(ca.vec(P_next))
    return ca.Function(
        name,
        inputs,
        [
            *(m_next, P_next, memory_next, health, sd),
            *disturbances(augmented, reported_mean, sd, w_known),
            *(predicted, innovation, ca.sqrt(variance), mask - believed),
        ],
        list(INPUTS),
        list(OUTPUTS),
    )


def exact_transition(augmented: AugmentedModel) -> ca.Function:
    """The model's own step with its Jacobian: ``(z, memory, u, p, w_known) → z⁺, A, memory⁺``.

    A model that steps several times in a sample is differentiated once, and its slopes follow by
    the chain rule: the code does not grow with the number of steps.
    """
    n_s, n = augmented.n_s, augmented.n
    z, memory, u, p, w_known = augmented.symbols()
    parts = _equal_steps(augmented)
    single: dict[int, ca.Function] = {}
    for part in parts:
        if id(part) in single:
            continue
        after = part(ca.vertcat(z[:n_s, 0], memory), u, p, augmented.torques(z, w_known))
        following = ca.vertcat(after[:n_s, 0], z[n_s:, 0])
        results = [following, ca.jacobian(following, z), after[n_s:, 0]]
        single[id(part)] = ca.Function(
            f"part_{len(single)}",
            [z, memory, u, p, w_known],
            [ca.densify(result) for result in ca.cse(results)],
        )
    if len(parts) == 1:
        return single[id(parts[0])]
    at, memory_0, *rest = augmented.symbols(ca.MX)
    state, slope, remembered = at, ca.MX.eye(n), memory_0
    for part in parts:
        state, one, remembered = single[id(part)](state, remembered, *rest)
        slope = one @ slope
    return ca.Function("transition", [at, memory_0, *rest], [state, ca.densify(slope), remembered])


def _equal_steps(augmented: AugmentedModel) -> tuple[ca.Function, ...]:
    """Steps that make up a sample: the model's own, or its substeps where nothing remembers.

    A memory changes at some part of the sample, and makes the substeps unequal.
    """
    discrete, count = augmented.discrete, augmented.substeps
    if len(discrete.parts) > 1 or count == 1 or discrete.n_x > augmented.model.n_x:
        return discrete.parts
    return (discretise(augmented.model, discrete.step_length / count).step,) * count


def exact_measurement(augmented: AugmentedModel) -> ca.Function:
    """The measured channels with their slope: ``(z, u, p) → y, H``."""
    z, _, u, p, _ = augmented.symbols()
    y = augmented.measured(z, u, p)
    results = ca.cse([y, ca.jacobian(y, z)])
    return ca.Function("measure", [z, u, p], [ca.densify(result) for result in results])
