"""Names in data lead to no file elsewhere, and are shown as text: on pages and on terminals."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from trms_cli.cli import describe_error
from trms_cli.core.errors import TrmsError
from trms_cli.core.printable import printable
from trms_cli.core.resources import config_folder

_ELSEWHERE = [
    *("../outside", "/etc/passwd", "a/../../b", "..", "a\0b", "C:\\Windows\\x"),
    *("x" * 5000, "", "\N{FULLWIDTH SOLIDUS}etc", "%2e%2e%2fx"),
]


def _bench(**more: object) -> str:
    import yaml

    text = (config_folder() / "parameters" / "bench.yaml").read_text(encoding="utf-8")
    return yaml.safe_dump(yaml.safe_load(text) | more)


@pytest.mark.parametrize("name", _ELSEWHERE)
def test_a_model_file_names_no_file_elsewhere(name: str, tmp_path: Path) -> None:
    from trms_cli.effects.model_file import load_model

    (tmp_path / "outside.yaml").write_text("_target_: trms_cli.models.newtonian.Newtonian\n")
    for more in ({"model": name}, {"effects": {name: {}}}):
        file = tmp_path / "model.yaml"
        file.write_text(_bench(**more), encoding="utf-8")
        with pytest.raises(TrmsError):
            load_model(str(file))


@pytest.mark.parametrize("name", _ELSEWHERE)
def test_the_key_of_a_blind_set_names_no_file_elsewhere(name: str, tmp_path: Path) -> None:
    from experiments.gap.blind.sealing import (
        COMMITMENT,
        COMMITMENT_SCHEMA,
        KEY,
        KEY_SCHEMA,
        _commitment,
        open_key,
    )

    content = {"set": "small", "seed": 1, "cases": {}, "files": {name: "0" * 64}}
    told = {"schema": COMMITMENT_SCHEMA, "sha256": _commitment("00", content)}
    (tmp_path / COMMITMENT).write_text(json.dumps(told))
    (tmp_path / KEY).write_text(json.dumps({"schema": KEY_SCHEMA, "salt": "00", "key": content}))
    with pytest.raises(TrmsError):
        open_key(tmp_path / KEY, tmp_path)


@pytest.mark.parametrize("sign", ["\x1b]0;x\x07", "\x1b[2J", "\x9b31m", "\r", "\b", "\u202e"])
def test_what_steers_a_terminal_is_written_out(sign: str) -> None:
    error = TrmsError(f"the name is {sign}a", where=f"{sign}b", remedy=f"{sign}c")
    said = describe_error(error, colour=False)
    assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e]", said)
    assert printable("α → ω\n\t1") == "α → ω\n\t1"


class _Elements(HTMLParser):
    """The elements of a page with the names of their attributes, in their order."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, tuple[str, ...]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, tuple(name for name, _ in attrs)))


def _page(word: str) -> str:
    """A page with every kind of block, and a word wherever one can stand."""
    from trms_cli.core.chart import Axis, Chart, Curve, Panel
    from trms_cli.core.findings import (
        Datum,
        Details,
        Findings,
        Measure,
        NextCommand,
        Remarks,
        Section,
        Table,
    )
    from trms_cli.reporting.page import page_html

    marks = [Curve([0.0, 1.0], [0.0, 1.0], word)]
    deep = [Curve([0.0, 1.0], [0.0, 1.0], z=[0.0, 1.0])]
    plot = Panel(Axis(word, word), Axis("y"), marks, word, caption=word)
    picture = Panel(Axis("x"), Axis("y"), deep, "drawn", z=Axis("z"))
    blocks = [
        Remarks([word, Datum(word)]),
        NextCommand(word, word),
        Table([word], [[word], [Datum(word)]], word),
        Chart("plot", [plot], word),
        Chart("picture", [picture], word),
        Table([word], [[word], [Datum(word, link=word)]], word, keys=[word], example=word),
        Details(word, word),
    ]
    measures = [Measure(word, word, word, note=word)]
    return page_html(
        Findings(word, [word, word], [Section(word, [word, word], blocks)], warnings=[word],
                 measures=measures, facts={word: word})
    )  # fmt: skip


def test_a_page_has_the_same_elements_whatever_it_shows() -> None:
    plain, hostile = _Elements(), _Elements()
    plain.feed(_page("word"))
    hostile.feed(_page("<script>alert(1)</script><img src=x onerror=alert(1)>\"'`**&--></style>"))
    assert hostile.found == plain.found and len(plain.found) > 30
    assert "Content-Security-Policy" in _page("word")
