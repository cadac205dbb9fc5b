"""What the ground looks like, against a model of colour blindness."""

from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchnav.planning.world.outcome import Outcome
from benchnav.viz.drives import MARKS, Drive, draw_drive, end_mark, mark
from benchnav.viz.maps import IMMOBILISING, draw_scale, field_colours, scale_length
from benchnav.viz.style import bytes_of

# Machado, Oliveira and Fernandes (2009), full severity, on linear RGB.
SEEN = {
    "all": np.eye(3),
    "without red": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "without green": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
    "without blue": np.array(
        [
            [1.255528, -0.076749, -0.178779],
            [-0.078411, 0.930809, 0.147602],
            [0.004733, 0.691367, 0.303900],
        ]
    ),
}


def lab(colours: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """CIE L*a*b* of sRGB colours in [0, 1], as somebody sees them."""
    linear = np.where(
        colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4
    )
    to_xyz = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    )
    xyz = (linear @ seen.T).clip(0, 1) @ to_xyz.T / to_xyz.sum(axis=1)
    x, y, z = np.moveaxis(
        np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116), -1, 0
    )
    return np.stack((116 * y - 16, 500 * (x - y), 200 * (y - z)), axis=-1)


@pytest.mark.parametrize("seen", SEEN)
def test_what_immobilises_a_robot_has_a_colour_that_no_traversability_has(
    seen: str,
) -> None:
    shades = (
        field_colours(np.linspace(0, 1, 256)[None], np.zeros((1, 256), bool))[0] / 255
    )
    away = lab(shades, SEEN[seen]) - lab(np.array(to_rgb(IMMOBILISING)), SEEN[seen])
    # A difference of 2.3 can just be seen.
    assert np.linalg.norm(away, axis=1).min() > 30


def test_cells_have_the_colour_of_their_own_traversability_or_that_of_what_holds() -> (
    None
):
    field = np.random.default_rng(0).random((5, 7))
    immobilising = field < 0.3
    colours = field_colours(field, immobilising)
    assert (colours.dtype, colours.shape) == (np.uint8, (5, 7, 3))
    usual = np.round(255 * matplotlib.colormaps["viridis"](field)[..., :3])
    np.testing.assert_array_equal(colours[~immobilising], usual[~immobilising])
    assert (colours[immobilising] == bytes_of(IMMOBILISING)[:3]).all()


def test_each_outcome_has_a_mark() -> None:
    marks = {
        outcome.name.lower(): end_mark(outcome.name.lower()) for outcome in Outcome
    }
    assert set(marks.values()) <= MARKS.keys()
    assert [name for name, mark in marks.items() if mark == "success"] == ["success"]
    assert [name for name, mark in marks.items() if mark == "immobilised"] == [
        "immobilised"
    ]
    # What stood still until its time was up is out of time too.
    assert [name for name, mark in marks.items() if mark == "out of time"] == [
        "timeout",
        "stuck",
        "stalled",
    ]


def drawn_marks(**changes: Any) -> tuple[Axes, dict[str, Line2D]]:
    panel = Figure(figsize=(4, 3), dpi=72).add_axes((0, 0, 1, 1))
    panel.set(xlim=(0, 8), ylim=(0, 6))
    track = np.stack((np.linspace(0.2, 3.8, 37), np.full(37, 3.2)), axis=1)
    draw_drive(panel, Drive(track=track, goal_m=np.array([4.5, 3.2]), **changes))
    return panel, {str(line.get_label()): line for line in panel.lines}


def test_an_end_is_marked_where_it_is_and_a_goal_that_was_reached_stays_in_sight() -> (
    None
):
    _, marks = drawn_marks(outcome="immobilised")
    np.testing.assert_allclose(np.ravel(marks["immobilised"].get_data()), (3.8, 3.2))
    assert "robot" not in marks
    panel, marks = drawn_marks(outcome="success")
    tick = marks["success"]
    position = tick.get_transform().transform(np.ravel(tick.get_data()))
    end = panel.transData.transform((3.8, 3.2))
    # At 72 dots an inch a pixel is a point; the goal lies along x.
    np.testing.assert_allclose(
        position - end, (-0.9 * tick.get_markersize(), 0), atol=1e-9
    )


def test_a_robot_that_drives_is_shown_with_its_heading() -> None:
    _, marks = drawn_marks(heading_rad=1.0)
    np.testing.assert_allclose(np.ravel(marks["robot"].get_data()), (3.8, 3.2))
    assert not {"success", "immobilised"} & marks.keys()


def test_a_mark_has_its_own_scale_whatever_was_drawn_before() -> None:
    panel = Figure().subplots()
    drawn = [mark(panel, "goal", (0, 0), scale) for scale in (2.0, 0.5, 1.0)]
    sizes = np.array([line.get_markersize() for line in drawn])
    np.testing.assert_allclose(sizes / sizes[-1], (2.0, 0.5, 1.0))


@pytest.mark.parametrize(
    ("width_m", "length_m"), [(32.0, 10.0), (1.2, 0.5), (500.0, 100.0), (28.0, 5.0)]
)
def test_a_scale_bar_is_as_long_as_it_says(width_m: float, length_m: float) -> None:
    assert scale_length(width_m) == length_m
    panel = Figure().add_axes((0, 0, 1, 1))
    draw_scale(panel, (width_m, 20.0))
    assert list(panel.lines[0].get_xdata()) == [0, length_m]
    assert panel.texts[0].get_text() == f"{length_m:g} m"
