"""What the ground looks like, against a model of colour blindness."""

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from benchnav.core.figures import MARKS, bytes_of
from benchnav.eval.report.plan_layers import IMMOBILISING, end_mark, field_colours, mark_end
from benchnav.planning.world.outcome import Outcome

# Machado, Oliveira and Fernandes (2009), full severity, on linear RGB.
SEEN = {
    "all": np.eye(3),
    "without red": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "without green": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "without blue": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}


def lab(colours: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """CIE L*a*b* of sRGB colours in [0, 1], as somebody sees them."""
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = (linear @ seen.T).clip(0, 1) @ to_xyz.T / to_xyz.sum(axis=1)
    x, y, z = np.moveaxis(np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116), -1, 0)
    return np.stack((116 * y - 16, 500 * (x - y), 200 * (y - z)), axis=-1)


@pytest.mark.parametrize("seen", SEEN)
def test_what_immobilises_a_robot_has_a_colour_that_no_traversability_has(seen: str) -> None:
    shades = field_colours(np.linspace(0, 1, 256)[None], np.zeros((1, 256), bool))[0] / 255
    away = lab(shades, SEEN[seen]) - lab(np.array(to_rgb(IMMOBILISING)), SEEN[seen])
    # A difference of 2.3 can just be seen.
    assert np.linalg.norm(away, axis=1).min() > 30


def test_cells_have_the_colour_of_their_own_traversability_or_that_of_what_holds() -> None:
    field = np.random.default_rng(0).random((5, 7))
    immobilising = field < 0.3
    colours = field_colours(field, immobilising)
    assert (colours.dtype, colours.shape) == (np.uint8, (5, 7, 3))
    usual = np.round(255 * matplotlib.colormaps["viridis"](field)[..., :3])
    np.testing.assert_array_equal(colours[~immobilising], usual[~immobilising])
    assert (colours[immobilising] == bytes_of(IMMOBILISING)[:3]).all()


def test_each_outcome_has_a_mark() -> None:
    marks = {outcome.name.lower(): end_mark(outcome.name.lower()) for outcome in Outcome}
    assert set(marks.values()) <= MARKS.keys()
    assert [name for name, mark in marks.items() if mark == "arrived"] == ["success"]
    assert [name for name, mark in marks.items() if mark == "immobilised"] == ["immobilised"]
    # What stood still until its time was up is out of time too.
    assert [name for name, mark in marks.items() if mark == "out of time"] == ["timeout", "stuck", "stalled"]


@pytest.mark.parametrize("goal_m", [(6.0, 4.5), (6.0, 1.5)])
def test_an_end_is_marked_beside_its_cell_on_the_side_away_from_the_goal(goal_m: tuple[float, float]) -> None:
    panel = Figure(figsize=(4, 3), dpi=100).add_axes((0, 0, 1, 1))
    panel.set(xlim=(0, 8), ylim=(0, 6))
    # It came along x, and ended in the cell from (3.5, 3) to (4, 3.5).
    track = np.stack((np.linspace(0.2, 3.8, 37), np.full(37, 3.2)), axis=1)
    cell, mark = mark_end(panel, "immobilised", track, np.array(goal_m), 0.5, color="red", label="held")
    assert cell.get_path().get_extents().bounds == (3.5, 3.0, 0.5, 0.5)
    assert (mark.get_marker(), mark.get_color(), mark.get_label()) == ("X", "red", "held")
    x, y = mark.get_transform().transform(np.ravel(mark.get_data()))
    middle_x, middle_y = panel.transData.transform((3.75, 3.25))
    assert x == pytest.approx(middle_x)
    assert (y > middle_y) == (goal_m[1] < 3)
    # 25 pixels are half a metre; a point is 100 / 72 of a pixel.
    assert abs(y - middle_y) - mark.get_markersize() / 2 * 100 / 72 > 12.5


def test_an_end_off_the_map_or_at_the_start_is_marked_too() -> None:
    panel = Figure().add_axes((0, 0, 1, 1))
    for track in (np.array([[1.0, 1.0]]), np.array([[1.0, 1.0], [-0.2, 9.0]])):
        ground = np.zeros((4, 4, 3), np.uint8)
        cell, mark = mark_end(panel, "timeout", track, np.array([2.0, 2.0]), 0.5, ground=ground)
        assert np.isfinite(mark.get_xydata()).all()
        assert cell.get_fill() == (len(track) == 1) or cell.get_facecolor()[3] == 0
