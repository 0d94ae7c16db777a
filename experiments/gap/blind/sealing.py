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
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from msgspec import convert

from experiments.gap.blind.cases import Case, plan
from experiments.gap.blind.recording import Timing, csv_of, record
from trms_cli.core.data_file import not_as_written, read_json
from trms_cli.core.errors import RecordingError
from trms_cli.core.whole_file import replace_whole

KEY_SCHEMA, COMMITMENT_SCHEMA = "trms.blind.key/1", "trms.blind.commitment/1"
RECORDINGS, COMMITMENT = "recordings", "commitment.json"
#: Of a recording, which is a file of this name.
_NAME = re.compile(r"[\w-][\w.-]{0,99}")
KEY, FRESH = "key.json", "fresh"


@dataclass(frozen=True, kw_only=True)
class SetRequest:
    """Which set is to be made."""

    name: str  #: Of :data:`experiments.gap.blind.cases.SETS`
    seed: int
    cases: int | None = None  #: Instead of the set's own number
    timing: Timing = field(default_factory=Timing)  #: Of the recordings
    fresh: float = 60.0  #: s of a second recording of each rig, kept with the key; 0: none
    jobs: int = 2  #: The two kinds of recording are made side by side with 2


@dataclass(frozen=True, kw_only=True)
class OpenedKey:
    """A key that fits its set."""

    set_name: str
    seed: int
    cases: Mapping[str, Case]  #: By the recording's name
    files: Mapping[str, str]  #: SHA-256 of each recording
    fresh: Path | None  #: Folder of the second recordings
    commitment: str  #: The SHA-256 that was told first


def make(asked: SetRequest, folder: Path, key_folder: Path, tell: Callable[[str], None]) -> str:
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
    cases, recorded, fresh = _recorded(asked)
    digests = {name: _sha256(text) for name, text in recorded.items()}
    content = {
        "set": asked.name,
        "seed": asked.seed,
        "sample_time_s": asked.timing.sample_time,
        "duration_s": asked.timing.duration,
        "fresh_s": asked.fresh,
        "cases": {name: asdict(case) for name, case in zip(recorded, cases, strict=True)},
        "files": digests,
        "fresh_files": {name: _sha256(text) for name, text in fresh.items()},
    }
    salt = secrets.token_hex(32)
    commitment = _commitment(salt, content)
    tell(commitment)
    document = {"schema": KEY_SCHEMA, "salt": salt, "key": content}
    _write(key_folder / KEY, _canonical(document) + "\n")
    for name, text in fresh.items():
        _write(key_folder / FRESH / f"{name}.csv", text)
    told = {
        "schema": COMMITMENT_SCHEMA,
        "what": "SHA-256 of the salt followed by the key, as compact JSON with sorted keys",
        "sha256": commitment,
        "recordings": len(recorded),
    }
    _write(folder / COMMITMENT, json.dumps(told, indent=2) + "\n")
    for name, text in recorded.items():
        _write(folder / RECORDINGS / f"{name}.csv", text)
    return commitment


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
    told = _document(folder / COMMITMENT, COMMITMENT_SCHEMA, "in")
    with not_as_written(str(file)):
        return _opened(document, told, file, folder)


def _opened(
    document: Mapping[str, Any], told: Mapping[str, Any], file: Path, folder: Path
) -> OpenedKey:
    content = document["key"]
    if any(not _NAME.fullmatch(name) for name in (*content["files"], *content["cases"])):
        raise ValueError("a recording's name leads elsewhere")
    commitment = _commitment(document["salt"], content)
    if commitment != told["sha256"]:
        raise RecordingError(
            f"the key has the SHA-256 {commitment[:16]}…, and {told['sha256'][:16]}… was told",
            where=str(file),
            remedy="give the key that was made with this set; it must not have been changed",
        )
    for name, digest in content["files"].items():
        recording = folder / RECORDINGS / f"{name}.csv"
        if not recording.is_file() or _sha256(recording.read_text(encoding="utf-8")) != digest:
            raise RecordingError(
                "this recording is not the one that was sealed",
                where=str(recording),
                remedy="make the set again from its seed",
            )
    fresh = file.parent / FRESH
    return OpenedKey(
        set_name=content["set"],
        seed=content["seed"],
        cases={name: _case(entry) for name, entry in content["cases"].items()},
        files=content["files"],
        fresh=fresh if fresh.is_dir() else None,
        commitment=commitment,
    )


def _recorded(asked: SetRequest) -> tuple[list[Case], dict[str, str], dict[str, str]]:
    """The cases as driven, and the texts of both recordings by name."""
    cases = plan(asked.name, asked.seed, asked.cases)
    digits = max(3, len(str(len(cases))))
    names = [f"c{i:0{digits}d}" for i in range(1, len(cases) + 1)]
    second = Timing(duration=asked.fresh, sample_time=asked.timing.sample_time)
    if asked.fresh and asked.jobs > 1:
        with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
            both = (
                pool.submit(_texts, cases, asked.timing, asked.seed, False),
                pool.submit(_texts, cases, second, asked.seed, True),
            )
            (driven, texts), (_, others) = (future.result() for future in both)
    else:
        driven, texts = _texts(cases, asked.timing, asked.seed, False)
        others = _texts(cases, second, asked.seed, True)[1] if asked.fresh else []
    return (
        driven,
        dict(zip(names, texts, strict=True)),
        dict(zip(names, others, strict=True)) if others else {},
    )


def _texts(
    cases: Sequence[Case], timing: Timing, seed: int, fresh: bool
) -> tuple[list[Case], list[str]]:
    driven, run = record(cases, timing, seed, fresh=fresh)
    texts = [
        csv_of(case, run.time, run.commands[i], run.measured[i]) for i, case in enumerate(driven)
    ]
    return driven, texts


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
        found = read_json(path)
    except (OSError, ValueError) as error:
        raise RecordingError(
            f"cannot be read: {error}", where=str(path), remedy=f"{where}= names another place"
        ) from error
    if not isinstance(found, dict) or found.get("schema") != schema:
        raise RecordingError(
            f"this is no {schema}", where=str(path), remedy=f"{where}= names another file"
        )
    return found
