"""Pages in the browser, and runs to draw."""

import base64
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trms_cli.reporting.signals import RunReport
from trms_cli.scoring.metrics import Series


@dataclass
class Opened:
    """A page in the browser, and what it complained of."""

    tab: Any
    messages: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    @property
    def fetched(self) -> list[str]:
        """What it asked for that is not in it."""
        return [url for url in self.requests if not url.startswith(("file:", "data:", "blob:"))]

    def __call__(self, script: str, *given: Any) -> Any:
        """What a script says."""
        return self.tab.evaluate(script, *given)


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[Callable[..., Opened]]:
    """Open a page of text from the disk, and wait until its plots stand."""
    contexts = []

    def open_(
        html: str, *, width: int = 1200, drawn: bool = True, before: str = "", **how: Any
    ) -> Opened:
        file = tmp_path / f"page-{len(contexts)}.html"
        file.write_text(html, encoding="utf-8")
        context = browser.new_context(viewport={"width": width, "height": 800}, **how)
        contexts.append(context)
        page = Opened(context.new_page())
        page.tab.on("console", lambda message: page.messages.append(message.text))
        page.tab.on("pageerror", lambda error: page.messages.append(str(error)))
        page.tab.on("dialog", lambda dialog: (page.messages.append("dialog"), dialog.dismiss()))
        page.tab.on("request", lambda request: page.requests.append(request.url))
        page.tab.add_init_script(before or ";")
        page.tab.goto(file.as_uri())
        if drawn:
            page.tab.wait_for_selector("html[data-plots=drawn]", state="attached")
        return page

    yield open_
    for context in contexts:
        context.close()


def unpacked(array: Mapping[str, str]) -> np.ndarray:
    """The numbers that a page carries packed."""
    return np.frombuffer(base64.b64decode(array["bdata"]), dtype="<" + array["dtype"])


def logged(
    columns: Mapping[str, Mapping[str, Any]],
    times: Mapping[str, Any],
    units: Mapping[str, Mapping[str, str]] | None = None,
) -> dict[str, Series]:
    """Columns by topic as a log has them."""
    return {topic: Series(times[topic], of, (units or {}).get(topic, {}))
            for topic, of in columns.items()}  # fmt: skip


def with_columns(run: RunReport, topic: str, columns: Mapping[str, Any]) -> RunReport:
    """A run with other signals of a topic."""
    table = run.tables[topic]
    other = Series(table.time, columns, table.units)
    return replace(run, tables={**run.tables, topic: other})


def events(*rows: tuple[float, str, str, str, float]) -> dict[str, Any]:
    """Columns of events: time, kind, source, message and value of each."""
    names = ("time", "kind", "source", "message", "value")
    columns = dict(zip(names, np.array(rows, dtype=object).T, strict=True))
    return columns | {name: columns[name].astype(float) for name in ("time", "value")}


def example_run(name: str = "first", *, shift: float = 0.0, seconds: float = 20.0) -> RunReport:
    """A run of both axes with everything that a log can hold."""
    time = np.arange(0.0, seconds, 0.05)
    control, made = time[::2], time[::20]
    square = np.where(time % 10 < 5, 0.3, -0.3)
    lagging = np.interp(time - 0.5 - shift, time, square)
    noise = 0.001 * np.sin(37.0 * time)
    ahead = np.arange(0.0, 2.0, 0.1)
    fans = np.empty(len(made), dtype=object)
    horizon = np.empty(len(made), dtype=object)
    for i, at in enumerate(made):
        fans[i], horizon[i] = np.interp(at + ahead, time, lagging), ahead
    angles = ("alpha_v", "alpha_h")
    estimate: dict[str, Any] = {}
    for angle in angles:
        estimate |= {
            angle: lagging + noise,
            f"sd_{angle}": np.full(len(time), 0.002),
            f"innovation_{angle}": noise,
            f"innovation_sd_{angle}": np.full(len(time), 0.002),
        }
    estimate |= {"yaw_moment": 1e-3 * square, "sd_yaw_moment": np.full(len(time), 1e-3)}
    solve = 1e-3 * (1.0 + 0.2 * np.sin(control))
    solve[50] = 0.2
    text = np.full(len(control), "converged", dtype=object)
    missed = (solve > 0.1).astype(float)
    channel = {"rmse": 0.1 + shift, "iae": 1.0, "unit": "rad", "scored_on": "state", "steps": 4}
    columns: dict[str, dict[str, Any]] = {
        "/reference": dict.fromkeys(angles, square),
        "/measurement": dict.fromkeys(angles, lagging + noise),
        "/plant/state": {**dict.fromkeys(angles, lagging), "omega_v": 100 + 50 * square},
        "/command": {"u_v": 2 * square, "u_h": square},
        "/estimate": estimate,
        "/controller": {
            "solve_time_s": solve,
            "iterations": np.full(len(control), 3.0),
            "status": text,
            "deadline_missed": missed,
            "fallback": missed,
        },
        "/prediction": {"time": horizon, "alpha_v": fans, "alpha_h": fans, "u_v": fans},
    }
    times = dict.fromkeys(columns, time) | {"/controller": control, "/prediction": made}
    units = {
        topic: {n: "rad" if n.startswith("alpha") else "V" for n in c}
        for topic, c in columns.items()
    }
    units["/estimate"]["yaw_moment"] = "N*m"
    columns["/event"] = events(
        (5.0, "fault_injected", "plant", "yaw is frozen", np.nan),
        (6.0, "saturation_begin", "u_v", "reached its limit", 2.5),
        (6.5, "saturation_end", "u_v", "left its limit", 2.0),
    )
    times["/event"] = columns["/event"].pop("time")
    return RunReport(
        name=name,
        tables=logged(columns, times, units),
        score={
            "channels": dict.fromkeys(angles, channel),
            "inputs": {"u_v": {"effort": 3.0, "unit": "V"}},
            "estimate": {"rmse": {"alpha_v": 0.001}, "units": {"alpha_v": "rad"}},
            "solver": {
                "time_ms": {"median": 1.0, "p99": 2.0, "max": 200.0},
                "deadline_misses": 1,
                "failures": 1,
            },
            "degraded": {"share": {"degraded": 0.1}},
        },
        limits={"u_v": (-2.5, 2.5), "alpha_v": (-0.5, 0.5)},
        duration=seconds,
        choices={"controller": "newton_mpc", "ref": "square", "model": "newtonian"},
        facts={"seed": "0"},
        command="trms run controller=newton_mpc",
        repeat="trms run --from first/run.mcap",
        config="sim:\n  duration: 20\n",
    )


@pytest.fixture
def run() -> RunReport:
    """A run with everything that a log can hold."""
    return example_run()
