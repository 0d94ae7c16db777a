"""A sealed set on disk: recordings for whoever diagnoses, a key for whoever judges.

The key holds the truth of every case and the SHA-256 of every file. Before any recording is handed
out its own SHA-256, with a random salt before it, is told and written beside the recordings: so
nobody can change the truth, or a recording, once diagnoses are known.
"""

from __future__ import annotations

import hashlib
import json
import re
import secrets
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import convert

from experiments.gap.blind.cases import Case, plan
from experiments.gap.blind.recording import Timing, csv_of, record, references_of
from trms_cli.core.data_file import not_as_written, read_json
from trms_cli.core.errors import RecordingError
from trms_cli.core.whole_file import replace_whole

if TYPE_CHECKING:
    from experiments.gap.blind.model_set import RigSource

KEY_SCHEMA, COMMITMENT_SCHEMA = "trms.blind.key/1", "trms.blind.commitment/1"
RECORDINGS, COMMITMENT = "recordings", "commitment.json"
RECORDING = "recording"  #: Of a recording that lies in a folder of its own
#: Of a recording, which is a file of this name.
_NAME = re.compile(r"[\w-][\w.-]{0,99}")
KEY, FRESH = "key.json", "fresh"
#: Folder of recordings of a known state, beside those that are diagnosed.
REFERENCES = "references"


@dataclass(frozen=True, kw_only=True)
class SetRequest:
    """Which set is to be made."""

    name: str  #: Of :data:`experiments.gap.blind.cases.SETS`
    seed: int
    cases: int | None = None  #: Instead of the set's own number
    timing: Timing = field(default_factory=Timing)  #: Of the recordings
    fresh: float = 60.0  #: s of a second recording of each rig, kept with the key; 0: none
    jobs: int = 2  #: Processes
    rigs: RigSource | None = None  #: What they are drawn from, where they are no TRMSs
    stem: str = "c"  #: What the recordings' names begin with; a number follows
    apart: bool = False  #: Whether each recording lies in a folder of its own, of its name


@dataclass(frozen=True, kw_only=True)
class OpenedKey:
    """A key that fits its set."""

    set_name: str
    seed: int
    cases: Mapping[str, Case]  #: By the recording's name
    files: Mapping[str, str]  #: SHA-256 of each recording
    fresh: Path | None  #: Folder of the second recordings
    commitment: str  #: The SHA-256 that was told first


def make(request: SetRequest, folder: Path, key_folder: Path, tell: Callable[[str], None]) -> str:
    """Make a set; the same request makes the same recordings, byte for byte.

    Parameters
    ----------
    folder, key_folder : Path
        Empty; the first is for whoever diagnoses.
    tell : callable
        Told the commitment before any recording is written.

    Returns
    -------
    str
        The commitment.
    """
    recorded_set = _recorded(request)
    digests = _digests(recorded_set.recordings)
    content = {
        "set": request.name,
        "seed": request.seed,
        "sample_time_s": request.timing.sample_time,
        "duration_s": request.timing.duration,
        "fresh_s": request.fresh,
        "apart": request.apart,
        "cases": {name: asdict(case) for name, case in recorded_set.cases.items()},
        "files": digests,
        "reference_files": _digests(recorded_set.references),
        "fresh_files": _digests(recorded_set.fresh),
    }
    salt = secrets.token_hex(32)
    commitment = _commitment(salt, content)
    tell(commitment)
    document = {"schema": KEY_SCHEMA, "salt": salt, "key": content}
    _write(key_folder / KEY, _canonical(document) + "\n")
    for name, text in recorded_set.fresh.items():
        _write(key_folder / FRESH / f"{name}.csv", text)
    commitment_document = {
        "schema": COMMITMENT_SCHEMA,
        "what": "SHA-256 of the salt followed by the key, as compact JSON with sorted keys",
        "sha256": commitment,
        "recordings": len(recorded_set.recordings),
    }
    _write(folder / COMMITMENT, json.dumps(commitment_document, indent=2) + "\n")
    for name, text in recorded_set.recordings.items():
        _write(recording_file(folder, name, apart=request.apart), text)
    for name, text in recorded_set.references.items():
        _write(folder / REFERENCES / f"{name}.csv", text)
    return commitment


def recording_file(folder: Path, name: str, *, apart: bool) -> Path:
    """Where the recording of a name lies in the folder of a set."""
    return folder / name / f"{RECORDING}.csv" if apart else folder / RECORDINGS / f"{name}.csv"


def open_key(key: Path, folder: Path) -> OpenedKey:
    """Open a key and hold it against what was told, and the recordings against the key.

    Parameters
    ----------
    key : Path
        The file or its folder.
    folder : Path
        Of the set.

    Raises
    ------
    RecordingError
        If a file is missing or is no such file, the key is not the one whose SHA-256 was told, or
        a recording is not the one that the key speaks of.
    """
    file = key / KEY if key.is_dir() else key
    document = _document(file, KEY_SCHEMA, "key")
    commitment_document = _document(folder / COMMITMENT, COMMITMENT_SCHEMA, "in")
    with not_as_written(str(file)):
        return _open(document, commitment_document, file, folder)


def _open(
    document: Mapping[str, Any], commitment_document: Mapping[str, Any], file: Path, folder: Path
) -> OpenedKey:
    content = document["key"]
    references = content.get("reference_files", {})
    names = (*content["files"], *references, *content.get("fresh_files", {}), *content["cases"])
    if any(not _NAME.fullmatch(name) for name in names):
        raise ValueError("a recording's name leads elsewhere")
    commitment = _commitment(document["salt"], content)
    if commitment != commitment_document["sha256"]:
        raise RecordingError(
            f"the key has the SHA-256 {commitment[:16]}…, "
            f"and {commitment_document['sha256'][:16]}… was told",
            where=str(file),
            remedy="give the key that was made with this set; it must not have been changed",
        )
    apart = bool(content.get("apart", False))  # keys of before have it not
    for name, digest in content["files"].items():
        _as_sealed(recording_file(folder, name, apart=apart), digest)
    for name, digest in references.items():
        _as_sealed(folder / REFERENCES / f"{name}.csv", digest)
    fresh = file.parent / FRESH
    for name, digest in content.get("fresh_files", {}).items() if fresh.is_dir() else ():
        _as_sealed(fresh / f"{name}.csv", digest)
    return OpenedKey(
        set_name=content["set"],
        seed=content["seed"],
        cases={name: _case(entry) for name, entry in content["cases"].items()},
        files=content["files"],
        fresh=fresh if fresh.is_dir() else None,
        commitment=commitment,
    )


def _as_sealed(recording: Path, digest: str) -> None:
    if not recording.is_file() or _sha256(recording.read_text(encoding="utf-8")) != digest:
        raise RecordingError(
            "this recording is not the one that was sealed",
            where=str(recording),
            remedy="make the set again from its seed",
        )


@dataclass(frozen=True, kw_only=True)
class _RecordedSet:
    """Cases as driven, and texts by name."""

    cases: Mapping[str, Case]
    recordings: Mapping[str, str]
    references: Mapping[str, str]  #: Each as :func:`reference_name` calls it
    fresh: Mapping[str, str]


def reference_name(name: str, number: int) -> str:
    """The name of a recording's reference, from 1."""
    return f"{name}-{number}"


def references_beside(recording: Path) -> list[Path]:
    """The recordings of a known state that belong to one of a set."""
    folder = recording.parent.with_name(REFERENCES)
    return sorted(folder.glob(f"{recording.stem}-*{recording.suffix}"))


def _recorded(request: SetRequest) -> _RecordedSet:
    """All recordings of a set."""
    rigs = request.rigs
    if rigs is None:
        cases = plan(request.name, request.seed, request.cases)
    else:
        cases = rigs.plan(request.seed, request.cases, request.timing.sample_time)
    digits = max(3, len(str(len(cases))))
    names = [f"{request.stem}{i:0{digits}d}" for i in range(1, len(cases) + 1)]
    driven_cases, recordings, references = texts_of(
        dict(zip(names, cases, strict=True)), request.timing, request.seed, request.jobs, rigs
    )
    fresh: dict[str, str] = {}
    if request.fresh:
        second = Timing(duration=request.fresh, sample_time=request.timing.sample_time)
        drive, written = (record, csv_of) if rigs is None else (rigs.record, rigs.csv_of)
        again, others = drive(
            [*driven_cases.values()] if rigs else cases,
            second,
            request.seed,
            jobs=request.jobs,
            fresh=True,
        )
        texts = [written(case, other) for case, other in zip(again, others, strict=True)]
        fresh = dict(zip(names, texts, strict=True))
    return _RecordedSet(
        cases=driven_cases, recordings=recordings, references=references, fresh=fresh
    )


def texts_of(
    cases: Mapping[str, Case],
    timing: Timing,
    seed: int,
    jobs: int,
    rigs: RigSource | None = None,
) -> tuple[dict[str, Case], dict[str, str], dict[str, str]]:
    """Record cases and their references, by name.

    Returns
    -------
    cases : dict of str to Case
        As driven.
    recordings, references : dict of str to str
        CSV.
    """
    before = {
        reference_name(name, number): reference_case
        for name, case in cases.items()
        for number, reference_case in enumerate(references_of(case), start=1)
    }
    drive, written = (record, csv_of) if rigs is None else (rigs.record, rigs.csv_of)
    driven_cases, recordings = drive([*cases.values(), *before.values()], timing, seed, jobs=jobs)
    texts = [written(c, recording) for c, recording in zip(driven_cases, recordings, strict=True)]
    count = len(cases)
    return (
        dict(zip(cases, driven_cases, strict=False)),
        dict(zip(cases, texts, strict=False)),
        dict(zip(before, texts[count:], strict=True)),
    )


def _digests(texts: Mapping[str, str]) -> dict[str, str]:
    return {name: _sha256(text) for name, text in texts.items()}


def _case(entry: Mapping[str, Any]) -> Case:
    """A case as it was, lists back to tuples."""
    case: Case = convert(entry, Case)
    return case


def _canonical(document: Mapping[str, Any]) -> str:
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _commitment(salt: str, content: Mapping[str, Any]) -> str:
    return _sha256(salt + _canonical(content))


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_whole(path, text.encode())


def _document(path: Path, schema: str, where: str) -> dict[str, Any]:
    try:
        document = read_json(path)
    except (OSError, ValueError) as error:
        raise RecordingError(
            f"cannot be read: {error}", where=str(path), remedy=f"{where}= names another place"
        ) from error
    if not isinstance(document, dict) or document.get("schema") != schema:
        raise RecordingError(
            f"this is no {schema}", where=str(path), remedy=f"{where}= names another file"
        )
    return document
