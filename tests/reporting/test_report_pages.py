"""Pages of runs, comparisons and sweeps: what stands in them, also where a log has little."""

import base64
import gzip
import hashlib
import itertools
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from html import unescape
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from tests.reporting.conftest import example_run, logged, unpacked, with_columns
from trms_cli.core.findings import Datum, Findings, Section, Table
from trms_cli.library.report.pages import runs_of_rows
from trms_cli.library.report.sweeps import read_sweep, relative_link
from trms_cli.reporting.chart_plot import MOST_POINTS
from trms_cli.reporting.page import page_html, policy
from trms_cli.reporting.report_runs import findings_of_comparison, findings_of_run
from trms_cli.reporting.report_sweep import findings_of_sweep
from trms_cli.reporting.signals import RunReport
from trms_cli.reporting.sweep_report import (
    Correlation,
    Draws,
    FailureShare,
    Objective,
    SweepReport,
    SweepRun,
)
from trms_cli.runs.query import QueryResult
from trms_cli.scoring.comparison.ranking import group, rank
from trms_cli.scoring.comparison.runs import ComparisonRun


def plots_of(page):
    """Specifications in a page by their headings."""
    found = re.findall(
        r'<figure class="plot[^>]*>\n(?:<h3>(.*?)</h3>)?.*?class="plot-data">(.*?)</script>',
        page_html(page),
        re.DOTALL,
    )
    return {unescape(title.replace("<wbr>", "")): json.loads(data) for title, data in found}


def traces_of(plot) -> dict:
    """The curves of a plot by their names."""
    return {trace["name"]: trace for trace in plot["traces"]}


def rows_html(rows) -> str:
    """The page of a table that is sorted and filtered."""
    columns = ["a", "b"][: len(rows[0])]
    table = Table(columns, rows, keys=columns)
    return page_html(Findings("Rows", [], [Section("", blocks=[table])]))


def swept(number, entrant="pid", *, k_g=0.1, rmse=0.2, **more):
    return SweepRun(
        name=str(number),
        number=number,
        entrant=entrant,
        values={"controller": entrant, "plant.parameters.k_g": k_g},
        figures={"rmse": rmse, "effort": 10.0 - 20 * rmse},
        **more,
    )


@pytest.fixture
def sweep() -> SweepReport:
    runs = [
        swept(i, ("pid", "lqr")[i % 2], k_g=0.1 + 0.01 * (i // 2), rmse=0.1 + 0.01 * i)
        for i in range(20)
    ]
    runs.append(SweepRun(name="20", outcome="failed", problem="the rig <fell>", entrant="pid"))
    return SweepReport(
        name="many",
        runs=runs,
        keys=["controller", "plant.parameters.k_g"],
        figures={"rmse": "rad", "effort": "V² s"},
    )


@pytest.fixture
def drawn() -> SweepReport:
    """Two controllers on the same twelve drawn values each; `k_9` is the strongest."""
    keys = [f"k_{i}" for i in (9, 8, 7, 6, 5, 4, 3, 2, 11, 10, 1, 0)]
    values = np.random.default_rng(1).normal(1.0, 0.1, (60, 12))
    runs = [
        SweepRun(
            name=str(2 * i + j),
            entrant=who,
            values={"controller": who, **dict(zip(keys, map(float, values[i]), strict=True))},
            figures={"rmse": 0.1 + 0.01 * i + 0.001 * j},
        )
        for i in range(60)
        for j, who in enumerate(("pid", "lqr"))
    ]
    return SweepReport(
        name="drawn",
        runs=runs,
        keys=["controller", *keys],
        figures={"rmse": "rad"},
        draws=Draws(
            keys=keys,
            limits={"rmse": 0.2},
            failures=[FailureShare(who="lqr", draws=4, count=1, share=0.25, low=0.006, high=0.8)],
            correlations=[
                Correlation(who="lqr", key="k_9", figure="rmse", rho=-0.9, p=0.001),
                Correlation(who="pid", key="k_8", figure="rmse", rho=0.8, p=0.002),
            ],
        ),
    )


@pytest.fixture(scope="module")
def ranking():
    """Two controllers on six rigs; `lqr` misses by a tenth to six tenths more."""
    runs = [
        ComparisonRun(
            path=f"{who}{rig}",
            coordinates={"controller": who, "plant": str(rig)},
            score={"channels": {"alpha_h": {"rmse": 0.1 + more * rig}}},
        )
        for rig in range(1, 7)
        for who, more in (("pid", 0.0), ("lqr", 0.01))
    ]
    return rank(group(runs))


class TestRun:
    @pytest.fixture
    def plots(self, run):
        return plots_of(findings_of_run(run))

    def test_has_every_part(self, run):
        page = findings_of_run(run)
        text = page_html(page)
        for heading in (
            *("Angles and commands", "Speeds, rates and torques", "Innovations", "Phase plots"),
            *("Predictions", "Solver", "Score", "Events"),
        ):
            assert f"<h2>{heading}</h2>" in text
        assert set(plots_of(page)) >= {
            *("pitch", "yaw", "commands", "predictions of pitch", "pitch against yaw"),
            *("pitch against its rate", "time of a control step", "distribution of the times"),
        }
        assert "trms run --from first/run.mcap" in text and "duration: 20" in text
        lead = page.lead[0]
        assert "**newton_mpc** followed pitch to 0.1 rad and yaw to 0.1 rad" in lead
        assert "**1 deadline missed**" in lead and "1 fault injected" in lead and "10 %" in lead

    def test_s_is_told_from_the_rate_of_its_axis(self, run):
        said = "S is the rate less what the other rotor"
        assert said not in page_html(findings_of_run(run))
        state = run.tables["/plant/state"]
        more = {**state.columns, "S_h": np.zeros(len(state.time))}
        assert said in page_html(findings_of_run(with_columns(run, "/plant/state", more)))

    def test_curves_are_the_samples_and_all_plots_of_the_time_share_a_range(self, run, plots):
        by_name = traces_of(plots["yaw"])
        assert set(by_name) >= {"rig", "measured", "reference", "estimate ± 2 sd"}
        x, y = (unpacked(by_name["rig"][axis]) for axis in "xy")
        state = run.tables["/plant/state"]
        np.testing.assert_allclose(y, state.columns["alpha_h"], rtol=1e-6)
        np.testing.assert_allclose(x, state.time, rtol=1e-6)
        timed = [spec for spec in plots.values() if spec["group"] == "time"]
        assert len(timed) >= 8
        assert {tuple(spec["layout"]["xaxis"]["range"]) for spec in timed} == {(0.0, 20.0)}

    def test_events_limits_and_saturation_are_drawn(self, plots):
        marks = traces_of(plots["pitch"])["event"]
        assert unpacked(marks["x"]).tolist() == [5.0] and "yaw is frozen" in marks["text"][0]
        shapes = plots["commands"]["layout"]["shapes"]
        assert any(s["type"] == "rect" and (s["x0"], s["x1"]) == (6.0, 6.5) for s in shapes)
        levels = [s["y0"] for s in plots["pitch"]["layout"]["shapes"] if s["xref"] == "paper"]
        assert levels == [-0.5, 0.5]
        traces = traces_of(plots["time of a control step"])
        assert unpacked(traces["deadline missed"]["x"]).tolist() == [5.0]
        assert unpacked(traces["deadline missed"]["y"]).tolist() == [200.0]
        assert len(unpacked(traces["fall-back"]["x"])) == 1

    def test_a_prediction_begins_where_it_was_made(self, run, plots):
        spec = plots["predictions of yaw"]
        (every, chosen), starts = spec["fans"]["pairs"][0], spec["fans"]["starts"]
        x = unpacked(spec["traces"][every]["x"])
        made = run.tables["/prediction"].time
        assert len(starts) == len(spec["fans"]["times"]) + 1 == len(made) + 1
        np.testing.assert_allclose([x[s] for s in starts[:-1]], made, rtol=1e-6)
        assert not len(unpacked(spec["traces"][chosen]["x"]))

    def test_is_small_for_eighty_seconds_at_a_hundred_hertz(self):
        # ten times the samples of the example are those of 80 s at 200 Hz
        page = findings_of_run(example_run(seconds=800.0))
        assert len(page_html(page).encode()) < 3e6
        traces = [trace for spec in plots_of(page).values() for trace in spec["traces"]]
        longest = max(len(unpacked(t["y"])) for t in traces if isinstance(t["y"], dict))
        assert longest <= 20_000 and MOST_POINTS == 2_000

    def test_without_reference_controller_and_truth_it_is_a_recording(self, run):
        tables = {topic: run.tables[topic] for topic in ("/measurement", "/command")}
        page = findings_of_run(RunReport(name="rig", tables=tables, duration=20.0))
        assert set(plots_of(page)) >= {"pitch", "yaw", "commands", "pitch against yaw"}
        assert "without a reference to follow" in page.lead[0]
        text = page_html(page)
        assert "<h2>Solver</h2>" not in text and "<h2>Predictions</h2>" not in text

    def test_of_no_samples_it_says_so(self):
        dead = RunReport(name="dead", tables={}, outcome="died", problems=("it holds no sample",))
        page = findings_of_run(dead)
        assert "no sample of any signal" in page_html(page) and "it holds no sample" in page.lead[1]

    def test_gaps_and_damage_are_drawn_as_far_as_they_go(self, run):
        measured = run.tables["/measurement"].columns

        def all_(value: float, topic: str) -> np.ndarray:
            return np.full(len(run.tables[topic].time), value)

        hurt = run
        for topic, columns in (
            ("/measurement", {**measured, "alpha_v": all_(np.nan, "/measurement")}),
            ("/estimate", {"alpha_v": all_(np.inf, "/estimate")}),
            ("/controller", {"solve_time_s": all_(np.nan, "/controller")}),
            ("/prediction", {"time": run.tables["/prediction"].columns["time"]}),
        ):
            hurt = with_columns(hurt, topic, columns)
        page = findings_of_run(replace(hurt, outcome="interrupted", score={}))
        assert "pitch" in plots_of(page) and "was interrupted" in page.lead[1]

    def test_one_channel_of_other_names(self, run):
        time = run.tables["/measurement"].time
        one = {"/measurement": {"level": np.sin(time)}, "/reference": {"level": 0.0 * time}}
        page = findings_of_run(RunReport(name="tank", tables=logged(one, dict.fromkeys(one, time))))
        assert {"level", "level against its rate"} == set(plots_of(page))


class TestComparison:
    def test_runs_lie_over_one_another_and_the_best_is_marked(self):
        one = example_run("one")
        page = findings_of_comparison([one, example_run("other", shift=0.2)])
        plots = plots_of(page)
        assert list(traces_of(plots["yaw"])) == ["reference", "one", "other"]
        assert "**one** tracks best" in page.lead[0]
        row = re.search(r"pitch: RMSE \[rad\]</th>(.*?)</tr>", page_html(page))
        assert re.findall(r'class="(.*?)">', row[1]) == ["best number", "number"]
        iae = re.search(r"pitch: IAE \[rad s\]</th>(.*?)</tr>", page_html(page))
        assert "best" not in iae[1]  # alike
        error = unpacked(plots["tracking error of yaw"]["traces"][0]["y"])
        wanted, actual = (
            one.tables[topic].columns["alpha_h"] for topic in ("/reference", "/plant/state")
        )
        np.testing.assert_allclose(error, wanted - actual, atol=1e-7)

    def test_different_references_are_drawn_each(self):
        other = example_run("other")
        higher = {n: v + 0.1 for n, v in other.tables["/reference"].columns.items()}
        page = findings_of_comparison(
            [example_run("one"), with_columns(other, "/reference", higher)]
        )
        names = ["reference of one", "reference of other", "one", "other"]
        assert list(traces_of(plots_of(page)["yaw"])) == names

    def test_runs_without_anything_in_common(self):
        empty = RunReport(name="dead", tables={}, outcome="died")
        page = findings_of_comparison([example_run("one"), empty], left_out=[("x.mcap", "damaged")])
        assert "**Incomplete**: dead" in page.lead[1] and "x.mcap" in page_html(page)

    def test_ranking_has_intervals(self, ranking):
        page = findings_of_comparison([example_run("a"), example_run("b")], ranking=ranking)
        (trace,) = plots_of(page)["error over the best's"]["traces"]
        first, second = ranking.standings
        ends = second.interval.low, second.interval.high
        assert first.interval.low == first.ratio == 1.0 and ends[0] < second.ratio < ends[1]
        found = [trace["error_x"][side] for side in ("arrayminus", "array")]
        wanted = [[0.0, abs(end - second.ratio)] for end in ends]
        np.testing.assert_allclose(found, wanted, atol=1e-6)
        assert f"{ends[0]:.3f}–{ends[1]:.3f}" in page_html(page)


class TestSweep:
    def test_draws_show_failures_correlations_and_limits_and_the_strongest_are_plotted(self, drawn):
        page = findings_of_sweep(drawn)
        text, plots = page_html(page), plots_of(page)
        failures = text.partition("Failures among the draws</h2>")[2].partition("</section>")[0]
        assert "rmse ≤ 0.2" in failures and "25.0 %" in failures and "0.6" in failures
        table = text.partition("Sensitivities</h2>")[2].partition("</section>")[0]
        assert table.index("-0.90") < table.index("+0.80") and "k_9" in table
        assert "lqr **1 of 4** (25.0 %" in page.lead[1]
        assert "against k_9" in plots and "against k_0" not in plots
        assert "Of 12 values that were varied 8 are here: those with the largest" in text
        assert "12 drawn values" in page.lead[-1] and "k_9" not in page.lead[-1]
        heads = re.findall(r"<th[^>]*>(.*?)</th>", text.partition("All runs</h2>")[2])
        told = re.sub("<.*?>", "", " ".join(heads))
        assert told.index("rmse") < told.index("k_9")  # what came of it before what was drawn
        # equal draws of two entrants are both seen
        [spec] = [plot for heading, plot in plots.items() if "over " in heading]
        dot, ring = (trace["marker"] for trace in spec["traces"])
        assert (dot["symbol"], ring["symbol"]) == ("circle", "circle-open")
        assert ring["size"] > 1.5 * dot["size"] and ring["coloraxis"] == dot["coloraxis"]

    def test_lead_counts_what_was_asked_and_names_the_best(self, sweep):
        lead = findings_of_sweep(sweep).lead
        assert lead[0] == "20 of 21 runs completed; **1 failed**."
        assert "Run 0 has the least rmse [rad], 0.1 (" in lead[-1]
        stopped = findings_of_sweep(replace(sweep, planned_count=50)).lead[0]
        assert stopped.startswith("20 of 50 runs completed; **1 failed**, **29 not begun**")
        assert (
            findings_of_sweep(replace(sweep, planned_count=5)).lead[0].startswith("20 of 21 runs")
        )

    @pytest.mark.parametrize(
        ("ratio", "words"),
        [
            (1.0, "misses by as much"),
            (1.0001, "by 1.0001 times as much"),
            (1 + 1e-9, "by as much, to six digits"),
            (1.2345, "by 1.23 times as much"),
        ],
    )
    def test_the_second_never_misses_by_one_times_as_much(self, sweep, ranking, ratio, words):
        first, second = ranking.standings
        standings = (first, replace(second, against_first=ratio))
        ranking = replace(ranking, standings=standings)
        assert words in findings_of_sweep(sweep, ranking=ranking).lead[1]

    def test_every_run_is_in_the_table_and_failures_have_their_reason(self, sweep):
        text = page_html(findings_of_sweep(sweep))
        assert text.count("<tr><td>") == 21
        assert "the rig &lt;fell&gt;" in text and "<fell>" not in text

    def test_each_figure_can_be_chosen_in_each_plot(self, sweep):
        plots = plots_of(findings_of_sweep(sweep))
        assert set(plots) == {"by who ran", "distribution", "against plant.parameters.k_g"}
        for spec in plots.values():
            assert [v["label"] for v in spec["variants"]] == ["rmse [rad]", "effort [V² s]"]
            assert all(len(v["traces"]) == len(spec["traces"]) for v in spec["variants"])
        dots = plots["against plant.parameters.k_g"]["traces"]
        assert [t["name"] for t in dots] == ["pid", "lqr"]
        expected = [0.11 + 0.02 * i for i in range(10)]
        np.testing.assert_allclose(unpacked(dots[1]["y"]), expected, rtol=1e-6)

    def test_two_keys_make_a_map_of_means(self):
        runs = [
            SweepRun(name=f"{a}{b}{k}", values={"a": a, "b": b}, figures={"rmse": a + b / 10 + k})
            for a, b, k in itertools.product((0.0, 1.0, 2.0), (0, 10, 20, 30), (0, 0.5))
        ]
        grid = SweepReport(name="grid", runs=runs, keys=["a", "b"], figures={"rmse": "rad"})
        (trace,) = plots_of(findings_of_sweep(grid))["over a and b"]["traces"]
        assert trace["type"] == "heatmap" and trace["x"] == ["0", "1", "2"]
        assert trace["y"] == ["30", "20", "10", "0"]
        expected = np.add.outer(np.arange(4)[::-1], np.arange(3)) + 0.25
        np.testing.assert_allclose(trace["z"], expected)

    def test_the_front_is_drawn_as_the_sweep_names_it_or_worked_out(self, sweep):
        objectives = (Objective("rmse"), Objective("effort"))
        named = replace(sweep, objectives=objectives, pareto=[3, 5, 99])
        drawn = plots_of(findings_of_sweep(named))["effort against rmse"]["traces"][1]
        assert drawn["text"] == ["3", "5"]
        runs = [*sweep.runs, swept(21, rmse=0.5)]  # effort falls with rmse: all are on the front
        runs.append(replace(swept(22), figures={"rmse": 0.6, "effort": 9.0}))
        out = replace(sweep, runs=runs, objectives=objectives)
        assert {run.number for run in out.front()} == {*range(20), 21}

    def test_three_objectives_are_drawn_in_pairs(self, sweep):
        runs = [replace(r, figures={**r.figures, "x": 1.0 * i}) for i, r in enumerate(sweep.runs)]
        objectives = [Objective(name) for name in ("rmse", "effort", "x")]
        page = findings_of_sweep(replace(sweep, runs=runs, objectives=objectives))
        assert {"effort against rmse", "x against rmse", "x against effort"} <= set(plots_of(page))

    def test_model_files_of_one_name_are_told_apart_as_a_comparison_does(self, tmp_path):
        def row(number, path):
            return {
                "path": str(tmp_path / str(number)),
                "log": str(tmp_path / str(number) / "run.mcap"),
                "model": "fit",
                "controller": "lqr",
                "outcome": "completed",
                "complete": True,
                "overrides": json.dumps([f"model={path}", "controller=lqr"]),
                "choices": json.dumps({"controller": "lqr", "model": "from_file"}),
            }

        typed = ["a/fit/model.yaml", "./b/fit", "b/fit/model.yaml"]
        rows = [row(i, path) for i, path in enumerate(typed)]
        found = QueryResult(runs=rows, columns={}, matching=3, of=3, folders=(), unreadable=())
        names = ("fit + path=a/fit/model.yaml", "fit + path=b/fit/model.yaml")
        assert group(runs_of_rows(found)).entrants == names
        report = read_sweep([tmp_path], found, tmp_path)
        assert [run.entrant for run in report.runs] == [names[0], names[1], names[1]]
        assert report.keys == ["model.path"]
        other = [{**row(3, "c/rig.yaml"), "model": "rig"}]
        found = replace(found, runs=[rows[0], *other])
        report = read_sweep([tmp_path], found, tmp_path)
        assert [run.entrant for run in report.runs] == ["fit", "rig"]

    @pytest.mark.parametrize("count", [0, 1])
    def test_one_run_and_none(self, count):
        few = SweepReport(name="few", runs=[swept(number) for number in range(count)])
        assert f"{count} of {count} runs completed" in page_html(findings_of_sweep(few))

    def test_thousands_of_runs_stay_in_bounds(self, sweep):
        k_g, rmse = np.random.default_rng(0).uniform(size=(2, 12_000)).tolist()
        runs = [swept(i, ("pid", "lqr")[i % 2], k_g=k_g[i], rmse=rmse[i]) for i in range(12_000)]
        text = page_html(findings_of_sweep(replace(sweep, runs=runs)))
        assert text.count("<tr><td>") == 10_000 and "first 10000 of 12000" in text
        assert len(text) < 8e6


class TestSafety:
    """Nothing of strangers runs, and nothing is fetched."""

    def test_the_policy_names_the_scripts_that_the_page_carries(self, run):
        text = page_html(findings_of_run(run))
        told = unescape(re.search(r'Content-Security-Policy" content="(.*?)"', text)[1])
        (ours,) = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
        (packed,) = re.findall(r'<script type="application/gzip;base64" id="plotly">(.*?)<', text)
        plotly = gzip.decompress(base64.b64decode(packed, validate=True))
        installed = find_spec("plotly").submodule_search_locations[0]
        assert plotly == Path(installed, "package_data", "plotly.min.js").read_bytes()
        hashes = [hashlib.sha256(body).digest() for body in (ours.encode(), plotly)]
        named = [f"'sha256-{base64.b64encode(one).decode()}'" for one in hashes]
        assert told.startswith("default-src 'none'")
        assert f"; script-src {' '.join(named)}; " in told

    def test_a_page_of_rows_alone_carries_no_plotly_and_one_without_lets_no_script_run(self):
        text = rows_html([["x"]])
        assert text.count("<script>") == 1 and 'id="plotly"' not in text and len(text) < 40_000
        assert "script-src 'none'" in policy()

    def test_the_script_is_compressed_once_and_plotly_is_not_imported(self, tmp_path):
        write = (
            "import sys, gzip; from trms_cli.reporting.page import plotly_script\n"
            "gzip.compress = (lambda real: lambda *a, **k: (print('compressed'), real(*a, **k))[1])"
            "(gzip.compress)\n"
            "plotly_script(), plotly_script()\n"
            "assert not any(name.split('.')[0] == 'plotly' for name in sys.modules)"
        )
        command, cache = [sys.executable, "-c", write], {"TRMS_CACHE": str(tmp_path / "functions")}
        for expected in ("compressed\n", ""):
            done = subprocess.run(command, env=os.environ | cache, capture_output=True, text=True)
            assert (done.returncode, done.stdout) == (0, expected), done.stderr

    @pytest.mark.parametrize(
        "name", ["javascript:alert(1)", "//evil.example/x", '"><img src=x>', "ä b#?.html"]
    )
    def test_links_lead_to_files_beside_the_page_alone(self, name, tmp_path):
        link = relative_link(str(tmp_path / name / "report.html"), str(tmp_path))
        assert link.startswith("./") and not set(link) & set('"<> #?')
        assert ":" not in link.partition("/")[0]

    def test_cells_are_escaped_and_cut(self):
        html = rows_html([[Datum("<x>", link='./"y'), float("nan")], ["<" * 1000, 1e400]])
        body = html.partition("<tbody>")[2].partition("</tbody>")[0]
        assert "<x>" not in body and './"' not in body and "<<" not in body
        assert len(body) < 2200 and "∞" in body
