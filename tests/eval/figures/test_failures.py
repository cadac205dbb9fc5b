import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from benchnav.eval.failures import FailedLine, Sheets, choose_failures
from benchnav.eval.figures.failures import Failures
from tests.eval.report import made

GENERATOR = np.random.default_rng(0)


def failures(outcomes: list[str], **changes: Any) -> pd.DataFrame:
    count = len(outcomes)
    columns = {
        "scenario": "hg", "map": range(count), "outcome": outcomes, "end_time_s": 20.0 + np.arange(count),
        "x_m": 1.0 + np.arange(count), "y_m": 2.0, "last_traversability": 0.05,
    }  # fmt: skip
    return pd.DataFrame(columns | changes)


def shown(rows: pd.DataFrame, **changes: Any) -> FailedLine:
    ground: dict[str, Any] = {
        "resolution_m": 0.5, "goal_m": np.full(2, 3.0), "immobilising": np.zeros((8, 12), bool),
        "predicted": np.zeros((8, 12)),
    } | changes  # fmt: skip
    recordings = [
        replace(
            made.recording(1, about={**made.condition(), "outcome": outcome}),
            states=np.array([[0.5, 0.5, 0.0], [x, y, 0.0]], float),
            **ground | {"predicted": ground["predicted"] + GENERATOR.random((8, 12))},
        )
        for x, y, outcome in rows[["x_m", "y_m", "outcome"]].to_numpy()
    ]
    return FailedLine(name="MPPI, mean", failures=rows, recordings=recordings, total=9)


def draw_failures(lines: list[FailedLine]) -> Figure:
    sheets = Sheets(shown=(("std", lines),), predicted={}, left_out="")
    return Failures().draw(made.run_data(sheets=sheets))


def test_each_outcome_is_shown_before_any_twice() -> None:
    rows = failures(["immobilised"] * 5 + ["stuck", "timeout", "timeout"])
    assert list(choose_failures(rows)["outcome"]) == [
        "immobilised",
        "timeout",
        "stuck",
        "immobilised",
    ]
    assert list(choose_failures(failures(["stuck"] * 6))["map"]) == [0, 1, 2, 3]
    assert choose_failures(failures(["stuck"], x_m=np.nan)).empty


def test_panels_say_where_when_and_why() -> None:
    rows = failures(
        ["immobilised", "out_of_bounds"],
        x_m=[1.2, 6.5],
        last_traversability=[0.04, np.nan],
    )
    line = shown(rows)
    figure = draw_failures([line])
    panels = [
        panel for panel in figure.axes if panel.get_visible() and panel.get_title()
    ]
    told = line.recordings[0].predicted[4, 2]
    titles = [
        " ".join(panel.get_title().replace("\N{NO-BREAK SPACE}", " ").split())
        for panel in panels
    ]
    assert titles == [
        f"hg, map 0: immobilised, 20 s λ̂ = {told:.2f}, observed λ = 0.04",
        "hg, map 1: out of bounds, 21 s outside the map",
    ]
    assert panels[0].get_ylabel() == "MPPI, mean\n(2 of 9 failures)"
    for panel, place in zip(panels, range(2), strict=True):
        np.testing.assert_array_equal(
            panel.images[0].get_array(), line.recordings[place].predicted
        )
        marked = [mark for mark in panel.lines if mark.get_marker() != "None"]
        marks = {mark.get_marker(): mark.get_xydata()[0].tolist() for mark in marked}
        assert marks[("X", "s")[place]] == rows.loc[place, ["x_m", "y_m"]].tolist()
        assert marks["*"] == [3, 3]
        assert marks["o"] == [0.5, 0.5]
    assert figure.get_figwidth() * 25.4 == pytest.approx(88)
    wide = draw_failures([line, shown(failures(["stuck"] * 3))])
    assert wide.get_figwidth() * 25.4 == pytest.approx(180)


def test_ground_that_immobilises_a_robot_is_drawn_and_named_where_there_is_such() -> (
    None
):
    rows = failures(["immobilised"])
    immobilising = np.zeros((8, 12), bool)
    immobilising[3, 4] = True
    figure = draw_failures([shown(rows, immobilising=immobilising)])
    drawn = np.ma.getmaskarray(figure.axes[0].images[1].get_array())
    assert (~drawn).tolist() == immobilising.tolist()
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["immobilises a robot", "driven", "start", "goal", "immobilised"]
    plain = draw_failures([shown(rows)])
    assert "immobilises a robot" not in [
        text.get_text() for text in plain.legends[0].get_texts()
    ]


def test_titles_of_neighbours_do_not_overlap() -> None:
    rows = failures(["planner_failure"] * 4, scenario="hg-050", map=range(996, 1000))
    for count in (2, 4):
        figure = draw_failures([shown(rows[:count])])
        figure.draw_without_rendering()
        titles = [
            panel.title.get_window_extent()
            for panel in figure.axes
            if panel.get_visible() and panel.get_title()
        ]
        assert len(titles) == count
        assert all(left.x1 < right.x0 for left, right in itertools.pairwise(titles))
