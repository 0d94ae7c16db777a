"""A failure to write leaves what was there."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

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

    def failing(*_: object) -> None:
        raise reason

    @contextmanager
    def full(handle: int, mode: str) -> Iterator[SimpleNamespace]:
        """A disk that takes a byte and no more."""
        with fdopen(handle, mode) as stream:
            yield SimpleNamespace(write=lambda content: failing(stream.write(content[:1])))

    with monkeypatch.context() as patch:
        patch.setattr(os, *(("fdopen", full) if step == "write" else ("replace", failing)))
        with pytest.raises(type(reason)):
            replace_whole(file, b"new")
    assert file.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [file]
