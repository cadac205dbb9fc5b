"""What readers of a run's tables should know: pairs that were left out, and what was warned of."""

import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from benchnav.core.errors import ConfigError
from benchnav.core.store import Shard
from benchnav.core.tables import to_terminal
from benchnav.eval.compare import compare_runs
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.folder.run_folder import open_run
from benchnav.eval.report.write import print_report, write_report
from benchnav.eval.run.merge import merge_shards
from benchnav.eval.run.rerun import rerun
from benchnav.eval.run.runner import run_suite

FREE, STEERING = "tests.eval.parts:Faulty", "tests.eval.parts:Steering"
LINE = "left out: planner Steering cannot steer robot bicycle"
WARNING = (
    "warning: in 2 of 2 maps of test/std a robot of 1 m/s cannot reach the goal within the time budget T"
)


def suite_on(dataset: Path, **changes: Any) -> Suite:
    given: dict[str, Any] = {
        "data": str(dataset), "model": "oracle", "planners": (FREE, STEERING), "risks": ("mean", "cvar:0.5"),
        "robots": ("unicycle", "bicycle"), "scenarios": ("std",), "maps": 2, "record": "none",
        "world": {"time_budget_s": 3.0},
    }  # fmt: skip
    return Suite(**(given | changes))


def test_a_pair_that_cannot_be_steered_is_left_out_and_named_everywhere(
    dataset_path: Path, tmp_path: Path, capsys: Any
) -> None:
    said: list[str] = []
    folder = tmp_path / "run"
    list(run_suite(suite_on(dataset_path), folder, say=said.append))
    assert {LINE, WARNING} <= set(said)
    run = open_run(folder)
    pairs = {
        (condition.labels["planner"], condition.labels["robot"]) for condition, _ in run.conditions.values()
    }
    assert pairs == {("Faulty", "unicycle"), ("Faulty", "bicycle"), ("Steering", "unicycle")}
    (dropped,) = run.about["dropped"]
    assert (dropped["planner"], dropped["robot"]) == ("Steering", "bicycle")
    assert dropped["reason"].startswith("Expected a robot with actions (speed_mps, turn_rate_radps)")
    assert run.about["warnings"].count(WARNING.removeprefix("warning: ")) == 1
    report = write_report(folder)
    print_report(report)
    printed = capsys.readouterr().out
    table = to_terminal(report.table).rstrip()
    below = printed.partition(table)[2]
    assert below
    text, page = (folder / "summary.md").read_text(), (folder / "report.html").read_text()
    for line in (LINE, WARNING):
        assert line not in table
        assert line in below
        assert line in text.partition("|---|")[2]
        assert line in page
        assert line in (folder / "summary.tex").read_text()
    # The family of tests is that of the conditions that were run.
    compared, shown = compare_runs([folder], "", "mean", {}, 0.05)
    assert len(compared) == 3
    assert {LINE, WARNING} <= set(shown.notes)
    _, shown = compare_runs([folder], "", "mean", {"robot": ["unicycle"]}, 0.05)
    assert WARNING in shown.notes
    assert LINE not in shown.notes
    # A run that is extended, and one that is repeated, still say it.
    list(run_suite(suite_on(dataset_path, robots=("unicycle",), seed=1), folder))
    assert open_run(folder).about["dropped"] == [dropped]
    next(steps := rerun(folder, tmp_path / "again"))
    steps.close()
    again = open_run(tmp_path / "again").about
    assert (again["dropped"], again["warnings"]) == ([dropped], open_run(folder).about["warnings"])


def test_a_run_in_which_nothing_is_left_is_refused(dataset_path: Path, tmp_path: Path) -> None:
    suite = suite_on(dataset_path, planners=(STEERING,), robots=("bicycle",))
    with pytest.raises(ConfigError, match="Expected a robot with actions"):
        list(run_suite(suite, tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_a_merged_run_says_what_its_shards_said(dataset_path: Path, tmp_path: Path) -> None:
    parts = [tmp_path / "1", tmp_path / "2"]
    for index, part in enumerate(parts, start=1):
        list(run_suite(suite_on(dataset_path), part, shard=Shard(index=index, of=2)))
    list(merge_shards(parts, tmp_path / "all"))
    about = open_run(tmp_path / "all").about
    assert about["dropped"] == open_run(parts[0]).about["dropped"]
    assert about["warnings"] == open_run(parts[1]).about["warnings"]
    assert json.dumps(about["history"]).count(str(dataset_path)) == len(about["history"])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"planner": "optimal", "beliefs": ("copula",)}, "'optimal', which plans once, got 'copula' and 'full'"),
        ({"planner": "optimal", "sensors": ("near:4",)}, "'optimal', which plans once, got 'static' and 'near:4'"),
        ({"planner": "optimal_bound"}, "planner 'optimal_bound', which is given λ itself, got 'oracle'"),
        ({"planner": "optimal", "robots": ("bicycle",)}, "Expected robot Unicycle for planner 'optimal', got Bicycle"),
        (
            {"planner": {"part": "optimal", "options": {"hazard": True}}, "world": "paper"},
            "immobilises robots for `hazard`",
        ),
    ],
)  # fmt: skip
def test_what_a_planner_cannot_be_told_is_refused_before_anything_is_run(
    dataset_path: Path, tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    planner = changes.pop("planner")
    suite = {"planners": (planner,), "robots": ("unicycle",), "risks": ("mean",), "world": "stakes"} | changes
    with pytest.raises(ConfigError, match=words):
        list(run_suite(suite_on(dataset_path, **suite), tmp_path / "run"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("once", [False, True])
def test_risk_on_the_cost_is_run_by_its_options(dataset_path: Path, tmp_path: Path, once: bool) -> None:
    options = {"samples": 32, "horizon_s": 1.0, "risk_on": "cost", "fields": 20, "level": 0.5, "once": once}
    planners = ({"part": "mppi", "options": options},)
    suite = suite_on(dataset_path, planners=planners, robots=("unicycle",), risks=("mean",), world="stakes")
    list(run_suite(suite, tmp_path / "run"))
    rows = pd.read_parquet(tmp_path / "run" / "episodes.parquet")
    assert not rows["outcome"].isin(["planner_error", "model_error"]).any()


def test_optimal_planners_are_run_by_their_names(dataset_path: Path, tmp_path: Path) -> None:
    conditions = [
        {"planners": ["optimal", {"part": "optimal", "label": "careful", "options": {"hazard": True}}]},
        {"planners": ["optimal", "optimal_bound"], "models": ["clairvoyant"]},
    ]
    suite = suite_on(
        dataset_path, conditions=conditions, robots=("unicycle",), risks=("mean",), world="stakes"
    )
    folder = tmp_path / "run"
    list(run_suite(suite, folder))
    rows = pd.read_parquet(folder / "episodes.parquet")
    assert len(rows) == 4 * 2
    known = rows[rows["model"] == "clairvoyant"]
    assert (known["outcome"] == "success").all()
    bound, plain = (
        known[known["planner"] == name]["end_time_s"].to_numpy() for name in ("optimal_bound", "optimal")
    )
    assert (bound <= plain + 0.5).all()
