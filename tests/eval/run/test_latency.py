"""How long one robot waits for a step is measured alone, without the first step, and
once.
"""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from benchnav.core.store import Shard
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.folder.run_folder import open_run
from benchnav.eval.report.result_tables import ALONE
from benchnav.eval.report.write import read_report
from benchnav.eval.run import latency
from benchnav.eval.run.merge import merge_shards
from benchnav.eval.run.runner import run_suite
from benchnav.eval.run.unit import Settings
from tests.eval.conftest import MAX_STEPS

MAPS = 3


@pytest.fixture(autouse=True)
def whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(latency, "_MAX_STEPS", MAX_STEPS)


def suite_on(dataset: Path, *planners: Any, **changes: Any) -> Suite:
    given: dict[str, Any] = {
        "data": str(dataset), "model": "oracle", "planners": planners, "risks": ("mean",),
        "scenarios": ("std",), "maps": MAPS - 1, "record": "none", "world": {"time_budget_s": 4.0},
    }  # fmt: skip
    return Suite(**(given | changes))


def latencies(folder: Path) -> list[Any]:
    return [
        entry.get("latency")
        for entry in open_run(folder).manifest["conditions"].values()
    ]


def test_a_step_of_one_robot_is_timed_with_its_replanning_and_without_the_first(
    dataset_path: Path, tmp_path: Path
) -> None:
    log = tmp_path / "calls.txt"
    timed = {
        "part": "tests.eval.parts:Timed",
        "label": "timed",
        "options": {"log": str(log)},
    }
    failing = {
        "part": "tests.eval.parts:Faulty",
        "label": "bad",
        "options": {"fault": "raise in init"},
    }
    suite = suite_on(dataset_path, timed, failing, risks=("mean", "cvar:0.5"))
    list(run_suite(suite, tmp_path / "run"))
    found = latencies(tmp_path / "run")
    by_planner = {
        condition.labels["planner"]: entry
        for (condition, _), entry in zip(
            open_run(tmp_path / "run").conditions.values(), found, strict=True
        )
    }
    assert by_planner["bad"] is None
    # one measurement for both risk settings
    assert found.count(by_planner["timed"]) == 2
    timed_ms = by_planner["timed"]
    assert timed_ms["steps"] == 39
    assert 4 <= timed_ms["median_ms"] < 30
    assert 40 <= timed_ms["p95_ms"] <= timed_ms["max_ms"]
    # Each condition's batch of two, then one robot alone, once.
    sizes = [line.split()[0] for line in log.read_text().splitlines()]
    assert sizes == ["2"] * 80 + ["1"] * 40
    report = read_report(tmp_path / "run")
    column = report.table.headings.index(ALONE)
    assert [row[column] for row in report.table.rows].count("–") == 2
    assert f"{timed_ms['max_ms']:.0f}"[:1] in report.table.rows[0][column]
    assert report.summary["latency_max_ms"].iloc[0] == timed_ms["max_ms"]


def test_long_episodes_are_left_and_what_was_measured_stays(
    dataset_path: Path, tmp_path: Path
) -> None:
    plain = {
        "part": "tests.eval.parts:Faulty",
        "label": "plain",
        "options": {"fault": "none"},
    }
    slow = {"part": "unicycle", "label": "slow", "options": {"speed_mps": [0.0, 0.1]}}
    still = {"part": "tests.eval.parts:Still", "label": "still"}
    suite = suite_on(dataset_path, still, world={"time_budget_s": 30.0}, maps=1)
    list(run_suite(suite, tmp_path / "run"))
    (first,) = latencies(tmp_path / "run")
    assert first["steps"] == 100
    more = suite_on(
        dataset_path,
        still,
        plain,
        world={"time_budget_s": 30.0},
        maps=1,
        robots=("unicycle", slow),
    )
    list(run_suite(more, tmp_path / "run"))
    found = latencies(tmp_path / "run")
    assert found[0] == first
    assert len({json.dumps(one) for one in found}) == 4


def test_shards_measure_their_own_and_their_run_has_all(
    dataset_path: Path, tmp_path: Path
) -> None:
    plain = {"part": "tests.eval.parts:Faulty", "label": "plain"}
    suite = suite_on(dataset_path, plain, "straight", seeds=(0, 1), maps=1)
    parts = [tmp_path / "1", tmp_path / "2"]
    for index, part in enumerate(parts, start=1):
        list(run_suite(suite, part, shard=Shard(index=index, of=2)))
    list(merge_shards(parts, tmp_path / "all"))
    assert None not in latencies(tmp_path / "all")
    assert latencies(tmp_path / "all")[0] in (
        latencies(parts[0])[0],
        latencies(parts[1])[0],
    )


@pytest.mark.parametrize("limit", [0.0, 60.0])
def test_the_planner_is_run_as_its_episodes_are(
    limit: float, dataset_path: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "pids"
    folder.mkdir()
    held = {"part": "tests.eval.parts:Held", "options": {"log": str(folder / "log")}}
    list(
        run_suite(
            suite_on(dataset_path, held, maps=1),
            tmp_path / "run",
            settings=Settings(planner_limit_s=limit),
        )
    )
    processes = (folder / "log").read_text().split()
    assert len(processes) == 2
    assert processes.count(str(os.getpid())) == (0 if limit else 2)
