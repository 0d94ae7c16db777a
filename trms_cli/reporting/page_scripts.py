"""The scripts that an interactive page carries, and the policy that lets nothing else run.

A page may hold text of strangers: names of files, messages of events, configurations. All of it is
escaped; should a mistake let markup through all the same, the page's Content-Security-Policy
refuses it: nothing is fetched from anywhere, and only two scripts run, by their hashes: ours
(``assets/page.js``) and plotly.js, as the installed package ``plotly`` has it.

plotly.js is 4.8 MB of text, and a page carries it compressed, as data that no browser runs. Our
script unpacks it and adds it to the page, where the policy knows it by the hash of its text.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from trms_cli.core.result_cache import cached_result


@dataclass(frozen=True)
class PackedScript:
    """A script as a page carries it: gzip, in base64."""

    packed: str
    digest: bytes  #: SHA-256 of the text that comes out


@cache
def page_script() -> str:
    """Our script: draws plots, links their axes, sorts and filters tables."""
    return Path(__file__).with_name("assets").joinpath("page.js").read_text(encoding="utf-8")


@cache
def plotly_script() -> PackedScript:
    """plotly.js of the installed package; that package itself is not imported, which takes time.

    Raises ModuleNotFoundError where it is not installed, and OSError where its script is missing.
    """
    package = find_spec("plotly")
    if package is None or package.origin is None:
        raise ModuleNotFoundError("No module named 'plotly'", name="plotly")
    text = Path(package.origin).with_name("package_data").joinpath("plotly.min.js").read_bytes()
    digest = hashlib.sha256(text).digest()
    packed = cached_result(__file__, [digest], str, lambda: _packed(text))
    return PackedScript(packed, digest)


def _packed(text: bytes) -> str:
    return base64.b64encode(gzip.compress(text, compresslevel=9, mtime=0)).decode("ascii")


def text_digest(script: str) -> bytes:
    """SHA-256 of a script that stands in a page as it is."""
    return hashlib.sha256(script.encode()).digest()


def policy(digests: Sequence[bytes] = ()) -> str:
    """The Content-Security-Policy of a page that runs the scripts with these hashes alone.

    Styles are inline: plotly.js sets the places of its parts so. Images come from the page itself,
    where a reader saves a plot as a file.
    """
    hashes = (f"'sha256-{base64.b64encode(digest).decode('ascii')}'" for digest in digests)
    return (
        f"default-src 'none'; script-src {' '.join(hashes) or chr(39) + 'none' + chr(39)}; "
        "style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
