"""``trms plot``: figures in which all can be read, equal for equal logs; reasons for the rest."""

import itertools
import json
import re
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import pytest
from matplotlib.text import Text

from trms_cli.cli import main
from trms_cli.core.errors import ConfigurationError
from trms_cli.recordings.log_reader import read_log
from trms_cli.reporting.plot import KINDS, absences, names_of, plot, size_of
from trms_cli.reporting.style import PALETTE, house_style

ALL = [kind for kind in KINDS if kind != "comparison"]
LONG = "plant.prior_seed=3"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Two runs that differ in their controller and seed, of six seconds each."""
    place = tmp_path_factory.mktemp("plot")
    usual = ("run", "sim.duration=6", "picture=false", "sim.scene_every=0")
    assert main([*usual, "controller=newton_mpc", f"out={place / 'mpc'}"]) == 0
    assert main([*usual, "controller=lqr", "seed=4", LONG, f"out={place / 'lqr'}"]) == 0
    return place


@pytest.fixture(scope="module")
def logs(folder):
    return [read_log(folder / name / "run.mcap") for name in ("mpc", "lqr")]


def texts_of(figure) -> list[tuple[str, object]]:
    """Words that are seen, with their extents in pixels."""
    renderer = figure.canvas.get_renderer()
    beyond = set()  # matplotlib keeps words of ticks that lie outside of a panel, and draws none
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            edge = 1e-9 * (high - low)
            for tick in [*axis.get_major_ticks(), *axis.get_minor_ticks()]:
                if not low - edge <= tick.get_loc() <= high + edge:
                    beyond |= {tick.label1, tick.label2}
    return [
        (text.get_text(), text.get_window_extent(renderer))
        for text in figure.findobj(Text)
        if text.get_visible() and text.get_text().strip() and text not in beyond
    ]


@pytest.fixture
def said(capsys):
    """Gives the message of the last command, without the breaks of its lines."""
    return lambda: " ".join(capsys.readouterr().err.split())


COMMON = ["estimate", "prediction"]
COMPARED = ["tracking", "inputs", "comparison"]


@pytest.mark.parametrize(
    ("style", "width", "kinds", "count"),
    [
        ("paper", "89mm", COMMON, 1),
        ("paper", "89mm", COMPARED, 2),
        ("slides", None, ["tracking", "inputs"], 2),
        ("screen", None, ["tracking", "inputs"], 2),
        pytest.param("paper", "89mm", ALL, 1, marks=pytest.mark.slow),
        pytest.param("paper", "183mm", ALL, 1, marks=pytest.mark.slow),
        pytest.param("paper", "183mm", COMPARED, 2, marks=pytest.mark.slow),
        pytest.param("paper", "89mm", ["phase"], 1, marks=pytest.mark.slow),
    ],
)
def test_no_words_are_cut_or_overlap(logs, style, width, kinds, count):
    title = {"title": "A square, followed with little delay"} if style == "paper" else {}
    figure = plot(logs[:count], kinds, style=style, width=width, **title)
    with house_style(style):
        figure.canvas.draw()
        seen = texts_of(figure)
    page = figure.bbox
    assert len(seen) > 10
    for words, box in seen:
        assert page.x0 - 1 <= box.x0 and box.x1 <= page.x1 + 1, words
        assert page.y0 - 1 <= box.y0 and box.y1 <= page.y1 + 1, words
    for (one, a), (other, b) in itertools.combinations(seen, 2):
        across = min(a.x1, b.x1) - max(a.x0, b.x0)
        down = min(a.y1, b.y1) - max(a.y0, b.y0)
        assert not (across > 1 and down > 1), (one, other)


def test_letters_of_a_column_are_seven_to_nine_points(logs):
    figure = plot(logs[:1], ["tracking", "inputs"], width="89mm")
    sizes = {text.get_fontsize() for text in figure.findobj(Text) if text.get_text().strip()}
    assert sizes and min(sizes) >= 7 and max(sizes) <= 9
    assert figure.get_figwidth() * 25.4 == pytest.approx(89)


def test_every_axis_has_its_unit_and_panels_of_the_estimate_say_that_they_show_errors(logs):
    for axes in plot(logs[:1], ["rates", "torques", "solver", "phase", "errors"]).axes:
        label = axes.get_ylabel()
        assert re.search(r"\[.+\]", label) or label == "iterations", label
    for axes in plot(logs[:1], "estimate").axes:
        assert re.search(r"\n(error|innovation) \[", axes.get_ylabel()), axes.get_ylabel()


def test_errors_of_estimates_that_are_logged_now_and_then_are_drawn_at_their_times(
    folder, tmp_path, said
):
    """A sweep logs each tenth estimate, or none."""
    run = ("run", "--from", str(folder / "lqr" / "run.mcap"), "picture=false")
    assert main([*run, "sim.estimate_every=10", f"out={tmp_path / 'tenth'}"]) == 0
    whole, tenth = (read_log(place / "run.mcap") for place in (folder / "lqr", tmp_path / "tenth"))
    panels = [plot([log], "estimate").axes for log in (whole, tenth)]
    assert [axes.get_ylabel() for axes in panels[0]] == [axes.get_ylabel() for axes in panels[1]]
    for one, other in zip(*panels, strict=True):
        (every,) = (line for line in one.lines if len(line.get_xdata()) == 300)
        (some,) = (line for line in other.lines if len(line.get_xdata()) == 30)
        assert list(some.get_xdata()) == list(every.get_xdata())[::10]
        assert list(some.get_ydata()) == list(every.get_ydata())[::10]
    assert main([*run, "sim.estimate_every=0", f"out={tmp_path / 'none'}"]) == 0
    said()
    assert main(["plot", str(tmp_path / "none"), "--what", "estimate"]) == 2
    assert "its estimates were not logged (sim.estimate_every=0)" in said()


@pytest.mark.parametrize("format_", ["png", "svg", "pdf"])
def test_equal_logs_give_equal_bytes_and_nothing_is_overwritten(folder, tmp_path, capsys, format_):
    log, out = str(folder / "mpc"), tmp_path / f"a.{format_}"
    again = tmp_path / f"b.{format_}"
    words = ("plot", log, "--what", "errors", "--width", "89mm", "--dpi", "60", "--out")
    assert main([*words, str(out)]) == main([*words, str(again)]) == 0
    assert out.read_bytes() == again.read_bytes()
    assert main([*words, str(out)]) == 2
    assert "nothing is overwritten" in capsys.readouterr().err


def test_letters_are_embedded_in_a_pdf_and_in_an_svg_outlines_or_text(folder, tmp_path):
    pdf, outlines, text = (tmp_path / name for name in ("a.pdf", "a.svg", "b.svg"))
    for out, more in ((pdf, ()), (outlines, ()), (text, ("--svg-text",))):
        assert main(["plot", str(folder / "mpc"), "--out", str(out), *more]) == 0
    content = pdf.read_bytes()
    assert b"/FontFile2" in content and b"/Type3" not in content  # Type 42: TrueType outlines
    assert "<text" not in outlines.read_text(encoding="utf-8")
    assert "pitch [rad]" in text.read_text(encoding="utf-8")


def test_several_logs_are_named_by_what_they_differ_in_and_one_by_its_folder(logs):
    one, other = names_of(logs)
    assert "newton_mpc" in one and "lqr" in other
    assert "seed 4" in other and "prior_seed 3" in other
    figure = plot(logs, "tracking")
    told = [text.get_text().replace("\n", " ") for text in figure.legends[0].get_texts()]
    assert one in told and other in told and "reference" in told
    assert names_of(logs[:1]) == ["mpc"]
    with pytest.raises(ConfigurationError, match="told apart"):
        plot(logs * 10, "tracking")


def test_each_word_of_a_legend_has_one_look_and_no_other_has_it(logs):
    found = defaultdict(set)  # colours and dashes by the words of the legend
    for axes in plot(logs[:1], ["tracking", "errors", "rates", "estimate", "torques"]).axes:
        for line in axes.lines:
            if not line.get_label().startswith("_"):
                found[line.get_label()].add((str(line.get_color()), str(line.get_linestyle())))
    assert all(len(each) == 1 for each in found.values())
    seen = [found[word] for word in ("rig", "estimate ± 2 sd", "estimate − true", "reference")]
    assert len(set.union(*seen)) == len(seen)


def test_what_belongs_to_an_axis_has_its_colour_in_all_plots_of_a_log(logs):
    """Pitch and the main rotor the first one, yaw and the tail rotor the second."""
    curves = {
        axes.get_ylabel().replace("\n", " ").partition(" [")[0].strip(): line.get_color()
        for axes in plot(logs[:1], ["inputs", "rates", "torques", "phase"]).axes
        for line in axes.lines
        if len(line.get_xdata()) > 10
    }
    for label, colour in curves.items():
        main = label.startswith(("pitch", "main"))
        assert colour == PALETTE["blue" if main else "vermilion"], label
    assert {"tail rotor command", "tail rotor", "yaw rate", "pitch moment"} <= set(curves)


def test_each_log_is_held_against_the_time_of_its_samples(logs):
    """Whatever the control period: the whole of a sample has to be done before the next one."""
    figure = plot(logs, "solver", names=["slow", "fast"])
    lines = [line for line in figure.axes[0].lines if "deadline" in line.get_label()]
    assert {line.get_label(): line.get_ydata()[0] for line in lines} == {"deadline": 20.0}
    table = logs[1].tables["/command"]
    doubled = {**logs[1].tables, "/command": replace(table, time=2 * table.time)}
    figure = plot([logs[0], replace(logs[1], tables=doubled)], "solver", names=["fast", "slow"])
    lines = [line for line in figure.axes[0].lines if "deadline" in line.get_label()]
    told = {line.get_label(): line.get_ydata()[0] for line in lines}
    assert told == {"deadline of fast, 20 ms": 20.0, "deadline of slow, 40 ms": 40.0}


def test_what_a_log_lacks_is_told(folder, logs, tmp_path, capsys):
    reasons = absences(logs[1:], ["prediction", "comparison", "tracking"])
    assert set(reasons) == {"prediction", "comparison"}
    out = tmp_path / "some.svg"
    words = ["plot", str(folder / "lqr"), "--what", "prediction,inputs", "--out", str(out)]
    assert main([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "trms.plot/1" and document["files"] == [str(out)]
    assert "controllers that plan ahead" in document["absent"]["prediction"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--what", "prediction"], ["nothing to be drawn"]),
        (["--what", "trakcing"], ["there is no plot", "in --what"]),
        (["--width", "3km"], ["is no size", "in --width"]),
        (["--width", "5mm"], ["from 30 to 1200 mm"]),
        (["--from", "9"], ["from 0 to 6 s"]),
        (["--from", "3", "--to", "2"], ["is empty", "in --from, --to"]),
        (["--out", "a.jpg"], ["a figure is no .jpg"]),
        (["--format", "gif"], ["is no gif"]),
        (["--names", "a,b"], ["2 names for 1 logs", "in --names"]),
        (["--what", "scene,tracking"], ["a figure of its own"]),
    ],
)
def test_wrong_words_are_answered_by_the_name_that_was_typed(folder, said, words, told):
    assert main(["plot", str(folder / "lqr"), *words]) == 2
    answer = said()
    assert all(part in answer for part in told), answer


def test_a_folder_that_is_no_runs_is_answered_with_what_to_type(folder, tmp_path, said):
    assert main(["plot", str(folder)]) == 2
    answer = said()
    assert "the folder of 2 runs" in answer and f"report {folder}" in answer
    assert main(["plot", str(tmp_path)]) == 2
    assert "there is no run.mcap in this folder" in said()


def test_a_folder_takes_a_file_a_kind_or_none(folder, tmp_path):
    words = ["plot", str(folder / "lqr"), "--what", "tracking,errors", "--format", "svg"]
    out = tmp_path / "figures"
    assert main([*words, "--out", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["errors.svg", "tracking.svg"]
    (out / "tracking.svg").unlink()
    assert main([*words, "--out", str(out)]) == 2  # one is there: the other is not written
    assert sorted(path.name for path in out.iterdir()) == ["errors.svg"]


def test_a_scene_is_drawn_still_and_moving(folder, tmp_path):
    still, moving = tmp_path / "scene.png", tmp_path / "scene.gif"
    words = ["plot", str(folder / "mpc"), "--what", "scene"]
    assert main([*words, "--from", "2", "--out", str(still), "--dpi", "60"]) == 0
    assert main([*words, "--from", "1", "--to", "1.2", "--out", str(moving)]) == 0
    from PIL import Image

    assert Image.open(still).size[0] > 200
    assert Image.open(moving).n_frames == 3  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("text", "size"),
    [("89mm", (89, None)), ("12cm", (120, None)), ("120x80mm", (120, 80)), ("7in", (177.8, None))],
)
def test_sizes(text, size):
    across, high = size_of(text, "paper")
    assert across == pytest.approx(size[0]) and high == (size[1] and pytest.approx(size[1]))


def test_a_figure_too_small_for_its_panels_is_told_in_our_words(folder, tmp_path, said, recwarn):
    words = ["--what", "tracking,inputs,solver", "--width", "40x30mm"]
    assert main(["plot", str(folder / "mpc"), *words, "--out", str(tmp_path / "small.png")]) == 0
    assert "the panels do not fit into 40 x 30 mm" in said()
    assert not [str(w.message) for w in recwarn if "layout" in str(w.message)]
