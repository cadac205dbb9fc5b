"""Whatever of a run is edited, its report is refused in one line, or is what it was."""

import random
import shutil
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from benchnav.core.errors import BenchnavError
from benchnav.eval.compare import compare_runs
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.find_episodes import find_episodes
from benchnav.eval.report.write import read_report
from benchnav.eval.run.runner import run_suite
from tests.edits import edit_json, edit_table


@pytest.fixture(scope="module")
def run(dataset_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("edited") / "run"
    suite = Suite(
        data=str(dataset_path), model="oracle", planners=("tests.eval.parts:Faulty", "straight"),
        risks=("mean", "cvar:0.5"), scenarios=("std",), maps=2, seeds=(0, 3), world={"time_budget_s": 4.0},
        record="none",
    )  # fmt: skip
    list(run_suite(suite, folder))
    return folder


def read_all(folder: Path) -> tuple[pd.DataFrame, pd.DataFrame, Any]:
    """What commands read of a run: its table, its warnings and header, a comparison, an
    episode.
    """
    report = read_report(folder)
    compared, _ = compare_runs([folder], "", "", {}, 0.05)
    find_episodes(folder, {}, None, 0, 0)
    return (
        report.summary,
        compared,
        (report.table, report.header, report.about.get("device")),
    )


def outcome(folder: Path) -> Any:
    """What is read; None where it is refused, which commands do in one line. What else
    is raised fails the test.
    """
    try:
        return read_all(folder)
    except BenchnavError:
        return None


def seeds(count: int) -> range:
    return range(1000 * count, 1000 * count + count)


@pytest.mark.parametrize("count", [50, pytest.param(300, marks=pytest.mark.slow)])
def test_an_edited_run_is_refused_or_read_as_it_was(
    count: int, run: Path, tmp_path: Path
) -> None:
    before, refused = read_all(run), 0
    for seed in seeds(count):
        chance = random.Random(seed)
        folder = Path(shutil.copytree(run, tmp_path / "run"))
        if chance.random() < 0.5:
            said = edit_json(folder / "run.json", chance)
        else:
            said = edit_table(folder / "episodes.parquet", chance)
        after = outcome(folder)
        refused += after is None
        if after is not None:
            pd.testing.assert_frame_equal(
                after[0], before[0], obj=f"seed {seed}, {said}"
            )
            pd.testing.assert_frame_equal(
                after[1], before[1], obj=f"seed {seed}, {said}"
            )
            assert after[2] == before[2], f"seed {seed}, {said}"
        shutil.rmtree(folder)
    assert refused > 0.9 * count
