"""What is asked of a validation."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from trms_cli.core.errors import ConfigurationError

_Positive = Annotated[float, Meta(gt=0)]
_Share = Annotated[float, Meta(gt=0, lt=1)]


@dataclass(frozen=True, kw_only=True)
class WindowOptions:
    """Free-run windows."""

    #: The state at the start of a window: the filter's, from all samples before it; that of the
    #: model's own best run over the seconds before it; or fitted to the window itself, which
    #: flatters the model
    start: Literal["estimated", "moving_horizon", "fitted"] = "estimated"
    history: _Positive = 2.0  #: s before the first window, and what ``moving_horizon`` fits to
    stride: _Positive = 0.5  #: s between the starts of two windows


@dataclass(frozen=True, kw_only=True)
class PredictorOptions:
    """The filter whose innovations are the one-step errors."""

    #: Scaled to the recording by maximum likelihood, or as the observer has it by default
    process_noise: Literal["fitted", "nominal"] = "fitted"
    #: Equations with an estimated torque; none by default, so that the model answers alone
    torques: tuple[str, ...] = ()
    settle: Annotated[float, Meta(ge=0)] = 2.0  #: s at the beginning that are not judged


@dataclass(frozen=True, kw_only=True)
class TestOptions:
    """Tests of the one-step errors."""

    lags: Annotated[int, Meta(ge=1, le=500)] = 20  #: Of the autocorrelation, samples
    longest: _Positive = 2.0  #: Longest lag of the tests with inputs, s
    level: _Share = 0.05  #: Probability of one or more false alarms in all tests together
    #: p-values from the limit of long recordings, or from simulations of the model with the
    #: sensors' noise and quanta on the recorded commands
    calibration: Literal["asymptotic", "simulated"] = "asymptotic"
    simulations: Annotated[int, Meta(ge=10)] = 50  #: How many, where they are asked for

    __test__ = False  # no test class, whatever its name


@dataclass(frozen=True, kw_only=True)
class ValidationOptions:
    """All that a validation is told besides model and recordings."""

    horizons: tuple[_Positive, ...] = (0.1, 0.5, 2.0, 10.0)  #: s, rising
    windows: WindowOptions = field(default_factory=WindowOptions)
    predictor: PredictorOptions = field(default_factory=PredictorOptions)
    tests: TestOptions = field(default_factory=TestOptions)
    block: _Positive = 10.0  #: s of the blocks that intervals are bootstrapped over
    seed: Annotated[int, Meta(ge=0)] = 0  #: Of the bootstrap and of simulations

    def __post_init__(self) -> None:
        if not self.horizons or any(
            b <= a for a, b in zip(self.horizons, self.horizons[1:], strict=False)
        ):
            raise ConfigurationError(
                f"{list(self.horizons)} given",
                where="horizons",
                remedy="give one or more times in s, rising: 'horizons=[0.1,0.5,2,10]'",
            )
