from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from benchnav.eval.report.figures import save
from benchnav.eval.report.recording import take_snapshot
from benchnav.eval.report.snapshot import Snapshot
from benchnav.eval.report.trajectories import MOST_PANELS, choose, trajectory_figure
from tests.eval.report import made


def snapshot(trial: str = "t", instance: int = 0, seed: int = 0, **labels: str) -> Snapshot:
    about = made.trial(**labels) | {"trial": trial, "instance": str(instance), "seed": str(seed)}
    return take_snapshot(made.recording(about=about | {"realisation": "0", "outcome": "out_of_bounds"}))


def chosen(snapshots: list[Snapshot], trials: list[str]) -> list[tuple[str, str]]:
    return [(s.about["trial"], s.about["instance"]) for s in choose(snapshots, trials)]


def test_one_a_trial_on_one_map_in_the_tables_order() -> None:
    every = [snapshot("b", 10), snapshot("b", 9), snapshot("a", 9), snapshot("a", 10), snapshot("c", 3)]
    assert chosen(every, ["c", "b", "a"]) == [("c", "3"), ("b", "9"), ("a", "9")]
    assert chosen(every, ["a", "b"]) == [("a", "9"), ("b", "9")]
    mixed = [snapshot("a", 2), snapshot("b", 1), snapshot("b", 2)]
    assert chosen(mixed, ["a", "b"]) == [("a", "2"), ("b", "2")]
    assert chosen([], ["a"]) == []


def test_no_more_than_can_be_seen() -> None:
    trials = [f"t{k}" for k in range(12)]
    assert len(chosen([snapshot(trial) for trial in trials], trials)) == MOST_PANELS


def shown(figure: Figure) -> list:  # type: ignore[type-arg]
    return [axes for axes in figure.axes if axes.get_visible() and axes.get_images()]


@pytest.mark.parametrize("count", [1, 3, 6])
def test_every_snapshot_has_two_panels_of_its_map(count: int) -> None:
    figure = trajectory_figure([snapshot()] * count)
    assert len(shown(figure)) == 2 * count
    for axes in shown(figure):
        assert (axes.get_xlim(), axes.get_ylim()) == ((0, 30), (0, 20))
    figure.draw_without_rendering()
    boxes = [axes.get_window_extent() for axes in shown(figure)]
    assert all(box.width > 200 and box.height > 130 for box in boxes)


def test_what_is_drawn_is_what_was_planned_and_driven_by_then() -> None:
    taken = snapshot()
    above, below = shown(trajectory_figure([taken]))
    assert above.get_title() == "MPPI, cvar, std 0\nt = 15 s; outcome: out of bounds"
    for panel in (above, below):
        lines = [path.vertices for layer in panel.collections for path in layer.get_paths()]
        for layer in taken.plan.lines.values():
            for line in layer:
                assert any(np.array_equal(line, drawn) for drawn in lines)
        met = next(layer for layer in panel.collections if layer.get_array() is not None)
        np.testing.assert_array_equal(met.get_array(), taken.traversability[:150])
        np.testing.assert_array_equal(met.get_paths()[-1].vertices, taken.track[149:151])
    np.testing.assert_array_equal(below.get_images()[0].get_array(), taken.predicted)
    closed = below.get_images()[1].get_array()
    np.testing.assert_array_equal(np.isfinite(np.ma.filled(closed, np.nan)), ~taken.free)


def test_the_legend_names_layers_that_are_there() -> None:
    (legend,) = trajectory_figure([snapshot()]).legends
    names = [text.get_text() for text in legend.get_texts()]
    assert names == ["start", "goal", "robot", "not free", "samples", "reference path", "planned"]


def test_an_episode_that_ended_at_once_can_be_drawn(tmp_path: Path) -> None:
    save(trajectory_figure([take_snapshot(made.recording(0, plans=()))]), tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 1000
