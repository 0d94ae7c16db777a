"""Recordings as MAT files: one vector per channel, named as in a CSV header.

In MATLAB: ``save('rec.mat', 't', 'u_v', 'u_h', 'alpha_v', 'alpha_h')``. Values are in SI
(commands in V) unless a struct ``units`` says otherwise: ``units.alpha_v = 'deg'``. Other
variables that are text become metadata; a single struct that holds all of it is opened.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.channels import find_channel
from trms_cli.recordings.recording import Recording, require_channels, require_values
from trms_cli.recordings.units import to_si

_REMEDY = "save('rec.mat', 't', 'u_v', 'u_h', 'alpha_v', 'alpha_h'), each a vector"


def read_mat(path: Path | str) -> Recording:
    """Read a MAT recording into SI units; NaN is a missing sample."""
    path = Path(path)
    variables = _variables(path)
    units = variables.get("units", {})
    if not isinstance(units, dict):
        raise RecordingError("'units' is not a struct", where=str(path), remedy="units.t = 's'")
    known = [name for name in variables if name == "t" or find_channel(name) is not None]
    require_channels(known, str(path))
    time, _ = to_si(
        _vector(path, "t", variables["t"]),
        str(units.get("t", "s")),
        ("s",),
        where=str(path),
        name="t",
    )
    _check_time(path, time)
    channels, si_units, ignored = {}, {}, []
    for name, value in variables.items():
        channel = find_channel(name)
        if channel is None:
            if name not in ("t", "units") and not isinstance(value, str):
                ignored.append(name)
            continue
        vector = _vector(path, name, value)
        if len(vector) != len(time):
            raise RecordingError(
                f"{name!r} has {len(vector)} samples, t has {len(time)}",
                where=str(path),
                remedy="give each channel a value per time, NaN where it is missing",
            )
        unit = str(units.get(name, channel.units[0] if channel.units else "1"))
        channels[name], si_units[name] = to_si(
            vector, unit, channel.units, where=str(path), name=name
        )
    require_values(channels, str(path))
    metadata = {name: value for name, value in variables.items() if isinstance(value, str)}
    remarks = (f"variables not used: {', '.join(ignored)}",) if ignored else ()
    return Recording(time, channels, si_units, metadata, path, remarks)


def _variables(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat

    try:
        content = loadmat(path, simplify_cells=True)
    except FileNotFoundError as error:
        raise RecordingError("there is no such file", where=str(path)) from error
    except NotImplementedError as error:
        raise RecordingError(
            "this is a MATLAB 7.3 file (HDF5)", where=str(path), remedy="save(..., '-v7')"
        ) from error
    except Exception as error:  # scipy's reader fails in many ways on files of another kind
        raise RecordingError(
            f"it cannot be read as a MAT file ({error})", where=str(path), remedy="save(..., '-v7')"
        ) from error
    variables = {name: value for name, value in content.items() if not name.startswith("__")}
    if len(variables) == 1 and isinstance(only := next(iter(variables.values())), dict):
        return only
    return variables


def _vector(path: Path, name: str, value: Any) -> np.ndarray:
    array = np.atleast_1d(np.squeeze(np.asarray(value)))
    if array.ndim != 1 or array.dtype.kind not in "fiub":
        raise RecordingError(
            f"{name!r} is not a vector of numbers (shape {array.shape})",
            where=str(path),
            remedy=_REMEDY,
        )
    vector = array.astype(float)
    infinite = np.flatnonzero(np.isinf(vector))
    if len(infinite):
        raise RecordingError(
            f"{name}({infinite[0] + 1}) is not finite",
            where=str(path),
            remedy="put NaN where a sample is missing",
        )
    return vector


def _check_time(path: Path, time: np.ndarray) -> None:
    if len(time) < 2:
        raise RecordingError(
            "there is a single sample", where=str(path), remedy="a recording needs two or more"
        )
    wrong = np.flatnonzero(~(np.diff(time) > 0))
    if len(wrong):
        index = int(wrong[0]) + 1
        raise RecordingError(
            f"time does not rise at t({index + 1}): {time[index]:.9g} s after "
            f"{time[index - 1]:.9g} s",
            where=str(path),
            remedy="sort the samples and keep one per time; NaN is no time",
        )
