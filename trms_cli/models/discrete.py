"""Models that are known from sample to sample only: a step, and no derivative.

A black box learns ``x⁺ = transition(x, u, p, w)`` at the sample time of its data. Whatever needs
only a step works with it: simulation, the UKF, the MPC, linear designs. A longer step is the
composition of whole ones (:func:`trms_cli.models.discretisation.discretise`); shorter ones and
accelerations do not exist.

Some of the states only remember: the step copies them from another state or from an input, as the
delayed outputs and inputs of a NARX model. Where the model rests they follow from the others.
"""

from abc import abstractmethod

import casadi as ca

from trms_cli.core.errors import ModelError
from trms_cli.models.model import Model


class SteppedModel(Model):
    """A model with a step of one ``sample_time`` and no derivative."""

    sample_time: float  #: s, length of the step

    @abstractmethod
    def transition(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        """States one ``sample_time`` later, ``u`` and ``w`` held over it, shape (n_x, 1)."""

    def dynamics(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        """Refused: there is no derivative.

        Raises ModelError: Always; it says what is possible.
        """
        raise ModelError(
            f"model {self.name!r} steps from sample to sample ({self.sample_time:g} s) and has no "
            "derivative",
            where="model",
            remedy="choose one with equations where accelerations are needed, as model=newtonian",
        )


def copied_states(model: Model) -> dict[int, tuple[str, int]]:
    """States that a step only copies, by position: their source now.

    Returns ``("x", j)`` for a state whose next value is that of state j, ``("u", j)`` of input j.
    Empty for a model with a derivative. A state that only keeps itself is not among them.
    """
    if model.sample_time is None:
        return {}
    x, u, p, w = model.symbols()
    after = model.transition(x, u, p, w)
    source = {x[j].element_hash(): ("x", j) for j in range(model.n_x)}
    source |= {u[j].element_hash(): ("u", j) for j in range(model.n_u)}
    copies = {}
    for i in range(model.n_x):
        origin = source.get(after[i].element_hash()) if after[i].is_symbolic() else None
        if origin is not None and origin != ("x", i):
            copies[i] = origin
    return copies


def root_of(copies: dict[int, tuple[str, int]], state: int) -> tuple[str, int]:
    """What a state equals in the end where the model rests: an input, or a state of its own.

    A ring of copies has no such end; its states stand for themselves.
    """
    kind, at = "x", state
    for _ in range(len(copies) + 1):
        if kind == "u" or at not in copies:
            return kind, at
        kind, at = copies[at]
    return "x", state
