"""Block diagrams: boxes, sums and wires where they are said to be."""

import pytest

from trms_cli.reporting.block_diagram import (
    Block,
    SummingPoint,
    branch,
    diagram_panel,
    draw_block,
    draw_sum,
    wire,
    word,
)
from trms_cli.reporting.style import figure_bytes, house_style


def test_wires_end_at_the_sides():
    block, node = Block(2.0, 1.0, "rig", wide=1.0, high=0.5), SummingPoint(0.0, 0.0, radius=0.2)
    assert (block.left, block.right) == ((1.5, 1.0), (2.5, 1.0))
    assert (block.top, block.bottom) == ((2.0, 1.25), (2.0, 0.75))
    assert (node.left, node.right) == ((-0.2, 0.0), (0.2, 0.0))
    assert (node.top, node.bottom) == ((0.0, 0.2), (0.0, -0.2))


def test_words_stand_within_their_block():
    with house_style():
        page, panel = diagram_panel(4.0, (0.0, 0.0), (4.0, 2.0))
        block = Block(2.0, 1.0, "title", "one line\nand another", wide=2.0, high=1.0)
        draw_block(panel, block)
        draw_sum(panel, SummingPoint(0.5, 1.0))
        branch(panel, (0.8, 1.0))
        wire(panel, [(0.1, 0.2), (0.5, 0.2), (0.5, 0.8)])
        word(panel, 0.3, 1.7, "u")
        content = figure_bytes(page, "svg")
        assert content == figure_bytes(page, "svg")
        page.draw_without_rendering()
        box = panel.transData.inverted()
        assert panel.get_xlim() == pytest.approx((0.0, 4.0))
        lines = [text for text in panel.texts if text.get_text() in ("title", "one line")]
        for text in lines:
            (x0, y0), (x1, y1) = box.transform(text.get_window_extent())
            assert 1.0 < x0 < x1 < 3.0 and 0.5 < y0 < y1 < 1.5
