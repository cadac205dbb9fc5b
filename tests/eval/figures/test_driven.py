from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from benchnav.core.errors import ConfigError
from benchnav.eval.figures.data import Driven, RunData, read_driven
from benchnav.eval.figures.driven import DrivenPaths
from benchnav.eval.recording import GROUND, RecordedMap, Recording
from benchnav.viz.drives import MARKS
from benchnav.viz.maps import IMMOBILISING
from benchnav.viz.style import planner_colours
from tests.eval.forged import forge_steps
from tests.eval.report import made
from tests.eval.report.test_write import run_folder

RISKS = ("mean", "cvar:0.5", "cvar:0.9")


def ground(**changes: Any) -> RecordedMap:
    field = np.linspace(0, 1, 40 * 60, dtype=np.float32).reshape(40, 60)
    about = {
        "data": "paper-v1",
        "scenario": "std",
        "world": "stakes",
        "seed": 0,
        "realisation": 0,
        "map": 1,
    }
    given = {
        "about": about, "resolution_m": 0.5, "rgb": np.full((3, 40, 60), 100, np.uint8), "field": field,
        "immobilising": field < 0.1, "goal_m": np.array([24.0, 15.0], np.float32),
    }  # fmt: skip
    return RecordedMap(**(given | changes))


def episodes(ended: dict[int, list[bool]]) -> pd.DataFrame:
    """Rows of three risk settings: of each map, which of them succeeded."""
    return made.rows(
        made.row(
            made.condition(risk=risk, world="stakes"),
            map_index,
            30.0 + place if success else None,
        )
        for map_index, successes in ended.items()
        for place, (risk, success) in enumerate(zip(RISKS, successes, strict=False))
    )


def track(place: int) -> np.ndarray:
    x = np.linspace(2, 20, 30)
    return np.stack((x, 3 + 0.3 * x + place), axis=1).astype(np.float32)


def draw_driven(driven: Driven) -> Figure:
    data = made.run_data()
    vars(data).update(driven=driven)  # as read of the folder of a run
    return DrivenPaths().draw(data)


def drawn(figure: Any) -> tuple[Axes, dict[str, np.ndarray]]:
    panel = figure.axes[0]
    return panel, {
        line.get_label(): np.array(line.get_data()).T
        for line in panel.lines
        if line.get_label()[0] != "_"
    }


def test_every_path_is_drawn_to_its_end_with_its_outcome() -> None:
    rows = episodes({1: [True, False, True]})
    panel, lines = drawn(
        draw_driven(
            Driven(ground=ground(), rows=rows, tracks=[track(i) for i in range(3)])
        )
    )
    for place, label in enumerate(
        ("mean: success, 30 s", "CVaR₀.₅: timeout, 100 s", "CVaR₀.₉: success, 32 s")
    ):
        np.testing.assert_array_equal(lines[label], track(place))
    np.testing.assert_array_equal(lines["goal"], [[24, 15]])
    np.testing.assert_array_equal(lines["start"], track(0)[:1])
    (end,) = [
        line
        for line in panel.lines
        if line.get_marker() is MARKS["out of time"]["marker"]
    ]
    np.testing.assert_array_equal(np.ravel(end.get_data()), track(1)[-1])
    labelled = [line for line in panel.lines if " s" in line.get_label()]
    assert end.get_color() == labelled[1].get_color()
    assert len({line.get_color() for line in labelled}) == 3
    # In grey the paths differ by their dashes; `get_linestyle` gives "--" for each
    # pattern.
    assert len({str(line._dash_pattern) for line in labelled}) == 3


def test_an_end_says_how_it_ended() -> None:
    rows = episodes({1: [False, False, False]}).assign(
        outcome=["immobilised", "stuck", "planner_error"]
    )
    figure = draw_driven(
        Driven(ground=ground(), rows=rows, tracks=[track(i) for i in range(3)])
    )
    names = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    ends = [
        f"{name}, in the colour of its path"
        for name in ("immobilised", "out of time", "failed")
    ]
    assert names[-3:] == ends
    assert [name for name in names if " s" in name] == names[:3], "paths come first"
    drawn_marks = [line.get_marker() for line in figure.axes[0].lines]
    assert all(
        MARKS[name]["marker"] in drawn_marks
        for name in ("immobilised", "out of time", "failed")
    )


def test_ends_that_coincide_stand_apart_each_joined_to_where_it_is() -> None:
    rows = episodes({1: [False, False, False]})
    tracks = [track(0) + np.float32(0.1 * place) for place in range(3)]
    panel, _ = drawn(draw_driven(Driven(ground=ground(), rows=rows, tracks=tracks)))
    ends = [
        line
        for line in panel.lines
        if line.get_marker() is MARKS["out of time"]["marker"]
    ]
    boxes = [line.get_window_extent() for line in ends]
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    for end, own in zip(ends, tracks, strict=True):
        (line,) = [
            line
            for line in panel.lines
            if line.get_color() == end.get_color() and len(line.get_xdata()) == 2
        ]
        joined = np.array(line.get_data()).T
        np.testing.assert_allclose(joined, [own[-1], np.ravel(end.get_data())])


def test_the_title_and_the_legend_are_apart_and_planners_go_by_their_names() -> None:
    rows = made.rows(
        made.row(made.condition(name, world="stakes"), 1)
        for name in ("astar_dwa", "mppi")
    )
    figure = draw_driven(
        Driven(ground=ground(), rows=rows, tracks=[track(0), track(1)])
    )
    figure.draw_without_rendering()
    legend = figure.axes[0].get_legend()
    assert (
        not figure.axes[0]
        .title.get_window_extent()
        .overlaps(legend.get_window_extent())
    )
    assert legend.get_texts()[0].get_text() == "A*+DWA: success, 30 s"
    colours = [line.get_color() for line in legend.get_lines()[:2]]
    assert colours == list(planner_colours(["astar_dwa", "mppi"]).values())


def test_what_immobilises_a_robot_stands_out_and_resampled_ground_is_faded_terrain() -> (
    None
):
    rows = episodes({1: [True]})
    panel, _ = drawn(draw_driven(Driven(ground=ground(), rows=rows, tracks=[track(0)])))
    shown = np.asarray(panel.images[0].get_array())
    red = np.isclose(shown, np.array(to_rgb(IMMOBILISING))).all(axis=-1)
    np.testing.assert_array_equal(red, ground().immobilising)
    greys = shown[~ground().immobilising]
    assert (np.diff(greys[:, 0]) >= 0).all()
    faded = ground(field=None, immobilising=np.zeros((40, 60), bool))
    panel, _ = drawn(draw_driven(Driven(ground=faded, rows=rows, tracks=[track(0)])))
    np.testing.assert_allclose(
        np.asarray(panel.images[0].get_array()), 0.6 + 0.4 * 100 / 255
    )


def run_data(folder: Path, rows: pd.DataFrame, **more: Any) -> RunData:
    return RunData(
        about={}, summary=made.summarised(rows), episodes=rows, folder=folder, **more
    )


def with_steps(folder: Path, rows: pd.DataFrame) -> None:
    """Stores a path of each row, like no other's."""
    for place, (condition, own) in enumerate(rows.groupby("condition", sort=False)):
        for (seed, realisation), unit in own.groupby(["seed", "realisation"]):
            steps = pd.concat(
                pd.DataFrame({"seed": seed, "realisation": realisation, "map": i, "step": np.arange(30)}
                             | dict(zip(("x_m", "y_m"), (track(place) + i + 5 * seed + 9 * realisation).T,
                                        strict=True)))
                for i in unit["map"]
            )  # fmt: skip
            path = (
                folder
                / "steps"
                / f"condition={condition}"
                / f"{seed}-{realisation}-00000.parquet"
            )
            forge_steps(path, steps)


def test_the_figure_is_of_the_stored_steps_of_its_map(tmp_path: Path) -> None:
    rows = episodes({0: [True] * 3, 1: [True, False, True]})
    folder = run_folder(tmp_path / "run", rows)
    assert read_driven(folder, rows) is None
    with_steps(folder, rows)
    assert read_driven(folder, rows) is None
    ground().save(folder / GROUND)
    driven = read_driven(folder, rows)
    assert driven
    data = run_data(folder, rows)
    assert DrivenPaths().is_available(data)
    assert (
        "std, map 1, seed 0, realisation 0. Outcomes differ most on this map."
        in DrivenPaths().caption(data)
    )
    assert driven.rows["map"].tolist() == [1, 1, 1]
    for place, positions in enumerate(driven.tracks):
        np.testing.assert_allclose(positions, track(place) + 1)
    _, lines = drawn(DrivenPaths()(data))
    np.testing.assert_allclose(lines["CVaR₀.₉: success, 32 s"], track(2) + 1)


@pytest.mark.parametrize(("seed", "realisation"), [(0, 0), (0, 1), (7, 0), (7, 1)])
def test_the_paths_are_those_of_the_maps_own_noise(
    seed: int, realisation: int, tmp_path: Path
) -> None:
    rows = made.rows(
        made.row(made.condition(risk=risk, world="stakes"), map_index, seed=one, realisation=draw)
        for risk in RISKS for one in (0, 7) for draw in (0, 1) for map_index in (0, 1)
    )  # fmt: skip
    folder = run_folder(tmp_path / "run", rows)
    with_steps(folder, rows)
    ground(about={**ground().about, "seed": seed, "realisation": realisation}).save(
        folder / GROUND
    )
    data = run_data(folder, rows)
    assert (
        f"std, map 1, seed {seed}, realisation {realisation}."
        in DrivenPaths().caption(data)
    )
    assert data.driven
    own, tracks = data.driven.rows, data.driven.tracks
    assert own["risk"].tolist() == list(RISKS)
    assert set(zip(own["seed"], own["realisation"], own["map"], strict=True)) == {
        (seed, realisation, 1)
    }
    for place, positions in enumerate(tracks):
        np.testing.assert_allclose(
            positions, track(place) + 1 + 5 * seed + 9 * realisation
        )


@pytest.mark.parametrize(
    ("arrives", "wanted"),
    [
        (lambda place: True, [0, 1, 2, 3, 4, 5, 6, 7]),
        (lambda place: place < 5, [0, 1, 2, 3, 5, 6, 7, 8]),
        (lambda place: place < 9, [0, 1, 2, 3, 4, 5, 6, 9]),
    ],
)
def test_more_conditions_than_can_be_distinguished_are_left_out_and_counted(
    arrives: Callable[[int], bool], wanted: list[int], tmp_path: Path
) -> None:
    most = 8
    rows = made.rows(
        made.row(
            made.condition(risk=f"cvar:0.{i:02}", world="stakes"),
            map_index,
            30.0 if arrives(i) else None,
        )
        for map_index in range(2)
        for i in range(most + 2)
    )
    folder = run_folder(tmp_path / "run", rows)
    with_steps(folder, rows)
    ground().save(folder / GROUND)
    data = run_data(folder, rows)
    words = f" The figure shows {most} of {most + 2} conditions, with equally many successes"
    assert words in DrivenPaths().caption(data)
    figure = DrivenPaths()(data)
    legend = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert [name.split(":")[0] for name in legend[:most]] == [
        f"CVaR₀.₀{'₀₁₂₃₄₅₆₇₈₉'[i]}" for i in wanted
    ]
    _, lines = drawn(figure)
    for place, name in zip(wanted, legend, strict=False):
        np.testing.assert_allclose(lines[name], track(place) + 1)
    assert data.driven
    fewer = rows[rows["condition"].isin(data.driven.rows["condition"][:most])]
    assert "Shown are" not in DrivenPaths().caption(run_data(folder, fewer))


def test_trajectories_are_of_that_map_as_many_that_arrived_as_not() -> None:
    risks = [f"cvar:0.{i}" for i in range(6)]
    rows = made.rows(
        made.row(made.condition(risk=risk), 1, None if place in (4, 5) else 30.0)
        for place, risk in enumerate(risks)
    )
    kept = made.recording(
        20,
        about={
            "condition": rows["condition"][0],
            "map": "1",
            "seed": "0",
            "realisation": "0",
        },
    )
    other = made.recording(
        20,
        about={
            "condition": rows["condition"][1],
            "map": "0",
            "seed": "0",
            "realisation": "0",
        },
    )
    asked: list[str] = []

    def again(wanted: pd.DataFrame) -> list[Any]:
        asked.extend(wanted["risk"])
        return [wanted["risk"].iloc[0]]

    def shown(recordings: list[Recording], record: Any) -> list[Any]:
        data = RunData(about={}, summary=rows, episodes=rows, record_driven=record)
        # As read of the folder of a run.
        vars(data).update(
            recordings=recordings, driven=Driven(ground=ground(), rows=rows, tracks=())
        )
        return data.on_one_map

    assert shown([kept, other], again) == [kept, "cvar:0.1", "cvar:0.4", "cvar:0.5"]
    assert asked == ["cvar:0.1", "cvar:0.4", "cvar:0.5"]
    assert shown([kept], None) == []

    def gone(wanted: pd.DataFrame) -> list[Any]:
        raise ConfigError("Expected the maps, got none.")

    assert shown([kept], gone) == []


def test_the_map_comes_back_as_it_was(tmp_path: Path) -> None:
    for one in (ground(), ground(field=None)):
        one.save(tmp_path / "a.npz")
        again = RecordedMap.load(tmp_path / "a.npz")
        assert (again.about, again.resolution_m) == (one.about, 0.5)
        assert (again.field is None) == (one.field is None)
        np.testing.assert_array_equal(again.immobilising, one.immobilising)
    path = tmp_path / "a.npz"
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ConfigError, match=r"a\.npz is damaged"):
        RecordedMap.load(path)
