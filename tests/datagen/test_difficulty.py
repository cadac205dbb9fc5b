from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchnav.core.grid import Grid
from benchnav.core.tables import to_terminal
from benchnav.datagen import difficulty
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe import latent
from benchnav.datagen.schema import UNLABELLED
from tests.datagen.small import SOFT, small_stakes, terrain_class
from tests.factories import tiny_dataset

GRID = Grid(8, 10, 0.5)
CLASSES = (
    terrain_class("firm", 1, scale=0.0, noise=0.01, offset=0.1),
    terrain_class("mud", 2, scale=0.0, noise=0.01, offset=0.95),
    terrain_class("dune", 3, scale=0.0, noise=0.01, offset=0.1, soft=SOFT),
)
RECIPE = small_stakes(
    height=8, width=10, classes=CLASSES, occupancy=(0.5, 0.5), class_periods_m=(2,), correlation_m=0,
    places=None, start_m=(0.75, 0.75), goal_m=(4.25, 0.75),
)  # fmt: skip


def maps_of(class_id: np.ndarray, times: list[float]) -> dict[str, np.ndarray]:
    """Hand-made maps to be crossed from left to right along row 1."""
    ends = {"start_m": (0.75, 0.75), "goal_m": (4.25, 0.75)}
    return {
        "class_id": class_id.astype(np.uint8),
        "slope_deg": np.zeros(class_id.shape, np.float32),
        "reference_time_s": np.array(times, np.float32),
        **{
            name: np.tile(np.float32(place), (len(class_id), 1))
            for name, place in ends.items()
        },
    }


def test_the_figures_are_those_of_hand_made_maps() -> None:
    class_id = np.zeros((4, 8, 10), dtype=int)
    class_id[1, 1, 5] = 1  # mud on the line
    class_id[2, 2, 5] = 1  # mud beside it
    class_id[3, :4] = 2  # soft spots on the line, that E[λ] hardly shows
    found = difficulty.measure(maps_of(class_id, [5.0, np.nan, np.inf, 7.0]), RECIPE)
    assert len(found["straight"]) == 4
    assert found["stuck"].mean() == pytest.approx(2 / 320)
    assert found["soft_ground"].mean() == pytest.approx(40 / 320)
    assert found["soft_spots"].mean() == pytest.approx(0.1 * 40 / 320)
    assert found["straight"].sum() == 3
    times = found["reference_times_s"]
    assert times[np.isfinite(times)].tolist() == [5, 7]


def test_shares_are_of_the_cells_whose_class_is_known() -> None:
    class_id = np.full((2, 8, 10), UNLABELLED)
    class_id[:, :4] = 0
    class_id[0, 1, 5] = 1  # mud on the line
    class_id[1, :2] = 2  # soft spots in half of what is known
    found = difficulty.measure(maps_of(class_id, [5.0, 6.0]), RECIPE)
    assert found["stuck"].mean() == pytest.approx(1 / 80)
    assert found["soft_ground"].mean() == pytest.approx(20 / 80)
    assert found["soft_spots"].mean() == pytest.approx(0.1 * 20 / 80)
    assert found["straight"].sum() == 1


def test_lambda_stuck_is_the_recipe_s_and_still_stuck() -> None:
    # E[λ] is 0.9 · 0.9 + 0.1 · 0.05, but for clipping
    class_id = np.full((1, 8, 10), 2)
    exact = float(
        latent.expected_of(
            latent.truth(class_id, np.zeros(class_id.shape), CLASSES)
        ).min()
    )
    for threshold, stuck in ((0.8, 0.0), (exact, 1.0), (0.82, 1.0)):
        found = difficulty.measure(
            maps_of(class_id, [1.0]), replace(RECIPE, stuck_threshold=threshold)
        )
        assert (found["stuck"], found["straight"]) == (stuck, 1 - stuck)


@given(
    start=st.tuples(st.floats(0, 4.99), st.floats(0, 3.99)), goal=st.tuples(st.floats(0, 4.99), st.floats(0, 3.99))
)  # fmt: skip
@settings(max_examples=200, deadline=None)
def test_a_line_crosses_the_cells_that_it_has_points_in(
    start: tuple, goal: tuple
) -> None:
    ends = np.array([start]), np.array([goal])
    crossed = difficulty.crossed_cells(GRID, *ends)[0]
    points = (
        ends[0] + np.linspace(0, 1, 4001)[:, None] * (ends[1] - ends[0])
    ) / GRID.resolution_m
    column, row = np.floor(points).astype(int).T
    sampled = np.zeros(GRID.shape, dtype=bool)
    sampled[row, column] = True
    middle = np.argwhere(np.ones(GRID.shape))[:, ::-1] + 0.5
    gap = (
        np.maximum(abs(points[:, None] - middle) - 0.5, 0)
        .max(axis=2)
        .min(axis=0)
        .reshape(GRID.shape)
    )
    depth = (
        (0.5 - abs(points[:, None] - middle))
        .min(axis=2)
        .max(axis=0)
        .reshape(GRID.shape)
    )
    # All that it runs through by more than the distance of two samples; nothing that it
    # does not touch.
    assert crossed[depth > 1e-9].all()
    assert (gap[crossed] < 3e-3).all()
    assert (crossed | (depth < 1e-9))[sampled].all()


def test_a_line_along_rows_columns_and_a_diagonal() -> None:
    start = np.array([[0.25, 0.25], [0.25, 0.25], [0.25, 0.25], [2.1, 2.1]])
    goal = np.array([[4.75, 0.25], [0.25, 3.75], [1.75, 1.75], [2.2, 2.2]])
    crossed = difficulty.crossed_cells(GRID, start, goal)
    assert crossed[0].tolist() == [[i == 0] * 10 for i in range(8)]
    assert crossed[1].T.tolist() == [[j == 0] * 8 for j in range(10)]
    np.testing.assert_array_equal(
        crossed[2], np.pad(np.eye(4, dtype=bool), ((0, 4), (0, 6)))
    )
    assert np.argwhere(crossed[3]).tolist() == [[4, 4]]


def test_a_split_is_measured_in_pieces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = TerrainDataset(tiny_dataset(tmp_path / "d.h5", small_stakes()))
    whole = difficulty.measure(dataset.read("train"), dataset.recipe)
    chunks = dataset.chunks
    monkeypatch.setattr(
        dataset, "chunks", lambda *given: chunks(*given, cells=3 * 32 * 32)
    )
    asked, read = [], dataset.read
    monkeypatch.setattr(
        dataset, "read", lambda *given: asked.append(list(given[1])) or read(*given)
    )
    pieces = difficulty.of_split(dataset, "train")
    assert asked == [[0, 1, 2], [3, 4, 5], [6, 7]]
    assert len(pieces["straight"]) == 8
    for name, values in whole.items():
        np.testing.assert_array_equal(pieces[name], values)
    assert not np.isfinite(pieces["reference_times_s"]).any()


def test_the_table_fits_a_terminal_and_names_every_split(tmp_path: Path) -> None:
    dataset = TerrainDataset(tiny_dataset(tmp_path / "d.h5", small_stakes()))
    lines = to_terminal(
        replace(difficulty.table(dataset), notes=()), width=80
    ).splitlines()
    assert "λ_stuck 0.1" in lines[0]
    train, hg = (
        next(line.split() for line in lines if line.startswith(f"{name} "))
        for name in ("train", "test/hg")
    )
    found = difficulty.of_split(dataset, "test/hg")
    times = found["reference_times_s"]
    times = times[np.isfinite(times)]
    shares = (
        f"{100 * found[name].mean():.1f}"
        for name in ("stuck", "soft_ground", "soft_spots")
    )
    assert hg == [
        "test/hg",
        *shares,
        f"{np.median(times):.1f}",
        f"{times.min():.1f}–{times.max():.1f}",
        f"{found['straight'].sum()}/3",
    ]
    assert train[4:6] == ["–", "–"]
    assert not any("…" in line for line in lines)


def test_every_column_is_explained_in_two_lines(tmp_path: Path) -> None:
    dataset = TerrainDataset(tiny_dataset(tmp_path / "d.h5", small_stakes()))
    table = difficulty.table(dataset)
    assert len(table.notes) == 2
    assert all(len(note) <= 112 for note in table.notes)
    columns = [heading.replace("\n", " ") for heading in table.headings]
    headings = {column.partition(",")[0].removesuffix(" %") for column in columns[1:]}
    assert {
        part.partition(":")[0] for note in table.notes for part in note.split(". ")
    } == headings
    assert "(λ_stuck 0.1)" in table.title
