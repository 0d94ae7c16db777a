"""Weights by name, put into the order of a model's signals."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest

FloatArray = npt.NDArray[np.float64]


def in_order(
    given: Mapping[str, float], known: tuple[str, ...], default: float, key: str
) -> FloatArray:
    """Weights in the order of ``known``, shape (len(known),).

    Names of an axis that this model lacks are passed over, so that one configuration also serves
    the models of one axis.

    Raises ConfigurationError for any other name; ``key`` is where it stands in the controller's
    configuration.
    """
    everywhere = {"alpha_v", "alpha_h", "u_v", "u_h", *known}
    for name in given:
        if name not in everywhere:
            raise ConfigurationError(
                f"{name!r} is not a name that a weight can have here",
                where=f"controller.{key}",
                remedy=nearest(name, known),
            )
    return np.array([given.get(name, default) for name in known])
