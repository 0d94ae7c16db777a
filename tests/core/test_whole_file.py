"""A failure to write leaves what was there."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from trms_cli.core.whole_file import replace_whole


def test_content_is_replaced(tmp_path: Path) -> None:
    file = tmp_path / "fit.yaml"
    for content in (b"old", b"new"):
        replace_whole(file, content)
        assert file.read_bytes() == content
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("reason", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("step", ["write_bytes", "replace"])
def test_a_failure_leaves_the_old_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, reason: BaseException
) -> None:
    file = tmp_path / "fit.yaml"
    file.write_bytes(b"old")
    write = Path.write_bytes

    def failing(path: Path, content: bytes | Path) -> None:
        if isinstance(content, bytes):
            write(path, content[:1])  # a half is on the disk
        raise reason

    with monkeypatch.context() as patch:
        patch.setattr(*((Path, step, failing) if step == "write_bytes" else (os, step, failing)))
        with pytest.raises(type(reason)):
            replace_whole(file, b"new")
    assert file.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [file]


def test_a_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        replace_whole(tmp_path / "no" / "fit.yaml", b"new")
