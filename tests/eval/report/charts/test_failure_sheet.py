from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchnav.eval.report.charts.failure_sheet import FailedGround
from benchnav.eval.report.charts.maps import failure_figure
from benchnav.eval.report.failure_choice import FailedLine, choose_failures

GENERATOR = np.random.default_rng(0)


def failures(outcomes: list[str], **changes: Any) -> pd.DataFrame:
    count = len(outcomes)
    columns = {
        "scenario": "hg", "map": range(count), "outcome": outcomes, "end_time_s": 20.0 + np.arange(count),
        "x_m": 1.0 + np.arange(count), "y_m": 2.0, "last_traversability": 0.05,
    }  # fmt: skip
    return pd.DataFrame(columns | changes)


def ground(count: int, **changes: Any) -> FailedGround:
    made = {
        "predicted": GENERATOR.random((count, 8, 12)), "immobilising": np.zeros((count, 8, 12), bool),
        "resolution_m": 0.5, "goal_m": np.full((count, 2), 3.0),
    }  # fmt: skip
    return FailedGround(**(made | changes))


def shown(rows: pd.DataFrame, **changes: Any) -> FailedLine:
    tracks = [np.array([[0.5, 0.5], [x, y]]) for x, y in rows[["x_m", "y_m"]].to_numpy()]
    made = {"name": "MPPI, mean", "failures": rows, "ground": ground(len(rows)), "tracks": tracks, "among": 9}
    return FailedLine(**(made | changes))


def test_told_is_that_of_the_cell_a_place_lies_in() -> None:
    one = ground(3)
    places = np.array([[5.9, 0.1], [0.2, 3.9], [6.1, 1.0]])
    expected = [one.predicted[0, 0, 11], one.predicted[1, 7, 0]]
    np.testing.assert_array_equal(one.told(places)[:2], expected)
    assert np.isnan(one.told(places)[2])
    assert np.isnan(one.told(np.full((3, 2), np.nan))).all()
    assert np.isnan(one.told(np.full((3, 2), -0.1))).all()


def test_each_outcome_is_shown_before_any_twice() -> None:
    rows = failures(["immobilised"] * 5 + ["stuck", "timeout", "timeout"])
    assert list(choose_failures(rows)["outcome"]) == ["immobilised", "timeout", "stuck", "immobilised"]
    assert list(choose_failures(failures(["stuck"] * 6))["map"]) == [0, 1, 2, 3]
    assert choose_failures(failures(["stuck"], x_m=np.nan)).empty


def test_panels_say_where_when_and_why() -> None:
    rows = failures(["immobilised", "out_of_bounds"], x_m=[1.2, 6.5], last_traversability=[0.04, np.nan])
    line = shown(rows)
    figure = failure_figure([line])
    panels = [panel for panel in figure.axes if panel.get_visible() and panel.get_title()]
    told = line.ground.predicted[0, 4, 2]
    assert [panel.get_title() for panel in panels] == [
        f"hg 0: immobilised, 20 s\nλ̂ = {told:.2f}, observed λ = 0.04",
        "hg 1: out of bounds, 21 s\noutside the map",
    ]
    assert panels[0].get_ylabel() == "MPPI, mean\n(2 of 9 failures)"
    for panel, place in zip(panels, range(2), strict=True):
        np.testing.assert_array_equal(panel.images[0].get_array(), line.ground.predicted[place])
        marked = [mark for mark in panel.lines if mark.get_marker() != "None"]
        marks = {mark.get_marker(): mark.get_xydata()[0].tolist() for mark in marked}
        assert marks["X"] == rows.loc[place, ["x_m", "y_m"]].tolist()
        assert marks["*"] == [3, 3]
        assert marks["o"] == [0.5, 0.5]
    assert figure.get_figwidth() * 25.4 == pytest.approx(88)
    wide = failure_figure([line, shown(failures(["stuck"] * 3))])
    assert wide.get_figwidth() * 25.4 == pytest.approx(180)


def test_ground_that_immobilises_a_robot_is_drawn_and_named_where_there_is_such() -> None:
    rows = failures(["immobilised"])
    immobilising = np.zeros((1, 8, 12), bool)
    immobilising[0, 3, 4] = True
    figure = failure_figure([shown(rows, ground=ground(1, immobilising=immobilising))])
    alpha = np.asarray(figure.axes[0].images[1].get_array())[..., 3]
    assert (alpha > 0).tolist() == immobilising[0].tolist()
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["driven", "start", "goal", "end", "ground that immobilises a robot"]
    plain = failure_figure([shown(rows)])
    assert "ground that immobilises a robot" not in [text.get_text() for text in plain.legends[0].get_texts()]
