import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from benchnav.errors import BenchnavError, ConfigError
from benchnav.eval import playback
from benchnav.eval.report import write_report
from benchnav.eval.runner import record_episode, run_suite
from benchnav.eval.suite import Suite, units
from benchnav.mixture import TraversabilityMixture
from benchnav.models import predictor
from benchnav.planning import planner as planners
from benchnav.terrain import Observation, Terrain

BUDGETS = {"mppi": {"samples": 64, "horizon": 20}, "cl_rrt": {"expansions": 50}}


def suite_on(dataset: Path, **changes: object) -> Suite:
    made = Suite(data=str(dataset), model="oracle", instances=2, time_budget_s=40.0, planner_options=BUDGETS)
    return replace(made, **changes)  # type: ignore[arg-type]


def finish(suite: Suite, folder: Path, jobs: int = 1) -> pd.DataFrame:
    for _ in run_suite(suite, folder, jobs):
        pass
    return pd.read_parquet(folder / "episodes.parquet")


@pytest.fixture(scope="module")
def finished(dataset_path: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Suite, Path]:
    """A run of every planner under two risk settings on two scenarios."""
    suite = suite_on(dataset_path, risks=("cvar", "mean"), scenarios=("std", "hs"))
    folder = tmp_path_factory.mktemp("run") / "run"
    finish(suite, folder)
    write_report(folder)
    return suite, folder


def test_a_run_folder_has_all_that_is_promised(finished: tuple[Suite, Path]) -> None:
    suite, folder = finished
    episodes = pd.read_parquet(folder / "episodes.parquet")
    assert len(episodes) == 3 * 2 * 2 * 2
    assert not episodes.duplicated(["planner", "risk", "scenario", "instance"]).any()
    assert set(episodes["planner"]) == set(suite.planners)
    about = json.loads((folder / "run.json").read_text())
    assert about["versions"]["torch"] == torch.__version__.split("+")[0]
    assert len(about["dataset"]["splits"]["test/std"]["digest"]) == 64
    figures = ("figures/trajectories.png", "figures/success.png")
    for name in ("summary.md", "summary.csv", "summary.tex", "timing.csv", *figures):
        assert (folder / name).stat().st_size > 100
    assert len(pd.read_csv(folder / "summary.csv")) == 12
    assert not list(folder.rglob("*partial*"))


def test_recordings_verify_and_hold_the_driven_path(finished: tuple[Suite, Path]) -> None:
    _, folder = finished
    recordings = sorted((folder / "playback").glob("*.rrd"))
    assert len(recordings) == 3
    subprocess.run(
        ["rerun", "rrd", "verify", *map(str, recordings)], check=True, capture_output=True, env=_path()
    )
    steps = pd.read_parquet(folder / "steps.parquet")
    for path in recordings:
        planner, risk, scenario, instance = path.stem.split("+")
        episode = steps.query(
            "planner == @planner and risk == @risk and scenario == @scenario and instance == @i",
            local_dict={"planner": planner, "risk": risk, "scenario": scenario, "i": int(instance)},
        )
        times, positions = playback.read_path(path)
        np.testing.assert_allclose(times, episode["time_s"], atol=1e-6)
        np.testing.assert_array_equal(positions[:, :2], episode[["x_m", "y_m"]].to_numpy())


def _path() -> dict[str, str]:
    return {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}


def test_rows_do_not_depend_on_workers(finished: tuple[Suite, Path], tmp_path: Path) -> None:
    suite, folder = finished
    again = finish(suite, tmp_path / "two", jobs=2)
    pd.testing.assert_frame_equal(again, pd.read_parquet(folder / "episodes.parquet"))


def test_a_killed_run_goes_on_to_the_same_rows(finished: tuple[Suite, Path], tmp_path: Path) -> None:
    suite, whole = finished
    folder = tmp_path / "run"
    code = (
        "import sys; from pathlib import Path; from benchnav.eval.suite import Suite\n"
        "from benchnav.eval.runner import run_suite\n"
        f"for _ in run_suite({suite!r}, Path({str(folder)!r})): pass"
    )
    process = subprocess.Popen([sys.executable, "-c", code])
    while len(list(folder.glob("units/*.json"))) < 2:
        time.sleep(0.02)
        assert process.poll() is None
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not (folder / "episodes.parquet").exists()
    kept = {path: path.stat().st_mtime_ns for path in folder.glob("units/*.json")}
    rows = finish(suite, folder)
    pd.testing.assert_frame_equal(rows, pd.read_parquet(whole / "episodes.parquet"))
    assert all(path.stat().st_mtime_ns == when for path, when in kept.items())


def test_another_suite_does_not_mix_into_a_run(finished: tuple[Suite, Path]) -> None:
    suite, folder = finished
    with pytest.raises(ConfigError, match="another suite"):
        finish(replace(suite, seed=1), folder)


def test_two_runs_in_one_folder_refuse_each_other(dataset_path: Path, tmp_path: Path) -> None:
    suite = suite_on(dataset_path, planners=("astar_dwa",), risks=("mean",), scenarios=("std",), recorded=0)
    first = run_suite(suite, tmp_path / "run")
    next(first)
    with pytest.raises(BenchnavError, match="Another run"):
        finish(suite, tmp_path / "run")
    first.close()


def test_replay_repeats_an_episode_that_was_not_recorded(finished: tuple[Suite, Path]) -> None:
    suite, folder = finished
    path = record_episode(suite, folder, "astar_dwa", "mean", "hs", 1)
    _, positions = playback.read_path(path)
    steps = pd.read_parquet(folder / "steps.parquet").query(
        "planner == 'astar_dwa' and risk == 'mean' and scenario == 'hs' and instance == 1"
    )
    np.testing.assert_array_equal(positions[:, :2], steps[["x_m", "y_m"]].to_numpy())
    with pytest.raises(ConfigError, match="instance 9"):
        record_episode(suite, folder, "mppi", "mean", "hs", 9)


def test_every_setting_meets_the_same_luck(dataset_path: Path, tmp_path: Path) -> None:
    suite = suite_on(
        dataset_path, planners=("astar_dwa", "mppi"), risks=("mean",), scenarios=("std",), recorded=0
    )
    finish(suite, tmp_path / "run")
    steps = pd.read_parquet(tmp_path / "run" / "steps.parquet").query("step == 0 and instance == 1")
    # At the start both stand on the same cell: the λ they meet must be the same draw.
    assert steps["traversability"].nunique() == 1


def test_models_see_observations_and_planners_the_prediction(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[object] = []

    class Spy:
        def predict(self, observation: Observation) -> TraversabilityMixture:
            seen.append(observation)
            shape = (len(observation.rgb), 1, *observation.grid.shape)
            return TraversabilityMixture(torch.ones(shape), torch.full(shape, 0.77), torch.full(shape, 0.01))

    problems: list[object] = []
    original = planners.make_planner("astar_dwa")

    class Watched:
        def init(self, problem, generator):  # type: ignore[no-untyped-def]
            problems.append(problem)
            return original.init(problem, generator)

        def plan(self, state, plan_state):  # type: ignore[no-untyped-def]
            return original.plan(state, plan_state)

    monkeypatch.setattr(predictor, "_REGISTERED", {})
    monkeypatch.setattr(planners, "_FACTORIES", {})
    predictor.register_model("spy", lambda *_, **__: Spy())
    planners.register("watched", lambda options: Watched())
    suite = suite_on(
        dataset_path,
        model="spy",
        planners=("watched",),
        risks=("mean",),
        scenarios=("std",),
        planner_options={},
    )
    finish(suite, tmp_path / "run")
    assert seen
    assert all(type(item) is Observation for item in seen)
    for problem in problems:
        torch.testing.assert_close(problem.traversability, torch.full_like(problem.traversability, 0.77))
        assert not any(isinstance(value, Terrain) for value in vars(problem).values())


def test_suites_are_checked_before_anything_runs(dataset_path: Path, tmp_path: Path) -> None:
    for change, expected in (
        ({"scenarios": ("fog",)}, "fog"),
        ({"risks": ("cvr",)}, "cvr"),
        ({"planners": ("mpi",), "planner_options": {}}, "mpi"),
        ({"planner_options": {"mppi": {"sample": 1}}}, "samples"),
        ({"model": "no-such-model"}, "no-such-model"),
        ({"data": "no-such-data"}, "no-such-data"),
        ({"noise": "loud"}, "loud"),
        ({"instances": 9}, "instances"),
        ({"risks": ("cvar", "cvar:0.9")}, "risks"),
        ({"time_budget_s": 0.01}, "time_budget_s"),
    ):
        with pytest.raises(BenchnavError, match=expected):
            finish(suite_on(dataset_path, **change), tmp_path / "run")
        assert not (tmp_path / "run").exists()


def test_units_cover_every_episode_once_in_blocks_of_twenty() -> None:
    suite = Suite(instances=0, planners=("mppi",), risks=("mean",))
    made = list(units(suite, {"std": 45, "hg": 3, "hs": 20}))
    assert [len(unit.instances) for unit in made] == [20, 20, 5, 3, 20]
    assert len({unit.name for unit in made}) == len(made)
    assert sum(unit.recorded for unit in made) == 1


def test_a_planner_that_gives_up_at_once_is_recorded_and_reported(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Hopeless:
        def init(self, problem, generator):  # type: ignore[no-untyped-def]
            return None

        def plan(self, state, plan_state):  # type: ignore[no-untyped-def]
            failed = torch.full((len(state),), int(planners.PlanStatus.FAILED))
            return torch.zeros(len(state), 2), None, planners.Plan.empty(len(state), status=failed)

    monkeypatch.setattr(planners, "_FACTORIES", {"hopeless": lambda options: Hopeless()})
    suite = suite_on(
        dataset_path, planners=("hopeless",), risks=("mean",), scenarios=("std",), planner_options={}
    )
    episodes = finish(suite, tmp_path / "run")
    assert episodes["outcome"].tolist() == ["planner_failure"] * 2
    assert episodes["end_time_s"].tolist() == [0, 0]
    assert episodes["total_time_s"].tolist() == [40, 40]
    write_report(tmp_path / "run")
    (recording,) = (tmp_path / "run" / "playback").glob("*.rrd")
    _, positions = playback.read_path(recording)
    assert len(positions) == 1
