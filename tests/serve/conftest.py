"""A server of pages over a few runs, and what asks it: a client without manners, and a browser."""

import http.client
import json
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.runs.conftest import _TOPICS, CONFIG, score
from trms_cli import run
from trms_cli.library.server import application as application_module
from trms_cli.library.server.application import application_of, listening_socket, running
from trms_cli.library.server.catalogue import Catalogue
from trms_cli.recordings.run_log import RunLog

#: Runs of the sweep: more than a page of the list has.
SWEPT = 101
HOSTILE = "<img src=x onerror='window.harmed = 1'>"


def hollow_run(folder: Path, *, ending: str | None = "completed", **choices: Any) -> RunLog:
    """The log of a run of three samples, with a score that nobody worked out."""
    number = int(folder.name) if folder.name.isdigit() else 0
    words = {
        "seed": "0",
        "start": f"2026-01-01T00:{number // 60:02}:{number % 60:02}+00:00",
        "choices": json.dumps({"ref": "square", "effect": [], "fault": []} | choices),
        "overrides": json.dumps([f"plant.prior_seed={number}"]),
        "versions": json.dumps({"trms": "0.1.0"}),
    }
    attachments = {"config.yaml": ("application/yaml", CONFIG)}
    log = RunLog(folder / "run.mcap", _TOPICS, words, attachments)
    for k in range(3):
        write_sample(log, k)
    log.flush()
    if ending is not None:
        rmse = 0.1 + 0.001 * ((37 * number) % 101)
        log.close(ending, score(rmse_alpha_v=rmse))
    return log


def write_sample(log: RunLog, number: int) -> None:
    """A sample of all signals, at 50 Hz."""
    for topic in ("/reference", "/command", "/measurement"):
        log.write(topic, number * 20_000_000, [0.1, 0.2])


@pytest.fixture(scope="session")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs, a sweep of runs, and one that failed under a hostile name."""
    folder = tmp_path_factory.mktemp("lab")
    for controller in ("pid", "lqr"):
        run(controller=controller, sim={"duration": 3}, picture=False, out=folder / controller)
    for number in range(SWEPT):
        hollow_run(folder / "sweep" / str(number), controller="pid" if number % 2 else "lqr")
    hollow_run(folder / "strange" / "<b>&'", ending="failed", controller=HOSTILE)
    return folder


@dataclass
class Answer:
    """What a server said."""

    status: int
    headers: dict[str, str]
    text: str


@dataclass
class Served:
    """A server that runs, and its token's address."""

    address: str
    folder: Path
    cookies: list[str] = field(default_factory=list)

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(re.findall(r":(\d+)/", self.address)[0])

    def ask(self, path: str, method: str = "GET", *, cookie: bool = True, **headers: str) -> Answer:
        """Send a request as it is, without what a browser would mend."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        connection.putrequest(method, path, skip_host="Host" in headers, skip_accept_encoding=True)
        if cookie:
            headers["Cookie"] = self.cookie()
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        told = {name.lower(): value for name, value in answer.getheaders()}
        text = answer.read().decode()
        connection.close()
        return Answer(answer.status, told, text)

    def cookie(self) -> str:
        """What a browser holds that was let in."""
        if not self.cookies:
            entrance = self.ask(self.address.partition(str(self.port))[2], cookie=False)
            self.cookies.append(entrance.headers["set-cookie"].partition(";")[0])
        return self.cookies[0]

    def key(self, name: str) -> str:
        """The key of a run by its name in the list."""
        return re.findall(rf'href="/run/(\w+)">{re.escape(name)}<', self.ask("/?sort=path").text)[0]


@pytest.fixture(scope="session")
def serving(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Served]]:
    """Start servers, each of a folder, with an index of their own."""
    with ExitStack() as stack, pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRMS_RUNS", str(tmp_path_factory.mktemp("index")))
        patch.setattr(application_module, "_LIST_EVERY", 0.5)  # s: a person has more patience

        def start(folder: Path) -> Served:
            catalogue = Catalogue([folder])
            stack.callback(catalogue.close)
            own = stack.enter_context(listening_socket(0))
            application = application_of(catalogue, own.getsockname()[1])
            stack.enter_context(running(application, own))
            return Served(application.address, folder)

        yield start


@pytest.fixture(scope="session")
def served(serving: Callable[..., Served], lab: Path) -> Served:
    """The server of the lab."""
    return serving(lab)
