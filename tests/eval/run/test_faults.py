"""A planner or model that fails harms no episode but those that are named for it."""

from pathlib import Path

import pandas as pd
import pytest

from benchnav.core.errors import BenchnavError
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.folder.run_folder import ERRORS
from benchnav.eval.run.runner import run_suite
from benchnav.eval.run.unit import Settings


def run(
    dataset_path: Path,
    folder: Path,
    fault: str,
    jobs: int = 1,
    limit_s: float = 0.0,
    **changes: object,
) -> pd.DataFrame:
    faulty = {
        "part": "tests.eval.parts:Faulty",
        "label": "faulty",
        "options": {"fault": fault},
    }
    given = {
        "data": str(dataset_path), "models": ("oracle",), "planners": (faulty,), "risks": ("mean",),
        "scenarios": ("std",), "maps": 2, "world": {"noise": "stored", "time_budget_s": 30.0}, "record": "none",
    } | changes  # fmt: skip
    for _ in run_suite(
        Suite(**given), folder, jobs, settings=Settings(planner_limit_s=limit_s)
    ):  # type: ignore[arg-type]
        pass
    return pd.read_parquet(folder / "episodes.parquet")


@pytest.fixture(scope="module")
def sound(dataset_path: Path, tmp_path_factory: pytest.TempPathFactory) -> pd.DataFrame:
    rows = run(dataset_path, tmp_path_factory.mktemp("sound") / "run", "none")
    assert rows["success"].all()
    return rows


MEASURES = ["outcome", "end_time_s", "path_length_m", "traversability"]


@pytest.mark.parametrize("fault", ["write", "write in init"])
def test_writing_into_what_one_is_given_changes_nothing(
    fault: str, dataset_path: Path, tmp_path: Path, sound: pd.DataFrame
) -> None:
    rows = run(dataset_path, tmp_path / "run", fault)
    pd.testing.assert_frame_equal(rows[MEASURES], sound[MEASURES])


def test_an_action_that_is_not_finite_ends_its_own_episode(
    dataset_path: Path, tmp_path: Path, sound: pd.DataFrame
) -> None:
    rows = run(dataset_path, tmp_path / "run", "nan")
    assert rows["outcome"].tolist() == ["planner_error", "success"]
    assert rows["end_time_s"][0] == pytest.approx(1.0)
    assert "finite" in rows["error"][0]
    assert rows["error"][1] == ""
    assert rows["total_time_s"][0] == 30.0
    pd.testing.assert_series_equal(rows[MEASURES].iloc[1], sound[MEASURES].iloc[1])


@pytest.mark.parametrize(
    ("fault", "word"), [("shape", "shape"), ("raise", "no way on")]
)
def test_a_raise_or_a_wrong_shape_ends_the_unfinished_episodes(
    fault: str, word: str, dataset_path: Path, tmp_path: Path
) -> None:
    rows = run(dataset_path, tmp_path / "run", fault)
    assert rows["outcome"].tolist() == ["planner_error"] * 2
    assert rows["end_time_s"].tolist() == pytest.approx([1.0, 1.0])
    assert all(word in error for error in rows["error"])
    assert word in (tmp_path / "run" / ERRORS).read_text()


def test_episodes_that_had_ended_keep_their_outcome(
    dataset_path: Path, tmp_path: Path, sound: pd.DataFrame
) -> None:
    first, last = sorted(sound["end_time_s"])
    assert last - first > 0.15  # else this test cannot tell
    faulty = {
        "part": "tests.eval.parts:Faulty", "label": "faulty",
        "options": {"fault": "raise", "after_s": (first + last) / 2},
    }  # fmt: skip
    rows = run(dataset_path, tmp_path / "run", "raise", planners=(faulty,))
    assert sorted(rows["outcome"]) == ["planner_error", "success"]
    kept = rows[rows["success"]].iloc[0]
    assert kept["error"] == ""
    pd.testing.assert_series_equal(kept[MEASURES], sound.loc[kept.name, MEASURES])
    trace = (tmp_path / "run" / ERRORS).read_text()
    assert "Traceback" in trace
    assert 'raise RuntimeError("no way on")' in trace


def test_a_planner_that_raises_at_the_beginning_leaves_rows_without_measures(
    dataset_path: Path, tmp_path: Path
) -> None:
    rows = run(dataset_path, tmp_path / "run", "raise in init")
    assert rows["outcome"].tolist() == ["planner_error"] * 2
    assert (
        rows[["traversability", "path_length_m", "stuck_share", "roughness_radps2"]]
        .isna()
        .all(axis=None)
    )
    assert rows["end_time_s"].tolist() == [0, 0]
    assert rows["total_time_s"].tolist() == [30.0, 30.0]


@pytest.mark.parametrize("limit_s", [0.0, 60.0])
def test_a_planner_that_exits_is_a_fault_like_any_other(
    limit_s: float, dataset_path: Path, tmp_path: Path
) -> None:
    rows = run(dataset_path, tmp_path / "run", "exit", limit_s=limit_s)
    assert rows["outcome"].tolist() == ["planner_error"] * 2
    assert all("SystemExit" in error for error in rows["error"])


def test_a_robot_that_fails_in_the_simulation_ends_the_run_and_blames_no_planner(
    dataset_path: Path, tmp_path: Path
) -> None:
    with pytest.raises(
        BenchnavError, match="Robot Rusty failed in the simulation: ValueError: seized"
    ):
        run(dataset_path, tmp_path / "run", "none", robots=("tests.eval.parts:Rusty",))


def test_a_planner_that_is_made_here_and_not_in_a_unit_ends_its_own_units(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    picky = {
        "part": "tests.eval.parts:Picky",
        "options": {"log": str(tmp_path / "seen")},
    }
    rows = run(dataset_path, tmp_path / "run", "none", planners=(picky, "straight"))
    assert set(rows[rows["planner"] == "Picky"]["outcome"]) == {"planner_error"}
    assert rows[rows["planner"] == "straight"]["success"].all()


def test_a_worker_that_is_killed_ends_the_run_with_a_line(
    dataset_path: Path, tmp_path: Path
) -> None:
    with pytest.raises(BenchnavError, match="A worker was killed"):
        run(dataset_path, tmp_path / "run", "kill", jobs=2)


def test_a_planner_that_gives_up_is_no_fault(
    dataset_path: Path, tmp_path: Path
) -> None:
    rows = run(dataset_path, tmp_path / "run", "give up")
    assert rows["outcome"].tolist() == ["planner_failure"] * 2
    assert not (tmp_path / "run" / ERRORS).exists()


def test_a_planner_that_hangs_is_stopped_and_the_others_go_on(
    dataset_path: Path, tmp_path: Path, sound: pd.DataFrame
) -> None:
    both = tuple(
        {"part": "tests.eval.parts:Faulty", "label": fault, "options": {"fault": fault}}
        for fault in ("hang", "none")
    )
    rows = run(dataset_path, tmp_path / "run", "", limit_s=3.0, planners=both)
    hung, fine = rows[rows["planner"] == "hang"], rows[rows["planner"] == "none"]
    assert hung["outcome"].tolist() == ["planner_error"] * 2
    assert hung["end_time_s"].tolist() == pytest.approx([1.0, 1.0])
    assert "within 3 s" in hung["error"].iloc[0]
    pd.testing.assert_frame_equal(
        fine[MEASURES].reset_index(drop=True), sound[MEASURES]
    )


def test_a_raise_in_a_process_of_its_own_keeps_its_traceback(
    dataset_path: Path, tmp_path: Path
) -> None:
    rows = run(dataset_path, tmp_path / "run", "raise", limit_s=60.0)
    assert rows["error"].tolist() == ["RuntimeError: no way on"] * 2
    assert 'raise RuntimeError("no way on")' in (tmp_path / "run" / ERRORS).read_text()


def test_a_model_that_raises_ends_its_own_conditions_alone(
    dataset_path: Path, tmp_path: Path
) -> None:
    rows = run(
        dataset_path,
        tmp_path / "run",
        "none",
        jobs=2,
        models=("oracle", "tests.eval.parts:Broken"),
    )
    by_model = {model: set(group["outcome"]) for model, group in rows.groupby("model")}
    assert by_model.pop("oracle") == {"success"}
    assert list(by_model.values()) == [{"model_error"}]
    failed = rows[rows["outcome"] == "model_error"]
    assert failed["error"].tolist() == ["ValueError: no idea"] * 2
    assert failed["total_time_s"].tolist() == [30.0, 30.0]
    assert 'raise ValueError("no idea")' in (tmp_path / "run" / ERRORS).read_text()


def test_a_risk_measure_that_gives_no_map_is_a_model_error(
    dataset_path: Path, tmp_path: Path
) -> None:
    broken = {
        "part": "tests.eval.parts:least",
        "label": "nan",
        "options": {"factor": float("nan")},
    }
    rows = run(dataset_path, tmp_path / "run", "none", risks=("mean", broken))
    assert rows[rows["risk"] == "nan"]["outcome"].tolist() == ["model_error"] * 2
    assert rows[rows["risk"] == "mean"]["success"].all()
