"""The suites of docs/risk.md can be run as they are written, and its script says what is so."""

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest
import yaml

from benchnav.eval.suite import Suite
from benchnav.eval.trial import trials_of
from tests.eval.report.made import row, rows, trial
from tests.eval.test_compare import run_folder

ROOT = Path(__file__).parents[2]
STUDY = ROOT / "docs" / "risk"


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, STUDY / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", sorted(STUDY.glob("*.yaml")), ids=lambda path: path.stem)
def test_each_suite_makes_trials(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    trials = trials_of(Suite(**yaml.safe_load(path.read_text())), lambda data: ["std"])
    assert len(trials) >= 6


def made(**success: Sequence[bool]) -> pd.DataFrame:
    """Episodes on the same maps under settings."""
    return rows(
        row(trial("mppi", risk), i, 30.0 if won else None)
        for risk, each in success.items()
        for i, won in enumerate(each)
    )


def printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], folder: Path) -> list[str]:
    monkeypatch.setattr("sys.argv", ["order.py", str(folder)])
    script("order").main()
    return capsys.readouterr().out.split("\n")


def test_the_best_is_told_from_the_worst(tmp_path: Path, monkeypatch, capsys) -> None:  # type: ignore[no-untyped-def]
    # 10 of 12 maps are won by the best alone: the exact test is 2 / 2¹⁰, threefold by Holm's correction.
    episodes = made(cvar=[True] * 11 + [False], mean=[True] + [False] * 11, var=[True, False] * 6)
    lines = printed(monkeypatch, capsys, run_folder(tmp_path / "run", episodes))
    assert lines[1] == "| | cvar | mean | var | best − worst [points] (95 %) | p |"
    assert lines[3].startswith("| all | 91.7 | 8.3 | 50.0 | cvar − mean +83.3 (+")
    assert lines[3].endswith(f"| {3 * 2 / 2**10:.2g} |")


def test_the_gain_has_the_sign_of_the_best(tmp_path: Path, monkeypatch, capsys) -> None:  # type: ignore[no-untyped-def]
    for name, order in (("a", ("mean", "cvar")), ("b", ("cvar", "mean"))):
        won = {"mean": [True] * 2 + [False] * 10, "cvar": [True] * 9 + [False] * 3}
        folder = run_folder(tmp_path / name, made(**{risk: won[risk] for risk in order}))
        text = printed(monkeypatch, capsys, folder)[3]
        assert "cvar − mean +58.3 (+" in text


def test_each_variant_has_a_row(tmp_path: Path, monkeypatch, capsys) -> None:  # type: ignore[no-untyped-def]
    episodes = made(mean=[True] * 12, cvar=[True, False] * 6)
    other = episodes.assign(model="oracle", trial=episodes["trial"] + "o", success=True, outcome="success")
    lines = printed(monkeypatch, capsys, run_folder(tmp_path / "run", pd.concat([episodes, other])))
    assert [line.split(" |")[0] for line in lines[3:5]] == ["| paper-v1", "| oracle"]
    assert "| 100.0 | 50.0 |" in lines[3]
    assert "| 100.0 | 100.0 |" in lines[4]


def test_variants_are_told_apart_by_the_whole_label(tmp_path: Path, monkeypatch, capsys) -> None:  # type: ignore[no-untyped-def]
    episodes = made(mean=[True] * 12, cvar=[True, False] * 6)
    worlds = [
        episodes.assign(world=label, trial=episodes["trial"] + label, success=won, outcome=outcome)
        for label, won, outcome in (
            ("stakes immobile=0.05/2s", True, "success"),
            ("stakes immobile=0.2/2s", False, "timeout"),
        )
    ]
    lines = printed(monkeypatch, capsys, run_folder(tmp_path / "run", pd.concat(worlds)))
    assert lines[3].startswith("| stakes immobile=0.05/2s | 100.0 | 100.0 |")
    assert lines[4].startswith("| stakes immobile=0.2/2s | 0.0 | 0.0 |")
