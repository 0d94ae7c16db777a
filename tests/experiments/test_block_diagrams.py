"""The block diagrams of the chapters: drawn alike, small, their words within their boxes."""

import pytest

from experiments import block_diagrams
from experiments.chapter2.__main__ import FIGURES
from trms_cli.reporting import block_diagram
from trms_cli.reporting.block_diagram import Block

#: Where each stands in the pages.
PLACES = {
    "newtonian": "chapter2/newtonian.png",
    "newton_mpc": "chapter6/controller.png",
    "output_feedback": "chapter7/loop.png",
    "robust_mpc": "chapter8/controller.png",
    "diagnosis": "diagnosis.png",
}


@pytest.mark.parametrize("name", PLACES)
def test_a_diagram_is_drawn_and_its_words_fit(name, tmp_path, monkeypatch):
    pages = []

    keep_png = block_diagrams.save_png
    monkeypatch.setattr(block_diagrams, "save_png", lambda page, path: pages.append(page))
    blocks: list[Block] = []
    draw_box = block_diagram.draw_box
    monkeypatch.setattr(
        block_diagram,
        "draw_box",
        lambda panel, block, *width: (blocks.append(block), draw_box(panel, block, *width)),
    )
    getattr(block_diagrams, f"draw_{name}")(tmp_path / "diagram.png")
    monkeypatch.undo()
    (page,) = pages
    page.draw_without_rendering()
    (panel,) = page.axes
    to_data = panel.transData.inverted()
    boxes = [to_data.transform(text.get_window_extent()) for text in panel.texts if text.get_text()]
    for block in blocks:
        low, high = block.x - block.wide / 2, block.x + block.wide / 2
        inside = [
            box
            for box in boxes
            if low < box[:, 0].mean() < high and abs(box[:, 1].mean() - block.y) < block.high / 2
        ]
        assert inside
        assert all(low < box[0, 0] and box[1, 0] < high for box in inside), block.title
    for i, one in enumerate(boxes):
        for other in boxes[i + 1 :]:
            apart = (one[1] - 0.02 < other[0]).any() or (other[1] - 0.02 < one[0]).any()
            assert apart, "two words overlap"
    keep_png(page, tmp_path / "diagram.png")
    assert (tmp_path / "diagram.png").stat().st_size < 60_000
    assert (FIGURES.parent / PLACES[name]).is_file()
