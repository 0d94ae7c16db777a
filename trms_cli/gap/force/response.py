"""What a missing force did to the motion, and what the rig would have done without it.

A draught moves the rig, so that its motion tells of the draught: a regression of the force on the
states would find a dependence where there is none. The motion less what the force itself did to it
is free of that. The response comes from the record alone: increments of the states are regressed on
states, commands, some products that the physics has, and the force; linearised along the motion
that regression says how the force's share δ of the motion evolves::

    δ⁺ = (I + A + C ∂g/∂z) δ + B f

A command that follows the states (closed loop) is treated as one of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from trms_cli.gap.force.record import FloatArray, ForceRecord, segments

#: Share of a command's unexplained increments that the states must explain for a closed loop.
_FEEDBACK = 0.3
#: Spreads of a variable beyond which its response to the force is not believed.
_LARGEST = 3.0


@dataclass(frozen=True, kw_only=True)
class Response:
    """How the variables of a record answer to the force."""

    record: ForceRecord
    #: (k, n) array; the variables of the record, in the order of :attr:`ForceRecord.variables`
    motion: FloatArray
    steps: FloatArray  #: (k, n, n) array; linearised transition from a sample to the next
    push: FloatArray  #: (n,) array; answer within one step to a force of one

    def undisturbed(self) -> FloatArray:
        """The motion without the force, (k, n); each stretch begins with the measured state."""
        force = self.record.force
        middle = np.append(force[:-1] / 2 + force[1:] / 2, 0.0)
        return self.motion - self._response(lambda i, _: middle[i])

    def governed(
        self, undisturbed: FloatArray, law: Callable[[int, FloatArray], float]
    ) -> FloatArray:
        """The motion, (k, n), if the force followed a law of sample and variables, (n,)."""
        return undisturbed + self._response(lambda i, now: law(i, undisturbed[i] + now))

    def _response(self, force: Callable[[int, FloatArray], float]) -> FloatArray:
        limit = _LARGEST * self.motion.std(axis=0)
        response = np.zeros_like(self.motion)
        for part in segments(self.record):
            now = np.zeros(self.push.size)
            for i in range(part.start, part.stop - 1):
                now = self.steps[i] @ now + self.push * force(i, now)
                now = np.minimum(np.maximum(now, -limit), limit)
                response[i + 1] = now
        return response


def fitted_response(record: ForceRecord) -> Response:
    """Fit the response to the force; the record at about 10 Hz."""
    names = list(record.variables)
    z = np.array([record.variables[name] for name in names]).T
    terms, slopes = _terms(names, z)
    starts = np.concatenate([np.arange(p.start, p.stop - 1) for p in segments(record)])
    force = record.force[starts] / 2 + record.force[starts + 1] / 2
    increments = z[starts + 1] - z[starts]
    columns = np.column_stack([z[starts], terms[starts], force, np.ones(starts.size)])
    scale = np.sqrt(np.mean(columns**2, axis=0)) + 1e-300
    fitted = np.linalg.lstsq(columns / scale, increments, rcond=1e-8)[0] / scale[:, None]
    for row, name in enumerate(names):
        if name.endswith("command") and not _follows(names, row, z[starts], increments[:, row]):
            fitted[:, row] = 0.0
    n, m = len(names), terms.shape[1]
    linear, curved, push = fitted[:n].T, fitted[n : n + m].T, fitted[n + m]
    steps = np.eye(n) + linear + np.einsum("im,kmj->kij", curved, slopes)
    return Response(record=record, motion=z, steps=steps, push=push)


def _terms(names: list[str], z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Products that the physics has, (k, m), and their derivatives by the variables, (k, m, n)."""
    values: list[FloatArray] = []
    slopes: list[FloatArray] = []

    def add(column: int, value: FloatArray, slope: FloatArray) -> None:
        values.append(value)
        derivative = np.zeros_like(z)
        derivative[:, column] = slope
        slopes.append(derivative)

    for column, name in enumerate(names):
        v = z[:, column]
        if name.endswith(("rate", "rotor speed")):
            add(column, v * np.abs(v), 2 * np.abs(v))
        elif name == "pitch angle":
            add(column, np.cos(v), -np.sin(v))
            add(column, np.sin(v), np.cos(v))
    if not values:
        return np.zeros((len(z), 0)), np.zeros((len(z), 0, len(names)))
    return np.array(values).T, np.array(slopes).transpose(1, 0, 2)


def _follows(names: list[str], row: int, z: FloatArray, increments: FloatArray) -> bool:
    """Whether angles and rates decide a command's increments: a loop is closed."""
    motion = [i for i, name in enumerate(names) if name.endswith(("angle", "rate"))]

    def left(columns: FloatArray) -> float:
        fitted = np.linalg.lstsq(columns, increments)[0]
        return float(np.sum((increments - columns @ fitted) ** 2))

    alone = np.column_stack([z[:, row], np.ones(len(z))])
    both = np.column_stack([alone, z[:, motion]])
    return left(both) < (1 - _FEEDBACK) * left(alone)
