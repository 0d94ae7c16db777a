"""The site in a browser: on a telephone, a tablet and a desk, light and dark.

Needs Chromium: skipped where there is none, but where ``TRMS_REQUIRE_BROWSER`` is set.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests import page_audit

#: The site is built first, and each of its pages is looked at in three widths.
pytestmark = pytest.mark.slow

PARTS = ["Start", "How-to", "Understand", "Reference", "Proof"]


@pytest.fixture
def tab(browser: Any) -> Iterator[Callable[..., Any]]:
    """Open a tab; what it complains of is in its ``messages``."""
    contexts = []

    def open_(width: int = 1400) -> tuple[Any, list[str]]:
        context = browser.new_context(viewport={"width": width, "height": 900})
        contexts.append(context)
        page, messages = context.new_page(), list[str]()
        page.on("console", lambda message: messages.append(message.text))
        page.on("pageerror", lambda error: messages.append(str(error)))
        return page, messages

    yield open_
    for context in contexts:
        context.close()


def audit(page: Any, file: Path, messages: list[str]) -> list[str]:
    """What is wrong with a page at every width, light and dark, in words."""
    messages.clear()
    page.goto(file.as_uri())
    wrong = page_audit.audit(page, schemes=("light", "dark"))
    return wrong + [f"console: {message}" for message in messages]


def test_nothing_overlaps_is_cut_or_faint(site: Path, tab: Any) -> None:
    page, messages = tab()
    files = [file for file in sorted(site.rglob("*.html")) if site / "source" not in file.parents]
    assert len(files) > 80
    wrong = {str(f.relative_to(site)): found for f in files if (found := audit(page, f, messages))}
    assert wrong == {}


def test_the_audit_sees_what_is_wrong(tab: Any, tmp_path: Path) -> None:
    page, messages = tab()
    file = tmp_path / "poor.html"
    file.write_text(
        "<meta charset=utf-8><body style='background:#fff'><article style='width:300px'>"
        "<style>@media (prefers-color-scheme: dark) {.night {color: #333}}</style>"
        "<p style='color:#bbb'>faint</p>"
        "<p style='background:#000;color:#fff'><b class=night>at night</b></p>"
        "<table><td><div style='width:2000px'>wide</div></table>"
        "<p style='height:1em'>under<p style='margin-top:-2.2em'>over</article><img src=none.png>",
        encoding="utf-8",
    )
    found = "\n".join(audit(page, file, messages))
    for what in ("wide", "cut", "overlap", "faint", "pictures", "console"):
        assert what in found, what
    assert [line.split(":")[0] for line in found.splitlines() if "at night" in line] == [
        f"{width} px, dark" for width in page_audit.WIDTHS
    ]


def test_the_side_bar_has_five_parts_that_unfold(site: Path, tab: Any) -> None:
    page, _ = tab()
    page.goto((site / "index.html").as_uri())
    entries = page.locator(".sidebar-tree a:visible")
    assert entries.all_inner_texts() == PARTS
    page.goto((site / "how-to.html").as_uri())
    assert len(PARTS) < entries.count() < 20
    first = page.locator(".sidebar-tree .current-page a").first
    assert first.inner_text() == "How-to"


def test_commands_wrap_and_are_copied_without_their_prompt(site: Path, tab: Any) -> None:
    page, _ = tab(width=360)
    page.goto((site / "getting-started.html").as_uri())
    console = page.locator(".highlight-console").first
    assert console.locator("button.copybtn").get_attribute("data-tooltip") == "Copy"
    page.evaluate("document.addEventListener('copy', e => { window.copied = e.target.value; })")
    console.locator("button.copybtn").click(force=True)
    assert page.evaluate("window.copied") == "trms run controller=pdi"
    # what is printed is not to be copied, and keeps its lines
    assert page.locator(".highlight-text button.copybtn").count() == 0
    for kind, wraps in (("sh", True), ("text", False)):
        style = page.locator(f".highlight-{kind} pre").first.evaluate(
            "e => getComputedStyle(e).whiteSpaceCollapse + ' ' + getComputedStyle(e).textWrapMode"
        )
        assert ("nowrap" not in style) is wraps, style
