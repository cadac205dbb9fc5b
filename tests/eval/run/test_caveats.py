"""What readers of a run's tables should know: pairs that were left out, and what was
warned of.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from benchnav.core.errors import ConfigError
from benchnav.core.store import Shard
from benchnav.core.tables import to_terminal
from benchnav.eval.compare import compare_runs
from benchnav.eval.experiment.condition import conditions_of, scenarios_of
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.folder.run_folder import caveats, open_run
from benchnav.eval.report.write import print_report, write_report
from benchnav.eval.run.begin import Work, begin
from benchnav.eval.run.check import check_suite
from benchnav.eval.run.merge import merge_shards
from benchnav.eval.run.rerun import rerun
from benchnav.eval.run.runner import run_suite
from benchnav.eval.run.unit import Settings
from tests.eval.parts import TwoModes

FREE, STEERING = "tests.eval.parts:Faulty", "tests.eval.parts:Steering"
TWO_MODES = "tests.eval.parts:TwoModes"
HAZARD = {"part": "optimal", "label": "careful", "options": {"hazard": True}}
LINE = "left out: planner Steering, robot bicycle: Expected a robot with actions"
WARNING = (
    "warning: in 2 of 2 maps of test/std, a robot with a top speed of 1 m/s cannot "
    "reach the goal within the time budget T"
)


def suite_on(dataset: Path, **changes: Any) -> Suite:
    given: dict[str, Any] = {
        "data": str(dataset), "models": ("oracle",), "planners": (FREE, STEERING), "risks": ("mean", "cvar:0.5"),
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
    assert all(
        any(line.startswith(known) for line in said) for known in (LINE, WARNING)
    )
    run = open_run(folder)
    pairs = {
        (condition.labels["planner"], condition.labels["robot"])
        for condition, _ in run.conditions.values()
    }
    assert pairs == {
        ("Faulty", "unicycle"),
        ("Faulty", "bicycle"),
        ("Steering", "unicycle"),
    }
    (dropped,) = run.manifest["dropped"]
    assert (dropped["planner"], dropped["robot"]) == ("Steering", "bicycle")
    assert dropped["reason"].startswith(
        "Expected a robot with actions (speed_mps, turn_rate_radps)"
    )
    assert run.manifest["warnings"].count(WARNING.removeprefix("warning: ")) == 1
    report = write_report(folder)
    print_report(report)
    printed = capsys.readouterr().out
    table = to_terminal(report.table).rstrip()
    below = printed.partition(table)[2]
    assert below
    text, page = (
        (folder / "summary.md").read_text(),
        (folder / "report.html").read_text(),
    )
    for line in (LINE, WARNING):
        assert line not in table
        assert line in below
        assert line in text.partition("|---|")[2]
        assert line in page
        assert line in (folder / "summary.tex").read_text()
    # The family of tests is that of the conditions that were run.
    compared, shown = compare_runs([folder], "", "mean", {}, 0.05)
    assert len(compared) == 3
    assert all(
        any(line.startswith(known) for line in shown.notes) for known in (LINE, WARNING)
    )
    _, shown = compare_runs([folder], "", "mean", {"robot": ["unicycle"]}, 0.05)
    assert WARNING in shown.notes
    assert not any(line.startswith(LINE) for line in shown.notes)
    # A run that is extended, and one that is repeated, still say it.
    list(run_suite(suite_on(dataset_path, robots=("unicycle",), seed=1), folder))
    assert open_run(folder).manifest["dropped"] == [dropped]
    next(steps := rerun(folder, tmp_path / "again"))
    steps.close()
    again = open_run(tmp_path / "again").manifest
    assert (again["dropped"], again["warnings"]) == (
        [dropped],
        open_run(folder).manifest["warnings"],
    )


def test_a_run_in_which_nothing_is_left_is_refused(
    dataset_path: Path, tmp_path: Path
) -> None:
    suite = suite_on(dataset_path, planners=(STEERING,), robots=("bicycle",))
    with pytest.raises(ConfigError, match="Expected a robot with actions"):
        list(run_suite(suite, tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_a_world_without_a_feasible_path_is_refused_before_anything_is_run(
    dataset_path: Path, tmp_path: Path
) -> None:
    world = {
        "preset": "stakes",
        "immobile": {"below": 0.999, "for_s": 2},
        "time_budget_s": 3.0,
    }
    suite = suite_on(dataset_path, planners=(FREE,), robots=("unicycle",), world=world)
    with pytest.raises(
        ConfigError, match="Expected a feasible path from start to goal"
    ):
        list(run_suite(suite, tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_a_merged_run_says_what_its_shards_said(
    dataset_path: Path, tmp_path: Path
) -> None:
    parts = [tmp_path / "1", tmp_path / "2"]
    for index, part in enumerate(parts, start=1):
        list(run_suite(suite_on(dataset_path), part, shard=Shard(index=index, of=2)))
    list(merge_shards(parts, tmp_path / "all"))
    about = open_run(tmp_path / "all").manifest
    assert about["dropped"] == open_run(parts[0]).manifest["dropped"]
    assert about["warnings"] == open_run(parts[1]).manifest["warnings"]
    assert json.dumps(about["history"]).count(str(dataset_path)) == len(
        about["history"]
    )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"planner": "optimal", "beliefs": ("copula",)}, "got 'copula' and 'full'. This planner plans only once"),
        ({"planner": "optimal", "sensors": ("near:4",)}, "got 'static' and 'near:4'. This planner plans only once"),
        ({"planner": "near_optimal"}, "planner 'near_optimal', got 'oracle'. This planner needs the true"),
        ({"planner": "optimal", "robots": ("bicycle",)}, "Expected robot Unicycle for planner 'optimal', got Bicycle"),
        ({"planner": HAZARD, "world": "paper"}, "only in a world that immobilises"),
        ({"planner": FREE, "models": ("clairvoyant",), "world": "paper"}, "constant λ for the model 'clairvoyant'"),
        ({"planner": FREE, "risks": ("single-class",), "models": (TWO_MODES,)}, "has no `class_names`"),
    ],
)  # fmt: skip
def test_a_suite_in_which_no_combination_can_be_run_is_refused_before_anything_is_run(
    dataset_path: Path, tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    planner = changes.pop("planner")
    suite = {
        "planners": (planner,),
        "robots": ("unicycle",),
        "risks": ("mean",),
        "world": "stakes",
    } | changes
    with pytest.raises(ConfigError, match=words):
        list(run_suite(suite_on(dataset_path, **suite), tmp_path / "run"))
    assert not (tmp_path / "run").exists()


# Which cells of a product can be run, as the parts are documented.
POSSIBLE: tuple[Callable[[dict[str, str]], bool], ...] = (
    lambda cell: not (cell["risk"] == "single-class" and cell["model"] == "TwoModes"),
    lambda cell: not (cell["risk"] == "single-class" and cell["belief"] == "copula"),
    lambda cell: (
        not (
            cell["planner"] in ("optimal", "careful", "near_optimal")
            and cell["belief"] == "copula"
        )
    ),
    lambda cell: (
        not (cell["planner"] == "near_optimal" and cell["model"] != "clairvoyant")
    ),
    lambda cell: not (cell["planner"] == "careful" and cell["world"] == "paper"),
    lambda cell: not (cell["model"] == "clairvoyant" and cell["world"] == "paper"),
)


def test_of_a_product_exactly_the_combinations_that_can_be_run_are_left(
    dataset_path: Path,
) -> None:
    listed: dict[str, Any] = {
        "planners": (FREE, "straight", "optimal", HAZARD, "near_optimal"),
        "models": ("oracle", TWO_MODES, "clairvoyant"),
        "risks": ("mean", "single-class"), "beliefs": ("static", "copula"), "world": ("paper", "stakes"),
    }  # fmt: skip
    suite = suite_on(dataset_path, robots=("unicycle",), maps=1, **listed)
    checked = check_suite(suite, uses_workers=False)
    columns = ("planner", "model", "risk", "belief", "world")
    labels = [condition.labels for condition in conditions_of(suite, scenarios_of)]
    # What a condition does not use is like a label with which all goes together.
    expected = [cell for cell in labels if all(possible(cell) for possible in POSSIBLE)]
    left = [condition.labels for condition, _ in checked.conditions.values()]
    assert left == expected
    assert 0 < len(left) < len(labels)
    # Each combination is named once, and its labels are in no condition that is left.
    pairs = [
        {name: label for name, label in entry.items() if name != "reason"}
        for entry in checked.dropped
    ]
    assert len({tuple(pair.items()) for pair in pairs}) == len(pairs)
    for cell in labels:
        assert (cell in left) != any(pair.items() <= cell.items() for pair in pairs)
    assert {"model": "TwoModes", "risk": "single-class"} in pairs
    assert all(
        set(pair) < {*columns, "sensor", "robot", "objective", "data"} for pair in pairs
    )


def test_what_is_left_out_is_told_before_anything_is_run_and_until_it_can_be_run(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite = suite_on(
        dataset_path, planners=(FREE,), robots=("unicycle",), models=("oracle", TWO_MODES),
        risks=("mean", "single-class"),
    )  # fmt: skip
    said: list[str] = []
    next(steps := run_suite(suite, tmp_path / "run", say=said.append))
    steps.close()
    (line,) = [line for line in said if line.startswith("left out")]
    assert line.startswith(
        "left out: model TwoModes, risk single-class: Expected a model that predicts classes"
    )
    assert line in caveats(open_run(tmp_path / "run").manifest)
    # The class has learnt its classes.
    monkeypatch.setattr(TwoModes, "class_names", ("firm", "soft"))
    checked = check_suite(suite, uses_workers=False)
    work = Work(**vars(checked), suite={}, record="none", settings=Settings())
    begin(work, tmp_path / "run", said.append)
    assert open_run(tmp_path / "run").manifest["dropped"] == []


def test_a_planner_whose_settings_are_never_prepared_is_refused(
    dataset_path: Path,
) -> None:
    """Its settings are at fault, where what drops out would be all that the suite has
    of it.
    """
    suite = suite_on(
        dataset_path, planners=(FREE, HAZARD), robots=("unicycle",), world="paper"
    )
    with pytest.raises(ConfigError, match="only in a world that immobilises"):
        check_suite(suite, uses_workers=False)
    left = check_suite(replace(suite, world=("paper", "stakes")), uses_workers=False)
    assert [entry["world"] for entry in left.dropped] == ["paper"]


@pytest.mark.parametrize(
    ("one", "other", "words"),
    [
        ({"risk": "single-class", "model": "TwoModes"}, {"risk": "mean", "model": "TwoModes"}, "has no `class_names`"),
        ({"risk": "single-class"}, {"risk": "mean"}, "has no `class_names`"),
        ({"risk": "single-class", "model": "oracle"}, {"risk": "mean", "model": "oracle"}, ""),
        ({"risk": "mean", "model": "TwoModes"}, {"risk": "mean", "model": "oracle"}, ""),
    ],
)  # fmt: skip
def test_a_hypothesis_on_what_is_left_out_is_refused(
    dataset_path: Path,
    tmp_path: Path,
    one: dict[str, str],
    other: dict[str, str],
    words: str,
) -> None:
    suite = suite_on(
        dataset_path, planners=(FREE,), robots=("unicycle",), models=("oracle", TWO_MODES),
        risks=("mean", "single-class"), hypotheses=({"one": one, "other": other, "metric": "success"},),
    )  # fmt: skip
    if words:
        with pytest.raises(
            ConfigError, match=f"in which one condition cannot be run: .*{words}"
        ):
            check_suite(suite, uses_workers=False)
    else:
        assert len(check_suite(suite, uses_workers=False).hypotheses["tests"]) == 1


@pytest.mark.parametrize("once", [False, True])
def test_risk_on_the_cost_is_run_by_its_options(
    dataset_path: Path, tmp_path: Path, once: bool
) -> None:
    options = {
        "samples": 32,
        "horizon_s": 1.0,
        "risk_on": "cost",
        "fields": 20,
        "level": 0.5,
        "once": once,
    }
    planners = ({"part": "mppi", "options": options},)
    suite = suite_on(
        dataset_path,
        planners=planners,
        robots=("unicycle",),
        risks=("mean",),
        world="stakes",
    )
    list(run_suite(suite, tmp_path / "run"))
    rows = pd.read_parquet(tmp_path / "run" / "episodes.parquet")
    assert not rows["outcome"].isin(["planner_error", "model_error"]).any()


def test_optimal_planners_are_run_by_their_names(
    dataset_path: Path, tmp_path: Path
) -> None:
    conditions = [
        {
            "planners": [
                "optimal",
                {"part": "optimal", "label": "careful", "options": {"hazard": True}},
            ]
        },
        {"planners": ["optimal", "near_optimal"], "models": ["clairvoyant"]},
    ]
    suite = suite_on(
        dataset_path,
        conditions=conditions,
        robots=("unicycle",),
        risks=("mean",),
        world="stakes",
        maps=1,
    )
    folder = tmp_path / "run"
    list(run_suite(suite, folder))
    rows = pd.read_parquet(folder / "episodes.parquet")
    assert len(rows) == 4
    known = rows[rows["model"] == "clairvoyant"]
    assert (known["outcome"] == "success").all()
    bound, plain = (
        known[known["planner"] == name]["end_time_s"].to_numpy()
        for name in ("near_optimal", "optimal")
    )
    assert (bound <= plain + 0.5).all()
