"""What is read again of the ground of failures, against the problem and the world that the run was on."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchnav.core.errors import BenchnavError
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.failed_ground import ground_of_run
from benchnav.eval.folder.folder import open_run, read_table, write_run
from benchnav.eval.report.failures import failures_table
from benchnav.eval.report.write import write_report
from benchnav.eval.run.runner import run_suite
from benchnav.eval.run.unit import Settings, build

BELOW = 0.6


@pytest.fixture(scope="module")
def folder(dataset_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with failures: robots are held by much of the ground, at once."""
    made = tmp_path_factory.mktemp("failed") / "run"
    world: dict[str, Any] = {
        "preset": "stakes",
        "immobile": {"below": BELOW, "for_s": 0.1},
        "time_budget_ratio": 1.0,
    }
    suite = Suite(
        data=str(dataset_path), scenarios=("std",), model="oracle", planners=("tests.eval.parts:Faulty",),
        risks=("cvar",), world=world, maps=2, seeds=(0, 1), realisations=2,
        record="steps",
    )  # fmt: skip
    for _ in run_suite(suite, made):
        pass
    return made


def test_the_ground_is_that_of_each_episode_under_its_own_noise(folder: Path) -> None:
    rows = read_table(folder, "episodes.parquet")  # whether they failed does not matter here
    assert len(rows) == 8
    mixed = rows.sort_values("map")
    ground = ground_of_run(folder)(mixed)
    (condition, _) = next(iter(open_run(folder).conditions.values()))
    for place, row in enumerate(mixed.to_dict("records")):
        noise = {name: row[name] for name in ("seed", "realisation")}
        unit = Unit(condition=condition, maps=(row["map"],), **noise)
        problem, simulation = build(unit, Settings().origins().of(unit))
        np.testing.assert_array_equal(ground.predicted[place], problem.risk_map[0].numpy())
        assert simulation.field is not None
        np.testing.assert_array_equal(ground.immobilising[place], (simulation.field[0] < BELOW).numpy())
        np.testing.assert_array_equal(ground.goal_m[place], problem.goal_m[0].numpy())
    # Each is held elsewhere, so that no ground passes for another's.
    assert ground.immobilising.any(axis=(1, 2)).all()
    assert len({immobilising.tobytes() for immobilising in ground.immobilising}) == 8


def test_the_report_shows_it_and_says_what_the_planner_was_told(folder: Path) -> None:
    report = write_report(folder, ground_of_run(folder))
    assert (folder / "figures" / "failures.png").stat().st_size > 5000
    assert "![failures](figures/failures.png)" in (folder / "summary.md").read_text()
    assert any("the predicted λ̂ was " in said for said in report.findings[0].sentences)
    assert report.warnings == () or "No sheet" not in report.warnings[-1]


@pytest.mark.parametrize("part", ["datasets", "codes"])
def test_other_maps_and_models_than_those_of_the_run_are_not_shown(part: str, folder: Path) -> None:
    about = json.loads((folder / "run.json").read_text())
    before = json.dumps(about)
    if part == "datasets":
        (data,) = about[part].values()
        data["maps"]["test/std"] = ["0" * 16 for _ in data["maps"]["test/std"]]
    else:
        (code,) = about[part].values()
        code["parts"]["planner tests.eval.parts:Faulty"] = "another"
    write_run(folder, about)
    try:
        rows = failures_table(folder, read_table(folder, "episodes.parquet"))
        with pytest.raises(BenchnavError, match="Expected"):
            ground_of_run(folder)(rows)
        report = write_report(folder, ground_of_run(folder))
        assert report.warnings[-1].startswith("No sheet of failures: Expected")
    finally:
        (folder / "run.json").write_text(before)
