"""Makes tables and pictures anew, in a copy of the checkout, and holds them against the pages."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter

from experiments.docs_check.comparison import Change, compare_blocks, picture_difference
from experiments.docs_check.sources import Source
from experiments.page_blocks import blocks_of
from experiments.provenance import ROOT
from trms_cli.core.errors import ConfigurationError

#: What of a checkout is not copied where git cannot tell what belongs to it.
_LEFT_OUT = shutil.ignore_patterns(".*", "outputs", "build", "dist", "__pycache__", "*.egg-info")


@dataclass
class Outcome:
    """What came of one source."""

    name: str
    seconds: float
    compared: int = 0  #: Tables and pictures
    changes: list[Change] = field(default_factory=list)
    problem: str = ""  #: Why it could not be made


def copy_checkout(folder: Path, root: Path = ROOT) -> None:
    """The files of the checkout as they are now, without what git ignores."""
    listed = subprocess.run(
        ["git", "-C", str(root), "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        capture_output=True,
        check=False,
    )
    if listed.returncode != 0:
        shutil.copytree(root, folder, ignore=_LEFT_OUT, dirs_exist_ok=True)
        return
    for name in filter(None, listed.stdout.decode().split("\0")):
        source, target = root / name, folder / name
        if source.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source, target)


def argv_of(source: Source, records: Path | None) -> list[str]:
    """The words of a source's command, this Python in the place of ``python``.

    Raises ConfigurationError if it asks for recordings and has none.
    """
    command = source.command
    if "{records}" in command:
        if records is None:
            raise ConfigurationError(
                "its recordings are not part of the repository",
                where="--records",
                remedy="name the folder that has tras/ and aero/",
            )
        command = command.replace("{records}", shlex.quote(str(records.resolve())))
    words = shlex.split(command)
    if words[0] == "python":
        words[0] = sys.executable
    elif words[0] == "trms":
        words[:1] = [sys.executable, "-m", "trms_cli"]
    return words


def make_anew(
    name: str,
    source: Source,
    keys: Sequence[str],
    scratch: Path,
    records: Path | None = None,
    root: Path = ROOT,
) -> Outcome:
    """Run a source in a copy of the checkout and compare what it makes.

    Parameters
    ----------
    keys : sequence of str
        Tables, ``docs/page.md#table``, and pictures of this source.
    scratch : Path
        An empty folder; the copy in it is removed afterwards.
    records : Path or None
        Folder of recordings, for commands that ask for them.
    root : Path
        The checkout.
    """
    begin = perf_counter()
    outcome = Outcome(name, 0.0)
    copy, log = scratch / name, scratch / f"{name}.log"
    try:
        words = argv_of(source, records)
    except ConfigurationError as error:
        outcome.problem = f"{error.problem}; {error.remedy}"
        return outcome
    copy_checkout(copy, root)
    for key in keys:  # a picture that is not drawn has to be missed
        if "#" not in key:
            (copy / key).unlink(missing_ok=True)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
    with log.open("w", encoding="utf-8") as out:
        done = subprocess.run(
            words,
            cwd=copy,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PATH": path, "PYTHONPATH": str(copy), "TRMS_RUNS": "off"},
            check=False,
        )
    outcome.seconds = perf_counter() - begin
    if done.returncode != 0:
        last = log.read_text(encoding="utf-8").strip().splitlines()[-3:]
        outcome.problem = f"exit code {done.returncode}: " + " / ".join(last)
    else:
        for origin, place in source.copies.items():
            shutil.copyfile(copy / origin, copy / place)
        outcome.changes = compare(source, keys, copy, root)
        outcome.compared = len(keys)
    shutil.rmtree(copy)
    return outcome


def compare(source: Source, keys: Sequence[str], copy: Path, root: Path = ROOT) -> list[Change]:
    """What of a source's tables and pictures is otherwise in a copy of the checkout."""
    changes: list[Change] = []
    for key in keys:
        page, _, table = key.partition("#")
        if table:
            old, new = (
                next((b.text for b in blocks_of(text) if b.name == table), "")
                for text in ((root / page).read_text("utf-8"), (copy / page).read_text("utf-8"))
            )
            changes += compare_blocks(
                old, new, key, source.tolerance_of(table), source.times, source.digits
            )
        elif not (copy / key).is_file():
            changes.append(Change(key, "", "a picture", ""))
        elif not source.is_time(key):
            share = picture_difference(root / key, copy / key)
            if share > source.picture:
                changes.append(
                    Change(key, "", "as it is", f"{share:.1%} of its area looks otherwise")
                )
    return changes
