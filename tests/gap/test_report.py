"""The report: it says what the document says, and it is one file."""

from __future__ import annotations

import html
import re
from dataclasses import replace

import numpy as np
import pytest

from trms_cli.gap.diagnosis import (
    LOCATIONS,
    Cause,
    Gap,
    LocationShare,
    RaceEntry,
    RegionShare,
    Shrink,
)
from trms_cli.reporting import diagnosis_figures as figures
from trms_cli.reporting.diagnosis_diagram import diagram
from trms_cli.reporting.diagnosis_page import diagnosis_page
from trms_cli.reporting.diagnosis_words import confidence_words, race_words, where_words
from trms_cli.reporting.diagnosis_words import tests_words as words_of_tests

from .diagnosis_case import FRICTION, diagnosis, traces

#: Without most of the pictures, which take their time.
PLAIN: dict = {"traces": None, "race": ()}


def words_of(text: str) -> str:
    """What a page says, without its pictures and marks."""
    body = re.sub(r"<(style|img)[^>]*>(.*?</style>)?", " ", text, flags=re.S)
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", body)).split())


def drawn(figure) -> list[str]:
    """All that is written in the panels of a figure."""
    return [text.get_text() for axes in figure.axes for text in axes.texts]


def test_says_what_was_found_in_one_file() -> None:
    case = diagnosis()
    text = diagnosis_page(case, remarks=["12 samples of alpha_h are missing"]).html()
    said = words_of(text)
    for expected in (
        case.sentence,
        "88 %",
        "4.12 ± 0.18 mN m",
        case.next_experiment.why,
        case.next_experiment.command,
        "the beam never came near the table",
        case.warnings[0],
        "12 samples of alpha_h are missing",
        "91 %",
        "monday.csv",
        "+4.9 sd",
    ):
        assert expected in said, expected
    assert not re.search(r"https?:", re.sub(r"data:[^\"]+", "", text))
    assert text.count("<img ") == 5


def test_the_gap_is_told_in_numbers_of_the_document() -> None:
    case = diagnosis(**PLAIN)
    said = words_of(diagnosis_page(case).html())
    row = case.gap["alpha_h"]["10.0"]
    shown = " ".join(f"{1e3 * v:.3g}" for v in (row.raw, row.refit, row.corrected, row.floor))
    assert f"yaw 10 {shown} mrad 91 % 87 % to 94 %" in said


@pytest.mark.parametrize(
    "changes",
    [
        {"verdict": "no_gap", "causes": (Cause(effects=("no_gap",), probability=0.97),), "race": (),
         "confusable": (), "traces": None, "region": (), "next_experiment": None},
        {"verdict": "parameters_only", **PLAIN, "where": (), "gap": {}, "shrink": {}},
        {"verdict": "none_of_these", **PLAIN, "description": ("acts on yaw", "below 1 Hz"),
         "tests": ()},
        {"verdict": "undecided", "causes": (), "detectable": {}, "not_testable": ()},
    ],
    ids=lambda changes: changes["verdict"],
)  # fmt: skip
def test_every_verdict_has_a_page(changes: dict) -> None:
    case = diagnosis(**changes)
    said = words_of(diagnosis_page(case).html())
    assert case.sentence in said
    for line in case.description:
        assert (line in said) == (case.verdict in ("none_of_these", "undecided"))
    assert ("The next experiment" in said) == (case.next_experiment is not None)


def test_what_could_not_be_told_is_a_dash() -> None:
    nothing = Gap(raw=np.nan, refit=np.inf, corrected=np.nan, floor=0.001, unit="rad")
    case = diagnosis(
        gap={"alpha_v": {"0.1": nothing, "2.0": nothing}},
        shrink={"alpha_v": {"2.0": Shrink(fraction=None, ci95=None)}},
        **PLAIN,
    )
    assert "pitch 2 – ∞ – 1 mrad –" in words_of(diagnosis_page(case).html())


def test_nothing_corrected_is_not_called_closed() -> None:
    row = diagnosis().gap["alpha_h"]["2.0"]
    same = {"alpha_h": {"2.0": replace(row, corrected=row.refit)}}
    case = diagnosis(gap=same, verdict="none_of_these", **PLAIN)
    said = words_of(diagnosis_page(case).html())
    assert "No cause was added" in said and "the correction closes" not in said
    panel = figures.gap_figure(same, corrected=False).axes[0]
    assert [line.get_label() for line in panel.lines] == ["as it was", "refitted", "floor"]


def test_a_channel_that_got_worse_is_not_hidden() -> None:
    row = diagnosis().gap["omega_v"]["2.0"]
    worse = {"omega_v": {"2.0": replace(row, corrected=1.2 * row.refit)}}
    text = diagnosis_page(diagnosis(gap=worse, worse=("omega_v",), **PLAIN)).html()
    assert "made main rotor worse" in words_of(text)
    assert re.search(r'<td class="bad number">2\.', text)


class TestDiagram:
    def test_every_place_has_its_share(self) -> None:
        where = [
            LocationShare(location=name, share=0.07 * i, ci95=(0.05 * i, 0.08 * i))
            for i, name in enumerate(LOCATIONS)
        ]
        said = drawn(diagram(where))
        for i, name in enumerate(LOCATIONS):
            assert name.replace("_", " ") in said and f"{7 * i:.0f} %" in said

    def test_a_place_with_nothing_has_no_figure(self) -> None:
        said = drawn(diagram([LocationShare(location="yaw_moment", share=1.0, ci95=(1.0, 1.0))]))
        assert sum("%" in text for text in said) == 2 and "main tacho" in said

    def test_a_sensor_that_was_not_recorded_is_dashed(self) -> None:
        panel = diagram([], ["u_v", "u_h", "alpha_v", "alpha_h", "omega_v"]).axes[0]
        dashed = [patch for patch in panel.patches if patch.get_linestyle() != "-"]
        assert len(panel.patches) == 12 and len(dashed) == 1

    def test_a_rig_of_one_axis_has_one_row(self) -> None:
        said = drawn(diagram([], ["u_h", "alpha_h", "omega_h"]))
        assert "yaw moment" in said and "pitch moment" not in said and "main tacho" not in said

    def test_the_larger_the_share_the_darker(self) -> None:
        where = [
            LocationShare(location="yaw_moment", share=0.8, ci95=(0.7, 0.9)),
            LocationShare(location="tail_thrust", share=0.2, ci95=(0.1, 0.3)),
            LocationShare(location="tail_motor", share=0.0, ci95=(0.0, 0.1)),
        ]
        panel = diagram(where).axes[0]
        light = sorted(sum(patch.get_facecolor()[:3]) for patch in panel.patches)
        assert light[0] < light[1] < light[2] == 3.0


class TestRace:
    def test_bars_are_the_scores_from_the_best(self) -> None:
        case = diagnosis()
        panel = figures.race_figure(case.race, case.confusable).axes[0]
        names = [tick.get_text() for tick in panel.get_yticklabels()]
        assert names[:2] == ["yaw Coulomb friction", "yaw Stribeck friction"]
        widths = [patch.get_width() for patch in panel.patches]
        assert widths == sorted((e.score for e in case.race), reverse=True)
        assert [t for t in drawn(panel.figure) if "confusable" in t] == ["96 %   confusable"]

    def test_one_that_fails_does_not_flatten_the_others(self) -> None:
        race = (
            *diagnosis().race,
            RaceEntry(effects=("x",), score=-1e6, se=1, explained=0, moved=0),
        )
        low, high = figures.race_figure(race, ()).axes[0].get_xlim()
        assert low > -0.3 * high

    def test_the_likeliest_cause_is_the_one_in_bold(self) -> None:
        case = diagnosis()
        best = ("yaw_stribeck_friction",)
        panel = figures.race_figure(case.race, case.confusable, best).axes[0]
        bold = [t.get_text() for t in panel.get_yticklabels() if t.get_fontweight() == "bold"]
        assert bold == ["yaw Stribeck friction"]
        nameless = diagnosis(causes=(Cause(effects=("none_of_these",), probability=0.9),))
        assert race_words(nameless).startswith("Yaw Coulomb friction foretells")
        swapped = diagnosis(causes=(Cause(effects=best, probability=0.9), *case.causes[:1]))
        assert race_words(swapped).startswith("Yaw Stribeck friction foretells")
        assert "Above it is yaw Coulomb friction by 30 nats" in race_words(swapped)

    def test_words_warn_of_something_that_has_no_name(self) -> None:
        entries = [replace(e, score=9000.0) if e.effects == ("flexible",) else e
                   for e in diagnosis().race]  # fmt: skip
        assert "something else is missing" in race_words(diagnosis(race=tuple(entries)))
        assert "does no better" in race_words(diagnosis())


class TestWords:
    def test_confidence(self) -> None:
        first, second = confidence_words(diagnosis())
        assert first.startswith("**Sure**")
        assert "**88 %**, **96 %** together with yaw Stribeck friction" in first
        assert "next is none of these with 3 %" in first
        assert "yaw Coulomb friction and yaw Stribeck friction apart" in second

    def test_a_pair_that_is_not_the_answer_is_not_brought_up(self) -> None:
        pair = (("main_input_delay", "main_actuator_lag"),)
        (words,) = confidence_words(diagnosis(confusable=pair))
        assert words.startswith("**Likely**") and "next is yaw Stribeck friction with 8 %" in words

    def test_a_place_that_is_not_certain(self) -> None:
        near = (
            LocationShare(location="yaw_moment", share=0.5, ci95=(0.3, 0.7)),
            LocationShare(location="tail_thrust", share=0.4, ci95=(0.2, 0.6)),
        )
        assert "tail thrust reach as far" in where_words(diagnosis(where=near))
        assert "reach" not in where_words(diagnosis())

    def test_tests(self) -> None:
        assert "1 of 2 tests" in words_of_tests(diagnosis())
        assert "in yaw" in words_of_tests(diagnosis())


class TestForce:
    def test_the_enlarged_part_is_where_the_cause_acts(self) -> None:
        case = traces()
        late = np.where(case.force_time > 80, 1.0, 0.0)
        case = replace(case, explained={"yaw_moment": late})
        panels = figures.force_figure(case, ["yaw_moment"]).axes
        assert panels[1].get_xlim()[0] > 79

    def test_nothing_smoothed_is_no_figure(self) -> None:
        assert figures.force_figure(replace(traces(), force={}), ["yaw_moment"]) is None
        assert figures.run_figure(replace(traces(), runs={})) is None
        assert figures.gap_figure({}) is None


def test_a_region_is_told() -> None:
    region = (RegionShare(location="yaw_moment", condition="|alpha_h| > 0.5 rad", share=0.6),)
    assert "|alpha_h| > 0.5 rad 60 %" in words_of(
        diagnosis_page(diagnosis(region=region, **PLAIN)).html()
    )


def test_the_case_names_an_effect_of_the_library() -> None:
    assert diagnosis().causes[0].effects == (FRICTION,)
