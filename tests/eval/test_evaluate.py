"""`evaluate` on objects gives the rows that the command gives by names; results answer
without another file.
"""

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

import benchnav
from benchnav.core.errors import ConfigError
from benchnav.eval import Suite, evaluate, open_run, run_suite
from benchnav.eval import cli as eval_cli
from benchnav.eval.results import Results
from benchnav.models import load_model
from benchnav.planning import (
    AStarDWA,
    CVaR,
    FreeSpace,
    Mean,
    Rules,
    Straight,
    Unicycle,
    World,
)
from benchnav.planning.world.world import read_world
from tests.commands import call
from tests.factories import tiny_recipe

FAST = Unicycle(speed_mps=(0.0, 2.0))


def results_of(rows: pd.DataFrame) -> pd.DataFrame:
    """What does not depend on the clock."""
    timed = [
        name for name in rows if name.startswith("planning_") or name == "learning_ms"
    ]
    return rows.drop(columns=[*timed, "code"]).sort_values(
        ["condition", "map"], ignore_index=True
    )


@pytest.fixture(scope="module")
def run(dataset_path: Path) -> Results:
    return evaluate(
        dataset_path,
        planners=[AStarDWA(), Straight()],
        models=[load_model("oracle")],
        risks=[CVaR(0.8), Mean()],
        robots=[FAST],
        world=World.stakes(time_budget_s=20.0),
        rules=Rules(free_space=FreeSpace(by="mean", above=0.2)),
        scenarios=["std"],
        hypotheses=[
            {
                "one": {"risk": "cvar:0.8"},
                "other": {"risk": "mean"},
                "metric": "success",
            }
        ],
        maps=2,
        verbose=False,
    )


def test_objects_give_the_rows_that_names_give(
    run: Results, dataset_path: Path, tmp_path: Path
) -> None:
    suite = Suite(
        data=str(dataset_path),
        planners=("astar_dwa", "straight"),
        models=("oracle",),
        risks=("cvar:0.8", "mean"),
        robots=(
            {
                "part": "unicycle",
                "label": "unicycle speed_mps=[0.0, 2.0]",
                "options": {"speed_mps": [0, 2]},
            },
        ),
        world={"preset": "stakes", "time_budget_s": 20},
        task={"free_space": {"by": "mean", "above": 0.2}, "min_traversability": 0.3},
        scenarios=("std",),
        maps=2,
    )
    for _ in run_suite(suite, tmp_path / "run"):
        pass
    named = pd.read_parquet(tmp_path / "run" / "episodes.parquet")
    pd.testing.assert_frame_equal(results_of(run.episodes), results_of(named))


def test_a_world_is_its_preset_by_name(tmp_path: Path) -> None:
    assert read_world(World.stakes()) == read_world("stakes")
    assert read_world(World.paper()) == read_world("paper")
    changed = {"preset": "stakes", "time_budget_s": 60.0}
    assert read_world(World.stakes(time_budget_s=60.0)) == read_world(changed)
    assert read_world(World.stakes(immobile=None))[0].immobile is None
    with pytest.raises(
        ConfigError, match="exactly one of `time_budget_s` and `time_budget_ratio`"
    ):
        World.stakes(time_budget_s=60.0, time_budget_ratio=2.0)


def test_results_hold_what_the_folder_holds(run: Results, tmp_path: Path) -> None:
    saved = run.save(tmp_path / "kept")
    assert results_of(open_run(tmp_path / "kept").episodes).equals(
        results_of(run.episodes)
    )
    with pytest.raises(ConfigError, match="new or empty"):
        run.save(tmp_path / "kept")
    assert list(run.conditions["planner"]) == ["astar_dwa", "straight", "astar_dwa"]
    assert len(repr(saved).splitlines()) <= 6
    assert len(repr(run.compare(by="risk")).splitlines()) == 1
    page = saved.report(tmp_path / "page")
    assert page.is_file()
    assert not (tmp_path / "kept" / "report.html").exists()
    tests = pd.read_csv(page.parent / "hypotheses.csv")
    assert list(tests["claim"]) == list(run.hypotheses["claim"])
    assert len(tests) == 1


def test_results_compare_as_the_command_does(run: Results, tmp_path: Path) -> None:
    saved = run.save(tmp_path / "kept")
    found = saved.compare(by="risk", against="mean", planner="astar_dwa")
    assert (
        call(
            "eval",
            "compare",
            saved.folder,
            "--by",
            "risk",
            "--against",
            "mean",
            "--out",
            tmp_path / "c",
        )
        == 0
    )
    written = pd.read_csv(tmp_path / "c.csv")
    assert found.numbers["success_difference"].tolist() == pytest.approx(
        written["success_difference"].tolist()
    )
    assert [path.name for path in found.save(tmp_path / "d")] == [
        "d.csv",
        "d.md",
        "d.tex",
    ]
    with pytest.raises(ConfigError, match="labels among"):
        saved.compare(by="risk", plannr="astar_dwa")
    best = saved.best()
    assert best["success_rate"].is_monotonic_decreasing
    assert set(best["planner"]) <= {"astar_dwa", "straight"}


def test_figures_are_methods(run: Results) -> None:
    figure = run.plot.success()
    assert figure.axes
    assert figure._repr_png_().startswith(b"\x89PNG")  # which notebooks show
    with pytest.raises(ConfigError, match="Did you mean 'success'"):
        run.plot.sucess()


def test_a_planner_of_a_file_gives_equal_rows_from_a_program_and_from_two_processes(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    Path("slower.py").write_text(
        "from benchnav.planning import Straight\n\n\n"
        "class Slower(Straight):\n"
        "    def __init__(self, factor: float = 0.5):\n        super().__init__()\n        self.factor = factor\n\n"
        "    def plan(self, step, plan_state):\n"
        "        action, plan_state, plan = super().plan(step, plan_state)\n"
        "        return action * self.factor, plan_state, plan\n"
    )
    slower = import_module("slower").Slower(factor=0.25)
    ours = evaluate(
        dataset_path,
        folder="program",
        planners=[slower],
        models=["oracle"],
        scenarios=["std"],
        maps=2,
        verbose=False,
    )
    words = [
        "--data",
        dataset_path,
        "--model",
        "oracle",
        "--scenarios",
        "[std]",
        "--maps",
        2,
        "--jobs",
        2,
    ]
    planners = (
        '[{part: "slower.py:Slower", label: "Slower:0.25", options: {factor: 0.25}}]'
    )
    # A report takes longer than a run.
    monkeypatch.setattr(eval_cli, "_finish", eval_cli._failed)
    assert call("eval", "run", *words, "--planners", planners, "--out", "command") == 0
    pd.testing.assert_frame_equal(
        results_of(ours.episodes), results_of(open_run("command").episodes)
    )
    del sys.modules["slower"]


def test_objects_of_one_process_are_marked_and_not_resumed(
    dataset_path: Path, tmp_path: Path
) -> None:
    class Mine(Straight):
        pass

    given: dict[str, Any] = {
        "models": ["oracle"],
        "scenarios": ["std"],
        "maps": 1,
        "verbose": False,
    }
    given |= {"terrain": dataset_path, "planners": [{"part": Mine(), "label": "mine"}]}
    results = evaluate(**given, folder=tmp_path / "run")
    assert any("not reproducible: planner mine" in line for line in results.notes)
    page = results.report()
    assert (
        "Not reproducible: planner mine is an object of one process" in page.read_text()
    )
    with pytest.raises(
        ConfigError, match="whose planner mine was a Python object that existed only in"
    ):
        evaluate(**given, folder=tmp_path / "run")
    with pytest.raises(ConfigError, match="which exists only in this process"):
        evaluate(**given, jobs=2)
    assert call("eval", "rerun", tmp_path / "run") == 2


def test_the_maps_of_a_recipe_are_generated(tmp_path: Path) -> None:
    results = evaluate(
        tiny_recipe(),
        folder=tmp_path / "run",
        planners=[Straight()],
        models=["oracle"],
        maps=1,
        verbose=False,
    )
    assert sorted(results.episodes["scenario"]) == ["hg", "hs", "std"]


def test_what_is_missing_or_unknown_is_named(dataset_path: Path) -> None:
    with pytest.raises(ConfigError, match="`models`, such as"):
        evaluate(dataset_path, planners=[Straight()])
    with pytest.raises(ConfigError, match="Did you mean 'planners'"):
        evaluate(dataset_path, planner=[Straight()], models=["oracle"])


def test_public_names() -> None:
    assert benchnav.evaluate is evaluate
    assert benchnav.open_run is open_run
