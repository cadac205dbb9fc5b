"""Steps of a run, as partitioned Parquet."""

import random
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Extent, units
from benchnav.eval.failures import failures_table
from benchnav.eval.folder.run_folder import EPISODES, open_run, read_table
from benchnav.eval.folder.steps import align_steps, read_steps
from benchnav.eval.run.rows import step_table
from benchnav.eval.run.runner import run_suite
from tests.edits import edit_table
from tests.eval.run.test_rows import made, unit

PLANNERS: tuple[Any, ...] = (
    {"part": "tests.eval.parts:Faulty", "label": "slow"},
    "straight",
)


def run(dataset: Path, folder: Path, **changes: Any) -> Path:
    given = {
        "planners": PLANNERS,
        "risks": ("mean", "cvar"),
        "maps": 2,
        "seeds": (0, 5),
    }
    given |= {"record": "steps"} | changes
    suite = Suite(
        data=str(dataset), scenarios=("std",), model="oracle", world={"noise": "stored", "time_budget_s": 4.0},
        **given,
    )  # fmt: skip
    for _ in run_suite(suite, folder):
        pass
    return folder


@pytest.fixture(scope="module")
def folder(dataset_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(dataset_path, tmp_path_factory.mktemp("steps") / "run")


def test_steps_hold_the_driven_path_and_the_robots_own_actions() -> None:
    problem, episodes = made()
    rows = step_table(unit(), problem, episodes).to_pandas()
    first, second = (rows[rows["map"] == i] for i in unit().maps)
    assert first["x_m"].tolist() == [0, 3, 3]
    assert first["y_m"].tolist() == [0, 0, 4]
    assert first["speed_mps"].tolist()[:2] == [1, 1]
    assert first["turn_rate_radps"].tolist()[:2] == [0, 0.5]
    assert np.isnan(first["traversability"].iloc[-1])
    assert np.isnan(first["speed_mps"].iloc[-1])
    assert second["step"].tolist() == [0, 1, 2, 3, 4]
    assert second["time_s"].tolist() == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])


def test_one_episode_is_read_with_filters_by_any_reader(folder: Path) -> None:
    rows = pd.read_parquet(folder / "episodes.parquet")
    everything = read_steps(folder)
    assert len(everything) == round((rows["end_time_s"] / 0.1 + 1).sum())
    for condition in rows["condition"].unique():
        filters = [("condition", "==", condition), ("map", "==", 1), ("seed", "==", 5)]
        steps = pd.read_parquet(folder / "steps", filters=filters)
        (row,) = rows[
            (rows["condition"] == condition) & (rows["map"] == 1) & (rows["seed"] == 5)
        ].to_dict("records")
        assert set(steps["condition"]) == {condition}
        assert steps["time_s"].max() == pytest.approx(row["end_time_s"])
        assert np.nanmean(
            steps["traversability"].to_numpy(np.float64)
        ) == pytest.approx(row["traversability"])
        ours = read_steps(folder, condition=condition, map=1, seed=5)
        pd.testing.assert_frame_equal(
            ours[steps.columns.drop("condition")], steps.drop(columns="condition")
        )
        assert ours["condition"].tolist() == [condition] * len(ours)


def test_steps_are_found_by_what_tables_call_their_conditions(folder: Path) -> None:
    rows = pd.read_parquet(folder / "episodes.parquet")
    named = rows.groupby(["planner", "risk"])["condition"].first()
    assert set(read_steps(folder, planner="slow")["condition"]) == {
        named["slow", "mean"],
        named["slow", "cvar"],
    }
    assert set(read_steps(folder, planner=["slow", "straight"], risk=["cvar", "–"])["condition"]) == {
        named["slow", "cvar"], named["straight", "–"]
    }  # fmt: skip
    assert len(read_steps(folder, planner="slow", risk="–")) == 0
    assert set(
        read_steps(folder, condition=named["slow", "mean"], risk="mean")["condition"]
    ) == {named["slow", "mean"]}
    assert len(read_steps(folder, condition=named["slow", "mean"], risk="cvar")) == 0
    with pytest.raises(
        ConfigError, match=r"Expected filters among .*map.* got 'instanse'"
    ):
        read_steps(folder, instanse=1)


def test_robots_of_other_actions_share_the_columns(
    dataset_path: Path, tmp_path: Path
) -> None:
    """Also where a run is extended by them; readers take the columns of the first file."""
    place = run(
        dataset_path,
        tmp_path / "run",
        planners=PLANNERS[:1],
        risks=("mean",),
        seeds=(0,),
    )
    run(
        dataset_path, place, risks=("mean",), seeds=(0,), robots=("bicycle",),
        planners=({"part": "mppi", "options": {"samples": 4, "horizon_s": 0.3}},),
    )  # fmt: skip
    steps = pd.read_parquet(place / "steps")
    assert {"speed_mps", "turn_rate_radps", "steering_rad"} <= set(steps.columns)
    assert steps.columns[-2] == "traversability"
    for planner, missing in (("slow", "steering_rad"), ("mppi", "turn_rate_radps")):
        own = read_steps(place, planner=planner)
        assert len(own)
        assert own[missing].isna().all()
        assert own["speed_mps"].notna().any()


def test_a_run_that_keeps_rows_alone_has_no_steps(
    dataset_path: Path, tmp_path: Path
) -> None:
    none = run(dataset_path, tmp_path / "none", record="none")
    assert not (none / "steps").exists()
    with pytest.raises(ConfigError, match="--record steps"):
        read_steps(none)


def test_files_that_agree_are_left_alone(folder: Path, dataset_path: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in folder.glob("steps/*/*")}
    assert len(before) == 6
    suite = Suite(data=str(dataset_path), model="oracle", planners=PLANNERS, risks=("mean", "cvar"),
                  world={"noise": "stored", "time_budget_s": 4.0})  # fmt: skip
    conditions = {
        t.id: (t, Extent.product((0, 5), 1, 2))
        for t in conditions_of(suite, lambda data: ("std",))
    }
    align_steps(folder, units(conditions))
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_a_file_that_was_cut_short_is_named_when_the_run_is_finished(
    folder: Path, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "run"))
    path = next(copy.glob("steps/*/*"))
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ConfigError, match="steps is damaged"):
        align_steps(copy, units(open_run(copy).conditions))


def test_an_episode_that_ended_at_once_has_its_one_state() -> None:
    problem, episodes = made()
    at_once = replace(episodes, steps=torch.tensor([0, 1]))
    rows = step_table(unit(), problem, at_once).to_pandas()
    rows = rows[rows["map"] == unit().maps[0]]
    assert (len(rows), rows["time_s"].tolist()) == (1, [0.0])
    assert np.isnan(rows["traversability"]).all()


@pytest.mark.parametrize("count", [20, pytest.param(300, marks=pytest.mark.slow)])
def test_edited_steps_are_read_or_refused_in_one_line(
    count: int, folder: Path, tmp_path: Path
) -> None:
    rows, said = read_table(folder, EPISODES), []
    for seed in range(count):
        chance, place = (
            random.Random(seed),
            Path(shutil.copytree(folder, tmp_path / "run")),
        )
        edit_table(chance.choice(sorted(place.glob("steps/*/*.parquet"))), chance)
        try:
            read_steps(place)
            failures_table(place, rows)
        except ConfigError as error:
            said.append(str(error))
        shutil.rmtree(place)
    assert len(said) > count / 5
    assert all("Remove the folder of steps" in line for line in said)
