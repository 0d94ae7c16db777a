"""The scripts that an interactive page carries, and the policy that lets nothing else run.

A page may hold text of strangers: names of files, messages of events, configurations. All of it is
escaped; should a mistake let markup through all the same, the page's Content-Security-Policy
refuses it: nothing is fetched from anywhere, and only scripts with the hashes of ours run.
"""

from __future__ import annotations

import base64
import hashlib
from functools import cache
from pathlib import Path

_ASSETS = Path(__file__).with_name("assets")
#: In this order: ours draws with plotly's.
SCRIPTS = ("plotly-cartesian.min.js", "page.js")


@cache
def scripts() -> tuple[str, ...]:
    """The text of each script, as it stands in a page.

    Raises ValueError if one of them could end the element that it stands in.
    """
    found = []
    for name in SCRIPTS:
        text = (_ASSETS / name).read_text(encoding="utf-8")
        if "</script" in text.lower() or "<!--" in text or "\r" in text:
            raise ValueError(f"{name} cannot stand inside a page")
        found.append(text)
    return tuple(found)


def policy(carried: tuple[str, ...] = ()) -> str:
    """The Content-Security-Policy of a page that carries these scripts; none may be.

    Styles are inline: plotly.js sets the places of its parts so. Images come from the page itself,
    where a reader saves a plot as a file.
    """
    hashes = (hashlib.sha256(text.encode()).digest() for text in carried)
    allowed = " ".join(f"'sha256-{base64.b64encode(one).decode('ascii')}'" for one in hashes)
    return (
        f"default-src 'none'; script-src {allowed or chr(39) + 'none' + chr(39)}; "
        "style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
