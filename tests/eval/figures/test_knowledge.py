"""Figures of robots that learn: what is drawn is what was known then, and what the
steps of a run tell.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchnav.core.grid import outline
from benchnav.eval.figures.knowledge import draw_knowledge
from benchnav.eval.figures.learning import METRICS, Learning, read_learning
from benchnav.eval.figures.moment import known_colours
from benchnav.eval.folder.sealed import read_sealed
from benchnav.eval.recording import Recording
from benchnav.eval.report import write
from benchnav.stats.bootstrap import LEAST_MAPS
from benchnav.viz.drives import MARKS, robot_marker
from benchnav.viz.maps import hatching
from benchnav.viz.style import TWO_COLUMNS_IN
from tests.eval.forged import forge_steps
from tests.eval.report import made
from tests.eval.report.test_write import run_folder


def moments(figure: Figure) -> list[tuple[Axes, Axes]]:
    """The panels of each moment: mean above, spread below."""
    panels = [axes for axes in figure.axes if axes.get_images()]
    half = len(panels) // 2
    return list(zip(panels[:half], panels[half:], strict=True))


def lines_of(panel: Axes) -> list[set[bytes]]:
    """The lines of each layer of a panel."""
    return [
        {np.asarray(line, np.float64).tobytes() for line in layer.get_segments()}
        for layer in panel.collections
    ]


def as_lines(lines: Any) -> set[bytes]:
    return {np.asarray(line, np.float64).tobytes() for line in lines}


def names_in_legend(figure: Figure) -> list[str]:
    (legend,) = figure.legends
    return [text.get_text() for text in legend.get_texts()]


def test_four_moments_from_start_to_end_show_what_was_known_by_then() -> None:
    recording = made.learning_recording(100)
    figure = draw_knowledge(recording)
    assert figure.get_figwidth() == TWO_COLUMNS_IN
    shown = moments(figure)
    for step, panels in zip((0, 33, 67, 100), shown, strict=True):
        known = recording.known_at(step)
        assert known is not None
        assert known.step in (0, 30, 65, 100)
        for panel, name in zip(panels, ("mean", "spread"), strict=True):
            np.testing.assert_array_equal(
                panel.get_images()[0].get_array(), known_colours(recording, step)[name]
            )
            assert lines_of(panel) == [
                as_lines(hatching(~known.seen, 0.5)),
                as_lines(outline(known.sensed, 0.5)),
            ]
            (reach,) = [
                line
                for line in panel.lines
                if line.get_label() == "footprint of the sensors"
            ]
            np.testing.assert_array_equal(np.transpose(reach.get_data()), known.outline)
            (driven,) = [line for line in panel.lines if line.get_label() == "driven"]
            np.testing.assert_array_equal(
                np.transpose(driven.get_data()), recording.track[: step + 1]
            )
            assert (panel.get_xlim(), panel.get_ylim()) == ((0, 30), (0, 20))
    assert [above.get_title() for above, _ in shown] == [
        "t = 0.0 s", "t = 3.3 s", "t = 6.7 s", "t = 10.0 s\nimmobilised"
    ]  # fmt: skip


def test_the_robot_stands_where_it_was_and_its_end_is_marked() -> None:
    recording = made.learning_recording(100)
    *before, last = moments(draw_knowledge(recording))
    for step, panels in zip((0, 33, 67), before, strict=True):
        heading = robot_marker(recording.states[step, 2]).get_transform().get_matrix()
        for panel in panels:
            (robot,) = [line for line in panel.lines if line.get_label() == "robot"]
            np.testing.assert_array_equal(
                np.ravel(robot.get_data()), recording.track[step]
            )
            np.testing.assert_allclose(
                robot._marker.get_transform().get_matrix(), heading
            )  # type: ignore[attr-defined]
            assert "immobilised" not in [line.get_label() for line in panel.lines]
    for panel in last:
        labels = {line.get_label(): line for line in panel.lines}
        assert "robot" not in labels
        assert labels["immobilised"].get_marker() == MARKS["immobilised"]["marker"]
        np.testing.assert_array_equal(
            np.ravel(labels["goal"].get_data()), recording.goal_m
        )
        np.testing.assert_array_equal(
            np.ravel(labels["start"].get_data()), recording.track[0]
        )


def test_the_legend_names_what_there_is_alone() -> None:
    recording = made.learning_recording(100)
    ground = [
        "edge of cells with measured λ",
        "not observed",
        "footprint of the sensors",
    ]
    names = names_in_legend(draw_knowledge(recording))
    assert set(names) == {"driven", "start", "goal", "robot", "immobilised", *ground}
    bare: list[Any] = [
        {"sensed": np.zeros((40, 60), bool)}, {"seen": np.ones((40, 60), bool)}, {"outline": np.empty((0, 2))}
    ]  # fmt: skip
    for changes, left_out in zip(bare, ground, strict=True):
        known = tuple(replace(each, **changes) for each in recording.known)
        found = names_in_legend(draw_knowledge(replace(recording, known=known)))
        assert found == [name for name in names if name != left_out]


def test_an_episode_that_ended_at_once_has_one_moment() -> None:
    (panels,) = moments(draw_knowledge(made.learning_recording(0)))
    assert panels[0].get_title() == "t = 0.0 s\nimmobilised"


MAPS, RISK = 9, "expected-time"


def draw_learning(curves: pd.DataFrame, summary: pd.DataFrame) -> Figure:
    return Learning().variant(curves=curves).draw(made.run_data(summary))


def learners() -> pd.DataFrame:
    """Rows of two conditions that learn, and of one that does not, on nine maps, two of
    which are one group.
    """
    return made.rows(
        made.row(made.condition(planner), place, group=min(place, MAPS - 2))
        for planner in ("astar_dwa", "astar_mppi", "mppi")
        for place in range(MAPS)
    )


def write_steps(folder: Path, rows: pd.DataFrame, seconds: float = 6.0) -> None:
    """Steps each 0.5 s of 1 s: RMSE is 0.1 × map + time, log score its negative; NaN
    for who does not learn.
    """
    time_s = np.arange(0, seconds, 0.5)
    for (condition, place), own in rows.groupby(["condition", "map"]):
        # The first map's episode ends early, and a step without an evaluation lies
        # between any two.
        told = np.where(np.arange(len(time_s)) % 2 == 0, 0.1 * place + time_s, np.nan)  # type: ignore[operator]
        told = np.where(own["planner"].iloc[0] == "mppi", np.nan, told)
        table = pd.DataFrame(
            {
                "seed": 0,
                "realisation": 0,
                "map": place,
                "step": range(len(time_s)),
                "time_s": time_s,
            }
        )
        numbers = {
            name: told.astype(np.float32)
            for name in ("x_m", "y_m", "traversability", "ahead_rmse")
        }
        table = table.assign(**numbers, ahead_log_score=-numbers["ahead_rmse"])
        table = table.head(4 if place == 0 else len(table))
        path = folder / "steps" / f"condition={condition}" / f"0-0-{place}.parquet"
        forge_steps(path, table)


def test_curves_are_means_over_maps_of_those_that_still_drive(tmp_path: Path) -> None:
    rows = learners()
    folder = run_folder(tmp_path / "run", rows)
    write_steps(folder, rows)
    curves = read_learning(folder, rows)
    conditions = rows["condition"].unique()
    assert set(curves["condition"]) == set(conditions[:2])
    own = curves[curves["condition"] == conditions[0]]
    # Of eight groups seven are left when the first has ended, which are too few.
    assert own["time_s"].tolist() == [1.0]
    assert own["maps"].tolist() == [LEAST_MAPS]
    # Evaluated at 0 and 1 s; the maps of a group count once.
    by_map = [0.1 * place + 0.5 for place in range(MAPS - 2)] + [
        0.1 * (MAPS - 1.5) + 0.5
    ]
    assert own["ahead_rmse"].iloc[0] == pytest.approx(np.mean(by_map), abs=1e-6)
    for name, sign in (("ahead_rmse", 1), ("ahead_log_score", -1)):
        middle, low, high = own[[name, f"{name}_low", f"{name}_high"]].iloc[0]
        assert middle == pytest.approx(sign * np.mean(by_map), abs=1e-6)
        # Standard error of eight maps, about twice to either side.
        error = np.std(by_map, ddof=1) / np.sqrt(len(by_map))
        assert low < middle - 1.4 * error < middle + 1.4 * error < high
        assert high - low < 5 * error


def test_without_steps_of_learning_there_are_no_curves(tmp_path: Path) -> None:
    rows = learners()
    folder = run_folder(tmp_path / "run", rows)
    assert read_learning(folder, rows).empty
    write_steps(folder, rows[rows["planner"] == "mppi"])
    assert read_learning(folder, rows).empty
    for path in folder.glob("steps/*/*.parquet"):
        forge_steps(path, read_sealed(path).drop_columns(list(METRICS)).to_pandas())
    assert read_learning(folder, rows).empty


def curves_of(summary: pd.DataFrame) -> pd.DataFrame:
    """Curves of five points, unlike for each condition."""
    rows = []
    for place, condition in enumerate(summary["condition"]):
        for time_s in range(1, 11, 2):
            value = 0.3 - 0.01 * place - 0.001 * time_s
            rows.append(
                (
                    condition,
                    float(time_s),
                    20,
                    value,
                    value - 0.02,
                    value + 0.03,
                    -value,
                    -value - 1,
                    1 - value,
                )
            )
    ends = ("", "_low", "_high")
    columns = [
        "condition",
        "time_s",
        "maps",
        *(f"{name}{end}" for name in METRICS for end in ends),
    ]
    return pd.DataFrame(rows, columns=columns)


def conditions(**several: list[str]) -> pd.DataFrame:
    """Labels of all combinations."""
    labels = pd.DataFrame(
        [made.condition(ground="contact", belief="copula", sensor="full")]
    )
    for name, values in several.items():
        labels = labels.drop(columns=name).merge(
            pd.DataFrame({name: values}), how="cross"
        )
    return labels.assign(condition=[f"t{place}" for place in range(len(labels))])


def test_a_line_a_condition_with_its_band_named_by_what_differs() -> None:
    summary = conditions(ground=["contact", "probe radius_m=1", "probe radius_m=2"])
    curves = curves_of(summary)
    figure = draw_learning(curves, summary)
    assert names_in_legend(figure) == [
        "contact",
        "probe radius_m=1",
        "probe radius_m=2",
    ]
    looks = set()
    for panel, name in zip(figure.axes, METRICS, strict=True):
        for line, band, condition in zip(
            panel.lines, panel.collections, summary["condition"], strict=True
        ):
            own = curves[curves["condition"] == condition]
            np.testing.assert_array_equal(line.get_xdata(), own["time_s"])
            np.testing.assert_array_equal(line.get_ydata(), own[name])
            heights = band.get_paths()[0].vertices[:, 1]
            assert heights.min() == pytest.approx(own[f"{name}_low"].min())
            assert heights.max() == pytest.approx(own[f"{name}_high"].max())
            looks.add((line.get_color(), line.get_linestyle()))
        assert panel.get_title() == METRICS[name]
    assert len(looks) == 3


def test_where_lines_are_many_panels_are_split_and_lines_look_alike_in_all() -> None:
    summary = conditions(
        ground=["contact", "probe"], belief=["static", "copula"], risk=["mean", "cvar:0.8"],
        planner=["mppi", "astar_dwa"], model=["oracle", "m"],
    )  # fmt: skip
    figure = draw_learning(curves_of(summary), summary)
    panels = figure.axes
    # Eight lines of two risk settings are too many still.
    assert len(panels) == 2 * 8
    assert [len(panel.lines) for panel in panels] == [4] * 16
    names = ["contact, static", "contact, copula", "probe, static", "probe, copula"]
    assert sorted(names_in_legend(figure)) == sorted(names)
    looks = {
        line.get_label(): set[tuple[Any, Any]]()
        for panel in panels
        for line in panel.lines
    }
    for panel in panels:
        for line in panel.lines:
            looks[line.get_label()].add((line.get_color(), line.get_linestyle()))
    assert [len(look) for look in looks.values()] == [1] * 4
    titles = [
        panel.get_title().replace("\n", " ") for panel in panels if panel.get_title()
    ]
    assert len(set(titles)) == 8
    assert "MPPI, mean, oracle" in titles
    fewer = conditions(ground=["contact", "probe"], scenario=["std", "hard"])
    figure = draw_learning(curves_of(fewer), fewer)
    assert [panel.get_title() for panel in figure.axes if panel.get_title()] == [
        "std",
        "hard",
    ]
    alone = conditions()
    assert names_in_legend(draw_learning(curves_of(alone), alone)) == ["mean over maps"]


def labelled(recording: Recording, rows: pd.DataFrame, condition: str) -> Recording:
    row = rows[rows["condition"] == condition].iloc[0]
    about = {name: str(row[name]) for name in recording.about if name in row} | {
        "map": "0"
    }
    return replace(recording, about=about)


def test_a_report_holds_what_robots_knew_where_they_learnt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def touch(figure: Figure, path: Path, trim: bool, mark: str) -> None:
        path.parent.mkdir(exist_ok=True)
        for suffix in (".png", ".pdf"):
            path.with_suffix(suffix).write_bytes(bytes(30))

    monkeypatch.setattr(write, "save_twice", touch)  # pictures take time
    rows = learners()
    folder = run_folder(tmp_path / "run", rows)
    write.write_report(folder)
    text = (folder / "summary.md").read_text()
    assert "learning" not in text
    assert "knowledge" not in text
    write_steps(folder, rows)
    first, second, other = rows["condition"].unique()
    for condition in (first, second):
        labelled(made.learning_recording(30), rows, condition).save(
            folder / "playback" / f"{condition}.npz"
        )
    labelled(made.held_recording(30), rows, other).save(
        folder / "playback" / f"{other}.npz"
    )
    write.write_report(folder)
    text = (folder / "summary.md").read_text()
    for name in ("learning", "knowledge-1", "knowledge-2"):
        assert f"![{name}](figures/{name}.png)" in text
    assert "knowledge-3" not in text
    assert "in bins of 2 s" in text
    assert "during its episode (A\\*+DWA)" in text
