"""Runs that are read before they are finished: their rows are those of the finished
run, and all says "partial".
"""

import hashlib
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchnav.core.errors import ConfigError
from benchnav.core.store import Shard
from benchnav.eval.compare import compare_runs
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.find_episodes import find_episodes
from benchnav.eval.folder.results import newest_units, read_results
from benchnav.eval.folder.run_folder import EPISODES, KEYS, open_run
from benchnav.eval.folder.steps import read_steps
from benchnav.eval.report.write import write_report
from benchnav.eval.run.recordings import find_recording, record_driven
from benchnav.eval.run.runner import run_suite
from tests.commands import call

FINISHED = 3  # of six units: both of `mean`, one of `cvar`, none of `var`
MARK = "artial: 3 of 6 units"


@pytest.fixture(scope="module")
def suite(dataset_path: Path) -> Suite:
    """Three conditions under two seeds; the first two fail, one on steps of other
    columns than the other.
    """
    hypotheses = [
        {"one": {"risk": risk, "planner": "Faulty"}, "other": {"risk": "mean", "planner": "Faulty"}, "metric": metric}
        for risk, metric in (("cvar", "T_total"), ("cvar", "success"), ("var", "success"))
    ]  # fmt: skip
    return Suite(
        data=str(dataset_path), model="oracle", planners=("tests.eval.parts:Faulty",), risks=("mean", "cvar", "var"),
        scenarios=("std",), seeds=(0, 1), maps=2, record="steps", world={"time_budget_s": 3.0},
        hypotheses=tuple(hypotheses),
    )  # fmt: skip


@pytest.fixture(scope="module")
def whole(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole") / "run"
    list(run_suite(suite, folder))
    return folder


@pytest.fixture
def running(suite: Suite, tmp_path: Path) -> Iterator[Path]:
    """A run in which `FINISHED` units are, while a command still holds the folder."""
    steps = run_suite(suite, tmp_path / "run")
    for step in steps:
        if step.done == FINISHED + 1:
            break
    rows = {
        path: pd.read_parquet(path) for path in (tmp_path / "run").glob("units/*/*")
    }
    (path,) = [path for path, own in rows.items() if set(own["risk"]) == {"var"}]
    path.unlink()
    yield tmp_path / "run"
    steps.close()


def digests(folder: Path) -> dict[str, str]:
    files = (
        path
        for path in folder.rglob("*")
        if path.is_file() and "partial" not in path.relative_to(folder).parts
    )
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_rows_of_a_run_that_is_not_finished_are_those_of_the_finished_one(
    running: Path, whole: Path
) -> None:
    with pytest.raises(ConfigError, match=r"finished run.* --partial"):
        read_results(running)
    found, all_rows = (
        read_results(running, partial=True),
        pd.read_parquet(whole / EPISODES),
    )
    kept = all_rows.set_index(KEYS).loc[
        list(found.episodes[KEYS].itertuples(index=False, name=None))
    ]
    same = [
        name
        for name in kept.columns
        if not name.startswith(("planning_", "learning_ms"))
    ]
    pd.testing.assert_frame_equal(
        kept[same].reset_index(), found.episodes[[*KEYS, *same]]
    )
    assert len(found.episodes) == 2 * FINISHED
    assert found.mark == "partial: 3 of 6 units"
    (lacking,) = set(all_rows["condition"]) - set(found.episodes["condition"])
    risk = all_rows.loc[all_rows["condition"] == lacking, "risk"].iloc[0]
    assert any("6 of 12 episodes" in line for line in found.notes())
    assert any(f"no episode yet: std Faulty {risk}" in line for line in found.notes())
    # A finished run is read as it was, whether parts would do or not.
    finished = read_results(whole, partial=True)
    assert (finished.mark, finished.notes()) == ("", [])
    pd.testing.assert_frame_equal(finished.episodes, all_rows)


def test_a_partial_report_says_so_everywhere_and_touches_nothing_of_the_run(
    running: Path, suite: Suite, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    marked: list[str] = []
    monkeypatch.setattr(
        "benchnav.eval.report.write.save_twice",
        lambda figure, path, mark="", **options: (
            marked.append(mark),
            path.parent.mkdir(exist_ok=True),
            png(path),
        ),
    )
    before = digests(running)
    report = write_report(
        running, lambda rows: record_driven(running, rows), partial=True
    )
    assert digests(running) == before
    place = running / "partial"
    assert len(marked) >= 4
    assert all(mark.endswith(MARK) for mark in marked)
    for path in place.glob("*.csv"):
        table = pd.read_csv(path)
        assert list(table.columns)[-1] == "partial"
        assert set(table["partial"]) == {"3 of 6 units"}
    assert {path.name for path in place.glob("*.csv")} == {
        "summary.csv",
        "failures.csv",
        "hypotheses.csv",
    }
    text, page = (place / "summary.md").read_text(), (place / "report.html").read_text()
    assert MARK in text.splitlines()[0]
    assert all(
        MARK in table for table in re.findall(r"\|---.*?\n\n(.*?)\n\n", text, re.DOTALL)
    )
    assert page.count(MARK) > 5
    assert MARK in page.partition("</title>")[0]
    for name in ("summary.tex", "hypotheses.tex"):
        tex = (place / name).read_text()
        assert re.search(r"\\caption\{Partial: 3 of 6 units", tex)
    assert len(report.sheets.shown) == 1
    # Differences are of common episodes, and nothing is a finding of a test.
    rows = read_results(running, partial=True).episodes.set_index(["seed", "map"])
    by_risk = dict(list(rows.groupby("risk")))
    assert {risk: len(own) for risk, own in by_risk.items()} == {"mean": 4, "cvar": 2}
    tests = report.tests
    assert tests[["p", "p_holm"]].isna().all(axis=None)
    assert not tests["supported"].any()
    for (_, test), (one, metric) in zip(
        tests.iterrows(),
        (("cvar", "total_time_s"), ("cvar", "success"), ("var", "success")),
        strict=True,
    ):
        if one in by_risk and "mean" in by_risk:
            both = by_risk[one].join(by_risk["mean"], rsuffix="_mean", how="inner")
            expected = (
                both[metric].astype(float) - both[f"{metric}_mean"].astype(float)
            ).mean()
            scale = 100 if metric == "success" else 1
            assert (test["n_episodes"], test["difference"]) == (
                len(both),
                pytest.approx(scale * expected),
            )
        else:
            assert test["n_episodes"] == 0
    said = [
        line
        for lines in report.findings.values()
        for line in lines
        if "partial: not yet a test" in line
    ]
    assert len(said) == 3
    assert all("partial: not yet a test" in row[-1] for row in report.hypotheses.rows)
    assert not any("significantly" in line or "p =" in line for line in said)


def png(path: Path) -> None:
    from matplotlib.figure import Figure

    Figure(figsize=(1, 1)).savefig(path)


def test_a_run_that_was_read_goes_on_as_if_nobody_had(
    suite: Suite, tmp_path: Path, whole: Path
) -> None:
    folder = tmp_path / "run"
    steps = run_suite(suite, folder)
    for step in steps:
        if step.done in (1, step.total - 1):
            write_report(folder, partial=True)
    results = [pd.read_parquet(place / EPISODES) for place in (folder, whole)]
    same = [
        name for name in results[0] if not name.startswith(("planning_", "learning_ms"))
    ]
    pd.testing.assert_frame_equal(results[0][same], results[1][same])
    assert write_report(folder, partial=True).mark == ""
    assert (folder / "report.html").exists()


def test_episodes_of_finished_units_are_replayed_while_the_run_goes_on(
    running: Path, tmp_path: Path
) -> None:
    known = {
        unit.condition.labels["risk"]: one
        for unit, one in newest_units(open_run(running))
        if unit.seed == 1
    }
    # Of what is not named the first condition that has rows is taken.
    ((unit, member),) = find_episodes(running, {}, 1, 0, 1)
    assert known[unit.condition.labels["risk"]] is not None
    mean = next(iter(open_run(running).conditions))
    (lost,) = running.glob(f"units/{mean}/0-*")
    lost.rename(tmp_path / "lost")
    ((other, _),) = find_episodes(running, {}, 0, 0, 1)
    assert (other.seed, other.condition.labels["risk"]) == (0, "cvar")
    (tmp_path / "lost").rename(lost)
    recording = find_recording(running, unit, member, tmp_path / "out")
    rows = read_results(running, partial=True).episodes
    row = rows[
        (rows["condition"] == unit.condition.id)
        & (rows["seed"] == 1)
        & (rows["map"] == 1)
    ].iloc[0]
    assert (recording.about["outcome"], recording.end_s) == (
        row["outcome"],
        pytest.approx(row["end_time_s"]),
    )
    assert not (running / "playback").exists()
    lacking = next(risk for risk, one in known.items() if one is None)
    ((unit, member),) = find_episodes(running, {"risk": [lacking]}, 1, 0, 1)
    with pytest.raises(ConfigError, match="does not contain yet"):
        find_recording(running, unit, member, tmp_path / "out")


def test_a_run_without_a_finished_unit_and_a_comparison_are_refused(
    suite: Suite, tmp_path: Path, running: Path, capsys: Any
) -> None:
    next(steps := run_suite(suite, tmp_path / "begun"))
    steps.close()
    for words, said in (
        (("report", tmp_path / "begun", "--partial"), "got .*, where 0 of 6"),
        (("report", running), "--partial"),
        (("compare", running, "--against", "mean"), "Expected a finished run"),
    ):
        assert call("eval", *words) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert re.search(said, line)
    with pytest.raises(ConfigError, match="finished run"):
        compare_runs([running], "", "mean", {}, 0.05)


def test_a_shard_is_a_part_of_its_run(suite: Suite, tmp_path: Path) -> None:
    folder = tmp_path / "part"
    list(run_suite(suite, folder, shard=Shard(index=1, of=2)))
    with pytest.raises(ConfigError, match="Merge all shards"):
        read_results(folder)
    found = read_results(folder, partial=True)
    assert (found.finished, found.units) == (len(list(folder.glob("units/*/*"))), 6)


def test_steps_of_robots_with_other_actions_are_read_before_they_are_aligned(
    suite: Suite, tmp_path: Path
) -> None:
    mixed = replace(
        suite,
        robots=("unicycle", "bicycle"),
        risks=("mean",),
        seeds=(0,),
        hypotheses=(),
        record="steps",
    )
    steps = run_suite(mixed, tmp_path / "run")
    for step in steps:
        if step.done == 2:
            break
    assert {"turn_rate_radps", "steering_rad"} <= set(read_steps(tmp_path / "run"))
    report = write_report(
        tmp_path / "run",
        lambda rows: record_driven(tmp_path / "run", rows),
        partial=True,
    )
    assert not report.sheets.left_out
    assert {one.about["robot"] for _, lines in report.sheets.shown for line in lines for one in line.recordings} == {
        "unicycle", "bicycle"
    }  # fmt: skip
    assert not np.isnan(report.failures["last_traversability"]).any()
    steps.close()
