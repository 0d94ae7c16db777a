"""A recording in the form that fits and validation take."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Signal


def recording(n: int = 100) -> Dataset:
    time = 0.1 * np.arange(n)
    return Dataset(
        name="rig",
        source="rig.csv",
        sha256="0" * 64,
        sample_time=0.1,
        time=time,
        inputs=(Signal("u_v", "V"),),
        outputs=(Signal("alpha_v", "rad"), Signal("omega_v", "rad/s")),
        commands=np.arange(n, dtype=float)[:, None],
        measurements=np.column_stack([np.sin(time), 10.0 * np.arange(n)]),
        noise_sd=np.array([0.001, 1.6]),
    )


@given(n=st.integers(2, 300), length=st.floats(0.2, 40.0), stride=st.none() | st.floats(0.1, 20.0))
def test_windows_lie_within_the_recording_and_part_it_without_a_stride(n, length, stride) -> None:
    first, count = recording(n).windows(length, stride)
    assert first[0] == 0
    assert (count >= 2).all() and (first + count <= n).all() and (np.diff(first) > 0).all()
    first, count = recording(n).windows(length)
    np.testing.assert_array_equal(first[1:], (first + count)[:-1])
    samples = count[0]
    assert n - (first[-1] + count[-1]) < max(2, samples / 2)


def test_parts_keep_time_and_rows_together() -> None:
    one, two = recording().split(0.7)
    assert (len(one), len(two)) == (70, 30)
    assert two.time[0] == pytest.approx(7.0)
    assert two.commands[0, 0] == 70.0
    assert two.output("omega_v")[0] == 700.0


def test_driven_by_a_channel() -> None:
    driven = recording().driven_by(["omega_v"])
    assert [s.name for s in driven.inputs] == ["u_v", "omega_v"]
    assert [s.name for s in driven.outputs] == ["alpha_v"]
    assert driven.noise_sd.tolist() == [0.001]
    # over the step from 3 to 4 the mean of 30 and 40
    assert driven.commands[3].tolist() == [3.0, 35.0]
    assert driven.commands[-1].tolist() == [99.0, 990.0]
    with pytest.raises(ConfigurationError, match="does not measure 'omega_h'"):
        recording().driven_by(["omega_h"])


def test_a_few_missing_samples_of_what_drives_are_interpolated_and_said() -> None:
    whole = recording()
    measurements = whole.measurements.copy()
    measurements[40:43, 1] = np.nan
    driven = replace(whole, measurements=measurements).driven_by(["omega_v"])
    np.testing.assert_allclose(driven.commands, whole.driven_by(["omega_v"]).commands)
    assert driven.remarks == ("3 samples of omega_v interpolated",)
    measurements[:60, 1] = np.nan
    with pytest.raises(ConfigurationError, match="missing in 60 of 100"):
        replace(whole, measurements=measurements).driven_by(["omega_v"])
