"""A key that cannot change after it was told, and recordings that reveal nothing."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from experiments.gap.blind.recording import Timing
from experiments.gap.blind.sealing import SetRequest, make, open_key, references_beside
from experiments.gap.blind.truths import TRUTHS
from trms_cli.core.errors import RecordingError

REQUEST = SetRequest(name="small", seed=5, cases=6, timing=Timing(duration=0.3), fresh=0.2, jobs=1)


@pytest.fixture(autouse=True, scope="module")
def _short() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("experiments.gap.blind.recording._SETTLING", 0.1)
        yield


@pytest.fixture(scope="module")
def sealed_set(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, list[str]]:
    folder = tmp_path_factory.mktemp("sets")
    digests: list[str] = []

    def tell(digest: str) -> None:
        assert not (folder / "set").exists()  # told before anything is handed out
        digests.append(digest)

    make(REQUEST, folder / "set", folder / "key", tell)
    return folder / "set", folder / "key", digests


def test_the_key_opens_and_is_the_one_that_was_told(sealed_set: tuple) -> None:
    folder, key, digests = sealed_set
    opened = open_key(key, folder)
    assert digests == [opened.commitment]
    assert opened.commitment == json.loads((folder / "commitment.json").read_text())["sha256"]
    assert len(opened.cases) == 6
    assert sorted(opened.cases) == sorted(p.stem for p in (folder / "recordings").iterdir())
    assert opened.fresh is not None
    assert len(list(opened.fresh.iterdir())) == 6
    # Recordings reveal nothing of it.
    handed_out = "".join(
        str(p.relative_to(folder)) + "".join(p.read_text().splitlines(True)[:3])
        for p in folder.rglob("*")
        if p.is_file()
    )
    words = {w for effect in TRUTHS for w in (effect, effect.split("_")[-1])}
    assert not [w for w in {*words, "null", "offset", "single", "seed"} if w in handed_out]
    assert json.loads((key / "key.json").read_text())["salt"] not in handed_out


def test_the_same_seed_makes_the_same_bytes_under_another_salt(
    sealed_set: tuple, tmp_path: Path
) -> None:
    folder, key, digests = sealed_set
    again = make(REQUEST, tmp_path / "set", tmp_path / "key", lambda digest: None)
    assert again != digests[0]
    for file in (folder / "recordings").iterdir():
        assert file.read_bytes() == (tmp_path / "set" / "recordings" / file.name).read_bytes()
    keys = [json.loads((k / "key.json").read_text()) for k in (key, tmp_path / "key")]
    assert keys[0]["key"] == keys[1]["key"]
    assert keys[0]["salt"] != keys[1]["salt"]
    with pytest.raises(RecordingError, match="was told"):
        open_key(tmp_path / "key", folder)


def test_a_changed_truth_or_recording_is_noticed(sealed_set: tuple, tmp_path: Path) -> None:
    folder, key, _ = sealed_set
    document = json.loads((key / "key.json").read_text())
    document["key"]["cases"]["c001"]["kind"] = "outside"
    (tmp_path / "key.json").write_text(json.dumps(document))
    with pytest.raises(RecordingError, match="was told"):
        open_key(tmp_path / "key.json", folder)
    file = folder / "recordings" / "c002.csv"
    text = file.read_text()
    file.write_text(text.replace("0.020,", "0.021,", 1))
    try:
        with pytest.raises(RecordingError, match="not the one that was sealed"):
            open_key(key, folder)
    finally:
        file.write_text(text)


@pytest.mark.parametrize("content", ["", "{", "[]", '{"schema": "trms.score/1"}'])
def test_what_is_no_key_is_said_to_be_none(sealed_set: tuple, tmp_path: Path, content: str) -> None:
    (tmp_path / "key.json").write_text(content)
    with pytest.raises(RecordingError):
        open_key(tmp_path / "key.json", sealed_set[0])


def test_recordings_of_a_known_state_are_sealed_with_the_set(tmp_path: Path) -> None:
    request = replace(REQUEST, cases=24, timing=Timing(duration=0.1), fresh=0.0)
    folder, key = tmp_path / "set", tmp_path / "key"
    make(request, folder, key, lambda digest: None)
    opened = open_key(key, folder)
    compared = {name: case for name, case in opened.cases.items() if case.references}
    assert compared
    for name, case in opened.cases.items():
        beside = references_beside(folder / "recordings" / f"{name}.csv")
        assert len(beside) == case.references
        own = (folder / "recordings" / f"{name}.csv").read_text()
        assert all(path.read_text() != own for path in beside)
    reference = next((folder / "references").iterdir())
    reference.write_text(reference.read_text().replace("0.020,", "0.021,", 1))
    with pytest.raises(RecordingError, match="not the one that was sealed"):
        open_key(key, folder)
