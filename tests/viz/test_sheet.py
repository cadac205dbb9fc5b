import numpy as np
import pytest

from benchnav.viz.sheet import SheetColumn, sheet_of_maps


@pytest.mark.parametrize("n_rows", [1, 3, 12])
def test_colour_bars_follow_their_columns_without_a_blank_band(n_rows: int) -> None:
    layers = np.zeros((n_rows, 8, 8))
    columns = [
        SheetColumn(name, name.title(), layers, unit="m")
        for name in ("first", "second")
    ]
    rows = [f"map {index}" for index in range(n_rows)]
    figure = sheet_of_maps(columns, rows, (8.0, 8.0), "sheet", [])
    figure.draw_without_rendering()
    panels = {panel.get_label(): panel.get_position() for panel in figure.axes}
    for name in ("first", "second"):
        lowest = panels[f"{name} {n_rows - 1}"]
        bar = panels[f"{name} bar"]
        assert 0 < (lowest.y0 - bar.y1) * figure.get_figheight() < 0.6
