"""The suites that are shipped and those of docs/risk.md can be run as they are written; its tables say what is so."""

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest
import yaml

from benchnav.eval.hypotheses import fix_hypotheses
from benchnav.eval.suite import Suite
from benchnav.eval.trial import trials_of
from tests.eval.report.made import row, rows, trial
from tests.eval.test_compare import run_folder

ROOT = Path(__file__).parents[2]
STUDY = ROOT / "docs" / "risk"


def tables() -> ModuleType:
    spec = importlib.util.spec_from_file_location("tables", ROOT / "docs" / "tables.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SUITES = [*STUDY.glob("*.yaml"), *(ROOT / "benchnav" / "eval" / "suites").glob("*.yaml")]


@pytest.mark.parametrize("path", sorted(SUITES), ids=lambda path: path.stem)
def test_each_suite_makes_trials_and_names_them_in_its_hypotheses(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    suite = Suite(**yaml.safe_load(path.read_text()))
    trials = {trial.id: trial for trial in trials_of(suite, lambda data: ["std", "hg", "hs"])}
    assert len(trials) >= 6
    tests = fix_hypotheses(suite.hypotheses, trials, dict.fromkeys(trials, 1)).get("tests", [])
    assert len(tests) >= len(suite.hypotheses)


def made(**success: Sequence[bool]) -> pd.DataFrame:
    """Episodes on the same maps under settings."""
    return rows(
        row(trial("mppi", risk), i, 30.0 if won else None)
        for risk, each in success.items()
        for i, won in enumerate(each)
    )


def sweep(folder: Path) -> list[str]:
    return tables().sweep(folder).split("\n")


def test_the_best_is_told_from_the_worst(tmp_path: Path) -> None:
    # 10 of 12 maps are won by the best alone: the exact test is 2 / 2¹⁰, threefold by Holm's correction.
    episodes = made(cvar=[True] * 11 + [False], mean=[True] + [False] * 11, var=[True, False] * 6)
    lines = sweep(run_folder(tmp_path / "run", episodes))
    assert lines[0] == "| cvar | mean | var | best − worst [points] (95 %) | p |"
    assert lines[2].startswith("| 91.7 | 8.3 | 50.0 | cvar − mean +83.3 (+")
    assert lines[2].endswith(f"| {3 * 2 / 2**10:.2g} |")


def test_the_gain_has_the_sign_of_the_best(tmp_path: Path) -> None:
    for name, order in (("a", ("mean", "cvar")), ("b", ("cvar", "mean"))):
        won = {"mean": [True] * 2 + [False] * 10, "cvar": [True] * 9 + [False] * 3}
        folder = run_folder(tmp_path / name, made(**{risk: won[risk] for risk in order}))
        text = sweep(folder)[2]
        assert "cvar − mean +58.3 (+" in text


def test_each_variant_has_a_row(tmp_path: Path) -> None:
    episodes = made(mean=[True] * 12, cvar=[True, False] * 6)
    other = episodes.assign(model="oracle", trial=episodes["trial"] + "o", success=True, outcome="success")
    lines = sweep(run_folder(tmp_path / "run", pd.concat([episodes, other])))
    assert [line.split(" |")[0] for line in lines[2:4]] == ["| paper-v1", "| oracle"]
    assert "| 100.0 | 50.0 |" in lines[2]
    assert "| 100.0 | 100.0 |" in lines[3]


def test_variants_are_told_apart_by_the_whole_label(tmp_path: Path) -> None:
    episodes = made(mean=[True] * 12, cvar=[True, False] * 6)
    worlds = [
        episodes.assign(world=label, trial=episodes["trial"] + label, success=won, outcome=outcome)
        for label, won, outcome in (
            ("stakes immobile=0.05/2s", True, "success"),
            ("stakes immobile=0.2/2s", False, "timeout"),
        )
    ]
    lines = sweep(run_folder(tmp_path / "run", pd.concat(worlds)))
    assert lines[2].startswith("| stakes immobile=0.05/2s | 100.0 | 100.0 |")
    assert lines[3].startswith("| stakes immobile=0.2/2s | 0.0 | 0.0 |")


def test_only_the_tables_of_runs_that_are_there_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_folder(tmp_path / "runs" / "one", made(mean=[True] * 12, cvar=[True, False] * 6))
    note = tmp_path / "note.md"
    note.write_text(
        "A\n<!-- sweep one -->\nold\n<!-- end -->\nB\n<!-- sweep two -->\nkept\n<!-- end -->\nC\n"
    )
    monkeypatch.setattr("sys.argv", ["tables.py", str(note), "--runs", str(tmp_path / "runs")])
    tables().main()
    before, (rest) = note.read_text().split("B\n")
    assert rest == "<!-- sweep two -->\nkept\n<!-- end -->\nC\n"
    assert before.startswith("A\n<!-- sweep one -->\n| mean | cvar |")
    assert "old" not in before


def test_settings_stand_beside_one_another_with_their_success_and_time(tmp_path: Path) -> None:
    shared = {"data": "d", "scenario": "std", "world": "w", "robot": "r", "model": "m", "planner": "mppi"}
    numbers = ("success_rate", "success_low", "success_high", "total_time_mean_s")
    rows = [
        {**shared, "risk": risk, **dict(zip(numbers, values, strict=True))}
        for risk, values in (
            ("mean", (1.0, 0.9, 1.0, 30.0)),
            ("–", (0, 0, 0, 0)),
            ("cvar", (0.5, 0.3, 0.7, 65.0)),
        )
    ]
    pd.DataFrame(rows).to_csv(tmp_path / "summary.csv")
    head, _, line = tables().settings(tmp_path).split("\n")
    assert head == "| planner | mean | cvar |"
    assert line == "| mppi | 100.0 (90–100), 30.0 s | 50.0 (30–70), 65.0 s |"
