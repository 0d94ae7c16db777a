"""Several signals added up."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trms_cli.core.errors import ConfigurationError
from trms_cli.references.signal import Array, ReferenceSignal, require_signal


@dataclass(frozen=True, kw_only=True)
class Sum:
    """``r(t) = Σ terms_i(t)``."""

    terms: Sequence[ReferenceSignal]  #: At least one

    def __post_init__(self) -> None:
        if not self.terms:
            raise ConfigurationError(
                "a sum of no signals", where="terms", remedy="give at least one signal"
            )
        for index, term in enumerate(self.terms):
            require_signal(term, f"terms[{index}]")

    def sample(self, times: Array) -> Array:
        return np.sum([term.sample(times) for term in self.terms], axis=0)
