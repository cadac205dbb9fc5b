"""The suites of docs/risk.md can be run as they are written, and its script says what is so."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest
import yaml

from benchnav.eval.suite import Suite
from benchnav.eval.trial import trials_of

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


def rows(**success: list[bool]) -> pd.DataFrame:
    """Episodes on the same maps under settings, with times of 10 s and, where they fail, 30 s."""
    made = [
        {
            "data": "d", "scenario": "std", "world": "stakes", "planner": "p", "model": "m", "risk": risk,
            "seed": 0, "realisation": 0, "instance": i, "success": won, "total_time_s": 10.0 if won else 30.0,
        }
        for risk, each in success.items()
        for i, won in enumerate(each)
    ]  # fmt: skip
    return pd.DataFrame(made)


def test_a_pair_is_compared_map_by_map() -> None:
    pairs = script("pairs")
    # 9 maps won by the second alone, 1 by the first alone: the exact McNemar test is 2 · 11 / 2¹⁰.
    data = rows(first=[False] * 9 + [True] + [True] * 10, second=[True] * 9 + [False] + [True] * 10)
    ((name, members),) = pairs.families(data, "risk")
    table = pairs.compared(members, "").iloc[0]
    assert (name, table["one"], table["other"]) == ("all", "second", "first")
    assert table["success"] == pytest.approx(40)
    assert table["success_low"] < 40 < table["success_high"]
    assert table["success_p"] == pytest.approx(22 / 1024)
    assert table["time"] == pytest.approx(-8)


def test_settings_that_are_equally_good_have_an_order_too(capsys: pytest.CaptureFixture[str]) -> None:
    pairs = script("pairs")
    ((name, members),) = pairs.families(rows(first=[True] * 4, second=[True] * 4), "risk")
    pairs.print_order(name, members)
    assert "+0 (" in capsys.readouterr().out


def test_the_clairvoyant_stands_beside_each_setting() -> None:
    pairs = script("pairs")
    data = rows(mean=[True, False], cvar=[True, True])
    knowing = rows(mean=[True, True]).assign(model="clairvoyant", risk="–")
    found = {name: set(members) for name, members in pairs.families(pd.concat([data, knowing]), "model")}
    assert found == {"mean": {"m", "clairvoyant"}, "cvar": {"m", "clairvoyant"}}
