"""Metrics that a suite names: from a file to rows, tables, hypotheses, comparisons and
the page of the run.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.store import Shard
from benchnav.eval.compare import compare_runs
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.folder.run_folder import open_run
from benchnav.eval.folder.steps import read_steps
from benchnav.eval.run import rerun, runner
from benchnav.eval.run.merge import merge_shards
from benchnav.eval.run.runner import run_suite
from benchnav.stats.holm import holm
from tests.commands import call

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_metric.py"
DETOUR = f"{EXAMPLE}:Detour"
HYPOTHESES = (
    {"one": {"risk": "cvar"}, "other": {"risk": "mean"}, "metric": "energy", "kind": "non-inferiority", "margin": 50},
    {"one": {"risk": "cvar"}, "other": {"risk": "mean"}, "metric": "detour"},
)  # fmt: skip


def suite(dataset_path: Path, **changes: Any) -> Suite:
    given = {
        "data": str(dataset_path), "model": "oracle", "planners": ("tests.eval.parts:Faulty",),
        "risks": ("mean", "cvar"),
        "scenarios": ("std",), "maps": 2, "world": {"noise": "stored", "time_budget_s": 30.0}, "record": "steps",
    } | changes  # fmt: skip
    return Suite(**given)


def run(
    dataset_path: Path, folder: Path, jobs: int = 1, **changes: Any
) -> tuple[pd.DataFrame, str]:
    """Rows, and what was said."""
    said: list[str] = []
    options = {
        name: changes.pop(name) for name in ("reuse_code", "shard") if name in changes
    }
    for _ in run_suite(
        suite(dataset_path, **changes), folder, jobs, say=said.append, **options
    ):
        pass
    table = folder / "episodes.parquet"
    return pd.read_parquet(table) if table.exists() else pd.DataFrame(), "\n".join(said)


@pytest.fixture(autouse=True)
def no_latency(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measures no planning time of one robot, which takes longer than a run."""
    monkeypatch.setattr(
        runner, "measure_latencies", lambda folder, chosen, settings: None
    )


@pytest.fixture(scope="module")
def finished(dataset_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the command in two processes, with a metric of a file, one by name, and
    hypotheses on them.
    """
    folder = tmp_path_factory.mktemp("metrics") / "run"
    mppi = "{part: mppi, options: {samples: 64}}"
    words = {
        "data": dataset_path, "model": "oracle", "planners": f"[{mppi}]", "risks": "[mean,cvar]",
        "scenarios": "[std]", "maps": 2, "realisations": 2, "record": "steps",
        "world": "{noise: resampled, time_budget_s: 15}",
        "metrics": f"['{DETOUR}', 'energy:120']", "hypotheses": str(list(HYPOTHESES)), "jobs": 2, "out": folder,
    }  # fmt: skip
    assert (
        call(
            "eval",
            "run",
            *(word for name, value in words.items() for word in (f"--{name}", value)),
        )
        == 0
    )
    return folder


def test_the_example_is_a_file_of_at_most_forty_lines() -> None:
    assert len(EXAMPLE.read_text().splitlines()) <= 40


def test_values_are_those_computed_by_hand_from_the_steps(finished: Path) -> None:
    rows = pd.read_parquet(finished / "episodes.parquet").set_index(
        ["condition", "seed", "realisation", "map"]
    )
    steps = read_steps(finished)
    assert rows["success"].any()
    goals = rows.groupby("map").size()
    assert len(goals) == 2
    for key, drive in steps.groupby(["condition", "seed", "realisation", "map"]):
        row, last = rows.loc[key], drive["traversability"].isna()
        met = drive.loc[~last, "traversability"].to_numpy(dtype=float)
        assert row["energy_j"] == pytest.approx(
            0.1 * (120 / np.maximum(met, 0.1)).sum(), rel=1e-9
        )
        x, y = (drive[name].to_numpy(dtype=float) for name in ("x_m", "y_m"))
        driven = np.hypot(np.diff(x), np.diff(y)).sum()
        if not row["success"]:
            assert np.isnan(row["detour"])
            continue
        goal = _goals(finished, rows)[key[-1]]
        straight = np.hypot(*(goal - (x[0], y[0]))) - 1.0
        assert row["detour"] == pytest.approx(driven / straight, rel=1e-6)


def _goals(folder: Path, rows: pd.DataFrame) -> dict[int, np.ndarray]:
    from benchnav.datagen.files.reader import TerrainDataset

    (data,) = rows["data"].unique()
    goals = TerrainDataset(Path(data)).read("test/std", [0, 1], ["goal_m"])["goal_m"]
    return {index: goal.astype(float) for index, goal in enumerate(goals)}


def test_the_summary_has_means_with_intervals_over_the_episodes_that_have_it(
    finished: Path,
) -> None:
    rows, summary = (
        pd.read_parquet(finished / "episodes.parquet"),
        pd.read_csv(finished / "summary.csv"),
    )
    for row in summary.to_dict("records"):
        own = rows[rows["condition"] == row["condition"]]
        assert row["energy_mean_j"] == pytest.approx(own["energy_j"].mean(), rel=1e-5)
        assert row["energy_std_j"] == pytest.approx(own["energy_j"].std(), rel=1e-5)
        assert (row["energy_n"], row["detour_n"]) == (len(own), own["success"].sum())
        assert np.isnan(row["energy_low_j"])  # fewer maps than have an interval


def test_the_page_and_the_tables_have_a_column_and_its_meaning(finished: Path) -> None:
    for file in ("report.html", "summary.md"):
        text = (finished / file).read_text()
        for words in (
            "energy [J]",
            "detour",
            "∫ P/λ dt",
            "length of the driven path over that of the straight line",
        ):
            assert words in text, (file, words)
    about = open_run(finished).manifest
    assert [entry["quantity"]["column"] for entry in about["metrics"]] == [
        "detour",
        "energy_j",
    ]
    assert about["metrics"][1]["options"] == {
        "power_w": 120.0,
        "min_traversability": 0.1,
    }
    (code,) = about["codes"].values()
    assert set(code["metrics"]) == {"detour", "energy_j"}


def test_hypotheses_on_metrics_are_tested_in_their_unit(finished: Path) -> None:
    tests = pd.read_csv(finished / "hypotheses.csv").set_index("metric")
    energy = tests.loc["energy"]
    assert (energy["unit"], energy["direction"], energy["margin"]) == ("J", "lower", 50)
    assert (
        energy["claim"] == "energy of cvar is less than 50 J higher than that of mean"
    )
    rows = pd.read_parquet(finished / "episodes.parquet")
    arrived = rows[rows["success"]].pivot_table(
        index=["map", "realisation"], columns="risk", values=["energy_j", "detour"]
    )
    for name, column in (("energy", "energy_j"), ("detour", "detour")):
        both = arrived[column].dropna()
        assert tests.loc[name, "n_episodes"] == len(both)
        assert tests.loc[name, "difference"] == pytest.approx(
            (both["cvar"] - both["mean"]).mean(), rel=1e-5
        )
    assert (finished / "figures" / "forest.png").exists()


def test_compare_shows_the_metric_that_is_named(
    finished: Path, tmp_path: Path, capsys: Any
) -> None:
    assert (
        call("eval", "compare", finished, "--metric", "energy", "--out", tmp_path / "c")
        == 0
    )
    table = pd.read_csv(tmp_path / "c.csv").iloc[0]
    tests = pd.read_csv(finished / "hypotheses.csv").set_index("metric").loc["energy"]
    assert (table["one"], table["other"], table["unit"]) == ("cvar", "mean", "J")
    assert table["difference"] == pytest.approx(tests["difference"], abs=1e-3)
    text = (tmp_path / "c.md").read_text()
    assert "energy [J]" in text
    assert "lower is better. Over the episodes in which both reached the goal." in text
    # Without a name the table is that of success and time.
    assert call("eval", "compare", finished) == 0
    assert "T_total" in capsys.readouterr().out
    assert call("eval", "compare", finished, "--metric", "enrgy") == 2
    assert "Did you mean 'energy'" in capsys.readouterr().err


def test_a_comparison_by_any_metric_of_every_run_is_that_of_its_hypothesis(
    finished: Path,
) -> None:
    columns = {
        "success": ("success", 100),
        "T_total": ("total_time_s", 1),
        "roughness": ("roughness_radps2", 1),
    }
    for metric, (column, scale) in columns.items():
        (row,) = compare_runs([finished], "risk", "mean", {}, 0.05, metric=metric)[
            0
        ].to_dict("records")
        rows = pd.read_parquet(finished / "episodes.parquet")
        means = rows.groupby("risk")[column].mean() * scale
        assert row["difference"] == pytest.approx(means["cvar"] - means["mean"])
        assert row["p_holm"] == holm(np.array([row["p"]]))[0]


def test_rows_of_one_process_and_of_two_are_equal(
    dataset_path: Path, tmp_path: Path
) -> None:
    one, _ = run(dataset_path, tmp_path / "one", metrics=(DETOUR, "energy"))
    two, _ = run(dataset_path, tmp_path / "two", jobs=2, metrics=(DETOUR, "energy"))
    timed = [name for name in one if name.startswith("planning_")]
    pd.testing.assert_frame_equal(
        one.drop(columns=timed), two.drop(columns=timed), check_exact=True
    )
    assert rerun.compare(tmp_path / "one", tmp_path / "two")[0]


def test_a_run_that_is_extended_by_a_metric_runs_its_units_again_and_says_so(
    dataset_path: Path, tmp_path: Path
) -> None:
    before, _ = run(dataset_path, tmp_path / "run", record="first")
    folder = tmp_path / "run"
    conditions = set(open_run(folder).conditions)
    after, said = run(dataset_path, folder, record="none", metrics=("energy",))
    assert f"{folder} is extended by metric energy" in said
    assert (
        "2 of 2 units have no values of new metrics (energy_j) and are run again"
        in said
    )
    assert set(open_run(folder).conditions) == conditions
    assert list(after.columns) == [*before.columns[:-1], "energy_j", "code"]
    same = [
        name for name in before if name != "code" and not name.startswith("planning_")
    ]
    pd.testing.assert_frame_equal(after[same], before[same], check_exact=True)
    # No less is recorded than was, and what has the metric stays without a word of it.
    assert len(list((folder / "playback").glob("*.npz"))) == 2
    _, said = run(dataset_path, folder, record="none")
    assert "2 of 2 units were already finished" in said
    assert pd.read_parquet(folder / "episodes.parquet")["energy_j"].notna().all()
    # Units without it are of other code, and are not taken for units that have it.
    _, said = run(
        dataset_path, folder, record="none", metrics=(DETOUR,), reuse_code=True
    )
    assert (
        "2 of 2 units have no values of new metrics (detour) and are run again" in said
    )


def test_other_units_wait_until_they_have_the_metric_too(
    dataset_path: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    run(dataset_path, folder)
    rows, said = run(dataset_path, folder, risks=("mean",), metrics=("energy",))
    assert rows.empty
    assert "1 of 2 conditions" in said
    rows, _ = run(dataset_path, folder)
    assert rows["energy_j"].notna().all()
    assert set(rows["risk"]) == {"mean", "cvar"}


@pytest.mark.parametrize(
    ("metrics", "message"),
    [
        (("energy:200",), "that differ in name and column, got 'energy'"),
        (
            ({"part": "energy", "options": {"min_traversability": 0.2}},),
            "Give one of them a different `name` and `column`",
        ),
    ],
)
def test_another_setting_under_a_column_of_the_run_is_refused(
    metrics: tuple[Any, ...], message: str, dataset_path: Path, tmp_path: Path
) -> None:
    run(dataset_path, tmp_path / "run", metrics=("energy",), risks=("mean",), maps=1)
    with pytest.raises(ConfigError, match=message):
        run(dataset_path, tmp_path / "run", metrics=metrics, risks=("mean",), maps=1)


OWN = """
import math
from benchnav.metrics import Metric

class Own(Metric):
    name = "own"
    column = "own"
    meaning = "anything"
    better = "neither"

    def compute(self, episode):
        return VALUE
"""


def own_metric(folder: Path, value: str, **attributes: str) -> str:
    """A file with a metric that returns a value."""
    path = folder / "own.py"
    text = OWN.replace("VALUE", value)
    for name, given in attributes.items():
        text = re.sub(rf"    {name} = .*", f'    {name} = "{given}"', text)
    path.write_text(text)
    return f"{path}:Own"


@pytest.mark.parametrize(
    ("metrics", "message"),
    [
        (
            ("score",),
            "other than the built-in ones, got 'score'. Every run has",
        ),
        (("enrgy",), "Did you mean 'energy'"),
        (("energy", "energy:5"), "that differ in name and column"),
        (
            ("benchnav.planning:Unicycle",),
            "to be an instance of benchnav.metrics.Metric, got Unicycle",
        ),
    ],
)
def test_a_metric_that_cannot_be_had_is_refused_before_the_run(
    metrics: tuple[str, ...], message: str, dataset_path: Path, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=message):
        run(dataset_path, tmp_path / "run", metrics=metrics)
    assert not (tmp_path / "run" / "run.json").exists()


@pytest.mark.parametrize(
    ("value", "attributes", "message"),
    [
        ("1 / 0", {}, "got ZeroDivisionError: division by zero.*tested on Episode"),
        ("math.inf", {}, "got inf"),
        ("'a'", {}, "got 'a'"),
        (
            "1.0",
            {"better": "more"},
            "Expected `better` as 'higher', 'lower' or 'neither'",
        ),
        ("1.0", {"column": "score"}, "and 'score' with column 'score'"),
        ("1.0", {"column": "map"}, "and 'bookkeeping' with column 'map'"),
    ],
)
def test_a_metric_that_breaks_its_contract_is_refused_before_the_run(
    value: str,
    attributes: dict[str, str],
    message: str,
    dataset_path: Path,
    tmp_path: Path,
) -> None:
    with pytest.raises(ConfigError, match=message):
        run(
            dataset_path,
            tmp_path / "run",
            metrics=(own_metric(tmp_path, value, **attributes),),
        )
    assert not (tmp_path / "run" / "run.json").exists()


def test_a_metric_that_fails_in_the_run_stops_it_with_a_line_and_units_stay(
    dataset_path: Path, tmp_path: Path
) -> None:
    # The sample episodes have other budgets, so that only the run finds it.
    folder = tmp_path / "run"
    bad = own_metric(tmp_path, "1.0 if episode.time_budget_s > 90 else math.inf")
    with pytest.raises(
        BenchnavError,
        match=r"from metric 'own', got inf.*The episode is one of .*seed 0, .*map 0\.",
    ):
        run(dataset_path, folder, metrics=(bad,))
    assert not (folder / "episodes.parquet").exists()
    rows, _ = run(
        dataset_path, folder, metrics=(own_metric(tmp_path, "episode.steps"),)
    )
    assert (rows["own"] == (rows["end_time_s"] / 0.1).round()).all()
    # An edit of the file is other code.
    rows, said = run(
        dataset_path, folder, metrics=(own_metric(tmp_path, "2 * episode.steps"),)
    )
    assert "were run with other code or maps (metric own)" in said
    assert (rows["own"] == 2 * (rows["end_time_s"] / 0.1).round()).all()


def test_a_metric_of_this_process_alone_is_refused_for_workers(
    dataset_path: Path, tmp_path: Path
) -> None:
    from benchnav import register
    from benchnav.metrics import Energy

    register(
        "metric", "here", type("Here", (Energy,), {"name": "here", "column": "here_j"})
    )
    with pytest.raises(
        ConfigError, match="Expected a metric that other processes can load"
    ):
        run(dataset_path, tmp_path / "run", jobs=2, metrics=("here",))


def test_shards_merge_and_reruns_repeat_with_the_metric(
    dataset_path: Path, tmp_path: Path
) -> None:
    parts = []
    for index in (1, 2):
        parts.append(tmp_path / f"part{index}")
        run(
            dataset_path,
            parts[-1],
            seeds=(0, 1),
            metrics=("energy",),
            shard=Shard(index=index, of=2),
        )
    for _ in merge_shards(parts, tmp_path / "whole"):
        pass
    whole = pd.read_parquet(tmp_path / "whole" / "episodes.parquet")
    assert len(whole) == 8
    assert whole["energy_j"].notna().all()
    for _ in rerun.rerun(tmp_path / "whole", tmp_path / "again"):
        pass
    assert rerun.compare(tmp_path / "whole", tmp_path / "again") == (
        True,
        [
            "all 8 rows are identical",
            "no difference between the recorded environments",
        ],
    )
    other = tmp_path / "other"
    run(dataset_path, other, seeds=(0, 1), shard=Shard(index=2, of=2))
    with pytest.raises(ConfigError, match="metrics"):
        list(merge_shards([parts[0], other], tmp_path / "none"))
