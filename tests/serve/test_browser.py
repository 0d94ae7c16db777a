"""The pages of a server in a real browser: chosen, compared, live, audited, quick."""

import re
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests import page_audit
from tests.program import wait_for
from tests.serve.conftest import SWEPT, Served, hollow_run, write_sample

_DRAWN = "html[data-plots=drawn]"


@pytest.fixture
def tab(browser: Any) -> Iterator[Callable[..., Any]]:
    """Open a tab at a server; what it complains of is in its ``messages``."""
    contexts = []

    def open_(at: Served, **how: Any) -> Any:
        context = browser.new_context(**({"viewport": {"width": 1200, "height": 900}} | how))
        contexts.append(context)
        page = context.new_page()
        page.messages = []
        page.on("console", lambda message: page.messages.append(message.text))
        page.on("pageerror", lambda error: page.messages.append(str(error)))
        page.on("request", lambda request: page.messages.append(request.url)
                if not request.url.startswith((f"http://127.0.0.1:{at.port}/", "data:", "blob:"))
                else None)  # fmt: skip
        page.goto(at.address)
        return page

    yield open_
    for context in contexts:
        context.close()


def test_from_the_list_to_a_run_to_a_comparison_by_keyboard_and_mouse(
    served: Served, tab: Any
) -> None:
    page = tab(served)
    assert page.url == f"http://127.0.0.1:{served.port}/"  # the token is out of sight
    assert page.evaluate("document.cookie") == ""
    page.keyboard.press("/")
    page.keyboard.type("sim.duration == 3 or duration == 3")
    page.keyboard.press("Enter")
    page.wait_for_url("**filter=*")
    links = page.locator("table.runs tbody a")
    assert sorted(links.all_inner_texts()) == ["lqr", "pid"]
    compare = page.get_by_role("button", name="compare those chosen")
    assert compare.is_disabled()
    for box in page.get_by_role("checkbox").all():
        box.focus()
        page.keyboard.press("Space")
    assert "2 chosen" in page.locator("form.runs").inner_text() and compare.is_enabled()
    compare.click()
    page.wait_for_selector(_DRAWN, state="attached")
    assert page.locator("h1").inner_text().startswith("Comparison of ")
    assert page.locator("div.plot .cartesianlayer path").count() > 0
    page.get_by_role("link", name="all runs").click()
    page.get_by_label("outcome").select_option("failed")  # shows at once
    page.wait_for_url("**outcome=failed*")
    assert page.locator("table.runs tbody tr").count() == 1
    assert page.evaluate("window.harmed") is None and page.messages == []


def test_keys_lead_through_a_run(served: Served, tab: Any) -> None:
    page = tab(served)
    page.goto(f"http://127.0.0.1:{served.port}/run/{served.key('pid')}")
    page.wait_for_selector(_DRAWN, state="attached")
    top = """() => [...document.querySelectorAll('main section[id]')].find(
      s => Math.abs(s.getBoundingClientRect().top) < 8)?.id"""
    visited = []
    for key in "jjjk":
        page.keyboard.press(key)
        visited.append(page.evaluate(top))
    assert None not in visited and len(set(visited)) == 3 and visited[3] == visited[1]
    folds = page.locator("main details").count()
    page.keyboard.press("o")
    assert page.locator("main details[open]").count() == folds > 2
    page.keyboard.press("o")
    assert page.locator("main details[open]").count() == 0
    page.keyboard.press("Tab")
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") != "none"
    assert page.messages == []


def test_a_live_run_is_drawn_as_it_goes_on_and_becomes_its_report(serving, tab, tmp_path) -> None:
    new = serving(tmp_path)
    page = tab(new)
    assert "No run yet" in page.locator("main").inner_text()
    log = hollow_run(tmp_path / "first", controller="pid", ending=None)
    page.wait_for_selector("text=is going on: first")  # the list came by itself
    page.get_by_role("link", name="first").click()
    page.wait_for_selector(_DRAWN, state="attached")
    samples = "() => document.querySelector('div.plot')._fullData[0].x.length"
    assert page.evaluate(samples) == 3
    for number in range(3, 150):
        write_sample(log, number)
    log.flush()
    wait_for(lambda: page.evaluate(samples) == 150, 20)
    assert page.locator("dl.measures").inner_text().count("2.98") == 1
    page.wait_for_timeout(1500)  # what stays as it was stays whole
    assert "Live" in page.locator(".lead").inner_text()
    log.close("completed", None)
    page.wait_for_selector("#circumstances", state="attached")
    assert page.locator("html").get_attribute("data-refresh") is None
    assert page.messages == []


def test_what_is_chosen_stays_as_the_list_is_renewed(serving, tab, tmp_path) -> None:
    new = serving(tmp_path)
    for name in ("one", "two"):
        hollow_run(tmp_path / name, controller="pid")
    page = tab(new)
    page.get_by_label("compare one").check()
    page.get_by_label("compare two").focus()
    hollow_run(tmp_path / "three", controller="lqr")
    page.wait_for_selector("text=three")
    assert page.get_by_label("compare one").is_checked()
    assert page.evaluate("document.activeElement.getAttribute('aria-label')") == "compare two"
    assert page.messages == []


def test_a_server_that_ended_is_told(serving, tab, tmp_path, served) -> None:
    page = tab(serving(tmp_path))
    page.route("**/*", lambda route: route.abort())
    page.wait_for_selector("text=does not answer")
    assert "No run yet" in page.locator("main").inner_text()


def test_without_scripts_the_list_filters_sorts_and_compares(served: Served, tab: Any) -> None:
    page = tab(served, java_script_enabled=False)
    page.locator("#filter").fill("duration == 3")
    page.get_by_role("button", name="show").click()
    for box in page.get_by_role("checkbox").all():
        box.check()
    page.get_by_role("button", name="compare those chosen").click()
    assert page.locator("h1").inner_text().startswith("Comparison of ")
    assert "switched off here" in page.locator("main").inner_text()


def test_another_site_cannot_use_the_cookie(serving, served: Served, tab: Any) -> None:
    """What other pages in the same browser can do: lead to it, embed it, fetch from it."""
    page = tab(served)
    base = f"http://127.0.0.1:{served.port}"
    page.route(
        "http://evil.example/",
        lambda route: route.fulfill(content_type="text/html", body=f"<a href='{base}/'>go</a>"
                                    f"<iframe src='{base}/'></iframe>"),
    )  # fmt: skip
    page.goto("http://evil.example/")
    page.wait_for_timeout(200)
    framed = [frame for frame in page.frames if frame != page.main_frame]
    assert "sweep" not in framed[0].content()
    script = f"fetch('{base}/', {{credentials: 'include'}}).then(a => a.text(), e => 'refused')"
    assert page.evaluate(script) == "refused"
    page.click("a")
    assert "trms serve" in page.locator("body").inner_text()  # led there, but not let in


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_overlaps_is_cut_or_faint(served: Served, tab: Any, scheme: str) -> None:
    page = tab(served, color_scheme=scheme)
    keys = [served.key(name) for name in ("pid", "lqr")]
    (folder,) = re.findall(r'href="(/folder/\w+)">sweep<', served.ask("/").text)
    wrong = {}
    for path in ("/", "/?filter=rmse_yaw+%3C", "/?page=99", "/nothing", f"/run/{keys[0]}",
                 f"/compare?run={keys[0]}&run={keys[1]}", folder):  # fmt: skip
        page.goto(f"http://127.0.0.1:{served.port}{path}")
        page.wait_for_selector(_DRAWN, state="attached")
        for fold in page.locator("main details").all():
            fold.evaluate("e => { e.open = true; }")
        if found := page_audit.audit(page):
            wrong[path] = found
    assert wrong == {}
    expected = re.compile("404|400")  # the two that are meant to be refused
    assert [m for m in page.messages if not expected.search(m)] == []


def test_pages_of_a_hundred_runs_open_in_under_a_second(served: Served, tab: Any) -> None:
    page = tab(served)
    (folder,) = re.findall(r'href="(/folder/\w+)">sweep<', served.ask("/").text)
    base = f"http://127.0.0.1:{served.port}"
    for path, wait in (("/", "table.runs tbody tr:nth-child(100)"), (folder, _DRAWN)):
        page.goto(base + path)  # the browser has started, and the scripts are compiled
        times = []
        for _ in range(3):
            begin = time.perf_counter()
            page.goto(base + path)
            page.wait_for_selector(wait, state="attached")
            times.append(time.perf_counter() - begin)
        assert min(times) < 1.0, f"{path}: {times}"
        assert page.get_by_text(str(SWEPT)).count() > 0
    assert page.messages == []
