"""A failure to write leaves what was there."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from trms_cli.core.whole_file import replace_whole


def test_content_is_replaced_and_a_link_not_followed(tmp_path: Path) -> None:
    file = tmp_path / ("x" * 250 + ".yaml")  # a long name is no hindrance
    for content in (b"old", b"new"):
        replace_whole(file, content)
        assert file.read_bytes() == content
    assert list(tmp_path.iterdir()) == [file]
    link = tmp_path / "fit.yaml"
    link.symlink_to(file)
    replace_whole(link, b"mine")
    assert file.read_bytes() == b"new" and link.read_bytes() == b"mine"
    assert not link.is_symlink()
    with pytest.raises(FileNotFoundError):
        replace_whole(tmp_path / "no" / "fit.yaml", b"new")


@pytest.mark.parametrize("reason", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("step", ["write", "replace"])
def test_a_failure_leaves_the_old_and_nothing_else(tmp_path, monkeypatch, step, reason) -> None:
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
