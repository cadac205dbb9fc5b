import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchnav.errors import ConfigError
from benchnav.eval import cli
from benchnav.eval.compare import compare_runs
from benchnav.eval.stats.comparison import compare
from benchnav.eval.stats.pairing import Compared, find_pairs
from benchnav.eval.trial import NOT_USED
from tests.eval.report.made import PAPER, row, rows, trial

VERSION_1 = Path(__file__).parent.parent / "data" / "run-1"
MAPS = 12


def settings(shift: int = 0) -> pd.DataFrame:
    """Two planners under three settings, of which the cautious ones arrive more often, and `straight`."""
    generator = np.random.default_rng(5)
    luck = generator.random(MAPS)
    made = []
    for planner in ("mppi", "cl_rrt"):
        for risk, rate in (("mean", 0.3), ("cvar", 0.6), ("var", 0.9)):
            labels = trial(planner, risk)
            late = {"mean": 0, "cvar": 3, "var": 7}[risk] + shift
            made.append([row(labels, i, 30.0 + i + late if luck[i] < rate else None) for i in range(MAPS)])
    made.append([row(trial("straight", NOT_USED, model=NOT_USED), i, None) for i in range(MAPS)])
    return rows(*made)


def run_folder(folder: Path, episodes: pd.DataFrame, **changes: Any) -> Path:
    """A finished run with what a comparison reads of it."""
    known = {
        name: {
            "value": {"data": "paper-v1", "split": "test/std", **PAPER}
            | {
                kind: {"part": kind, "options": {}}
                for kind in ("model", "risk", "planner", "robot", "objective")
            },
            "labels": {label: group[label].iloc[0] for label in trial()},
            "seeds": [0],
            "draws": [[0, 0, MAPS]],
        }
        for name, group in episodes.groupby("trial", sort=False)
    }
    about = {
        "format": "benchnav-run", "format_version": 2, "run_id": "r", "trials": known, "suite": {},
        "datasets": {"paper-v1": {"maps": {"test/std": [f"{i:x}" for i in range(MAPS)]}}},
        "code": {"sources": "s"},
    }  # fmt: skip
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps(about | changes))
    episodes.to_parquet(folder / "episodes.parquet")
    return folder


def command(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["benchnav-eval", "compare", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0)


def test_the_numbers_are_those_of_the_pairs_of_the_run(tmp_path: Path) -> None:
    episodes = settings()
    table, _ = compare_runs([run_folder(tmp_path / "run", episodes)], "", "mean", {"planner": "mppi"}, 0.05)
    trials = [
        Compared(
            labels={**trial("mppi", risk), "run": NOT_USED}, world={}, maps=["m"] * MAPS,
            episodes=episodes[(episodes["planner"] == "mppi") & (episodes["risk"] == risk)].assign(time_budget_s=100.0),
        )
        for risk in ("mean", "cvar", "var")
    ]  # fmt: skip
    pd.testing.assert_frame_equal(table, compare(find_pairs(trials, against="mean")))
    assert list(table["one"]) == ["cvar", "var"]
    assert (table["arrival_time_difference_s"] == [3, 7]).all()


def test_what_is_looked_at_can_be_narrowed(tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "run", settings())
    every, _ = compare_runs([folder], "", "", {}, 0.05)
    assert len(every) == 6
    some, shown = compare_runs([folder], "", "", {"risk": "mean,var"}, 0.05)
    assert [(r["planner"], r["one"], r["other"]) for r in some.to_dict("records")] == [
        ("mppi", "var", "mean"),
        ("cl_rrt", "var", "mean"),
    ]
    assert any("Family: 2 pairs" in note for note in shown.notes)
    assert some["success_p_holm"].iloc[0] < every["success_p_holm"].iloc[1]
    planners, _ = compare_runs([folder], "planner", "", {"risk": "cvar"}, 0.05)
    assert [(r["one"], r["other"]) for r in planners.to_dict("records")] == [("cl_rrt", "mppi")]
    blind, _ = compare_runs([folder], "", "straight", {}, 0.05)
    assert len(blind) == 6
    assert set(blind["other"]) == {"straight"}


def test_two_runs_are_compared_trial_by_trial(tmp_path: Path) -> None:
    before = run_folder(tmp_path / "a" / "run", settings())
    after = run_folder(tmp_path / "b" / "run", settings(shift=2), code={"sources": "t"})
    table, shown = compare_runs([before, after], "", "", {}, 0.05)
    assert len(table) == 7
    assert set(table["one"]) == {"b/run"}
    assert set(table["other"]) == {"a/run"}
    assert (table["arrival_time_difference_s"].dropna() == 2).all()
    assert any("different sources" in note for note in shown.notes)
    # Settings of one run, where another stands beside it.
    table, _ = compare_runs([before, after], "risk", "mean", {"planner": "mppi"}, 0.05)
    assert list(table["run"]) == ["a/run", "a/run", "b/run", "b/run"]


def test_runs_with_trials_of_their_own_are_compared_across(tmp_path: Path) -> None:
    episodes = settings()
    cautious = run_folder(tmp_path / "a", episodes[episodes["risk"] == "cvar"])
    plain = run_folder(tmp_path / "b", episodes[episodes["risk"] == "mean"])
    table, _ = compare_runs([cautious, plain], "", "mean", {}, 0.05)
    assert list(table["planner"]) == ["mppi", "cl_rrt"]
    other = {"paper-v1": {"maps": {"test/std": ["x"] * MAPS}}}
    elsewhere = run_folder(tmp_path / "c", episodes[episodes["risk"] == "mean"], datasets=other)
    with pytest.raises(ConfigError, match="other digests"):
        compare_runs([cautious, elsewhere], "", "mean", {}, 0.05)


def test_command_prints_and_writes(tmp_path: Path, monkeypatch, capsys) -> None:  # type: ignore[no-untyped-def]
    folder = run_folder(tmp_path / "run", settings())
    out = tmp_path / "made" / "cautious"
    assert command(monkeypatch, str(folder), "--against", "mean", "--points", "20", "--out", str(out)) == 0
    printed = capsys.readouterr().out
    assert "Family: 4 pairs" in printed
    assert "12 maps, 1 episode on each" in printed
    assert "A difference of 20 points needs" in printed
    numbers = pd.read_csv(out.with_suffix(".csv"))
    assert list(numbers["one"]) == ["cvar", "var"] * 2
    assert out.with_suffix(".md").read_text().count("\n| ") == 4
    paper = out.with_suffix(".tex").read_text()
    assert r"\toprule" in paper
    assert rf"\label{{tab:{out.name}}}" in paper


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "one or more run folders"),
        (("RUN", "--planner", "mpi"), "Did you mean 'mppi'"),
        (("RUN", "--points", "0"), r"`points` in (0, 100]"),
        (("RUN", "RUN"), "Expected runs that differ"),
        (("RUN", str(VERSION_1)), "version 1"),
        (("RUN", "--by", "data"), "other maps"),
    ],
)
def test_bad_input_ends_with_one_line_and_status_2(
    arguments: tuple[str, ...], message: str, tmp_path: Path, monkeypatch, capsys
) -> None:  # type: ignore[no-untyped-def]
    folder = run_folder(tmp_path / "run", settings())
    assert command(monkeypatch, *(str(folder) if word == "RUN" else word for word in arguments)) == 2
    written = capsys.readouterr().err
    assert message in written
    assert written.count("\n") == 1
