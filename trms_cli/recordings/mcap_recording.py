"""Recordings inside run logs: /command, /measurement and /reference on one time grid."""

import hashlib
from pathlib import Path

import numpy as np

from trms_cli.core.errors import RecordingError
from trms_cli.core.whole_file import whole_file
from trms_cli.recordings.channels import Vocabulary, reference_of, signal_of, to_si
from trms_cli.recordings.log_reader import LoggedRun, read_log
from trms_cli.recordings.recording import Recording, refuse
from trms_cli.recordings.run_log import RunLog
from trms_cli.recordings.topics import Field, Topic, standard_topics

#: Topics that are a recording, and the roles of their fields.
_TOPICS = {
    "/command": ("input",),
    "/measurement": ("output", "current"),
    "/reference": ("reference",),
    "/disturbance": ("disturbance",),
}
_TIME_OFFSET = "time_offset_s"
#: What a recording says about itself, apart from what trms says about the log.
OWN_PREFIX = "recording."
_BOOKKEEPING = frozenset({"schema", "end", "outcome", "last_time_s", _TIME_OFFSET})


def read_mcap(path: Path | str, vocabulary: Vocabulary | None = None) -> Recording:
    """Read the recording that a run log holds; a log of a run that died as far as it goes."""
    return recording_of(read_log(path, tuple(_TOPICS)), vocabulary)


def recording_of(log: LoggedRun, vocabulary: Vocabulary | None = None) -> Recording:
    """Join a log's topics on the times of /measurement.

    Commands, references and disturbances are held between their samples, as the rig does
    (zero-order hold); they are missing before their first sample. ``vocabulary``: of the model that
    it is read for; None: topics tell what their fields are.
    """
    measurement, command = log.table("/measurement"), log.table("/command")
    if len(measurement) < 2 or not len(command):
        problem = f"the log holds {len(measurement)} measurements and {len(command)} commands"
        remedy = "a recording needs two measurements or more; the run may have died at once"
        refuse(log.path, problem, remedy)
    tables = {topic: log.tables[topic] for topic in _TOPICS if len(log.tables.get(topic, ()))}
    roles = {
        _channel_name(topic, key): _TOPICS[topic][0]
        for topic, table in tables.items()
        for key, column in table.columns.items()
        if column.dtype == float
    }
    vocabulary = vocabulary or Vocabulary.of_roles(roles)
    others = vocabulary.left_out([*roles, "t"], str(log.path))
    channels: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    for topic, table in tables.items():
        for key, column in table.last_values(measurement.time_ns).items():
            column_name, unit = _channel_name(topic, key), table.units[key]
            name = vocabulary.name_of(column_name) if column_name in roles else None
            channel = vocabulary.find(name) if name else None
            if name and channel:
                if vocabulary.origin == "model":
                    column, unit = to_si(column, unit, channel.units, where=str(log.path), name=key)
                channels[name], units[name] = column, unit
    # Sum in nanoseconds: decimal times then come back as they were written.
    offset_ns = round(float(log.run.get(_TIME_OFFSET, 0.0)) * 1e9)
    time = (measurement.time_ns - offset_ns) / 1e9
    remarks = [f"the log is incomplete: {problem}" for problem in log.problems]
    remarks += [f"not used: {', '.join(others)}"] if others else []
    metadata = _own_metadata(log.run)
    return Recording(time, channels, units, metadata, log.path, tuple(remarks), vocabulary)


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
    def fields(topic: str) -> list[Field]:
        result = []
        for name in recording.channels:
            channel = recording.vocabulary.find(name)
            if channel is not None and channel.role in _TOPICS[topic]:
                own = signal_of(name) if topic == "/reference" else name
                result.append(Field(own, recording.units[name], channel.description))
        return result

    return standard_topics(
        references=fields("/reference"),
        inputs=fields("/command"),
        outputs=fields("/measurement"),
        disturbances=fields("/disturbance"),
        controller=False,
    )


def _channel_name(topic: str, field: str) -> str:
    return reference_of(field) if topic == "/reference" else field
