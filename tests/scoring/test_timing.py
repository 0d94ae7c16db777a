"""How punctual a real rig's samples were, from the log's own times."""

import numpy as np
import pytest

from trms_cli.scoring.findings import timing_in_words
from trms_cli.scoring.metrics import Series
from trms_cli.scoring.score import score_tables, timing_figures


def timing(lateness: list[float], command: list[float], due: list[float] | None = None) -> Series:
    times = np.array(due) if due is not None else np.arange(len(lateness)) * 0.02
    zero = np.zeros(len(lateness))
    columns = {"due_s": times, "lateness_s": np.array(lateness), "command_s": np.array(command)}
    names = ("reading_s", "observer_s", "controller_s", "log_s")
    return Series(times, columns | dict.fromkeys(names, zero), {})


def test_a_run_that_waits_for_no_clock_has_no_figures() -> None:
    assert timing_figures(None, None) is None
    assert "timing" not in score_tables({}, limits={}, duration_s=0.0)


def test_lateness_and_the_time_to_the_command() -> None:
    figures = timing_figures(timing([0.0, 0.0005, 0.003, 0.0], [1e-3, 2e-3, 3e-3, 4e-3]), None)
    assert figures is not None
    assert figures["samples"] == 4 and figures["skipped"] == 0
    assert figures["late_share"] == 0.25
    assert figures["lateness_ms"]["max"] == pytest.approx(3.0)
    assert figures["command_ms"]["median"] == pytest.approx(2.5)
    assert sum(figures["histogram"]["counts"]) == 4
    words = timing_in_words({"timing": figures})
    assert "25.0 % of the samples over 1 ms late, worst 3 ms" in words


def test_only_samples_at_which_the_controller_was_asked_have_a_time_to_the_command() -> None:
    rows = timing([0.0] * 4, [1e-3, 2e-3, 3e-3, 4e-3])
    asked = Series(np.array([0.0, 0.04]), {}, {})
    figures = timing_figures(rows, asked)
    assert figures is not None
    assert figures["command_ms"]["max"] == pytest.approx(3.0)
    assert figures["command_ms"]["median"] == pytest.approx(2.0)


def test_samples_that_were_left_out_are_counted() -> None:
    due = [0.0, 0.02, 0.08, 0.10, 0.12]
    figures = timing_figures(timing([0.0] * 5, [0.0] * 5, due), None)
    assert figures is not None and figures["skipped"] == 2
    assert "2 samples left out" in timing_in_words({"timing": figures})
