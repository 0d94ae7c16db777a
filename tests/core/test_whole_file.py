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
@pytest.mark.parametrize("step", ["write", "replace"])
def test_a_failure_leaves_the_old_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, reason: BaseException
) -> None:
    file = tmp_path / "fit.yaml"
    file.write_bytes(b"old")
    fdopen = os.fdopen

    class Full:
        """A disk that takes a byte and no more."""

        def __init__(self, handle: int, mode: str) -> None:
            self.stream = fdopen(handle, mode)

        def __enter__(self) -> Full:
            return self

        def __exit__(self, *_: object) -> None:
            self.stream.close()

        def write(self, content: bytes) -> None:
            self.stream.write(content[:1])
            raise reason

    def failing(*_: object) -> None:
        raise reason

    with monkeypatch.context() as patch:
        patch.setattr(os, *(("fdopen", Full) if step == "write" else ("replace", failing)))
        with pytest.raises(type(reason)):
            replace_whole(file, b"new")
    assert file.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [file]


def test_a_link_that_lies_there_is_replaced_and_not_followed(tmp_path: Path) -> None:
    other, file = tmp_path / "other", tmp_path / "fit.yaml"
    other.write_bytes(b"theirs")
    file.symlink_to(other)
    replace_whole(file, b"mine")
    assert other.read_bytes() == b"theirs" and file.read_bytes() == b"mine"
    assert not file.is_symlink()


def test_a_long_name_is_no_hindrance(tmp_path: Path) -> None:
    file = tmp_path / ("x" * 250 + ".yaml")
    replace_whole(file, b"new")
    assert file.read_bytes() == b"new"


def test_a_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        replace_whole(tmp_path / "no" / "fit.yaml", b"new")
