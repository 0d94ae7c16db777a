"""The reference of a run: its axes, its configurations, its overrides on the command line."""

import numpy as np
import pytest

from trms_cli.composition.composer import compose
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build
from trms_cli.core.resources import config_folder
from trms_cli.references.constant import Constant
from trms_cli.references.shaping import Shaping
from trms_cli.references.sine import Sine
from trms_cli.references.square import Square
from trms_cli.references.step import Step
from trms_cli.references.trajectory import ReferenceTrajectory

from .conftest import needs_planner

REFERENCES = sorted(path.stem for path in (config_folder() / "ref").glob("*.yaml"))
TIMES = np.arange(0, 60, 0.01)


def composed(*overrides: str) -> ReferenceTrajectory:
    """The reference that a command line gets."""
    return build(compose(list(overrides)).config["ref"], "ref")


@pytest.mark.parametrize("name", REFERENCES)
def test_every_reference_there_is_can_be_built_and_stays_in_reach(tmp_path, name):
    table = tmp_path / "reference.csv"
    table.write_text("t[s],r_v[rad],r_h[rad]\n0,0.1,0.2\n1,0.3,0.4\n")
    more = [f"ref.alpha_v.file={table}"] if name == "from_csv" else []
    trajectory = composed(f"ref={name}", *more)
    values = trajectory.sample(TIMES)
    if name == "speed":
        assert trajectory.axes == ("omega_v", "omega_h")
        # Both rotors hold these with less than 2.5 V.
        assert values.min() > 0 and values[:, 0].max() < 250 and values[:, 1].max() < 600
        return
    assert trajectory.axes == ("alpha_v", "alpha_h")
    assert values.shape == (TIMES.size, 2)
    assert values[:, 0].min() > -0.9 and values[:, 0].max() < 0.6


def test_the_benchmark_is_as_agreed_and_changed_from_the_command_line():
    assert composed("ref=square", "ref.alpha_h.amplitude=0.7").alpha_h == Square(
        amplitude=0.7, frequency=0.025
    )
    mixed = composed("ref=per_axis", "signal@ref.alpha_v=sine", "signal@ref.alpha_h=step")
    assert isinstance(mixed.alpha_v, Sine) and isinstance(mixed.alpha_h, Step)
    shaped = composed("ref=square", "shaping@ref.shaping=limited", "ref.shaping.max_jerk=null")
    assert shaped.shaping == Shaping(max_rate=0.5, max_acceleration=0.5)
    assert composed("ref=square", "ref.alpha_h=null").axes == ("alpha_v",)
    summed = composed("ref=sum", "ref.alpha_v.terms.0.amplitude=0.05")
    assert summed.alpha_v.terms[0].amplitude == 0.05
    assert composed("ref=square") == ReferenceTrajectory(
        alpha_v=Square(amplitude=0.3, frequency=0.025),
        alpha_h=Square(amplitude=0.5, frequency=0.025),
    )


def test_columns_are_the_axes_in_order_and_mistakes_are_named():
    both = ReferenceTrajectory(alpha_v=Constant(offset=0.1), alpha_h=Constant(offset=0.2))
    np.testing.assert_array_equal(both.sample(np.zeros(3)), [[0.1, 0.2]] * 3)
    yaw = both.restricted_to(["alpha_h"])
    assert yaw.axes == ("alpha_h",)
    np.testing.assert_array_equal(yaw.sample(np.zeros(3)), [[0.2]] * 3)
    with pytest.raises(ConfigurationError, match="no reference"):
        yaw.restricted_to(["alpha_v"])
    with pytest.raises(ConfigurationError, match="no axis"):
        ReferenceTrajectory()
    with pytest.raises(ConfigurationError, match="is not a signal"):
        ReferenceTrajectory(alpha_v=Shaping(max_rate=1.0))
    with pytest.raises(ConfigurationError, match="is not a shaping"):
        ReferenceTrajectory(alpha_v=Constant(), shaping=Constant())


@needs_planner
def test_shaping_holds_on_every_axis():
    shaped = ReferenceTrajectory(
        alpha_v=Step(amplitude=0.3), alpha_h=Step(amplitude=-0.5), shaping=Shaping(max_rate=0.1)
    )
    values = shaped.sample(TIMES)
    assert np.max(np.abs(np.diff(values, axis=0))) <= 0.1 * 0.01 * (1 + 1e-9)
    np.testing.assert_allclose(values[-1], [0.3, -0.5])
