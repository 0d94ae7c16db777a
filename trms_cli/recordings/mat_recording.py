"""Recordings as MAT files: one vector per channel, or a struct per topic as exports have it.

In MATLAB: ``save('rec.mat', 't', 'u_v', 'u_h', 'alpha_v', 'alpha_h')``. Values are in SI
(commands in V) unless a struct ``units`` says otherwise: ``units.alpha_v = 'deg'``. Other
variables that are text become metadata; a single struct that holds all of it is opened.

A file with the structs ``measurement`` and ``command`` (and ``reference``, ``disturbance`` where
there are any) is read as the log that it was exported from: each has its own ``time`` and
``units``, and what lies on other times than the measurement's is held.

The structure of a file is walked through first (:mod:`trms_cli.core.mat_structure`).
"""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from trms_cli.core.data_file import not_as_written, recorded_bytes, unreadable
from trms_cli.core.errors import RecordingError
from trms_cli.core.mat_structure import USUAL_MOST, is_level_5, plain_variables
from trms_cli.recordings.channels import CHANNELS, Vocabulary, reference_of, to_si
from trms_cli.recordings.recording import Recording, refuse, require_channels, require_values

if TYPE_CHECKING:
    from trms_cli.recordings.log_reader import TopicTable

#: Structs of an exported log that are a recording.
_TOPICS = ("measurement", "command", "reference", "disturbance")
_REMEDY = "save('rec.mat', 't', 'u_v', 'u_h', 'alpha_v', 'alpha_h'), each a vector"


def read_mat(path: Path | str, vocabulary: Vocabulary | None = None) -> Recording:
    """Read a MAT recording into SI units; NaN is a missing sample.

    ``vocabulary``: of the model that it is read for; None: the file's own.
    """
    path = Path(path)
    with not_as_written(str(path)):
        return _recording(path, _variables(path), vocabulary)


def _recording(path: Path, variables: dict[str, Any], vocabulary: Vocabulary | None) -> Recording:
    if "t" not in variables and isinstance(variables.get("measurement"), dict):
        return _of_topics(path, variables, vocabulary)
    units = variables.get("units", {})
    if not isinstance(units, dict):
        refuse(path, "'units' is not a struct", "units.t = 's'")
    metadata = {name: value for name, value in variables.items() if isinstance(value, str)}
    where, columns = str(path), [name for name in variables if name != "units"]
    vocabulary = vocabulary or Vocabulary.declared(metadata, columns, where)
    ignored = vocabulary.left_out(columns, where)
    own = {str(vocabulary.name_of(name)): name for name in columns if name not in ignored}
    require_channels(list(own), where, vocabulary, ignored)
    time = _vector(path, own["t"], variables[own["t"]])
    time, _ = to_si(time, str(units.get(own["t"], "s")), ("s",), where=where, name=own["t"])
    _check_time(path, time, own["t"])
    del own["t"]
    channels, si_units = _channels(path, variables, units, len(time), own, vocabulary)
    require_values(channels, where, vocabulary)
    ignored = [name for name in ignored if name not in metadata]
    remarks = (f"variables not used: {', '.join(ignored)}",) if ignored else ()
    return Recording(time, channels, si_units, metadata, path, remarks, vocabulary)


def _channels(
    path: Path,
    struct: dict[str, Any],
    units: dict[str, Any],
    samples: int,
    names: Mapping[str, str],
    vocabulary: Vocabulary,
    topic: str = "",
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Vectors of a struct in SI, and their units, by name; ``samples``: as many as there are times.

    ``names``: the struct's name of each. ``topic``: the struct's name in an exported log.
    """
    columns, si_units, dot = {}, {}, f"{topic}." if topic else ""
    for own, name in names.items():
        channel = vocabulary.find(own)
        if channel is None:
            continue
        vector = _vector(path, f"{dot}{name}", struct[name])
        if len(vector) != samples:
            problem = f"{dot + name!r} has {len(vector)} samples, "
            problem += f"{f'{dot}time' if topic else 't'} has {samples}"
            refuse(path, problem, "give each channel a value per time, NaN where it is missing")
        unit = str(units.get(name, channel.units[0] if channel.units else "1"))
        key = name if topic else own
        columns[key], si_units[key] = to_si(
            vector, unit, channel.units, where=str(path), name=f"{dot}{name}"
        )
    return columns, si_units


def _of_topics(path: Path, content: dict[str, Any], vocabulary: Vocabulary | None) -> Recording:
    """Read the layout of ``trms export --format mat``."""
    # imported here: a log's reader is not needed for vectors
    from trms_cli.recordings.log_reader import LoggedRun
    from trms_cli.recordings.mcap_recording import OWN_PREFIX, recording_of

    tables = {f"/{name}": _table(path, name, content[name]) for name in _TOPICS if name in content}
    run = content.get("run", {})
    metadata = {str(k): str(v) for k, v in run.items()} if isinstance(run, dict) else {}
    # a name in MATLAB has no dot
    mangled = OWN_PREFIX.replace(".", "_")
    metadata = {
        OWN_PREFIX + key.removeprefix(mangled) if key.startswith(mangled) else key: text
        for key, text in metadata.items()
    }
    complete = bool(content.get("complete", True))
    problems = () if complete else ("the run that it was exported from did not end",)
    log = LoggedRun(
        path, complete, metadata.get("outcome", "died"), tables, metadata, {}, {}, problems
    )
    recording = recording_of(log, vocabulary)
    require_channels(["t", *recording.channels], str(path), recording.vocabulary)
    require_values(recording.channels, str(path), recording.vocabulary)
    return recording


def _table(path: Path, topic: str, struct: Any) -> TopicTable:
    from trms_cli.recordings.log_reader import TopicTable

    if not isinstance(struct, dict) or "time" not in struct:
        remedy = f"{topic}.time and the channels beside it, as trms export writes them"
        refuse(path, f"{topic!r} is not a struct with a time", remedy)
    units = struct.get("units", {})
    if not isinstance(units, dict):
        refuse(path, f"'{topic}.units' is not a struct", _REMEDY)
    time = _vector(path, f"{topic}.time", struct["time"])
    _check_time(path, time, f"{topic}.time")
    names = {
        reference_of(name) if topic == "reference" else name: name
        for name, values in struct.items()
        if name not in ("time", "units") and (name in CHANNELS or not isinstance(values, str))
    }
    own = Vocabulary.of_roles(dict.fromkeys(names, topic))
    columns, si_units = _channels(path, struct, units, len(time), names, own, topic)
    # to the nanosecond, as logs have it
    return TopicTable(time, np.round(time * 1e9).astype(np.int64), columns, si_units)


def _variables(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat

    data = recorded_bytes(path, USUAL_MOST)
    try:
        names = plain_variables(data) if is_level_5(data) else None
        content = loadmat(BytesIO(data), simplify_cells=True, variable_names=names)
    except OSError as error:
        raise unreadable(error, path) from error
    except MemoryError as error:
        raise RecordingError("it does not fit into the memory", where=str(path)) from error
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
        refuse(path, f"{name!r} is not a vector of numbers (shape {array.shape})", _REMEDY)
    vector = array.astype(float)
    infinite = np.flatnonzero(np.isinf(vector))
    if len(infinite):
        problem = f"{name}({infinite[0] + 1}) is not finite"
        refuse(path, problem, "put NaN where a sample is missing")
    return vector


def _check_time(path: Path, time: np.ndarray, name: str = "t") -> None:
    if len(time) < 2:
        refuse(path, "there is a single sample", "a recording needs two or more")
    wrong = np.flatnonzero(~(np.diff(time) > 0))
    if len(wrong):
        index = int(wrong[0]) + 1
        problem = f"time does not rise at {name}({index + 1}): {time[index]:.9g} s after "
        problem += f"{time[index - 1]:.9g} s"
        refuse(path, problem, "sort the samples and keep one per time; NaN is no time")
