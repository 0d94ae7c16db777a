"""Expressions that every filter's update is made of."""

from __future__ import annotations

import casadi as ca

from trms_cli.observers.augmentation import AugmentedModel


def diagonal(values: ca.MX) -> ca.MX:
    """A dense matrix with these values on its diagonal."""
    return ca.densify(ca.diag(values))


def gain_stage(n: int, n_y: int) -> ca.Function:
    """``cross S⁻¹`` by Cholesky factors."""
    cross, S = ca.SX.sym("cross", n, n_y), ca.SX.sym("S", n_y, n_y)
    root = ca.chol(S)
    gain = ca.solve(root, ca.solve(root.T, cross.T)).T
    return ca.Function("gain", [cross, S], [ca.densify(gain)])


def gated(mask: ca.MX, innovation: ca.MX, variance: ca.MX, gate: ca.MX) -> ca.MX:
    """1 for each channel that is there and within its gate, else 0, (n_y, 1).

    Parameters
    ----------
    mask : (n_y, 1)
        1 where there is a sample.
    innovation, variance : (n_y, 1)
        And what is expected of its square.
    gate : (n_y, 1)
        Squared width in standard deviations; infinite: open.
    """
    return mask * (innovation * innovation <= gate * variance)


def disturbances(
    augmented: AugmentedModel, mean: ca.MX, sd: ca.MX, known: ca.MX
) -> tuple[ca.MX, ca.MX]:
    """All disturbances and their standard deviations, (n_w, 1) each."""
    d, d_sd = ca.MX(known), ca.MX.zeros(augmented.model.n_w)
    for k, equation in enumerate(augmented.equations):
        d[equation] += mean[augmented.n_s + k]
        d_sd[equation] = sd[augmented.n_s + k]
    return d, d_sd
