from pathlib import Path

import matplotlib
import pytest
from matplotlib.figure import Figure

from benchnav.core.figures import (
    BLIND,
    LINE_COLOURS,
    MARKS,
    TWO_COLUMNS_IN,
    condition_colours,
    planner_colours,
    planner_name,
    save_twice,
    styled,
)


def test_a_planner_has_one_colour_in_whatever_company() -> None:
    alone, others = planner_colours(["mppi"]), planner_colours(["own", "cl_rrt", "mppi", "straight"])
    assert alone["mppi"] == others["mppi"]
    assert len(set(others.values())) == 4
    assert others["straight"] == BLIND
    shipped = planner_colours(["astar_dwa", "astar_mppi", "cl_rrt", "mppi", "straight"])
    assert len(set(shipped.values())) == len(shipped)


@pytest.mark.parametrize(
    ("planner", "name"),
    [
        ("astar_dwa", "A* + DWA"),
        ("cl_rrt expansions=64", "CL-RRT expansions=64"),
        ("mppi:9", "MPPI:9"),
        ("mine", "mine"),
    ],
)
def test_a_planner_is_called_by_its_name_with_its_options(planner: str, name: str) -> None:
    assert planner_name(planner) == name


def test_conditions_have_their_planners_colours_where_these_tell_them_apart() -> None:
    planners = ["mppi", "straight", "own"]
    own = planner_colours(planners)
    assert condition_colours(planners) == [own[planner] for planner in planners]
    assert condition_colours(["mppi"] * 3) == list(LINE_COLOURS[:3])
    assert condition_colours(["mppi", "straight", "mppi"]) == [LINE_COLOURS[0], BLIND, LINE_COLOURS[1]]


def test_eight_conditions_have_eight_colours() -> None:
    assert len(set(condition_colours(["mppi"] * 8))) == 8
    assert condition_colours(["mppi"] * 9)[8] == condition_colours(["mppi"] * 2)[0]


def test_marks_differ_in_shape_or_colour() -> None:
    assert len({(looks["marker"], looks["color"]) for looks in MARKS.values()}) == len(MARKS)
    assert {looks["mec"] for looks in MARKS.values()} == {"white"}


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
