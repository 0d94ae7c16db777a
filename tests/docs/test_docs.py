"""The pages: every file in them is written, every command typed, every link followed.

In a page, a ``sh`` block is typed line by line, in one folder for the whole page, by a person who
has the installed program and this checkout's ``docs`` at hand; ``sh by-hand=REASON`` is left to the
reader (`markdown.REASONS`), and what of it composes is composed without being run. A block with
``file=PATH`` is that file. A ``console`` block shows what a command says, ``…`` standing for
anything; a ``text printed`` block shows lines of what the commands before it say, with numbers as
of another machine. Runs are shortened to a few simulated seconds, but for pages whose figures are
looked at.
"""

import importlib
import json
import os
import re
import shlex
import subprocess
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest

from tests.program import INSTALLED, Done, forgotten, in_process
from trms_cli.cli import COMMANDS

from .markdown import REASONS, Block, blocks

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    page
    for pattern in ("README.md", "CONTRIBUTING.md", "docs/*.md", "docs/course/*.md",
                    "docs/how-to/*.md", "docs/reference/*.md", "*/*/README.md")
    for page in ROOT.glob(pattern)
)  # fmt: skip
#: Pages whose runs are looked at afterwards: as long as they say.
WHOLE = ["docs/recordings.md", "docs/excitation.md", "docs/watch.md", "docs/gap-watch.md",
         "docs/how-to/own-effect.md"]  # fmt: skip
#: Pages that a test of their own types; so do those of examples. All but one are a stranger's.
ELSEWHERE = {"docs/identify.md", "README.md", "docs/tutorial.md", "docs/diagnose.md",
             "docs/how-to/own-rig-from-csv.md"}  # fmt: skip
#: Pages that are typed in seconds; the others are left to `make slow`.
QUICK = {"docs/writing-a-plugin.md", "docs/recordings.md", "docs/excitation.md",
         "docs/foxglove.md", "docs/how-to/cluster-sweep.md", "docs/how-to/own-controller.md",
         "docs/watch.md"}  # fmt: skip
WHOLE += ["docs/your-own-rig.md"]  # with a diagnosis
WHOLE += ["docs/course/lecturer.md"]  # whose rigs are as short as they can be
#: Pages that only lead to others, and the glossary itself.
FRONT = {"index.md", "start.md", "glossary.md", "choices.md"}
_SHORT = 2.0  # s


def is_typed(block: Block) -> bool:
    """Whether a test types a block's commands."""
    return block.language in ("sh", "console") and block.by_hand is None


TYPED = [
    name
    for page in PAGES
    if (name := page.relative_to(ROOT).as_posix()) not in ELSEWHERE
    and not name.startswith("examples/")
    and any(map(is_typed, blocks(page)))
]


def shortened(command: str) -> str:
    """A run that begins as the page says, but ends soon; drawings have tests of their own."""
    if command.startswith(("trms excite ", "trms identify ")):
        return f"{command} picture=false"
    if command.startswith("trms validate "):
        return f"{command} page=false windows.stride=2"
    if not command.startswith("trms run ") or "--cfg" in command:
        return command
    if "controller=played" in command:  # what is recorded is fitted afterwards: all of it counts
        return f"{command} picture=false"
    command = re.sub(r" sim\.duration=[\d.]+", "", command)
    return f"{command} sim.duration={_SHORT} picture=false"


def typed(command: str, folder: Path, settings: Path | None = None) -> Done:
    """A line of a page: the program's alone in this process, another in a shell that finds it."""
    home = str((settings or folder) / ".settings")
    variables = {"COLUMNS": "92", "XDG_CONFIG_HOME": home, "TRMS_ALLOW": ""}
    if command.startswith("trms ") and not re.search(r"[|<>;&$*?~`\\]", command):
        importlib.invalidate_caches()  # a page writes modules between its commands
        with forgotten(folder):
            return in_process(folder, *shlex.split(command)[1:], code=None, **variables)
    programs = f"{INSTALLED.parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", command],
        cwd=folder,
        env=os.environ | variables | {"PATH": programs, "NO_COLOR": "1"},
        capture_output=True,
        text=True,
        encoding="utf-8",
        timeout=120,
    )
    return Done(done.returncode, done.stdout, done.stderr).checked(None)


def says(expected: str, output: str) -> bool:
    """Whether an output is as a page shows it; ``…`` stands for anything, blanks count as one."""
    parts = [re.escape(" ".join(part.split())) for part in expected.split("…")]
    pattern = ".*?".join(parts).replace(r"\ ", r"\s+")
    return re.fullmatch(rf"\s*{pattern}\s*", " ".join(output.split()), re.DOTALL) is not None


_TIMED = re.compile(r"\d ms\b|× real time")
_BOUND = re.compile(r"\b(?:over|under) (?=\d)")
_NUMBER = re.compile(r"[-−+]?\d+(?:\.\d+)?(?:e[-−+]?\d+)?")


def not_printed(expected: str, output: str) -> str | None:
    """The first line of a page that is not printed in its turn; None where all are.

    Words are the same, numbers within 5 % or one of their last digit, but for times; a ``…`` stands
    for anything. A sentence may be broken elsewhere: 0.993 is told as 0.99, 0.996 as over 0.99, and
    which of them comes out differs between processors.
    """
    lines, at = output.splitlines(), 0
    said = _BOUND.sub("", " ".join(output.split()))
    for paragraph in re.split(r"(?m)^\s*…?\s*$\n?", expected):
        wanted, begin = [line for line in paragraph.splitlines() if line.strip()], at
        for line in wanted:
            here = next((k for k in range(at, len(lines)) if same_line(line, lines[k])), None)
            if here is not None:
                at = here + 1
            elif is_part(_BOUND.sub("", " ".join(paragraph.split())), said):
                at = begin
                break
            else:
                return line
    return None


def is_part(wanted: str, said: str) -> bool:
    """Whether a text of one line is part of another, but for the last digits of its numbers."""
    words, whole = words_of(wanted), words_of(said)
    numbers = _NUMBER.findall(said)
    at = whole.find(words)
    while at >= 0:
        first = whole[:at].count("#")
        pairs = zip(_NUMBER.findall(wanted), numbers[first:], strict=False)
        if all(near(a.replace("−", "-"), b.replace("−", "-")) for a, b in pairs):
            return True
        at = whole.find(words, at + 1)
    return False


def same_line(wanted: str, line: str) -> bool:
    """Whether a line is as a page has it, but for the last digits of its numbers."""
    wanted, line = _BOUND.sub("", wanted), _BOUND.sub("", line)
    if words_of(wanted) != words_of(line):
        return False
    if _TIMED.search(line):  # how fast a machine is
        return True
    pairs = zip(_NUMBER.findall(wanted), _NUMBER.findall(line), strict=True)
    return all(near(a.replace("−", "-"), b.replace("−", "-")) for a, b in pairs)


def words_of(line: str) -> str:
    """A line without its numbers and spaces, and without how far a bar goes."""
    return re.sub(r"[━─█⠀-⣿]+", "~", _NUMBER.sub("#", " ".join(line.split())))


def near(a: str, b: str) -> bool:
    """Whether two printed numbers are within 5 %, or one of the last digit of either."""
    last = max(10.0 ** Decimal(text).as_tuple().exponent for text in (a, b))
    return abs(float(a) - float(b)) <= max(0.05 * abs(float(a)), 1.001 * last)


def type_page(
    name: str,
    folder: Path,
    change: Callable[[str], str] = shortened,
    typed: Callable[..., Done] = typed,
) -> int:
    """Write its files, type its commands, compare what it shows; the number of commands."""
    count, here = 0, folder
    for block in blocks(ROOT / name):
        place = f"{name}, line {block.line}"
        if block.file is not None:
            file = folder / block.file
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(block.text, encoding="utf-8")
        elif block.language == "sh" and is_typed(block):
            said = ""
            for command in block.commands:
                if command.startswith("cd "):
                    here = here / command.removeprefix("cd ")
                    continue
                done = typed(change(command), here, settings=folder)
                assert done.returncode == 0, f"{place}: {command}\n{done.stdout}{done.stderr}"
                count, said = count + 1, f"{said}{done.stdout}\n{done.stderr}"
        elif "printed" in block.words and change is str:
            missing = not_printed(block.text, said)
            assert missing is None, f"{place}: {missing!r} is not in\n{said}"
        elif block.language == "console" and is_typed(block):
            first, _, expected = block.text.partition("\n")
            done = typed(first.removeprefix("$ "), here, settings=folder)
            output = done.stdout + done.stderr
            assert says(expected, output), f"{place}: {first}\n{output}"
            count += 1
    return count


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in TYPED]
)
def test_what_a_page_tells_to_type_works(name: str, tmp_path: Path) -> None:
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    change = str if name in WHOLE else shortened
    assert type_page(name, tmp_path, change) >= 1


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_what_is_not_typed_says_why(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for block in blocks(page):
        assert block.by_hand is None or block.by_hand in REASONS, (block.line, block.words)
        assert block.language not in ("bash", "shell", "console-session"), block.line
    plain = re.sub(r"^```.*?^```$|<!-- .*?begin -->.*?end -->", "", text, flags=re.M | re.S)
    # what is indented has neither a copy button nor a test
    assert re.findall(r"^ {4,}(?:trms|make|python -m|pip) .*$", plain, re.M) == []


def composable(page: Path) -> list[tuple[int, str]]:
    """Commands that no test runs but that name nothing a reader would have to bring."""
    own = re.compile(
        r"…|\.(?:csv|ya?ml|mcap)\b|--from|--config-dir|--in |real=|resume=|experiment=my_"
    )
    return [
        (block.line, command)
        for block in blocks(page)
        if block.language == "sh" and block.by_hand in ("minutes", "yours", "live", "cluster")
        for command in block.commands
        if re.match(r"trms (?:run|stability|excite|identify)(?: |$)", command)
        and not own.search(command)
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if composable(page)],
    ids=lambda page: page.relative_to(ROOT).as_posix(),
)
def test_what_a_reader_types_by_hand_composes(page: Path, tmp_path: Path) -> None:
    (tmp_path / "experiments").symlink_to(ROOT / "experiments")
    for line, command in composable(page):
        done = typed(f"{command} --cfg job", tmp_path)
        assert done.returncode == 0, f"line {line}: {command}\n{done.stderr}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_commands_in_a_sentence_exist(page: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    words = re.findall(r"`trms ([a-z][a-z-]*)[^`]*`", text)
    words += [w for b in blocks(page) for c in b.commands for w in re.findall(r"^trms ([a-z-]+)", c)
              if b.language == "sh"]  # fmt: skip
    assert set(words) <= {*COMMANDS, "help"}


@pytest.mark.slow
def test_from_a_recording_to_a_model_that_runs(tmp_path: Path) -> None:
    assert type_page("docs/identify.md", tmp_path, str) >= 6
    fit = json.loads((tmp_path / "fit/identification.json").read_text(encoding="utf-8"))
    for name, before in fit["errors"]["held_out"]["before"].items():
        assert fit["errors"]["held_out"]["after"][name]["rmse"] < before["rmse"]
    found = {frozenset(entry["names"]) for entry in fit["identifiability"]["confounded"]}
    assert frozenset({"m_cb", "l_cb"}) in found  # as the page says
    for name in ("model.yaml", "identification.html", "config.yaml", "free_runs.png"):
        assert (tmp_path / "fit" / name).is_file()
    search = json.loads((tmp_path / "search/identification.json").read_text(encoding="utf-8"))
    assert search["details"]["generations"] == 5


@pytest.mark.slow
def test_the_table_of_excitations_is_what_the_program_says(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "excitation.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|", page, re.M)
    assert len(rows) == 4
    for kind, *numbers in rows:
        done = typed(f"trms excite excitation={kind} rigs=0 picture=false out={kind}", tmp_path)
        assert done.returncode == 0, done.stderr
        inputs = json.loads((tmp_path / kind / "excitation.json").read_text())["inputs"]
        measured = [inputs[n][k] for n in ("u_v", "u_h") for k in ("amplitude", "crest_factor")]
        assert measured == pytest.approx([float(n) for n in numbers], rel=0.02), kind


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere_and_no_path_out_of_the_checkout(page: Path) -> None:
    whole = page.read_text(encoding="utf-8")
    assert not re.search(r"=\.\./.*", whole), page.name
    text = re.sub(r"^```.*?^```$", "", whole, flags=re.M | re.S)
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
        if not re.match(r"[a-z]+://", target):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_every_page_is_in_one_of_the_five_parts() -> None:
    parts = ("start", "how-to", "understand", "reference", "proof")
    texts = {part: (ROOT / "docs" / f"{part}.md").read_text(encoding="utf-8") for part in parts}
    docs = ROOT / "docs"
    for page in [*docs.glob("*.md"), *docs.glob("how-to/*.md"), *docs.glob("course/*.*")]:
        name = page.relative_to(docs).as_posix()
        if name.removesuffix(".md") not in (*parts, "index"):
            there = [part for part, text in texts.items() if f"]({name})" in text]
            assert len(there) == 1, f"{name} is in {there or 'no part'} of {parts}"


def test_the_readme_is_short_and_shows_the_rig_and_a_diagnosis() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert text.count("\n") <= 150
    assert re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text) == [
        "docs/figures/square.gif", "docs/figures/diagnosis_page.png",
    ]  # fmt: skip
    first = blocks(ROOT / "README.md")[0]
    assert first.language == "sh" and len(first.commands) == 3


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_the_words_of_the_glossary_are_linked_where_they_occur_first(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    plain = re.sub(
        r"^```.*?^```$|<!-- .*?(?:begin|table \S+) -->.*?end -->|^#.*?$|`[^`\n]*`|^\|.*?$",
        "", text, flags=re.M | re.S,
    )  # fmt: skip
    for word in ("nats", "NEES", "VAF", "Φ") if page.parent.name == "docs" else ():
        said = re.search(rf"(?<![\w/]){word}(?!\w)", plain)
        assert said is None or "glossary.md" in text or page.name in FRONT, f"{page.name}: {word}"


def scored(folder: Path, *words: str) -> dict[str, Any]:
    """Channels of the score of a run."""
    from trms_cli.cli import main

    assert main(["run", *words, "picture=false", f"out={folder}"]) == 0
    return json.loads((folder / "score.json").read_text(encoding="utf-8"))["channels"]


def test_preview_does_what_getting_started_says(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "getting-started.md").read_text(encoding="utf-8")
    numbers = re.search(r"RMSE ([\d.]+) to ([\d.]+) rad\).*?\(([\d.]+) to ([\d.]+)\)", text)
    assert numbers is not None
    without = scored(tmp_path / "without")
    preview = scored(tmp_path / "preview", "controller.preview_horizon=15")
    measured = [run[axis]["rmse"] for axis in ("alpha_h", "alpha_v") for run in (without, preview)]
    assert measured == pytest.approx([float(n) for n in numbers.groups()], rel=0.02)
    assert all(c["unsettled_steps"] == c["steps"] for c in preview.values())


def test_a_push_settles_as_getting_started_says(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "getting-started.md").read_text(encoding="utf-8")
    number = re.search(r"settling time ([\d.]+) s, worst of 3 steps", text)
    assert number is not None
    push = "disturbance@plant.disturbances=yaw_push"
    yaw = scored(tmp_path / "push", push, "sim.duration=60")["alpha_h"]
    assert yaw["settling_time_s"] == pytest.approx(float(number[1]), abs=0.1) and yaw["steps"] == 3
    assert yaw["settling_time_median_s"] < 4.0


def test_make_targets_in_the_pages_exist() -> None:
    for page in PAGES:
        own = page.with_name("Makefile")  # of an example
        makefile = own if own.is_file() else ROOT / "Makefile"
        targets = set(re.findall(r"^([a-z0-9-]+):", makefile.read_text(), re.MULTILINE))
        shell = [block for block in blocks(page) if block.language == "sh"]
        for line in (command for block in shell for command in block.commands):
            words = shlex.split(line, comments=True)
            # `make -C FOLDER` is about another makefile.
            if len(words) > 1 and words[0] == "make" and words[1] != "-C":
                assert words[1] in targets, f"{page.name}: make {words[1]}"


@pytest.mark.parametrize(
    ("expected", "output", "same"),
    [
        ("error  a\n   in  b", "error  a\n   in  b\n", True),
        ("error  a … z", "error  a b\n  c z", True),
        ("error  a", "error  b", False),
        ("a … c", "a b d", False),
    ],
)
def test_ellipsis_stands_for_anything(expected: str, output: str, same: bool) -> None:
    assert says(expected, output) is same


@pytest.mark.parametrize(
    ("expected", "output", "missing"),
    [
        ("a  1.50\n…\nb 2e−04", "x\na 1.52\ny\nb 2.1e-04\n", None),
        ("a 1.5", "a 1.7", "a 1.5"),
        ("a 1\nb 2", "b 2\na 1", "b 2"),
        ("rad 12", "rad 13", None),
        ("a  99 %  b", "a  over 99 %  b", None),
    ],
)
def test_printed_lines_are_held_in_their_order(
    expected: str, output: str, missing: str | None
) -> None:
    assert not_printed(expected, output) == missing
