"""Plugins from configuration: what is built, and what each mistake is told."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Protocol

import pytest
from msgspec import Meta, Struct

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build, nearest


@pytest.fixture(autouse=True)
def _allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The classes of this file are a user's own."""
    monkeypatch.setenv("TRMS_ALLOW", f"{__name__.partition('.')[0]},no_such_package_here")


class Shape(Protocol):
    def area(self) -> float: ...


@dataclass(frozen=True, kw_only=True)
class Square:
    side: Annotated[float, Meta(gt=0)]

    def area(self) -> float:
        return self.side**2


class Pen(Struct, frozen=True, forbid_unknown_fields=True):
    width: Annotated[float, Meta(ge=0)]
    tip: str = "round"


@dataclass(frozen=True, kw_only=True)
class Drawing:
    title: str = "untitled"
    style: Literal["line", "fill"] = "line"
    copies: Annotated[int, Meta(ge=1)] = 1
    main: Shape | None = None
    shapes: tuple[Shape, ...] = ()
    named: Mapping[str, Shape] = field(default_factory=dict)
    sizes: Mapping[str, float] = field(default_factory=dict)
    pen: Literal["auto"] | Pen = "auto"
    pens: Mapping[str, Pen] = field(default_factory=dict)
    span: tuple[float, float] = (0.0, 1.0)
    spans: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    seed: int | None = None
    names: tuple[str, ...] | None = None
    share: Annotated[float, Meta(ge=0, lt=1)] = 0.0

    def __post_init__(self) -> None:
        if self.title == "forbidden":
            raise ConfigurationError("not this one", where="title", remedy="choose another")


class Plain:
    """A class that is no dataclass: its arguments are those of its constructor."""

    def __init__(self, *, factor: Annotated[float, Meta(le=1)] = 0.5) -> None:
        self.factor = factor


def node(name: str, **arguments: Any) -> dict[str, Any]:
    return {"_target_": f"{__name__}.{name}", **arguments}


def test_builds_nested_plugins_in_fields_lists_and_mappings_also_of_no_dataclass() -> None:
    drawing = build(
        node(
            "Drawing",
            main=node("Square", side=2),
            shapes=[node("Square", side=1.5)],
            named={"a": node("Square", side=3)},
            sizes={"x": 1},
        ),
        "drawing",
    )
    assert drawing.main.area() == 4.0
    assert [shape.area() for shape in drawing.shapes] == [2.25]
    assert drawing.named["a"].area() == 9.0
    assert drawing.sizes == {"x": 1.0}
    assert build(node("Plain", factor=0.25)).factor == 0.25


@pytest.mark.parametrize(
    ("given", "where", "remedy"),
    [
        (node("Drawing", titel="x"), "d.titel", "did you mean title?"),
        (node("Square"), "d.side", "d.side="),
        (node("Square", side=-1.0), "d.side", "> 0"),
        (node("Square", side="big"), "d.side", "expected a number > 0"),
        (node("Drawing", style="dots"), "d.style", "allowed: fill, line"),
        (node("Drawing", copies=0), "d.copies", ">= 1"),
        (node("Drawing", copies=1.5), "d.copies", "a whole number >= 1"),
        (node("Drawing", main=3), "d.main", "by its name"),
        (node("Drawing", shapes=[node("Square", side=0)]), "d.shapes[0].side", "> 0"),
        (node("Drawing", sizes={"w": 1.0, "x": "y"}), "d.sizes.x", "'y' given expected a number"),
        (node("Drawing", sizes=3), "d.sizes", "a mapping from names to a number"),
        (node("Drawing", pen=3), "d.pen", "expected auto, or a mapping with the keys width, tip"),
        (node("Drawing", pen="aut"), "d.pen", "expected auto, or a mapping"),
        (node("Drawing", pen={"width": 1.0, "tap": "x"}), "d.pen.tap", "did you mean tip?"),
        (node("Drawing", pen={"tip": "x"}), "d.pen.width", "required"),
        (node("Drawing", pen={"width": -1.0}), "d.pen.width", "expected a number >= 0"),
        (node("Drawing", pens={"a": {"width": "x"}}), "d.pens.a.width", "expected a number >= 0"),
        (node("Drawing", span=[1.0]), "d.span", "expected two numbers [lower, upper]"),
        (node("Drawing", span=[1.0, "x"]), "d.span[1]", "expected a number"),
        (node("Drawing", spans={"x": [1.0, 2.0, 3.0]}), "d.spans.x", "two numbers [lower, upper]"),
        (node("Drawing", seed="x"), "d.seed", "expected a whole number, or null"),
        (node("Drawing", names="x"), "d.names", "expected a list, each item a text, or null"),
        (node("Square", side=1e200), "d.side", "up to 1e+20"),
        (node("Drawing", sizes={"x": -1e21}), "d.sizes.x", "up to 1e+20"),
        (node("Drawing", copies=10**400), "d.copies", "up to 1e+20"),
        (node("Drawing", share=2.0), "d.share", "expected a number >= 0 and < 1"),
        (node("Drawing", title="forbidden"), "d.title", "choose another"),
        (node("Plain", factor=2.0), "d.factor", "<= 1"),
        ({"_target_": "no_such_package_here.Thing"}, "d._target_", "install"),
        ({"_target_": "trms_cli.core.plugins.Bild"}, "d._target_", "allowed"),
        ({"_target_": "undotted"}, "d._target_", "package.module.Class"),
        ({"no": "target"}, "d", "_target_"),
        ("a word", "d", "_target_"),
    ],
)
def test_each_mistake_names_the_key_and_what_is_allowed(given, where, remedy) -> None:
    with pytest.raises(ConfigurationError) as raised:
        build(given, "d")
    error = raised.value
    assert error.where.startswith(where)
    assert remedy in f"{error.problem} {error.remedy}"


def test_nearest_name_comes_first() -> None:
    assert nearest("sqare", ["square", "sine"]).startswith("did you mean square?")
    assert nearest("zzz", ["square", "sine"]) == "allowed: sine, square"
