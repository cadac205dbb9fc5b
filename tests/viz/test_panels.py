"""Grids of panels."""

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from benchnav.viz import panel_grid, styled

WORLDS = [
    "std, stakes backend=physics immobile=0.1/2s/observed clearance_m=0.354",
    "std, stakes",
]


@pytest.mark.parametrize("across", [1, 2, 4])
def test_long_titles_meet_neither_each_other_nor_the_edge(across: int) -> None:
    with styled():
        figure, stacks = panel_grid(WORLDS * 4, across, 1.0)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        boxes = [panel.title.get_window_extent() for (panel,) in stacks]
    for index, box in enumerate(boxes):
        assert box.x0 >= 0
        assert box.x1 <= figure.bbox.width
        for other in boxes[:index]:
            assert not box.overlaps(other)
    # Short titles need no room.
    with styled():
        short, _ = panel_grid(["std", "hg"], 2, 1.0)
    assert short.get_figheight() == pytest.approx(1.5)
