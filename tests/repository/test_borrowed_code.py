"""No code of third parties stands among the tracked files, and `make lint` would say so."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / ".ci" / "borrowed_code.py"


def check(*files: str, folder: Path = ROOT) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), *files]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder)


def test_nothing_is_borrowed_here_and_lint_and_the_hook_look() -> None:
    done = check()
    assert done.returncode == 0, done.stdout
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    lint = makefile.partition("\nlint:")[2].partition("\n\n")[0]
    hooks = (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    assert ".ci/borrowed_code.py" in lint and ".ci/borrowed_code.py" in hooks


#: File, text, and whether it is a hit; parted by ~, so that this file is no hit of its own.
FILES = [
    ("a.js", "/* Copy~right 2012-2026, Somebody, Inc. */", True),
    ("a.c", "// SP~DX-License-Identifier: MIT", True),
    ("a.py", "# Licensed un~der the Apache License", True),
    ("plot.min.js", "x", True),
    ("LICENSE-plot.js", "MIT", True),
    ("lib/LICENSE", "MIT", True),
    ("LICENSE", "Copy~right (c) 2026 us. Permission i~s hereby granted", False),
    ("about.md", "Copy~right (c) of others is no concern here", False),
    ("b.py", "LICENCE = 'the copyright of a table'", False),
]


def test_a_licence_header_is_found(tmp_path: Path) -> None:
    (tmp_path / "lib").mkdir()
    for name, text, _ in FILES:
        (tmp_path / name).write_text(text.replace("~", ""), encoding="utf-8")
    done = check(*(name for name, _, _ in FILES), folder=tmp_path)
    told = [line.partition(": ")[0] for line in done.stdout.splitlines()]
    assert done.returncode == 1 and told == [name for name, _, hit in FILES if hit]
    assert check("LICENSE", "about.md", "b.py", folder=tmp_path).returncode == 0
