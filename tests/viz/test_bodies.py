import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from benchnav.planning.footprint import Footprint
from benchnav.viz.bodies import MAX_RUT_M, draw_body, rectangle, rut_colours
from benchnav.viz.drives import Drive, draw_drive

POSE = np.array([10.0, 8.0, 0.7])
FOOTPRINT = Footprint(track_m=0.6, wheelbase_m=1.0, ahead_m=0.4)
CONTACTS = FOOTPRINT.contacts(torch.tensor(POSE)).flatten(0, 1).numpy()


def panel(width_m: float) -> Axes:
    axes = Figure().subplots()
    axes.set(xlim=(0, width_m), ylim=(0, width_m))
    return axes


def drawn(axes: Axes) -> tuple[Polygon, PolyCollection]:
    body = axes.patches[0]
    (wheels,) = axes.collections
    assert isinstance(body, Polygon)
    assert isinstance(wheels, PolyCollection)
    return body, wheels


def test_the_rectangle_has_the_sizes_of_the_footprint() -> None:
    centre, size, axes = rectangle(POSE, CONTACTS)
    np.testing.assert_allclose(centre, [0.4, 0], atol=1e-7)
    np.testing.assert_allclose(size, [1.0, 0.6], atol=1e-7)
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-12)


@pytest.mark.parametrize("width_m", [5.0, 100.0])
def test_a_robot_is_drawn_in_its_size_or_enlarged_about_its_position(
    width_m: float,
) -> None:
    axes = panel(width_m)
    draw_body(axes, POSE, CONTACTS)
    body, wheels = drawn(axes)
    corners = body.get_xy()[:4]
    scale = np.linalg.norm(corners[0] - corners[1])  # the wheelbase is 1 m
    assert body.get_label() == (
        "robot" if scale == pytest.approx(1) else "robot, enlarged"
    )
    assert scale == pytest.approx(max(1, 0.055 * width_m))
    expected = POSE[:2] + scale * (CONTACTS - POSE[:2])
    away = np.linalg.norm(corners[:, None] - expected, axis=-1)
    np.testing.assert_allclose(away.min(axis=0), 0, atol=1e-6)
    middles = [path.vertices[:4].mean(axis=0) for path in wheels.get_paths()]
    np.testing.assert_allclose(middles, expected, atol=1e-6)
    assert (axes.get_xlim(), axes.get_ylim()) == ((0, width_m), (0, width_m))


def test_wheels_are_darker_the_deeper_their_ruts() -> None:
    axes = panel(5.0)
    ruts_m = np.array([0.0, 0.01, 0.03, 2 * MAX_RUT_M])
    draw_body(axes, POSE, CONTACTS, ruts_m)
    _, wheels = drawn(axes)
    brightness = wheels.get_facecolor()[:, :3].sum(axis=1)
    assert (np.diff(brightness) < 0).all()
    assert brightness[[0, 3]] == pytest.approx([3, 0])
    assert rut_colours(ruts_m).dtype == np.uint8


@pytest.mark.parametrize("outcome", ["", "immobilised"])
def test_a_footprint_replaces_the_arrowhead_but_no_outcome(outcome: str) -> None:
    track = np.array([[2.0, 2.0], POSE[:2]])
    drive = Drive(
        track=track,
        goal_m=np.array([20.0, 20.0]),
        outcome=outcome,
        heading_rad=POSE[2],
        contacts_m=CONTACTS,
    )
    axes = panel(30.0)
    draw_drive(axes, drive)
    drawn(axes)
    labels = {str(line.get_label()) for line in axes.lines}
    assert "robot" not in labels
    assert ("immobilised" in labels) == bool(outcome)
