"""What README and the front page show: the rig in motion, a terminal in motion, pages in a browser.

All of it is what the program draws and prints: the scene is composed from a log's own messages,
the terminal shows the lines that ``trms watch`` would, the pages are those of ``trms report`` and
``trms diagnose`` in a headless Chromium.
"""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont
from rich.color import blend_rgb
from rich.console import Console
from rich.style import Style
from rich.terminal_theme import MONOKAI
from rich.text import Text

from trms_cli.commands.plot import shots_of
from trms_cli.commands.watch.frame import Player
from trms_cli.recordings.log_reader import read_log
from trms_cli.reporting.scene_picture import Shot, draw_scene
from trms_cli.reporting.style import COLOURS, INK, PAPER, house_style, new_figure
from trms_cli.runs.follower import RunFollower

#: The run that is shown: that of ``make run``.
RUN = ["controller=newton_mpc", "ref=square"]
#: The rig that is diagnosed: see README, *Diagnose the gap*.
RIG = [
    "controller=open_loop", "observer=full_state", "signal@controller.u_v=multilevel",
    "controller.u_v.amplitude=0.5", "controller.u_v.offset=0.9",
    "signal@controller.u_h=multilevel", "controller.u_h.amplitude=0.8", "plant.prior_seed=3",
    "effect=yaw_coulomb_friction", "sim.duration=120",
]  # fmt: skip
#: The runs that are listed: two controllers on rigs drawn from the priors.
SERVED_SWEEP = [
    "controller=pid,lqr,newton_mpc", "plant.prior_seed=range(1,5)", "sim.duration=20",
    "picture=false",
]  # fmt: skip
#: Of the square, s: two of its steps; every so many poses (10 a second) make a frame.
_SHOWN, _EVERY = (18.0, 45.0), 3
#: Of ``trms watch --speed 4``: s of the run, frames per second of the picture.
_WATCHED, _SPEED, _RATE = 26.0, 4.0, 8
_COLUMNS, _ROWS = 80, 30
#: Colours of a picture; those that are rare, of a small part or a word, are among them.
_TONES = 128


def draw_moving(folder: Path, program: str, scratch: Path) -> None:
    """``square.gif`` and ``watch.gif``."""
    _run(program, scratch, "run", *RUN, "picture=false", "out=first")
    (folder / "square.gif").write_bytes(square(scratch / "first" / "run.mcap"))
    (folder / "watch.gif").write_bytes(watched(scratch / "first" / "run.mcap", "first/run.mcap"))


def draw_pages(folder: Path, program: str, scratch: Path) -> None:
    """``run_page.png``, ``diagnosis_page.png`` and ``serve_list.png``."""
    _run(program, scratch, "run", *RUN, "picture=false", "out=first")
    _run(program, scratch, "report", "first")
    _run(program, scratch, "run", *RIG, "picture=false", "out=rig")
    _run(program, scratch, "diagnose", "real=rig", "out=diagnosis")
    pages = {
        "run_page.png": (scratch / "first" / "report.html", "angles-and-commands", "figure.plot"),
        "diagnosis_page.png": (
            scratch / "diagnosis" / "report.html",
            "where-the-gap-lies",
            "figure img",
        ),
    }
    for name, (page, section, until) in pages.items():
        (folder / name).write_bytes(page_picture(page, section, until))


def draw_served(folder: Path, program: str, scratch: Path) -> None:
    """``serve_list.png``: the list of ``trms serve`` over a sweep, while a run goes on."""
    home, scratch = scratch, scratch / "lab"
    scratch.mkdir()
    _run(program, scratch, "run", "-m", *SERVED_SWEEP, "out=sweep")
    _run(program, scratch, "run", "controller=pid", "fault=yaw_encoder_frozen", "out=frozen")
    live = [program, "run", "controller=newton_mpc", "sim.pace=real_time", "sim.duration=60"]
    environment = os.environ | {"TRMS_RUNS": str(home / "index"), "HOME": str(home)}
    output: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    with (
        subprocess.Popen([*live, "out=live"], cwd=scratch, **output) as run,
        subprocess.Popen(
            [program, "serve", "port=0"], cwd=scratch, env=environment, **output
        ) as server,
    ):
        try:
            assert server.stdout is not None
            lines = iter(server.stdout.readline, "")
            address = next(line.split()[1] for line in lines if "http://" in line)
            while not any((scratch / "live").glob("run.mcap")):
                time.sleep(0.1)
            time.sleep(5.0)
            (folder / "serve_list.png").write_bytes(_head_of(address))
        finally:
            server.terminate()
            run.terminate()


def _head_of(address: str, *, width: int = 1100, height: int = 640) -> bytes:
    """The head of a page of a server, as a PNG."""
    with _tab(width, height) as tab:
        tab.goto(address)
        tab.wait_for_selector("html[data-plots=drawn]", state="attached")
        return _few_tones(Image.open(io.BytesIO(tab.screenshot())).convert("RGB"))


def _run(program: str, scratch: Path, *words: str) -> None:
    subprocess.run([program, *words], cwd=scratch, check=True, capture_output=True)


def square(log: Path) -> bytes:
    """The rig in space beside its angles over time, as a GIF, three times as fast as the run."""
    bodies, shots = shots_of(read_log(log), *_SHOWN, moving=True)
    panels = _Panels(log)
    frames = []
    for shot in shots[::_EVERY]:
        scene = _picture(draw_scene(bodies, shot, width=95.0), dpi=100)
        curves = panels.at(shot)
        frame = Image.new("RGB", (scene.width + curves.width, scene.height), PAPER)
        frame.paste(scene, (0, 0))
        frame.paste(curves, (scene.width, (scene.height - curves.height) // 2))
        frames.append(frame)
    return animation(frames, pause=0.1)


class _Panels:
    """Pitch and yaw against their references, up to a moment."""

    def __init__(self, log: Path) -> None:
        follower = RunFollower(log)
        try:
            while follower.look():
                pass
            self._axes = follower.at(_SHOWN[1], span=_SHOWN[1] - _SHOWN[0]).axes
        finally:
            follower.close()

    def at(self, shot: Shot) -> Image.Image:
        with house_style("paper"):
            figure = new_figure(3.6, 2.75)
            panels = figure.subplots(len(self._axes), 1, sharex=True)
            for panel, axis, name in zip(panels, self._axes, ("pitch", "yaw"), strict=True):
                past = axis.time <= shot.time
                panel.plot(axis.time, axis.references, color=INK, linestyle="--", linewidth=0.8)
                panel.plot(axis.time[past], axis.outputs[past], color=COLOURS[0], linewidth=1.8)
                panel.plot(axis.time[past][-1:], axis.outputs[past][-1:], "o", color=COLOURS[1])
                panel.set_xlim(*_SHOWN)
                panel.set_ylabel(f"{name} [{axis.unit}]")
            panels[0].set_title("dashed: what newton_mpc is asked for")
            panels[-1].set_xlabel("time [s]")
        return _picture(figure, dpi=100)


def _picture(figure: Any, dpi: float) -> Image.Image:
    buffer = io.BytesIO()
    with house_style("paper"):
        figure.savefig(buffer, format="png", dpi=dpi)
    return Image.open(buffer).convert("RGB")


def watched(log: Path, name: str) -> bytes:
    """What ``trms watch LOG --speed 4`` shows on a terminal, as a GIF; `name`: LOG as typed."""
    run = RunFollower(log)
    run.path = Path(name)
    pictures = []
    try:
        player = Player(run, live=False, speed=_SPEED, begin=0.0, span=20.0)
        for _ in range(round(_WATCHED / _SPEED * _RATE)):
            player.advance(1.0 / _RATE)
            pictures.append(terminal_picture(player.frame(_COLUMNS, _ROWS, keys=True)))
    finally:
        run.close()
    return animation(pictures, pause=1.0 / _RATE)


def terminal_picture(lines: Sequence[Text], *, size: int = 15) -> Image.Image:
    """Lines as a terminal of 80 columns shows them.

    Braille is drawn dot by dot: few fonts of fixed width have it.
    """
    theme = MONOKAI
    ground, ink = tuple(theme.background_color), tuple(theme.foreground_color)
    fonts = {bold: _font(size, bold=bold) for bold in (False, True)}
    wide, high, edge = round(fonts[False].getlength("─")), size + 4, 12
    picture = Image.new("RGB", (_COLUMNS * wide + 2 * edge, _ROWS * high + 2 * edge), ground)
    draw = ImageDraw.Draw(picture)
    console = Console(width=_COLUMNS, force_terminal=True, color_system="truecolor")
    for row, line in enumerate(lines):
        column = 0
        for segment in line.render(console):
            style = segment.style or Style()
            colour = ink if style.color is None else tuple(style.color.get_truecolor(theme))
            if style.dim:
                colour = tuple(blend_rgb(theme.background_color, colour, 0.6))  # type: ignore[arg-type]
            for sign in segment.text.rstrip("\n"):
                x, y = edge + column * wide, edge + row * high
                if 0x2800 <= ord(sign) <= 0x28FF:
                    _braille(draw, ord(sign) - 0x2800, (x, y), (wide, high), colour)
                else:
                    draw.text((x, y), sign, fill=colour, font=fonts[bool(style.bold)])
                column += 1
    return picture


def _font(size: int, *, bold: bool) -> ImageFont.FreeTypeFont:
    from matplotlib.font_manager import FontProperties, findfont

    weight = "bold" if bold else "normal"
    return ImageFont.truetype(
        findfont(FontProperties(family="DejaVu Sans Mono", weight=weight)), size
    )


#: Place of each of the eight dots: column and row.
_DOTS = ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (0, 3), (1, 3))


def _braille(
    draw: ImageDraw.ImageDraw,
    bits: int,
    corner: tuple[int, int],
    cell: tuple[int, int],
    colour: tuple[int, ...],
) -> None:
    for dot, (column, row) in enumerate(_DOTS):
        if bits >> dot & 1:
            x = corner[0] + round((column + 0.5) * cell[0] / 2)
            y = corner[1] + round((row + 0.5) * cell[1] / 4)
            draw.rectangle((x - 1, y - 1, x + 1, y + 1), fill=colour)


def animation(frames: Sequence[Image.Image], *, pause: float) -> bytes:
    """A GIF of one palette, without dithering: what stands still costs nothing."""
    some = frames[:: -(-len(frames) // 8)]
    sheet = Image.new("RGB", (some[0].width, some[0].height * len(some)))
    for i, frame in enumerate(some):
        sheet.paste(frame, (0, i * frame.height))
    palette = sheet.quantize(_TONES, Image.Quantize.MAXCOVERAGE)
    first, *others = (f.quantize(palette=palette, dither=Image.Dither.NONE) for f in frames)
    content = io.BytesIO()
    first.save(
        content, format="gif", save_all=True, append_images=others,
        duration=round(1000 * pause), loop=0, optimize=True,
    )  # fmt: skip
    return content.getvalue()


def page_picture(page: Path, section: str, until: str, *, width: int = 1000) -> bytes:
    """The head of a page, and below it one section down to its first plot, as a PNG."""
    with _tab(width, 4000) as tab:
        tab.goto(page.as_uri())
        if tab.locator("div.plot").count():
            tab.wait_for_selector("html[data-plots=drawn]", state="attached")
        ends = tab.evaluate(
            """([section, until]) => {
              const sections = [...document.querySelectorAll("section")];
              const bottom = e => e.getBoundingClientRect().bottom + scrollY;
              const top = e => e.getBoundingClientRect().top + scrollY;
              const kept = document.getElementById(section);
              return [top(sections[0]), top(kept), bottom(kept.querySelector(until) || kept)];
            }""",
            [section, until],
        )
        whole = Image.open(io.BytesIO(tab.screenshot())).convert("RGB")
    head_ends, begins, stops = (round(place) for place in ends)
    parts = [(0, head_ends), (begins, stops)]
    picture = Image.new("RGB", (whole.width, sum(b - a for a, b in parts)), PAPER)
    place = 0
    for above, below in parts:
        picture.paste(whole.crop((0, above, whole.width, below)), (0, place))
        place += below - above
    return _few_tones(picture)


@contextlib.contextmanager
def _tab(width: int, height: int) -> Iterator[Any]:
    """A tab of a headless Chromium."""
    from playwright.sync_api import sync_playwright

    names = ("chromium", "chromium-browser", "google-chrome")
    executable = next((path for name in names if (path := shutil.which(name))), None)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=executable, args=["--no-sandbox", "--disable-gpu"]
        )
        yield browser.new_page(viewport={"width": width, "height": height})
        browser.close()


def _few_tones(picture: Image.Image) -> bytes:
    picture = picture.quantize(_TONES, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    content = io.BytesIO()
    picture.save(content, format="png", optimize=True)
    return content.getvalue()
