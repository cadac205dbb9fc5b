"""What recordings tell of the ground, against what robots met on it and against the
dataset.
"""

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from benchnav.core.errors import BenchnavError
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.layers.vegetation import Growth
from benchnav.datagen.recipe.classes import SoftSpots
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.find_episodes import find_episodes
from benchnav.eval.folder.run_folder import open_run
from benchnav.eval.recorded_plans import (
    NUMBERS,
    KnownMap,
    drawn_plan,
    thinned,
)
from benchnav.eval.recording import Recording
from benchnav.eval.run.recorder import Recorder
from benchnav.eval.run.recordings import find_recording
from benchnav.eval.run.runner import run_suite
from benchnav.eval.run.unit import Settings, build, read_block
from benchnav.planning.planners.planner import Plan
from tests import factories
from tests.datagen.small import grown
from tests.eval.forged import forge_rows
from tests.eval.report import made

BELOW, HELD_S, SEEDS = 0.45, 0.4, (3, 4)
SOFT = (1, 3, 4)  # classes with soft spots


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recipe = factories.tiny_recipe(train=1, valid=1, test_std=4, test_hg=1, test_hs=1)
    spots = SoftSpots(weight=0.2, mean=0.05, std=0.05)
    classes = tuple(
        replace(item, soft=spots) if number in SOFT else item
        for number, item in enumerate(recipe.classes)
    )
    recipe = replace(recipe, synthesis=2, classes=classes)
    return factories.tiny_dataset(tmp_path_factory.mktemp("data") / "soft.h5", recipe)


def run(
    dataset: Path, folder: Path, say: Any = lambda line: None, **changes: Any
) -> Path:
    stakes = {
        "preset": "stakes",
        "immobile": {"below": BELOW, "for_s": HELD_S},
        "time_budget_ratio": 2.0,
    }
    given: dict[str, Any] = {
        "world": stakes,
        "maps": 4,
        "seeds": SEEDS,
        "record": "all",
    } | changes
    given = {"planners": ("straight",)} | given
    suite = Suite(data=str(dataset), scenarios=("std",), model="oracle", **given)
    for _ in run_suite(suite, folder, say=say):
        pass
    return folder


def recordings(folder: Path) -> list[Recording]:
    return [
        Recording.load(path) for path in sorted((folder / "playback").glob("*.npz"))
    ]


def recorded(folder: Path) -> list[tuple[str, str, str]]:
    """Which episodes are recorded: risk setting, seed and map."""
    return sorted(
        (r.about["risk"], r.about["seed"], r.about["map"]) for r in recordings(folder)
    )


def again(folder: Path, seed: int, map_index: int) -> Recording:
    ((unit, member),) = find_episodes(folder, {}, seed, 0, map_index)
    return find_recording(folder, unit, member)


@pytest.fixture(scope="module")
def stakes(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(dataset, tmp_path_factory.mktemp("stakes") / "run")


def cells(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns in which a robot stood at each step."""
    column, row = np.floor(recording.states[:-1, :2] / 0.5).astype(int).T
    return row, column


def test_a_recorded_field_is_what_the_robot_met_in_its_own_episode(
    stakes: Path,
) -> None:
    taken = recordings(stakes)
    assert len(taken) == 4 * len(SEEDS)
    for recording in taken:
        assert recording.field is not None
        assert recording.field.shape == (32, 32)
        np.testing.assert_array_equal(
            recording.field[cells(recording)], recording.traversability
        )
    # The others' fields are others.
    for recording, other in zip(taken, taken[1:] + taken[:1], strict=True):
        assert not np.array_equal(
            other.field[cells(recording)], recording.traversability
        )  # type: ignore[index]


def test_a_recording_holds_the_problem_of_its_own_episode(
    dataset: Path, tmp_path: Path
) -> None:
    task = {"free_space": {"by": "mean", "above": 0.6}}
    folder = run(
        dataset, tmp_path / "run", maps=3, realisations=2, seeds=(3,), task=task
    )
    ((condition, _),) = open_run(folder).conditions.values()
    taken = recordings(folder)
    episodes = [
        tuple(int(r.about[name]) for name in ("seed", "realisation", "map"))
        for r in taken
    ]
    assert sorted(episodes) == list(itertools.product((3,), range(2), range(3)))
    for recording, (seed, realisation, map_index) in zip(taken, episodes, strict=True):
        unit = Unit(
            condition=condition, seed=seed, realisation=realisation, maps=(map_index,)
        )
        built = build(unit, Settings().origins().of(unit))
        problem, simulation = built.problem, built.simulation
        assert simulation.field is not None
        for found, expected in (
            (recording.rgb, problem.observation.rgb),
            (recording.elevation_m, problem.elevation_m),
            (recording.predicted, problem.risk_map),
            (recording.free, problem.free),
            (recording.field, simulation.field),
            (recording.goal_m, problem.goal_m),
            (recording.states[0], problem.start),
        ):
            np.testing.assert_array_equal(found, expected[0].numpy())
        assert recording.time_budget_s == float(problem.time_budget_s[0])
    # No two maps are alike in any of these, so that none passes for another.
    for name in ("rgb", "elevation_m", "predicted", "free", "time_budget_s"):
        assert (
            len({np.asarray(getattr(recording, name)).tobytes() for recording in taken})
            == 3
        )
    assert (
        len(
            {
                recording.field.tobytes()
                for recording in taken
                if recording.field is not None
            }
        )
        == 6
    )


def test_cells_that_hold_a_robot_are_those_under_the_worlds_own_limit(
    stakes: Path,
) -> None:
    ends = []
    for recording in recordings(stakes):
        assert recording.field is not None
        np.testing.assert_array_equal(
            recording.immobilising, recording.field < np.float32(BELOW)
        )
        assert recording.immobilising.any()
        held = recording.immobilising[cells(recording)]
        last = round(HELD_S / recording.dt_s)
        assert held[-last:].all() == (recording.about["outcome"] == "immobilised")
        ends.append(recording.about["outcome"])
    assert "immobilised" in ends


def test_soft_ground_is_that_of_classes_with_soft_spots_on_the_episodes_own_map(
    dataset: Path, stakes: Path
) -> None:
    assert len(recordings(stakes)) > 2
    for recording in recordings(stakes):
        classes = TerrainDataset(dataset).read(
            "test/std", [int(recording.about["map"])], ["class_id"]
        )
        np.testing.assert_array_equal(
            recording.soft, np.isin(classes["class_id"][0], SOFT)
        )
        assert 0 < recording.soft.mean() < 1


def test_the_true_mean_is_that_of_the_episodes_own_map(
    dataset: Path, stakes: Path
) -> None:
    for recording in recordings(stakes):
        terrain = TerrainDataset(dataset).terrain(
            "test/std", [int(recording.about["map"])]
        )
        np.testing.assert_allclose(
            recording.true_mean, terrain.truth.mean()[0].numpy(), atol=1e-6
        )
        # The oracle's mean is the truth's.
        assert recording.true_mean.shape == recording.predicted.shape


def test_an_episode_that_is_run_again_is_recorded_on_its_own_ground(
    dataset: Path, stakes: Path, tmp_path: Path
) -> None:
    folder = run(dataset, tmp_path / "run", record="steps")
    found = again(folder, SEEDS[0], 1)
    (first,) = [
        r
        for r in recordings(stakes)
        if (r.about["map"], r.about["seed"]) == ("1", str(SEEDS[0]))
    ]
    for name in (
        "field",
        "soft",
        "immobilising",
        "states",
        "true_mean",
        "predicted",
        "free",
    ):
        np.testing.assert_array_equal(getattr(found, name), getattr(first, name))
    assert (found.about, found.free_by, found.free_above) == (first.about, "mean", 0.1)
    assert recorded(folder) == [("–", str(SEEDS[0]), "1")]
    other = again(folder, SEEDS[1], 1)
    assert not np.array_equal(other.field, found.field)  # type: ignore[arg-type]
    np.testing.assert_array_equal(other.field[cells(other)], other.traversability)  # type: ignore[index]


def test_what_is_recorded_is_not_run_again(
    stakes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benchnav.eval.run.recordings.build", None)
    assert again(stakes, SEEDS[1], 2).about["map"] == "2"


@pytest.mark.parametrize(
    "name", ["path_length_m", "traversability", "end_time_s", "outcome"]
)
def test_an_episode_that_does_not_repeat_is_refused(
    name: str, dataset: Path, tmp_path: Path
) -> None:
    folder = run(dataset, tmp_path / "run", record="steps", seeds=(), maps=2)
    again(folder, 0, 0)
    rows = pd.read_parquet(folder / "episodes.parquet")
    rows[name] = "planner_failure" if name == "outcome" else rows[name] + 0.1
    forge_rows(folder, rows)
    with pytest.raises(
        BenchnavError, match="repeated episode differs from the stored one"
    ):
        again(folder, 0, 1)


@pytest.mark.parametrize(
    ("record", "expected"),
    [
        ("none", lambda rows: rows["map"] < 0),
        ("first", lambda rows: (rows["map"] == 0) & (rows["seed"] == SEEDS[0])),
        (
            "failures",
            lambda rows: (
                ~rows["success"] | ((rows["map"] == 0) & (rows["seed"] == SEEDS[0]))
            ),
        ),
        ("all", lambda rows: rows["map"] >= 0),
    ],
)
def test_what_is_asked_for_is_recorded(
    record: str, expected: Any, dataset: Path, tmp_path: Path
) -> None:
    """Of a run at once, and of one that was run to record nothing and then extended."""
    # All are at the goal at once but the first of each unit, whose planner fails.
    faulty = {
        "part": "tests.eval.parts:Faulty",
        "options": {"fault": "nan", "after_s": 0.0},
    }
    given: dict[str, Any] = {
        "planners": (faulty,),
        "task": {"goal_radius_m": 30.0},
        "record": record,
    }
    folder = run(dataset, tmp_path / "run", risks=("mean", "cvar"), **given)
    rows = pd.read_parquet(folder / "episodes.parquet")
    assert rows.groupby("map")["success"].mean().tolist() == [0, 1, 1, 1]
    asked = rows[expected(rows)].astype({"seed": str, "map": str})
    wanted = sorted(zip(asked["risk"], asked["seed"], asked["map"], strict=True))
    assert recorded(folder) == wanted
    other = tmp_path / "other"
    run(dataset, other, risks=("mean",), **given | {"record": "none"}, maps=3)
    said: list[str] = []
    run(dataset, other, risks=("mean",), **given, maps=3, say=said.append)
    assert any("run again" in line for line in said) == (record != "none")
    run(dataset, other, risks=("mean", "cvar"), **given)
    assert recorded(other) == wanted
    # The same again finds all done.
    run(dataset, other, risks=("mean", "cvar"), **given, say=said.append)
    assert said[-1] == "4 of 4 units were already finished"


def test_plans_after_the_moment_of_figures_are_thinned(stakes: Path) -> None:
    """So that a unit's recordings fit into memory; the viewer is given no more of them."""
    unit = find_episodes(stakes, {}, None, 0, 1)[0][0]
    problem: Any = SimpleNamespace(dt_s=0.1)
    nothing: Any = None
    recorder = Recorder(unit, problem, nothing, nothing, [1, 3])
    assert recorder.observer.plan_interval == 5
    samples = torch.rand(4, 40, 30, 2)
    for step in (0, 150, 155, 900):
        recorder.store_plan(step, Plan.empty(4, samples=samples), [0, 1, 2, 3])
    for member, plans in recorder._plans.items():
        whole = drawn_plan(0, {"samples": samples[member]})
        assert [plan.step for plan in plans] == [0, 150, 155, 900]
        for plan, lines in zip(
            plans, (whole, whole, thinned(whole), thinned(whole)), strict=True
        ):
            for before, after in zip(
                lines.lines["samples"], plan.lines["samples"], strict=True
            ):
                np.testing.assert_array_equal(after, before)


def test_what_watched_episodes_know_is_kept_to_their_end(stakes: Path) -> None:
    unit = find_episodes(stakes, {}, None, 0, 1)[0][0]
    origin = Settings().origins().of(unit)
    built = build(unit, origin)
    recorder = Recorder(
        unit, built.problem, built.simulation, read_block(unit, origin).terrain, [1, 3]
    )
    first = made.learning_recording(5).known[0]

    class Knows:
        """Of all episodes, whether they are wanted or not."""

        def maps_of(self, step: int, wanted: Any) -> dict[int, KnownMap]:
            assert set(wanted) == {1, 3}
            return {
                member: replace(
                    first, step=step, mean=first.mean.astype(np.float64) / member
                )
                for member in wanted
            }

    knowing: Any = Knows()
    for step in (0, 4, 5, 8):
        recorder.store_knowledge(step, knowing)
    states, actions = np.zeros((6, 3)), np.zeros((5, 2))
    for member, wanted in ((1, [0, 4, 5]), (3, [0, 4, 5]), (0, [])):
        known = recorder.recording_from_states(
            member, "stuck", states, actions, np.zeros(5)
        ).known
        assert [each.step for each in known] == wanted
        for each in known:
            np.testing.assert_allclose(each.mean, first.mean / member, atol=1e-3)
            assert {getattr(each, name).dtype for name in NUMBERS} == {
                np.dtype(np.float16)
            }


@pytest.mark.parametrize(
    ("world", "stays"),
    [
        ("paper", False),
        ({"noise": "stored"}, True),
        ({"preset": "stakes", "immobile": None}, True),
    ],
)
def test_where_nothing_immobilises_a_robot_no_cell_does(
    world: Any, stays: bool, dataset: Path, tmp_path: Path
) -> None:
    taken = recordings(
        run(dataset, tmp_path / "run", world=world, seeds=(), record="first")
    )
    assert len(taken) == 1
    for recording in taken:
        assert (recording.field is not None) == stays
        assert not recording.immobilising.any()
        assert recording.soft.any()


def test_ground_without_soft_spots_is_not_soft(
    dataset_path: Path, tmp_path: Path
) -> None:
    (recording,) = recordings(
        run(
            dataset_path,
            tmp_path / "run",
            world="paper",
            seeds=(),
            maps=2,
            record="first",
        )
    )
    assert recording.soft.shape == (32, 32)
    assert not recording.soft.any()


def test_a_recording_holds_the_layers_of_its_map_when_run_and_when_run_again(
    tmp_path: Path,
) -> None:
    recipe = factories.tiny_recipe(train=1, valid=1, test_std=3, test_hg=1, test_hs=1)
    grass = Growth(height_m=(0.2, 0.9), cover=0.5, colour=(60, 110, 30))
    recipe = grown(
        replace(recipe, synthesis=2), **{item.name: grass for item in recipe.classes}
    )
    data = factories.tiny_dataset(tmp_path / "grown.h5", recipe)
    folder = run(data, tmp_path / "run", maps=3, seeds=(3,), record="first")
    stored = TerrainDataset(data).read("test/std")["vegetation_m"]
    (first,) = recordings(folder)
    for recording in (first, again(folder, 3, 2)):
        assert list(recording.layers) == ["vegetation_m"]
        np.testing.assert_array_equal(
            recording.layers["vegetation_m"], stored[int(recording.about["map"])]
        )
    assert stored[0].any()
