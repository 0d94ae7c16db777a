"""What a diagnosis has to tell: its findings say what the document says; the page is one file."""

import html
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from trms_cli.composition.catalogue import read_yaml
from trms_cli.core.chart import Bars, RigDiagram
from trms_cli.core.findings import Datum, Findings, Table, plain
from trms_cli.gap.diagnosis import (
    Cause,
    DiagnosisResult,
    Gap,
    LocationShare,
    NotTestable,
    Onset,
    RaceEntry,
    Shrink,
    SizeEstimate,
    document_of,
)
from trms_cli.gap.evidence_sections import force_chart, gap_chart, race_chart, run_chart
from trms_cli.gap.findings import findings
from trms_cli.gap.sentence import sentence
from trms_cli.gap.shrinkage import Shrinkage
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.rig_parts import diagram_rows, parts_of
from trms_cli.reporting.page import page_html
from trms_cli.reporting.rig_diagram import diagram

from .diagnosis_case import DOCUMENT, FRICTION, diagnosis, traces

#: Without most of the pictures, which take their time.
PLAIN: dict = {"traces": None, "race": ()}


def words_of(text: str) -> str:
    """What a page says, without its pictures and marks."""
    body = re.sub(r"<(style|img)[^>]*>(.*?</style>)?", " ", text, flags=re.S)
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", body)).split())


def drawn(figure) -> list[str]:
    """All that is written in the panels of a figure."""
    return [text.get_text() for axes in figure.axes for text in axes.texts]


def section(report: Findings, heading: str):
    return next(section for section in report.sections if section.heading == heading)


def rows(report: Findings, head: str) -> list[list]:
    """Of the first table with a column of that head, without judgements."""
    table = next(t for t in report.tables if head in t.columns)
    return [[plain(cell) for cell in row] for row in table.rows]


def test_says_what_was_found_in_one_file(tmp_path) -> None:
    case = diagnosis()
    report = findings(case, ["12 samples of alpha_h are missing"], tmp_path)
    text = page_html(report, interactive=False)
    page_text = words_of(text)
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
        f"validate model={tmp_path}/corrected_model.yaml",
    ):
        assert expected in page_text, expected
    assert report.title == "Diagnosis: yaw Coulomb friction is what the model lacks"
    assert not re.search(r"https?:", re.sub(r"data:[^\"]+", "", text))
    assert text.count("<img ") == 5 and "█" not in text
    assert report.lead[1].startswith(
        "**Sure**: yaw Coulomb friction, 88 %; 96 % together with yaw Stribeck"
    )
    assert "next is none of these (3 %)" in report.lead[1]
    # Only the advice says what an experiment tells.
    assert not any("experiment" in sentence for sentence in report.lead)
    (text,) = section(report, "Is there a gap at all?").text
    assert "1 of 3 tests" in text and "in yaw" in text
    assert "reach" not in section(report, "Where the gap lies").text[0]
    assert rows(report, "of its energy")[0][-1] == "22 % where |rate of yaw| < 0.05 rad/s"


def test_the_answer_and_what_to_type_come_before_what_limits_and_proves_it() -> None:
    onset = Onset(time_s=31.24, ci95=(30.9, 31.8))
    case = diagnosis(excitation=("The rig was held at one point.",), **PLAIN)
    case = replace(case, causes=(replace(case.causes[0], onset=onset), *case.causes[1:]))
    assert case.worth is not None
    page_text = words_of(page_html(findings(case, folder=Path("found")), interactive=False))
    order = [
        "The rig was held at one point.", case.sentence, "yaw Coulomb friction, 88 %",
        "31.2 s into the recording (30.9 to 31.8 s)", case.worth.words, case.worth.command,
        case.next_experiment.command, case.warnings[0], "4.12 ± 0.18 mN m",
        "not told apart from yaw Coulomb friction", "86 % of the gap lies",
        "u_h never crosses zero",
    ]  # fmt: skip
    # the links to the sections say nothing yet
    places = [page_text.find(text) for text in order]
    assert -1 not in places and places == sorted(places)
    measures = {m.label: m.value for m in findings(case).measures}
    assert measures["since"] == "31.2" and measures["in the loop"] == "79 % less"


class TestSuspects:
    def test_those_that_were_fitted_come_first_and_others_are_folded_away(self) -> None:
        report = findings(diagnosis(**PLAIN))
        near, rest = section(report, "Why not the others"), section(report, "Why not the rest")
        assert rest.folded and not near.folded
        suspect_rows = [[plain(cell) for cell in row] for row in near.blocks[0].rows]
        assert suspect_rows[0] == [
            "yaw Stribeck friction",
            "not told apart from yaw Coulomb friction: explains 30 nats less",
            5090, "3.8 ± 0.18 mN m", "4.1 mN m",
        ]  # fmt: skip
        assert suspect_rows[1][2:] == [-40, "", "2.1 ms"]
        assert [plain(c) for c in rest.blocks[0].rows[0]] == [
            "ground effect", "the beam never came near the table", "–"
        ]  # fmt: skip

    def test_without_any_there_is_no_section(self) -> None:
        report = findings(diagnosis(rejected=(), moved=(), **PLAIN))
        heads = {section.heading for section in report.sections}
        assert not heads & {"Why not the others", "Why not the rest", "Which of the parameters"}


def test_parameters_that_moved_are_told_with_their_probability() -> None:
    report = findings(diagnosis(verdict="parameters_only", **PLAIN))
    assert any("from 20.9 to 10.3 mrad (noise alone: 1.1)" in text for text in report.lead)
    assert rows(report, "that it moved") == [
        ["k_oh", "97 %", "viscous friction of yaw +59 % (0.0095 → 0.0151 N m s)"]
    ]


def test_an_effect_that_several_answers_hold_has_a_probability_of_its_own() -> None:
    pair = ("yaw_coulomb_friction", "main_input_delay")
    causes = (Cause(effects=pair, probability=0.7), *diagnosis().causes[1:])
    report = findings(diagnosis(causes=causes, inclusion={pair[0]: 0.78, pair[1]: 0.7}, **PLAIN))
    assert rows(report, "part of the answer") == [
        ["yaw Coulomb friction", "78 %"], ["main input delay", "70 %"]
    ]  # fmt: skip
    assert not any("part of the answer" in t.columns for t in findings(diagnosis(**PLAIN)).tables)


@pytest.mark.parametrize(
    ("verdict", "rejected", "words"),
    [
        ("effect", True, "1 of 3 tests find"),
        ("effect", False, "a weak gap"),
        ("no_gap", True, "The verdict names no effect all the same"),
        ("no_gap", False, "larger than usual."),
    ],
)
def test_what_the_tests_say_goes_with_the_verdict(verdict, rejected, words) -> None:
    tests = [replace(test, rejected=test.rejected and rejected) for test in diagnosis().tests]
    report = findings(diagnosis(verdict=verdict, tests=tuple(tests), **PLAIN))
    part = section(report, "Is there a gap at all?")
    assert words in part.text[0]
    assert ("weak gap" in part.text[0]) == (words == "a weak gap")
    assert "25 % stronger than usual, and correlations of 0.05," in part.blocks[0].caption


def test_the_gap_is_told_in_numbers_of_the_document() -> None:
    case = diagnosis(**PLAIN)
    row = case.gap["alpha_h"]["10.0"]
    whole = section(findings(case), "Before and after").blocks[-1]
    assert isinstance(whole, Table)
    cells = next([plain(c) for c in r] for r in whole.rows if r[:2] == ["yaw [mrad]", "10"])
    figures = (row.raw, row.refit, row.corrected, row.floor)
    assert cells[2:6] == pytest.approx([1e3 * value for value in figures])
    assert cells[6:] == ["91 %", "87 to 94 %"]


@pytest.mark.parametrize(
    "changes",
    [
        {"verdict": "no_gap", "causes": (Cause(effects=("no_gap",), probability=0.97),), "race": (),
         "confusable": (), "traces": None, "region": (), "next_experiment": None, "worth": None},
        {"verdict": "parameters_only", **PLAIN, "where": (), "gap": {}, "shrink": {}},
        {"verdict": "none_of_these", **PLAIN, "description": ("acts on yaw", "below 1 Hz"),
         "tests": ()},
        {"verdict": "undecided", "causes": (), "detectable": {}, "not_testable": ()},
    ],
    ids=lambda changes: changes["verdict"],
)  # fmt: skip
def test_every_verdict_has_a_page(changes: dict) -> None:
    case = diagnosis(**changes)
    report = findings(case)
    page_text = words_of(page_html(report, interactive=False))
    assert case.sentence in page_text
    for line in case.description:
        assert (line in page_text) == (case.verdict in ("none_of_these", "undecided"))
    assert bool(report.next) == (case.next_experiment is not None)


def test_what_could_not_be_told_is_a_dash() -> None:
    nothing = Gap(raw=np.nan, refit=np.inf, corrected=np.nan, floor=0.001, unit="rad")
    case = diagnosis(
        gap={"alpha_v": {"0.1": nothing, "2.0": nothing}},
        shrink={"alpha_v": {"2.0": Shrink(fraction=None, ci95=None)}},
        **PLAIN,
    )
    assert "pitch [mrad] 2 – ∞ – 1 –" in words_of(page_html(findings(case), interactive=False))


def test_nothing_corrected_is_not_called_closed() -> None:
    row = diagnosis().gap["alpha_h"]["2.0"]
    same = {"alpha_h": {"2.0": replace(row, corrected=row.refit)}}
    case = diagnosis(gap=same, verdict="none_of_these", **PLAIN)
    report = findings(case)
    assert "No cause was added" in section(report, "Before and after").text[0]
    assert not any("closed" in table.columns for table in report.tables)
    chart = gap_chart(case)
    labels = [mark.label for mark in chart.panels[0].marks if getattr(mark, "label", "")]
    assert labels == ["as it was", "refitted", "floor"]


def test_a_channel_that_got_worse_is_not_hidden() -> None:
    row = diagnosis().gap["omega_v"]["2.0"]
    worse = {"omega_v": {"2.0": replace(row, corrected=1.2 * row.refit)}}
    report = findings(diagnosis(gap=worse, worse=("omega_v",), **PLAIN))
    assert "made main rotor worse" in report.warnings[0]
    cells = [cell for table in report.tables for row in table.rows for cell in row]
    assert any(isinstance(c, Datum) and c.judgement == "bad" and c.value > 2 for c in cells
               if isinstance(getattr(c, "value", None), float))  # fmt: skip


class TestNothingContradicts:
    def test_a_share_is_never_more_than_all(self) -> None:
        beyond = LocationShare(location="yaw_moment", share=4.56, ci95=(1.82, 4.56))
        shrink = {"all": {"2.0": Shrink(fraction=1.3, ci95=(-9.0, 1.4))}}
        report = findings(diagnosis(where=(beyond,), region=(), shrink=shrink, **PLAIN))
        page_text = words_of(page_html(report, interactive=False))
        assert not re.search(r"[1-9]\d\d %|[−-]\d+ %", page_text.replace("100 %", ""))
        assert rows(report, "share of the gap")[0][1] == "100 %"

    def test_what_has_no_probability_is_not_confusable(self) -> None:
        case = diagnosis(confusable=((FRICTION, "yaw_stribeck_friction", "yaw_tangling_cable"),))
        (first, *_) = rows(findings(case), "confusable with")
        assert first[-1] == "yaw Stribeck friction"

    def test_a_cause_is_not_called_untestable(self) -> None:
        untested = (NotTestable(effect=FRICTION, reason="x"), NotTestable(effect="y", reason="z"))
        report = findings(diagnosis(not_testable=untested, **PLAIN))
        assert [row[0] for row in rows(report, "not testable")] == ["y"]

    def test_what_raced_is_said_to_be_hardly_testable_or_not_told_from_no_effect(self) -> None:
        names = {"yaw_sensor_bias": (2.0, 1.5), "tail_thrust_curve": (60.0, 9.0)}
        untested = tuple(NotTestable(effect=name, reason="r") for name in (*names, "y"))
        more = [
            RaceEntry(effects=(name,), score=score, se=se, explained=0, moved=0)
            for name, (score, se) in names.items()
        ]
        case = diagnosis(not_testable=untested, race=(*diagnosis().race, *more))
        report = findings(case)
        assert [row[0] for row in rows(report, "not testable")] == ["y"]
        assert [row[:2] for row in rows(report, "raced, but hardly testable")] == [
            ["yaw sensor bias", "2 ± 2 nats better: not told apart"],
            ["tail thrust curve", "60 ± 9 nats better"],
        ]
        (bars,) = race_chart(case).panels[0].marks
        notes = dict(zip(bars.names, bars.notes, strict=True))
        assert notes["yaw sensor bias"] == "not significantly different from no effect"
        assert notes["tail thrust curve"] == ""

    def test_the_rows_of_all_answers_sum_to_one(self) -> None:
        odd = (*diagnosis().causes[:2], Cause(effects=("ground_effect",), probability=0.004),
               Cause(effects=("main_inflow",), probability=0.008),
               Cause(effects=("none_of_these",), probability=0.028))  # fmt: skip
        answer_rows = rows(findings(diagnosis(causes=odd, **PLAIN)), "probability")
        assert [row[:2] for row in answer_rows][-2:] == [
            ["none of these", "3 %"],
            ["others, together", "1 %"],
        ]
        assert sum(int(row[1].removesuffix(" %")) for row in answer_rows) == 100
        answer_rows = rows(findings(diagnosis(**PLAIN)), "probability")
        assert [row[0] for row in answer_rows][-1] == "parameters only"

    def test_a_score_below_the_refitted_model_is_worse(self) -> None:
        lost = RaceEntry(effects=(FRICTION,), score=-3.2, se=1.1, explained=0, moved=0)
        (words,) = section(findings(diagnosis(race=(lost,))), "The race of the candidates").text
        assert words == (
            "Yaw Coulomb friction foretells held-out blocks 3 ± 1 nats worse than the refitted "
            "model."
        )


def rig_diagram(where, channels=()) -> RigDiagram:
    return RigDiagram("places", {p.location: (p.share, *p.ci95) for p in where}, channels)


class TestDiagram:
    def test_every_place_has_its_share(self) -> None:
        places = [p for row in diagram_rows(parts_of(Newtonian())) for p in row.places.values()]
        where = [
            LocationShare(location=name, share=0.07 * i, ci95=(0.05 * i, 0.08 * i))
            for i, name in enumerate(places)
        ]
        texts = drawn(diagram(rig_diagram(where)))
        for i, name in enumerate(places):
            assert name.replace("_", " ") in texts and f"{7 * i:.0f} %" in texts
        # A place with nothing has no figure.
        whole = LocationShare(location="yaw_moment", share=1.0, ci95=(1.0, 1.0))
        texts = drawn(diagram(rig_diagram([whole])))
        assert sum("%" in text for text in texts) == 2 and "main tacho" in texts

    def test_a_sensor_that_was_not_recorded_is_dashed(self) -> None:
        panel = diagram(rig_diagram([], ["u_v", "u_h", "alpha_v", "alpha_h", "omega_v"])).axes[0]
        dashed = [patch for patch in panel.patches if patch.get_linestyle() != "-"]
        assert len(panel.patches) == 12 and len(dashed) == 1
        # A rig of one axis has one row.
        texts = drawn(diagram(rig_diagram([], ["u_h", "alpha_h", "omega_h"])))
        assert "yaw moment" in texts and "pitch moment" not in texts and "main tacho" not in texts

    def test_the_larger_the_share_the_darker(self) -> None:
        where = [
            LocationShare(location="yaw_moment", share=0.8, ci95=(0.7, 0.9)),
            LocationShare(location="tail_thrust", share=0.2, ci95=(0.1, 0.3)),
            LocationShare(location="tail_motor", share=0.0, ci95=(0.0, 0.1)),
        ]
        panel = diagram(rig_diagram(where)).axes[0]
        light = sorted(sum(patch.get_facecolor()[:3]) for patch in panel.patches)
        assert light[0] < light[1] < light[2] == 3.0


class TestRace:
    def bars(self, case: DiagnosisResult) -> Bars:
        (bars,) = race_chart(case).panels[0].marks
        assert isinstance(bars, Bars)
        return bars

    def test_bars_are_the_scores_from_the_best(self) -> None:
        case = diagnosis()
        bars = self.bars(case)
        assert list(bars.names[:2]) == ["yaw Coulomb friction", "yaw Stribeck friction"]
        assert list(bars.values) == sorted((e.score for e in case.race), reverse=True)
        assert list(bars.colours[:2]) == ["blue", "sky"]
        assert [n for n in bars.notes if n] == ["not significantly different from the best"]
        # One that fails does not flatten the others.
        failed = RaceEntry(effects=("x",), score=-1e6, se=1, explained=0, moved=0)
        low, high = race_chart(diagnosis(race=(*case.race, failed))).panels[0].x.limits
        assert low > -0.3 * high

    def test_the_likeliest_cause_is_the_winner(self) -> None:
        case = diagnosis()
        best = ("yaw_stribeck_friction",)
        nameless = diagnosis(causes=(Cause(effects=("none_of_these",), probability=0.9),))
        (words,) = section(findings(nameless), "The race of the candidates").text
        assert words.startswith("Yaw Coulomb friction foretells")
        swapped = diagnosis(causes=(Cause(effects=best, probability=0.9), *case.causes[:1]))
        assert list(self.bars(swapped).colours[:2]) == ["sky", "blue"]
        (words,) = section(findings(swapped), "The race of the candidates").text
        assert "Above it is yaw Coulomb friction by 30 nats" in words

    def test_words_warn_of_something_that_has_no_name(self) -> None:
        entries = [replace(e, score=9000.0) if e.effects == ("flexible",) else e
                   for e in diagnosis().race]  # fmt: skip
        for race, words in ((entries, "something else is missing"), ((), "does no better")):
            case = diagnosis(race=tuple(race)) if race else diagnosis()
            assert words in section(findings(case), "The race of the candidates").text[0]


def test_a_rival_that_is_not_confusable_takes_the_certainty() -> None:
    pair = (("main_input_delay", "main_actuator_lag"),)
    words = findings(diagnosis(confusable=pair)).lead[1]
    assert words.startswith("**Likely**") and "next is yaw Stribeck friction (8 %)" in words


def test_a_place_that_is_not_certain() -> None:
    near = (
        LocationShare(location="yaw_moment", share=0.5, ci95=(0.3, 0.7)),
        LocationShare(location="tail_thrust", share=0.4, ci95=(0.2, 0.6)),
    )
    (text,) = section(findings(diagnosis(where=near)), "Where the gap lies").text
    assert "interval of tail thrust reaches as far" in text


def test_the_enlarged_part_is_where_the_cause_acts() -> None:
    case = traces()
    late = np.where(case.force_time > 80, 1.0, 0.0)
    chart = force_chart(replace(case, explained={"yaw_moment": late}), ["yaw_moment"])
    assert chart.panels[1].x.limits[0] > 79


def test_nothing_smoothed_is_no_chart() -> None:
    assert force_chart(replace(traces(), force={}), ["yaw_moment"]) is None
    assert run_chart(replace(traces(), runs={})) is None
    assert gap_chart(diagnosis(gap={})) is None


def test_the_document_is_the_one_of_the_contract() -> None:
    document, written = document_of(diagnosis()), read_yaml(DOCUMENT)
    assert next(iter(document)) == "schema" and document["schema"] == "trms.diagnosis/1"
    assert {key: document[key] for key in written} == written
    assert "traces" not in document  # pictures stay out


def test_horizons_are_seconds_with_a_decimal_in_order() -> None:
    row = Gap(raw=1.0, refit=1.0, corrected=1.0, floor=1.0, unit="rad")
    document = document_of(diagnosis(gap={"alpha_h": {"10": row, "2": row, "0.10": row}}))
    assert list(document["gap"]["alpha_h"]) == ["0.1", "2.0", "10.0"]
    assert list(document["shrink"]["all"]) == ["0.5", "2.0", "10.0"]
    assert document["shrink"]["all"]["2.0"] == {"fraction": 0.91, "ci95": [0.86, 0.94]}
    # What is not finite is null, and NumPy's values are plain.
    case = diagnosis()
    row = replace(case.gap["alpha_h"]["2.0"], raw=math.nan, refit=np.float64(math.inf))
    place = LocationShare(location="yaw_moment", share=np.float32(0.5), ci95=(np.float64(0.1), 1.0))
    document = document_of(replace(case, gap={"alpha_h": {"2.0": row}}, where=(place,)))
    assert document["gap"]["alpha_h"]["2.0"]["raw"] is None
    assert document["gap"]["alpha_h"]["2.0"]["refit"] is None
    assert document["where"][0] == {"location": "yaw_moment", "share": 0.5, "ci95": [0.1, 1.0]}
    assert json.loads(json.dumps(document, allow_nan=False)) == document


def sentence_of(verdict: str, gap: Gap, shrink: Shrink | None = None) -> str:
    """The sentence on yaw's gap at 2 s; with a cause where the verdict names one."""
    effect = verdict == "effect"
    cause = Cause(
        effects=(FRICTION,) if effect else (verdict,),
        probability=0.94,
        parameters=diagnosis().causes[0].parameters if effect else {},
    )
    return sentence(
        SimpleNamespace(verdict=verdict, confusable=()),  # type: ignore[arg-type]
        [cause],
        [],
        Shrinkage({"alpha_h": {"2.0": gap}}, {"all": {"2.0": shrink}} if shrink else {}, ()),
        diagnosis().moved,
    )


@pytest.mark.parametrize(
    ("verdict", "refit", "words", "absent"),
    [
        ("parameters_only", 0.002, "No effect is missing", "times what the noise explains"),
        ("parameters_only", 0.06, "40 times what the noise explains", None),
        ("no_gap", 0.0016, "explain these recordings.", "Over 2 s"),
        ("no_gap", 0.003, "2.0 times what the sensors' noise alone makes (yaw, 3 against", None),
        ("no_gap", 0.03, "30 against 1.5 mrad): do not rely on this, and record longer.", None),
    ],
)
def test_without_a_cause_it_is_told_how_far_free_runs_lie_above_the_floor(
    verdict, refit, words, absent
):
    beginning = {"parameters_only": "No effect is missing", "no_gap": "No gap was found, with"}
    gap = Gap(raw=refit, refit=refit, corrected=refit, floor=0.0015, unit="rad")
    text = sentence_of(verdict, gap)
    assert text.startswith(beginning[verdict])
    assert (diagnosis().moved[0].words in text) == (verdict == "parameters_only")
    assert words in text and (absent is None or absent not in text)
    assert verdict != "no_gap" or ("Over 2 s" in text) == (absent is None)


def test_sizes_that_fit_as_well_are_told_with_a_cause_that_is_not_decided():
    size = SizeEstimate(value=10.4, sd=0.1, unit="rad/s", others=(4.8, 6.34))
    cause = Cause(
        effects=("yaw_flexible_mode",),
        probability=0.9,
        parameters={"yaw_flexible_mode.frequency": size},
    )
    posterior = SimpleNamespace(verdict="undecided", confusable=())
    text = sentence(posterior, [cause], [], Shrinkage({}, {}, ()))  # type: ignore[arg-type]
    assert text.startswith(
        "These recordings do not decide what causes the gap, or how large it is: "
    )
    assert "several sizes fit equally well: frequency 10.4 ± 0.1 or 4.8 or 6.3 rad/s." in text
    settled = replace(cause, parameters={"yaw_flexible_mode.frequency": replace(size, others=())})
    text = sentence(posterior, [settled], [], Shrinkage({}, {}, ()))  # type: ignore[arg-type]
    assert "equally well" not in text and "what causes the gap: " in text


@pytest.mark.parametrize(
    ("fraction", "words"),
    [
        (0.9998, "closes over 99 % of the gap at 2 s (99 to 100 % on another recording)."),
        (-0.2, "closes nothing of the gap at 2 s."),
    ],
)
def test_the_sentence_tells_the_share_that_is_closed(fraction, words):
    gap = Gap(raw=0.1, refit=0.1, corrected=0.002, floor=0.0015, unit="rad")
    text = sentence_of("effect", gap, Shrink(fraction=fraction, ci95=(0.991, 1.2)))
    assert text.endswith(words)


def test_what_has_ended_is_told_so_and_bounds_only_where_there_are_any():
    case = diagnosis(**PLAIN)
    ended = Onset(time_s=31.24, ci95=(30.9, 31.8), ends=True)
    report = findings(
        replace(case, causes=(replace(case.causes[0], onset=ended), *case.causes[1:]))
    )
    assert report.title.endswith("what ended")
    assert any("It ends 31.2 s into the recording" in sentence for sentence in report.lead)
    assert "until" in [measure.label for measure in report.measures]
    rejected = tuple(replace(item, upper_bound=None) for item in case.rejected)
    why = section(findings(replace(case, rejected=rejected)), "Why not the others")
    assert all("at most" not in str(block) for block in why.blocks if not isinstance(block, str))


def test_what_a_named_cause_leaves_is_told_where_it_is_much():
    shrink = Shrink(fraction=0.6, ci95=(0.5, 0.7))
    much = Gap(raw=0.1, refit=0.1, corrected=0.02, floor=0.002, unit="rad")
    words = "It is not all: over 2 s yaw is still off by 20 mrad, 10 times what"
    assert words in sentence_of("effect", much, shrink)
    assert "not all" not in sentence_of("effect", replace(much, corrected=5e-3), shrink)
