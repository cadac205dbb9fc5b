from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from benchnav.core.grid import outline
from benchnav.eval.figures.data import choose_recordings
from benchnav.eval.figures.moment import known_colours
from benchnav.eval.figures.trajectories import draw_trajectories
from benchnav.eval.recording import Recording
from benchnav.viz.drives import MARKS, robot_marker
from benchnav.viz.maps import CLOSED, field_colours, hatching
from benchnav.viz.style import TWO_COLUMNS_IN, bytes_of, save_twice
from tests.eval.report import made


def recording(
    condition: str = "t", map_index: int = 0, seed: int = 0, **labels: str
) -> Recording:
    about = made.condition(**labels) | {
        "condition": condition,
        "map": str(map_index),
        "seed": str(seed),
    }
    return made.recording(
        about=about | {"realisation": "0", "outcome": "out_of_bounds"}
    )


def chosen(recordings: list[Recording], conditions: list[str]) -> list[tuple[str, str]]:
    return [
        (s.about["condition"], s.about["map"])
        for s in choose_recordings(recordings, conditions)
    ]


def test_one_a_condition_on_one_map_in_the_tables_order() -> None:
    every = [
        recording("b", 10),
        recording("b", 9),
        recording("a", 9),
        recording("a", 10),
        recording("c", 3),
    ]
    assert chosen(every, ["c", "b", "a"]) == [("c", "3"), ("b", "9"), ("a", "9")]
    assert chosen(every, ["a", "b"]) == [("a", "9"), ("b", "9")]
    mixed = [recording("a", 2), recording("b", 1), recording("b", 2)]
    assert chosen(mixed, ["a", "b"]) == [("a", "2"), ("b", "2")]
    assert chosen([], ["a"]) == []


def test_the_first_map_on_which_outcomes_differ_goes_before_one_on_which_they_do_not() -> (
    None
):
    def ended(condition: str, map_index: int, outcome: str) -> Recording:
        made = recording(condition, map_index)
        return replace(made, about={**made.about, "outcome": outcome})

    outcomes = {
        ("a", 1): "success",
        ("b", 1): "success",
        ("a", 2): "success",
        ("b", 2): "immobilised",
    }
    every = [ended(*place, outcome) for place, outcome in outcomes.items()]
    every += [
        ended("a", 3, "success"),
        ended("b", 3, "stuck"),
        ended("b", 0, "stuck"),
        ended("c", 0, "success"),
    ]
    assert chosen(every, ["a", "b", "c"]) == [("a", "2"), ("b", "2"), ("c", "0")]
    alike = [ended(name, 1, "success") for name in "ab"] + [
        ended(name, 2, "stuck") for name in "ab"
    ]
    assert chosen(alike, ["a", "b"]) == [("a", "2"), ("b", "2")]
    assert chosen(alike[:2], ["a", "b"]) == [("a", "1"), ("b", "1")]


def shown(figure: Figure) -> list:  # type: ignore[type-arg]
    return [axes for axes in figure.axes if axes.get_visible() and axes.get_images()]


SOFT_WORDS = "soft terrain, which no image shows"


@pytest.mark.parametrize("count", [1, 3, 6])
def test_every_episode_has_two_panels_of_its_map(count: int) -> None:
    figure = draw_trajectories([recording()] * count)
    assert len(shown(figure)) == 2 * count
    for axes in shown(figure):
        assert (axes.get_xlim(), axes.get_ylim()) == ((0, 30), (0, 20))
    figure.draw_without_rendering()
    boxes = [axes.get_window_extent() for axes in shown(figure)]
    assert all(box.width > 180 and box.height > 120 for box in boxes)
    assert figure.get_figwidth() <= TWO_COLUMNS_IN
    columns = {axes.get_subplotspec().colspan.start for axes in shown(figure)}
    assert columns == set(range(min(count, 3))), "a column is empty"


def test_what_is_drawn_is_what_was_planned_and_driven_by_then() -> None:
    taken = recording()
    above, below = shown(draw_trajectories([taken]))
    now = taken.now
    assert (
        above.get_title().replace("\N{NO-BREAK SPACE}", " ")
        == f"MPPI, CVaR\nt = {now / 10:g} s; out of bounds after {taken.end_s:g} s"
    )
    for panel in (above, below):
        lines = [
            path.vertices for layer in panel.collections for path in layer.get_paths()
        ]
        for layer in taken.plan.lines.values():
            for line in layer:
                assert any(np.array_equal(line, drawn) for drawn in lines)
    (met,) = (layer for layer in above.collections if layer.get_array() is not None)
    np.testing.assert_array_equal(met.get_array(), taken.traversability[:now])
    np.testing.assert_array_equal(
        met.get_paths()[-1].vertices, taken.track[now - 1 : now + 1]
    )
    # On the map of λ̂ in black, since it has the colours of λ.
    black = [
        line
        for line in below.lines
        if line.get_color() == "black" and len(line.get_xdata()) > 1
    ]
    np.testing.assert_array_equal(
        np.stack(black[0].get_data(), axis=1), taken.track[: now + 1]
    )
    (shown_map,) = below.get_images()
    np.testing.assert_array_equal(
        shown_map.get_array(), known_colours(taken, now)["risk"]
    )
    closed = (np.asarray(shown_map.get_array()) == bytes_of(CLOSED)[:3]).all(axis=-1)
    np.testing.assert_array_equal(closed, ~taken.free)


def held(world: str = "stakes", **changes: Any) -> Recording:
    recording = made.held_recording(170)
    changes = {"about": recording.about | {"world": world}} | changes
    return replace(recording, **changes)


def test_λ_as_it_was_has_a_third_panel_with_the_whole_path_and_where_it_ended() -> None:
    taken = held()
    above, below, last = shown(draw_trajectories([taken]))
    assert taken.field is not None
    (drawn,) = (image.get_array() for image in last.get_images())
    np.testing.assert_array_equal(drawn, field_colours(taken.field, taken.immobilising))
    assert last.get_images()[0].origin == "lower"
    paths = [line for line in last.lines if len(line.get_xdata()) > 1]
    assert paths
    for line in paths:
        np.testing.assert_array_equal(np.stack(line.get_data(), axis=1), taken.track)
    marks = {
        line.get_marker(): line for line in last.lines if line.get_marker() != "None"
    }
    assert marks.keys() == {
        MARKS[name]["marker"] for name in ("start", "goal", "immobilised")
    }
    for name, place in (("start", taken.track[0]), ("goal", taken.goal_m)):
        np.testing.assert_array_equal(
            np.ravel(marks[MARKS[name]["marker"]].get_data()), place
        )
    end = marks[MARKS["immobilised"]["marker"]]
    np.testing.assert_array_equal(np.ravel(end.get_data()), taken.track[-1])
    assert last.get_title() == "complete path over the λ field"
    # Where it was by the moment of the plan is told by the panels above, and where it
    # headed.
    heading = robot_marker(taken.states[taken.now, 2]).get_transform()
    for panel in (above, below):
        (robot,) = [line for line in panel.lines if line.get_label() == "robot"]
        np.testing.assert_array_equal(
            np.ravel(robot.get_data()), taken.track[taken.now]
        )
        np.testing.assert_allclose(
            robot._marker.get_transform().get_matrix(), heading.get_matrix()
        )
        assert not [
            line
            for line in panel.lines
            if (line.get_marker(), line.get_color()) == ("X", "black")
        ]
        assert max(len(line.get_xdata()) for line in panel.lines) == taken.now + 1 < 170


def test_soft_ground_is_marked_on_the_terrain_alone() -> None:
    taken = held()
    above, below, last = shown(draw_trajectories([taken]))
    drawn = [
        {path.vertices.tobytes() for c in p.collections for path in c.get_paths()}
        for p in (above, below, last)
    ]
    for lines in (outline, hatching):
        wanted = {line.astype(float).tobytes() for line in lines(taken.soft, 0.5)}
        assert wanted <= drawn[0]
        assert not wanted & (drawn[1] | drawn[2])


def test_only_panels_whose_λ_stayed_have_a_third() -> None:
    figure = draw_trajectories([recording(), held(), recording(), recording(), held()])
    titles = [axes.get_title() for axes in shown(figure)]
    assert len(titles) == 5 * 2 + 2
    assert sum("λ field" in title for title in titles) == 2
    figure.draw_without_rendering()
    columns = [
        axes.get_subplotspec().colspan.start
        for axes in shown(figure)
        if "λ field" in axes.get_title()
    ]
    assert columns == [1, 1]


def test_titles_tell_models_and_worlds_apart_where_they_differ() -> None:
    def titles(*labels: dict[str, str]) -> list[str]:
        figure = draw_trajectories([recording(**one) for one in labels])
        return [
            axes.get_title().split("\n")[0]
            for axes in shown(figure)
            if " after " in axes.get_title()
        ]

    blind = {"planner": "straight", "model": "–", "risk": "–"}
    assert titles({}, blind) == ["MPPI, CVaR", "straight"]
    told = {"model": "clairvoyant", "risk": "–"}
    assert titles(told) == ["MPPI, clairvoyant"]
    assert titles({"model": "oracle"}, told) == [
        "MPPI, oracle, CVaR",
        "MPPI, clairvoyant",
    ]
    assert titles({}, {"world": "stakes"}) == [
        "MPPI, paper, CVaR",
        "MPPI, stakes, CVaR",
    ]


def test_without_a_recorded_plan_the_whole_path_is_shown_and_how_it_ended() -> None:
    taken = replace(held(), plans=())
    above, below, _ = shown(figure := draw_trajectories([taken]))
    assert above.get_title() == "MPPI, CVaR\nimmobilised after 17\N{NO-BREAK SPACE}s"
    (driven,) = [layer for layer in above.collections if layer.get_array() is not None]
    np.testing.assert_array_equal(driven.get_array(), taken.traversability)
    assert max(len(line.get_xdata()) for line in below.lines) == 171
    for panel in (above, below):
        assert MARKS["immobilised"]["marker"] in [
            line.get_marker() for line in panel.lines
        ]
    names = names_in_legend(figure)
    assert "immobilised" in names
    assert not {"robot", "planned", "samples", "tree", "reference path"} & set(names)


def names_in_legend(figure: Figure) -> list[str]:
    (legend,) = figure.legends
    return [text.get_text() for text in legend.get_texts()]


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({}, [SOFT_WORDS, "not free", "immobilised", "immobilises a robot"]),
        (
            {"soft": np.zeros((40, 60), bool)},
            ["not free", "immobilised", "immobilises a robot"],
        ),
        (
            {"immobilising": np.zeros((40, 60), bool)},
            [SOFT_WORDS, "not free", "immobilised"],
        ),
    ],
)
def test_the_legend_names_what_the_ground_has(
    changes: dict[str, Any], names: list[str]
) -> None:
    ground = (SOFT_WORDS, "not free", "immobilised", "immobilises a robot")
    shown = names_in_legend(draw_trajectories([held(**changes)]))
    assert {name for name in shown if name in ground} == set(names)


def test_the_legend_names_layers_that_are_there() -> None:
    names = names_in_legend(draw_trajectories([recording()]))
    below = ["not free", "driven path; in the top row, its colour is the observed λ"]
    assert set(names) == {
        "samples",
        "reference path",
        "planned",
        "start",
        "goal",
        "robot",
        *below,
    }
    taken = recording()
    everywhere = replace(taken, free=np.ones_like(taken.free))
    assert "not free" not in names_in_legend(draw_trajectories([everywhere]))


def test_whose_map_of_λ_it_is_stands_above_it() -> None:
    blind = {"planner": "straight", "model": "–", "risk": "–"}
    learns = recording(belief="copula", ground="probe:1")
    *_, given, none, first = shown(
        draw_trajectories([recording(), recording(**blind), learns])
    )
    assert given.get_title() == "λ̂ given to the planner"
    assert none.get_title() == "true E[λ]; the planner uses no map"
    assert first.get_title() == "λ̂ at the start"


def test_an_episode_that_ended_at_once_can_be_drawn(tmp_path: Path) -> None:
    save_twice(draw_trajectories([made.recording(0, plans=())]), tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 1000


def test_λ_hat_of_a_robot_that_learns_is_that_known_at_the_moment() -> None:
    taken = made.learning_recording(170)
    known = taken.known_at(taken.now)
    assert known is not None
    assert 0 < known.step < 170
    _, below, _ = shown(draw_trajectories([taken]))
    np.testing.assert_array_equal(
        below.get_images()[0].get_array(), known_colours(taken, taken.now)["risk"]
    )
    assert below.get_title() == "λ̂ of the belief at that time"
