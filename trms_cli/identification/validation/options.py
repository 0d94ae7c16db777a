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
    """Free-run windows.

    Attributes
    ----------
    start : {"estimated", "moving_horizon", "fitted"}
        The state at the start of a window: the filter's, from all samples before it; that of the
        model's own best run over the seconds before it; or fitted to the window itself, which
        flatters the model.
    history : float
        s before the first window, and what ``moving_horizon`` fits to.
    stride : float
        s between the starts of two windows.
    """

    start: Literal["estimated", "moving_horizon", "fitted"] = "estimated"
    history: _Positive = 2.0
    stride: _Positive = 0.5


@dataclass(frozen=True, kw_only=True)
class PredictorOptions:
    """The filter whose innovations are the one-step errors.

    Attributes
    ----------
    process_noise : {"fitted", "nominal"}
        Scaled to the recording by maximum likelihood, or as the observer has it by default.
    torques : tuple of str
        Equations with an estimated torque; none by default, so that the model answers alone.
    settle : float
        s at the beginning that are not judged.
    """

    process_noise: Literal["fitted", "nominal"] = "fitted"
    torques: tuple[str, ...] = ()
    settle: Annotated[float, Meta(ge=0)] = 2.0


@dataclass(frozen=True, kw_only=True)
class TestOptions:
    """Tests of the one-step errors.

    Attributes
    ----------
    lags : int
        Of the autocorrelation, samples.
    longest : float
        Longest lag of the tests with inputs, s.
    level : float
        Probability of one or more false alarms in all tests together.
    calibration : {"asymptotic", "simulated"}
        p-values from the limit of long recordings, or from simulations of the model with the
        sensors' noise and quanta on the recorded commands.
    simulations : int
        How many, where they are asked for.
    """

    lags: Annotated[int, Meta(ge=1, le=500)] = 20
    longest: _Positive = 2.0
    level: _Share = 0.05
    calibration: Literal["asymptotic", "simulated"] = "asymptotic"
    simulations: Annotated[int, Meta(ge=10)] = 50

    __test__ = False  # no test class, whatever its name


@dataclass(frozen=True, kw_only=True)
class ValidationOptions:
    """All that a validation is told besides model and recordings.

    Attributes
    ----------
    horizons : tuple of float
        s, rising.
    windows : WindowOptions
    predictor : PredictorOptions
    tests : TestOptions
    block : float
        s of the blocks that intervals are bootstrapped over.
    seed : int
        Of the bootstrap and of simulations.
    """

    horizons: tuple[_Positive, ...] = (0.1, 0.5, 2.0, 10.0)
    windows: WindowOptions = field(default_factory=WindowOptions)
    predictor: PredictorOptions = field(default_factory=PredictorOptions)
    tests: TestOptions = field(default_factory=TestOptions)
    block: _Positive = 10.0
    seed: Annotated[int, Meta(ge=0)] = 0

    def __post_init__(self) -> None:
        if not self.horizons or any(
            b <= a for a, b in zip(self.horizons, self.horizons[1:], strict=False)
        ):
            raise ConfigurationError(
                f"{list(self.horizons)} given",
                where="horizons",
                remedy="give one or more times in s, rising: 'horizons=[0.1,0.5,2,10]'",
            )
