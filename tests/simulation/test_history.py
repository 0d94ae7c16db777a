"""What a run leaves in memory and hands to its log: rows by topic, whole and in their order."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from trms_cli.simulation.history import History

UNITS = {
    "/reference": {"r": "rad"},
    "/estimate": {"x": "rad", "y": "rad", "z": "rad"},
    "/controller": {"status": "", "time": "s"},
    "/event": {"kind": "", "source": "", "message": "", "value": ""},
}


class Kept:
    """A sink that keeps what it is given."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, int, str, list[Any]]] = []
        self.events: list[tuple[int, str]] = []
        self.flushes = 0

    def write_rows(
        self, times_ns: Sequence[int], wall_ns: Sequence[int], rows: Mapping[str, Any]
    ) -> None:
        for topic, values in rows.items():
            for time_ns, wall, row in zip(times_ns, wall_ns, values, strict=True):
                self.rows.append((time_ns, wall, topic, list(row)))

    def event(
        self, time_ns: int, kind: str, source: str, message: str, value: float = np.nan
    ) -> None:
        self.events.append((time_ns, kind))

    def flush(self) -> None:
        self.flushes += 1


@pytest.mark.parametrize("every", [1, 3, 1000])  # more samples than there is room for at first
def test_signals_come_back_whatever_the_flushes(every: int) -> None:
    sink = Kept()
    history = History(UNITS, sink)
    note = history.signal_writer(
        {"/reference": 1, "/command": 1, "/estimate": 2}, {"/estimate": [2, 0, 1]}
    )
    control = history.writer("/controller")
    estimate = np.zeros(2)
    for k in range(400):
        estimate[:] = k, k + 0.25  # overwritten, as an observer's are
        note(10 * k, (np.array([0.5 * k]), np.array([7.0, 7.0]), estimate, np.array([-1.0 * k])))
        if k % 2 == 0:
            control(10 * k, ("ok", 0.001 * k))
        if k % every == 0:
            history.flush()
    history.flush()
    k = np.arange(400)
    np.testing.assert_allclose(history.times("/reference"), 1e-8 * k)
    np.testing.assert_array_equal(history.columns("/reference")["r"], 0.5 * k)
    columns = history.columns("/estimate")
    assert list(columns) == ["x", "y", "z"]
    np.testing.assert_array_equal(list(columns.values()), [-1.0 * k, k, k + 0.25])
    assert list(history.columns("/controller")["status"]) == ["ok"] * 200
    assert history.columns("/command") == {}  # is not kept, nor written
    written = {topic: [row for *_, name, row in sink.rows if name == topic] for topic in UNITS}
    assert {name for *_, name, _ in sink.rows} == {"/reference", "/estimate", "/controller"}
    assert written["/estimate"] == np.transpose([-1.0 * k, k, k + 0.25]).tolist()
    assert len(written["/controller"]) == 200
    walls = [wall for _, wall, topic, _ in sink.rows if topic == "/reference"]
    assert walls == sorted(walls) and walls[0] > 10**18


def test_what_is_kept_of_nothing_costs_nothing_and_breaks_nothing() -> None:
    history = History({}, None)
    history.signal_writer({"/reference": 1})(0, (np.zeros(1),))
    history.writer("/controller")(0, ("ok", 0.0))
    history.event(5, "note", "test", "something")
    history.flush()
    assert history.events == [(5, "note", "test", "something", pytest.approx(np.nan, nan_ok=True))]
    assert history.times("/reference").size == 0


def test_a_row_of_another_width_is_refused() -> None:
    note = History(UNITS, None).signal_writer({"/reference": 1, "/estimate": 1})
    with pytest.raises(ValueError, match=r"(?i)output array"):
        note(0, (np.zeros(1), np.zeros(2)))
