"""One style for all figures: nothing that draws has settings or colours of its own."""

import ast
import re
from pathlib import Path
from typing import get_args

import pytest
from matplotlib.colors import CSS4_COLORS, TABLEAU_COLORS

from trms_cli.core.chart import Colour

ROOT = Path(__file__).parents[2]
STYLE = ROOT / "trms_cli" / "reporting" / "style.py"
#: Words of colours that say something else than a colour.
PLAIN = {"none", "inherit", "face", "auto"}
#: A mark of a chart is coloured by the house's own names: Curve(…, colour="grey").
HOUSE = set(get_args(Colour))
HEX = re.compile(r"#(?:[0-9a-fA-F]{3,4}){1,2}")
COLOUR_KEYS = re.compile(r"(?:^|_)colou?rs?$|^(?:edge|face|label|marker\w*)colou?r$|^[cf]c$|^ec$")
NAMED = set(CSS4_COLORS) | set(TABLEAU_COLORS) | set("bgrcmykw") | {f"C{i}" for i in range(10)}


def drawing_modules() -> list[Path]:
    """Modules that draw: those of `reporting`, and all beside it that import its style."""
    found = sorted((ROOT / "trms_cli" / "reporting").rglob("*.py"))
    for place in ("docs", "experiments", "benchmarks"):
        for path in sorted((ROOT / place).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            if "matplotlib" in text or "reporting.style" in text:
                found.append(path)
    return [path for path in found if path != STYLE]


def offences(source: str) -> list[str]:
    """What of a module's drawing is not the house's, with line numbers."""
    found = []
    for node in ast.walk(ast.parse(source)):
        at = getattr(node, "lineno", 0)
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            names = [alias.name for alias in node.names]
            module = getattr(node, "module", None) or ""
            for name in [module, *names]:
                if "pyplot" in name or name in ("rc_context", "rcParams", "rc", "style.use"):
                    found.append(f"{at}: {name}")
        elif isinstance(node, ast.Attribute) and node.attr in ("rcParams", "rc_context"):
            found.append(f"{at}: {node.attr}")
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            if HEX.fullmatch(node.value):
                found.append(f"{at}: colour {node.value}")
        elif isinstance(node, ast.keyword) and node.arg and COLOUR_KEYS.search(node.arg):
            value = node.value
            own = HOUSE if node.arg == "colour" else PLAIN
            if isinstance(value, ast.Constant) and value.value in NAMED - own:
                found.append(f"{value.lineno}: {node.arg}={value.value!r}")
    return found


@pytest.mark.parametrize("path", drawing_modules(), ids=lambda p: p.relative_to(ROOT).as_posix())
def test_draws_in_the_style_of_the_house(path):
    assert offences(path.read_text(encoding="utf-8")) == []


def test_all_figures_of_the_studies_are_looked_at():
    names = {path.relative_to(ROOT).as_posix() for path in drawing_modules()}
    assert {"experiments/chapter6/figures.py", "experiments/tournament/figures.py"} <= names
    assert len(names) > 30


@pytest.mark.parametrize(
    "source",
    [
        "import matplotlib.pyplot as plt",
        "from matplotlib import pyplot",
        "from matplotlib import rc_context",
        "import matplotlib\nmatplotlib.rcParams['font.size'] = 3",
        "axes.plot(x, y, color='#ff0000')",
        "axes.plot(x, y, color='red')",
        "axes.fill(x, y, facecolor='C1')",
        "line.set_color('#abc')",
        "Curve(x, y, colour='red')",
    ],
)
def test_other_styles_are_found(source):
    assert len(offences(source)) >= 1


def test_colours_of_the_style_are_distinct_when_printed_grey():
    """Curves that share a grey have other dashes: told apart without colour."""
    from trms_cli.core.chart import curve_look

    looks = [curve_look(i) for i in range(6)]
    assert len({look["style"] for look in looks}) == len(looks)
    assert len({look["colour"] for look in looks}) == len(looks)
