"""What a reader would stumble over in a page, as it stands in a browser."""

import json
import time
from pathlib import Path
from typing import Any

#: Plots are drawn anew a moment after the window has another width.
_FITS = """() => [...document.querySelectorAll('div.plot')].every(plot => {
  const svg = plot.querySelector('.main-svg');
  return !svg || !plot.offsetWidth || Math.abs(svg.getBoundingClientRect().width
    - plot.getBoundingClientRect().width) < 2; })"""
_SCRIPT = Path(__file__).with_suffix(".js").read_text(encoding="utf-8")
_PATIENCE = 20.0  # s
WIDTHS = (1400, 800, 360)  # px: a desk, a tablet, a telephone


def audit(page: Any, widths: tuple[int, ...] = WIDTHS, schemes: tuple[str, ...] = ()) -> list[str]:
    """What is wrong with the page of a tab at every width, in words.

    ``schemes``: for pages whose colours alone follow the reader's (``light``, ``dark``): looked at
    in each of them at every width. Without any: as the tab has it.
    """
    wrong = []
    for width in widths:
        page.set_viewport_size({"width": width, "height": 900})
        page.evaluate("() => new Promise(done => requestAnimationFrame(() => setTimeout(done)))")
        until = time.monotonic() + _PATIENCE
        while not page.evaluate(_FITS) and time.monotonic() < until:
            page.wait_for_timeout(50)
        for scheme in schemes or ("",):
            if scheme:
                page.emulate_media(color_scheme=scheme)
            for what, where in page.evaluate(_SCRIPT).items():
                if where:
                    words = json.dumps(where, ensure_ascii=False)[:300]
                    wrong.append(f"{width} px{scheme and ', '}{scheme}: {what}: {words}")
    return wrong
