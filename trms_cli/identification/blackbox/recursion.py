"""Predictors that correct themselves by their residuals, as one recursion.

A network whose regressors have past residuals (NNARMAX), and one in innovations form (NNSSIF),
predict p(k) — the outputs, or the states — from p of before::

    φ(k) = K(k) + Σ_l M_l p(k − l)            K(k): commands and measured outputs of before
    p(k) = b(k) + S p(k − 1) + N(φ(k))        b(k): y(k − 1) in an incremental NNARMAX, else 0
    ŷ(k) = C p(k)

for the residuals e(k − l) = y(k − l) − C p(k − l) among the regressors are linear in both.

Many windows go side by side, so that a step is one matrix product for all of them.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trms_cli.core.arrays import FloatArray
from trms_cli.models.innovation_network import InnovationStructure
from trms_cli.models.network import NarxStructure, Network


class Drive(NamedTuple):
    """What recordings give to a recursion; T samples of m windows."""

    known: FloatArray  #: (T, m, n_phi) array; K(k), of no meaning before the first step
    base: FloatArray  #: (T, m, n_p) array; b(k)
    start: FloatArray  #: (first, m, n_p) array; p before the first step, as measured


@dataclass(frozen=True)
class Recursion:
    """The constant part of a predictor."""

    structure: NarxStructure | InnovationStructure
    first: int  #: The sample that is predicted first
    lags: tuple[int, ...]  #: Rising
    by_lag: tuple[FloatArray, ...]  #: M_l, (n_phi, n_p) arrays, one a lag
    shift: FloatArray  #: S, (n_p, n_p)
    output: FloatArray  #: C, (n_y, n_p)

    def drive(self, outputs: FloatArray, inputs: FloatArray) -> Drive:
        """From measured outputs (T, m, n_y), none missing, and commands (T, m, n_u)."""
        structure, first = self.structure, self.first
        n, m = outputs.shape[:2]
        known = np.zeros((n, m, structure.n_regressors))
        base = np.zeros((n, m, len(self.shift)))
        if isinstance(structure, InnovationStructure):
            n_x = structure.n_states
            known[1:, :, n_x : n_x + inputs.shape[2]] = inputs[:-1]
            known[1:, :, n_x + inputs.shape[2] :] = outputs[:-1]
            return Drive(known, base, np.concatenate(outputs[: structure.order], axis=1)[None])
        lagged = [outputs[first - lag : n - lag] for lag in structure.output_lags]
        lagged += [inputs[first - lag : n - lag] for lag in structure.input_lags]
        lagged += [outputs[first - lag : n - lag] for lag in structure.residual_lags]
        known[first:] = np.concatenate(lagged, axis=2) @ structure.arrangement().T
        if structure.incremental:
            base[first:] = outputs[first - 1 : n - 1]
        return Drive(known, base, outputs[:first])

    def run(self, network: Network, outputs: FloatArray, inputs: FloatArray) -> FloatArray:
        """Predicted outputs of windows side by side, (T, m, n_y), from the first step on.

        Samples before it are the measured ones. Not finite after a divergence.
        """
        drive = self.drive(outputs, inputs)
        p = np.empty_like(drive.base)
        p[: self.first] = drive.start
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(self.first, len(p)):
                phi = drive.known[k].copy()
                for lag, matrix in zip(self.lags, self.by_lag, strict=True):
                    phi += p[k - lag] @ matrix.T
                p[k] = drive.base[k] + p[k - 1] @ self.shift.T + network.evaluate(phi)
        return np.asarray(p @ self.output.T)


def recursion_of(structure: NarxStructure | InnovationStructure) -> Recursion:
    """The recursion of a structure with residuals among its regressors."""
    n_y, n_phi = len(structure.outputs), structure.n_regressors
    if isinstance(structure, InnovationStructure):
        n_x = structure.n_states
        output = np.eye(n_y, n_x)
        matrix = np.zeros((n_phi, n_x))
        matrix[:n_x] = np.eye(n_x)
        matrix[-n_y:] -= output
        return Recursion(structure, 1, (1,), (matrix,), structure.shift(), output)
    matrices = []
    begin = n_phi - structure.n_residuals
    for i in range(len(structure.residual_lags)):
        matrix = np.zeros((n_phi, n_y))
        matrix[begin + i * n_y : begin + (i + 1) * n_y] = -np.eye(n_y)
        matrices.append(matrix)
    return Recursion(
        structure,
        structure.longest_lag,
        structure.residual_lags,
        tuple(matrices),
        np.zeros((n_y, n_y)),
        np.eye(n_y),
    )


def corrects_itself(structure: NarxStructure | InnovationStructure) -> bool:
    """Whether residuals are among the regressors."""
    return structure.n_residuals > 0


def simulate_states(
    structure: InnovationStructure, network: Network, past: FloatArray, inputs: FloatArray
) -> FloatArray:
    """Outputs after the past of a network in innovations form, innovations zero, (K, m, n_y).

    ``past``: (order, m, n_y) array; the first outputs, which are the first state. ``inputs``:
    (order + K, m, n_u) array. Not finite after a divergence.
    """
    first, n_y = structure.order, len(structure.outputs)
    shift = structure.shift().T
    x = np.concatenate(past, axis=1)
    zeros = np.zeros((len(x), n_y))
    result = np.empty((len(inputs) - first, *past.shape[1:]))
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(1, len(inputs)):
            x = x @ shift + network.evaluate(np.hstack([x, inputs[k - 1], zeros]))
            if k >= first:
                result[k - first] = x[:, :n_y]
    return result


def filled(outputs: FloatArray) -> FloatArray:
    """Outputs (n, n_y) with missing samples on straight lines between their neighbours.

    A predictor that runs through a recording needs each; what is compared leaves them out.
    """
    if np.isfinite(outputs).all():
        return outputs
    result, index = outputs.copy(), np.arange(len(outputs))
    for column in result.T:  # views
        there = np.isfinite(column)
        column[~there] = np.interp(index[~there], index[there], column[there])
    return result
