"""The pages that ``trms serve`` has, by their addresses, and the server that sends them.

====================== ================================================================
``/``                  all runs: filter, choices, sorting, pages; some chosen to compare
``/run/KEY``           a run: as it goes on, or its report
``/compare?run=KEY…``  runs over one another; more than eight: their ranking and spread
``/folder/KEY``        the report of all runs of a folder, as of a sweep
``/assets/NAME``       the scripts of the pages
====================== ================================================================

What is shown is made of logs and of the index, by the same findings as ``trms report`` has; nothing
is written but the index, and no address names a file.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import socket
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.routing import Route

from trms_cli.core.errors import ConfigurationError, RecordingError, TrmsError
from trms_cli.core.findings import Details, Findings, Section
from trms_cli.library.report.pages import report_of
from trms_cli.library.server.access import LOOPBACK, Guard
from trms_cli.library.server.catalogue import Catalogue, key_of
from trms_cli.library.server.list_page import ListRequest, list_page
from trms_cli.library.server.live_page import live_page
from trms_cli.reporting.page import Hosting, page_html, page_script, plotly_source
from trms_cli.runs.run_folder import name_of

_HOME = ("◀ all runs", "/")
_LIVE_EVERY, _LIST_EVERY = 1.0, 3.0  # s between two looks of a page at what goes on
_MOST_PAGES = 16  # kept, of those that take a moment to make
_MOST_COMPARED = 200
_FOR_EVER = "private, max-age=31536000, immutable"
_PATIENCE = 2.0  # s for answers that are being sent when the server ends


class Pages:
    """Answers to requests.

    One page is made at a time: they share the drawing of figures, and their reader is one person.
    """

    def __init__(self, catalogue: Catalogue) -> None:
        self.catalogue = catalogue
        self._making = threading.Lock()
        self._kept: OrderedDict[Any, str] = OrderedDict()
        scripts = {"page": page_script().encode(), "plotly": plotly_source()}
        names = {
            what: f"{what}-{hashlib.sha256(text).hexdigest()[:16]}.js"
            for what, text in scripts.items()
        }
        self._assets = {names[what]: text for what, text in scripts.items()}
        self._page_script, self._plotly = (f"/assets/{names[what]}" for what in scripts)

    def _html(
        self, findings: Findings, *, refresh: float = 0.0, home: bool = True, **more: Any
    ) -> str:
        links = [_HOME] if home else []
        hosting = Hosting(self._page_script, self._plotly, links, refresh)
        return page_html(findings, hosting=hosting, **more)

    def _remembered(self, key: Any, make: Callable[[], str]) -> str:
        """A page that takes a moment to make, made again where what it is of has changed."""
        with self._making:
            if key not in self._kept:
                self._kept[key] = make()
                while len(self._kept) > _MOST_PAGES:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(key)
            return self._kept[key]

    def all_runs(self, request: Request) -> Response:
        """All runs."""
        findings, runs = list_page(self.catalogue, ListRequest.of_query(request.query_params))
        page = self._html(findings, refresh=_LIST_EVERY, home=False, run_list=runs)
        return HTMLResponse(page, 400 if runs.problem else 200)

    def run(self, request: Request) -> Response:
        """A run; as it goes on where it is being written."""
        log = self.catalogue.log(request.path_params["key"])
        if log.suffix == ".mcap":
            follower = self.catalogue.follower(log)
            if not follower.has_ended and self.catalogue.is_live(str(log)):
                with self._making:
                    findings = live_page(follower, name_of(log))
                return HTMLResponse(self._html(findings, refresh=_LIVE_EVERY))
        return HTMLResponse(self._remembered(_stamps([log]), lambda: self._report([log])))

    def compare(self, request: Request) -> Response:
        """Some runs, side by side."""
        keys = list(dict.fromkeys(request.query_params.getlist("run")))
        if len(keys) == 1:
            return RedirectResponse(f"/run/{key_of(str(self.catalogue.log(keys[0])))}", 303)
        if not keys:
            return RedirectResponse("/", 303)
        if len(keys) > _MOST_COMPARED:
            raise ConfigurationError(
                f"{len(keys)} runs chosen",
                where="the comparison",
                remedy=f"choose up to {_MOST_COMPARED}; `trms compare` takes any number",
            )
        logs = [self.catalogue.log(key) for key in keys]
        return HTMLResponse(self._remembered(_stamps(logs), lambda: self._report(logs)))

    def folder(self, request: Request) -> Response:
        """The runs of a folder."""
        folder = self.catalogue.run_folder(request.path_params["key"])
        logs = [
            log
            for log in self.catalogue.inventory.logs
            if os.path.dirname(os.path.dirname(log)) == str(folder)
        ]
        key = (str(folder), _stamps([Path(log) for log in logs]))
        return HTMLResponse(self._remembered(key, lambda: self._report([folder])))

    def _report(self, paths: list[Path]) -> str:
        return self._html(report_of(paths, quiet=True, address=_address).findings)

    def asset(self, request: Request) -> Response:
        """A script."""
        content = self._assets.get(request.path_params["name"])
        if content is None:
            raise HTTPException(404)
        return Response(content, media_type="text/javascript", headers={"cache-control": _FOR_EVER})

    def problem(self, request: Request, error: Exception) -> Response:
        """What a user can mend, or an address of nothing."""
        if isinstance(error, TrmsError):
            code = 404 if isinstance(error, RecordingError) else 400
            lead = [f"**{error.problem}**", error.remedy]
            where = [Details("where", error.where)] if error.where else []
            sections = [Section("", blocks=where)] if where else []
            return HTMLResponse(self._html(Findings("Not shown", lead, sections)), code)
        code = error.status_code if isinstance(error, HTTPException) else 500
        words = {
            404: "There is no such page.",
            500: "This is a bug in trms: its terminal has more.",
        }
        findings = Findings("Not shown", [words.get(code, "This cannot be shown.")])
        return HTMLResponse(self._html(findings), code)


def _stamps(logs: list[Path]) -> tuple[tuple[str, int, int], ...]:
    """What a page is of: another time or size of a log makes it another page."""
    stamps = []
    for log in logs:
        with contextlib.suppress(OSError):
            about = os.stat(log)
            stamps.append((str(log), about.st_mtime_ns, about.st_size))
    return tuple(stamps)


def _address(log: str) -> str:
    """Where the page of a run is, by its log."""
    return f"/run/{key_of(log)}"


def application_of(catalogue: Catalogue, port: int) -> Guard:
    """The application, behind its guard, which makes a token of its own."""
    pages = Pages(catalogue)
    routes = [
        Route("/", pages.all_runs),
        Route("/run/{key}", pages.run),
        Route("/compare", pages.compare),
        Route("/folder/{key}", pages.folder),
        Route("/assets/{name}", pages.asset),
    ]
    handlers: Any = dict.fromkeys((TrmsError, HTTPException, Exception), pages.problem)
    return Guard(Starlette(routes=routes, exception_handlers=handlers), port)


@contextlib.contextmanager
def listening_socket(port: int) -> Iterator[socket.socket]:
    """A socket of the loopback address alone; 0: any port that is free.

    Raises ConfigurationError if the port cannot be had.
    """
    own = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        if os.name == "posix":  # elsewhere it would let two servers have one port
            own.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            own.bind((LOOPBACK, port))
            own.listen(64)
        except OSError as error:
            raise ConfigurationError(
                f"port {port} cannot be had: {error.strerror or error}",
                where="port",
                remedy="another by port=8761; port=0 takes one that is free",
            ) from error
        yield own
    finally:
        own.close()


@contextlib.contextmanager
def running(application: Guard, own: socket.socket) -> Iterator[threading.Thread]:
    """Inside, a thread answers requests; what is being sent at the end is sent.

    It is a thread beside, so that Ctrl-C is the caller's, as in every other command.
    """
    config = uvicorn.Config(
        application,
        log_config=None,
        access_log=False,
        lifespan="off",
        server_header=False,
        timeout_graceful_shutdown=int(_PATIENCE),
        ws="none",
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [own]}, daemon=True)
    thread.start()
    try:
        yield thread
    finally:
        server.should_exit = True
        thread.join(2 * _PATIENCE)


def serve(application: Guard, own: socket.socket) -> None:
    """Answer requests until this is interrupted."""
    with running(application, own) as thread:
        while thread.is_alive():
            thread.join(0.5)
