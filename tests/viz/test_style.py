from pathlib import Path

import matplotlib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.figure import Figure

from benchnav.core.grid import outline
from benchnav.core.registry import find, names
from benchnav.viz.drives import robot_marker
from benchnav.viz.maps import hatching, layer_scale
from benchnav.viz.style import (
    _RISKS,
    BLIND,
    LINE_COLOURS,
    LINE_STYLES,
    TWO_COLUMNS_IN,
    condition_colours,
    line_style,
    planner_colours,
    planner_name,
    risk_name,
    save_twice,
    styled,
)


def test_a_planner_has_one_colour_in_whatever_company() -> None:
    alone, others = (
        planner_colours(["mppi"]),
        planner_colours(["own", "cl_rrt", "mppi", "straight"]),
    )
    assert alone["mppi"] == others["mppi"]
    assert len(set(others.values())) == 4
    assert others["straight"] == BLIND
    shipped = planner_colours(
        [name for name in names("planner") if find("planner", name).shipped]
    )
    assert len(set(shipped.values())) == len(shipped)


@pytest.mark.parametrize(
    ("planner", "name"),
    [
        ("astar_dwa", "A*+DWA"),
        ("cl_rrt expansions=64", "CL-RRT expansions=64"),
        ("mppi:9", "MPPI:9"),
        ("mine", "mine"),
    ],
)
def test_a_planner_is_called_by_its_name_with_its_options(
    planner: str, name: str
) -> None:
    assert planner_name(planner) == name


def test_conditions_have_their_planners_colours_where_these_tell_them_apart() -> None:
    planners = ["mppi", "straight", "own"]
    own = planner_colours(planners)
    assert condition_colours(planners) == [own[planner] for planner in planners]
    assert condition_colours(["mppi"] * 3) == list(LINE_COLOURS[:3])
    assert condition_colours(["mppi", "straight", "mppi"]) == [
        LINE_COLOURS[0],
        BLIND,
        LINE_COLOURS[1],
    ]


def test_lines_that_are_drawn_together_differ_in_style() -> None:
    assert len({repr(line_style(place)) for place in range(len(LINE_STYLES))}) == len(
        LINE_STYLES
    )
    assert line_style(0) == line_style(len(LINE_STYLES)) == "-"


def test_the_robots_mark_turns_and_keeps_its_size() -> None:
    east, north = (robot_marker(heading) for heading in (0.0, np.pi / 2))
    tips = [
        turned.get_transform().transform(turned.get_path().vertices[0])
        for turned in (east, north)
    ]
    np.testing.assert_allclose(tips[0][::-1], tips[1], atol=1e-9)


@pytest.mark.parametrize("trim", [False, True])
def test_a_mark_stands_in_a_strip_over_a_figure_that_stays_as_it_is(
    tmp_path: Path, trim: bool
) -> None:
    drawn = []
    for mark in ("", "Partial: 3 of 6 units"):
        with styled():
            figure = Figure(figsize=(3, 2), layout="constrained")
            figure.subplots().plot([0, 1], [0, 1])
            figure.suptitle("title")
        save_twice(figure, tmp_path / "one.png", dpi=100, trim=trim, mark=mark)
        drawn.append(matplotlib.image.imread(tmp_path / "one.png")[..., :3])
    plain, marked = drawn
    strip = len(marked) - len(plain)
    assert 10 <= strip <= 25
    assert (marked[:strip] < 0.9).any()
    if not trim:
        np.testing.assert_array_equal(marked[strip:], plain)
    same = marked[-len(plain) :, -plain.shape[1] :]
    assert (same < 0.9).sum() == pytest.approx((plain < 0.9).sum(), rel=0.05)


@pytest.mark.usefixtures("whole_fonts")
def test_a_figure_is_written_whole_as_png_and_pdf_at_its_width(tmp_path: Path) -> None:
    path, settings = tmp_path / "new" / "one.png", dict(matplotlib.rcParams)
    with styled():
        figure = Figure(figsize=(TWO_COLUMNS_IN, 2), layout="constrained")
        figure.subplots().set_title("title")
    save_twice(figure, path, dpi=100)
    assert matplotlib.image.imread(path).shape[1] == int(TWO_COLUMNS_IN * 100)
    assert {one.name for one in path.parent.iterdir()} == {"one.png", "one.pdf"}
    assert b"/Type3" not in path.with_suffix(".pdf").read_bytes()
    assert dict(matplotlib.rcParams) == settings


REGIONS = arrays(bool, st.tuples(st.integers(1, 7), st.integers(1, 9)))


def cells_beside(
    region: np.ndarray, edge: np.ndarray, resolution_m: float
) -> list[bool]:
    """Whether the cells on the two sides of an edge are of a region; off the map none
    is.
    """
    middle, along = edge.mean(axis=0) / resolution_m, (edge[1] - edge[0]) / resolution_m
    across = 0.5 * along[::-1]
    found = []
    for column, row in (middle - across, middle + across):
        inside = 0 <= row < region.shape[0] and 0 <= column < region.shape[1]
        found.append(bool(inside and region[int(row), int(column)]))
    return found


@given(region=REGIONS, resolution_m=st.sampled_from([0.25, 0.5, 1.0]))
def test_an_outline_is_every_edge_between_what_is_in_a_region_and_what_is_not(
    region: np.ndarray, resolution_m: float
) -> None:
    edges = outline(region, resolution_m)
    np.testing.assert_allclose(
        np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1), resolution_m
    )
    for edge in edges:
        assert sorted(cells_beside(region, edge, resolution_m)) == [False, True]
    # Each cell has four sides, and two cells of the region share what is between them.
    shared = (region[1:] & region[:-1]).sum() + (region[:, 1:] & region[:, :-1]).sum()
    assert len(np.unique(edges, axis=0)) == len(edges) == 4 * region.sum() - 2 * shared


@given(region=REGIONS, resolution_m=st.sampled_from([0.25, 0.5, 1.0]))
def test_hatching_lies_in_its_region_alone(
    region: np.ndarray, resolution_m: float
) -> None:
    lines = hatching(region, resolution_m)
    column, row = np.floor(lines.mean(axis=1) / resolution_m).astype(int).T
    assert region[row, column].all()
    np.testing.assert_allclose(lines[:, 1] - lines[:, 0], resolution_m)


def test_hatching_goes_through_all_of_a_region_without_breaks() -> None:
    lines = hatching(np.ones((9, 12), bool), 1.0)
    column, row = lines[:, 0].astype(int).T
    for line in range(9):
        np.testing.assert_array_equal(np.diff(np.sort(column[row == line])), 4)
        assert (row == line).sum() == 3
    starts = {tuple(point) for point in lines[:, 0]}
    assert all(
        tuple(end) in starts for end in lines[:, 1] if end[0] < 12 and end[1] < 9
    )


@pytest.mark.parametrize(
    ("values", "low", "high"),
    [
        ([0.5, 2.0], 0.0, 2.0),
        ([-3.0, 2.0], -3.0, 2.0),
        ([-3.0, -2.0], -3.0, 0.0),
        ([0.0, np.nan], 0.0, 1.0),
        ([np.nan], 0, 1),
    ],
)
def test_a_layer_is_coloured_from_zero_to_its_greatest_value(
    values: list[float], low: float, high: float
) -> None:
    scale = layer_scale("moss", np.array(values))
    assert (scale["vmin"], scale["vmax"]) == (low, high)


def test_a_layer_of_directions_ends_in_the_colour_that_it_begins_with() -> None:
    scale = layer_scale("rows_azimuth_deg", np.array([10.0, 20.0]))
    assert (scale["vmin"], scale["vmax"]) == (0.0, 360.0)
    np.testing.assert_allclose(scale["cmap"](0.0), scale["cmap"](1.0), atol=0.02)


@pytest.mark.parametrize(
    ("label", "name"),
    [
        ("mean", "mean"), ("cvar", "CVaR"), ("cvar:0.95", "CVaR₀.₉₅"), ("var:0.9", "VaR₀.₉"),
        ("expected-time", "expected time"), ("expected-time:0.05", "expected time (floor 0.05)"),
        ("time-cvar", "time CVaR"), ("time-cvar:0.8", "time CVaR₀.₈"),
        ("chance:0.1", "P(λ ≥ 0.1)"), ("single-class", "single class"), ("single-class:0", "single-class CVaR₀"),
        ("entropic:5", "entropic:5"), ("cautious", "cautious"), ("cvar:x", "cvar:x"), ("–", "–"),
    ],
)  # fmt: skip
def test_risk_settings_are_named_as_papers_do_and_own_ones_stay(
    label: str, name: str
) -> None:
    assert risk_name(label) == name


def test_every_shipped_risk_measure_has_a_name_for_readers() -> None:
    assert set(_RISKS) == {name for name in names("risk") if find("risk", name).shipped}
