"""Recordings inside run logs: /command, /measurement and /reference on one time grid."""

import hashlib
from pathlib import Path

import numpy as np

from trms_cli.core.errors import RecordingError
from trms_cli.recordings.channels import AXIS_OF_REFERENCE, REFERENCE_OF_AXIS, find_channel
from trms_cli.recordings.log_reader import LoggedRun, read_log
from trms_cli.recordings.output_file import whole_file
from trms_cli.recordings.recording import Recording
from trms_cli.recordings.run_log import RunLog
from trms_cli.recordings.topics import Field, Topic, standard_topics

_TOPICS = ("/measurement", "/command", "/reference", "/disturbance")
_TIME_OFFSET = "time_offset_s"
#: What a recording says about itself, apart from what trms says about the log.
OWN_PREFIX = "recording."
_BOOKKEEPING = frozenset({"schema", "end", "outcome", "last_time_s", _TIME_OFFSET})


def read_mcap(path: Path | str) -> Recording:
    """Read the recording that a run log holds; a log of a run that died as far as it goes."""
    return recording_of(read_log(path, _TOPICS))


def recording_of(log: LoggedRun) -> Recording:
    """Join a log's topics on the times of /measurement.

    Commands, references and disturbances are held between their samples, as the rig does
    (zero-order hold); they are missing before their first sample.
    """
    measurement, command = log.table("/measurement"), log.table("/command")
    if len(measurement) < 2 or not len(command):
        raise RecordingError(
            f"the log holds {len(measurement)} measurements and {len(command)} commands",
            where=str(log.path),
            remedy="a recording needs two measurements or more; the run may have died at once",
        )
    channels: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    for topic in ("/command", "/measurement", "/reference", "/disturbance"):
        table = log.tables.get(topic)
        if table is None or not len(table):
            continue
        for key, column in table.last_values(measurement.time_ns).items():
            name = REFERENCE_OF_AXIS.get(key, key) if topic == "/reference" else key
            if find_channel(name) is not None:
                channels[name], units[name] = column, table.units[key]
    # Sum in nanoseconds: decimal times then come back as they were written.
    offset_ns = round(float(log.run.get(_TIME_OFFSET, 0.0)) * 1e9)
    time = (measurement.time_ns - offset_ns) / 1e9
    remarks = tuple(f"the log is incomplete: {problem}" for problem in log.problems)
    return Recording(time, channels, units, _own_metadata(log.run), log.path, remarks)


def write_mcap(
    recording: Recording, path: Path | str, run_metadata: dict[str, str], *, force: bool = False
) -> None:
    """Write a recording as a run log with the rig's own time stamps.

    MCAP times are not negative: a recording that begins before zero is shifted, and the shift
    stands in the metadata and is undone on reading. Missing samples become null.

    ``path``: appears when it is whole; an existing file is refused unless ``force``.
    ``run_metadata``: for the ``trms.run`` record, beside the recording's own metadata.
    """
    topics = _topics(recording)
    offset_ns = max(0, -round(float(recording.time[0]) * 1e9))
    metadata = {f"{OWN_PREFIX}{key}": value for key, value in recording.metadata.items()}
    metadata.update(run_metadata)
    if offset_ns:
        metadata[_TIME_OFFSET] = repr(offset_ns / 1e9)
    times = (np.round(recording.time * 1e9).astype(np.int64) + offset_ns).tolist()
    rows = {
        topic.name: np.column_stack(
            [recording.channels[_channel_name(topic.name, f.name)] for f in topic.fields]
        ).tolist()
        for topic in topics
        if topic.name in _TOPICS
    }
    with whole_file(Path(path), force=force) as temporary:
        try:
            with RunLog(temporary, topics, metadata, publish_time="log") as log:
                for index, time_ns in enumerate(times):
                    for topic, values in rows.items():
                        log.write(topic, time_ns, values[index])
                    if index % 1000 == 999:  # chunks that a reader can seek in
                        log.flush()
                for start, end in recording.gaps:
                    message = f"no samples until {end:.6g} s"
                    time_ns = round(start * 1e9) + offset_ns
                    log.event(time_ns, "gap", "recording", message, end - start)
        except RecordingError as error:
            # What the log says of a part that is safe is not so here: nothing is left of it.
            if isinstance(error.__cause__, OSError):
                raise error.__cause__ from None
            raise


def _own_metadata(run: dict[str, str]) -> dict[str, str]:
    """Return what an imported recording said about itself; of a run, what defines it."""
    own = {
        key.removeprefix(OWN_PREFIX): text
        for key, text in run.items()
        if key.startswith(OWN_PREFIX)
    }
    if own or run.get("imported"):
        return own
    return {key: text for key, text in run.items() if key not in _BOOKKEEPING}


def sha256_of(path: Path) -> str:
    """Return the file's SHA-256 as hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _topics(recording: Recording) -> list[Topic]:
    def fields(*roles: str) -> list[Field]:
        result = []
        for name in recording.channels:
            channel = find_channel(name)
            if channel is not None and channel.role in roles:
                unit = recording.units[name]
                result.append(Field(AXIS_OF_REFERENCE.get(name, name), unit, channel.description))
        return result

    return standard_topics(
        references=fields("reference"),
        inputs=fields("input"),
        outputs=fields("output", "current"),
        disturbances=fields("disturbance"),
        controller=False,
    )


def _channel_name(topic: str, field: str) -> str:
    return REFERENCE_OF_AXIS.get(field, field) if topic == "/reference" else field
