from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchnav.core.tables import Bold, Table
from benchnav.eval.report.between_tables import between_findings, between_tables
from benchnav.eval.stats.between import BetweenWorlds
from tests.eval.report import made

LABELS = made.condition() | {"rules": "–"}
WORLDS = ("stakes", "stakes backend=tracks")


def setting(world: str, risk: str, rate: float, **changes: Any) -> dict[str, Any]:
    row = {
        **LABELS,
        "risk": risk,
        "world": world,
        "condition": f"{world} {risk}",
        "n_episodes": 40,
        "n_maps": 20,
        "success_rate": rate,
        "success_low": rate - 0.1,
        "success_high": rate + 0.05,
        "competes": True,
        "best_p": 0.5,
        "in_best": True,
        "robust": True,
        "regret": 0.0,
        "regret_low": 0.0,
        "regret_high": 0.02,
    }
    return row | changes


def worse(**changes: Any) -> dict[str, Any]:
    regret = {"regret": 0.25, "regret_low": 0.1, "regret_high": 0.4}
    return {"robust": False, **regret, **changes}


def compared(*rows: dict[str, Any], **tables: Any) -> BetweenWorlds:
    return BetweenWorlds(settings=pd.DataFrame(rows), **tables)


def some_worse() -> BetweenWorlds:
    return compared(
        setting(WORLDS[0], "mean", 0.9, **worse()),
        setting(WORLDS[1], "mean", 0.5, **worse(in_best=False)),
        setting(WORLDS[0], "cvar:0.8", 0.85),
        setting(WORLDS[1], "cvar:0.8", 0.75),
        setting(WORLDS[0], "clairvoyant", 1.0, competes=False, in_best=False),
    )


def cells(table: Table) -> list[list[str]]:
    return [list(row) for row in table.rows]


def test_one_world_has_no_tables_and_no_sentences() -> None:
    assert between_tables(BetweenWorlds(), "map") == ()
    assert between_findings(BetweenWorlds()) == []


def test_settings_have_a_column_per_world() -> None:
    (table,) = between_tables(some_worse(), "map")
    assert table.headings[:3] == ("setting", "stakes", "backend=tracks")
    mean, cvar, reference = cells(table)
    assert mean == ["mean", "90 (80–95)", "50 (40–55)", "25.0 (10.0 to 40.0)", "no"]
    assert cvar[1:] == ["85 (75–90)", "75 (65–80)", "0.0 (0.0 to 2.0)", "yes"]
    assert reference[1:] == ["100 (90–105)", "–", "–", "–"]
    bold = [[isinstance(cell, Bold) for cell in row[1:3]] for row in table.rows]
    assert bold == [[True, False], [True, True], [False, False]]
    assert "share: stakes." in table.notes[-1]


def test_nothing_is_bold_if_no_setting_is_worse() -> None:
    rows = [setting(world, risk, 0.8) for world in WORLDS for risk in ("a", "b")]
    (table,) = between_tables(compared(*rows), "map")
    assert not made.bold_cells(table)
    assert not table.bold_note
    (sentence,) = between_findings(compared(*rows))
    assert sentence.startswith("No setting is significantly worse than the best")
    assert "all 2 settings" in sentence


def test_the_robust_set_is_named() -> None:
    (sentence,) = between_findings(some_worse())
    assert sentence == (
        "1 of 2 settings are in the best set of all 2 worlds, each at level 0.05/2 "
        "(robust set): CVaR₀.₈."
    )


def test_an_empty_robust_set_names_the_least_worst_regret() -> None:
    rows = [
        setting(world, risk, 0.8, **worse(regret=regret, scenario=scenario))
        for scenario in ("std", "hg")
        for risk, regret in (("mean", 0.3), ("cvar:0.8", 0.2), ("low", 0.4))
        for world in WORLDS
    ]
    first, second = between_findings(compared(*rows))
    assert first == (
        "std: no setting is in the best set of all 2 worlds, each at level 0.05/2. "
        "CVaR₀.₈ has the least worst regret: 20.0 (10.0 to 40.0) points."
    )
    assert second.startswith("hg: ")


def agreement(**changes: Any) -> dict[str, Any]:
    row: dict[str, Any] = {**LABELS, "world": WORLDS[0], "other": WORLDS[1]}
    row |= {"n_settings": 4, "n_episodes": 40, "n_maps": 20, "same_draws": True}
    values = {"pearson": 0.9, "spearman": 0.8, "mmrv": 0.04, "mmrv_back": 0.02}
    for name, value in (values | {"kappa": 0.5}).items():
        row |= {name: value, f"{name}_low": value - 0.01, f"{name}_high": value + 0.01}
    for suffix in ("", "_back"):
        row |= {f"n_pairs{suffix}": 0, f"same_sign{suffix}": np.nan}
        row |= {f"same_sign_low{suffix}": np.nan, f"same_sign_p{suffix}": 1.0}
    return row | changes


def test_agreement_has_a_row_per_pair_of_worlds() -> None:
    signs = {"n_pairs": 6, "same_sign": 5 / 6, "same_sign_low": 0.5}
    undefined = {"pearson": np.nan, "spearman_low": np.nan, "same_draws": False}
    table = pd.DataFrame([agreement(**signs), agreement(**undefined)])
    base = some_worse().settings
    _, shown = between_tables(BetweenWorlds(settings=base, agreement=table), "group")
    first, second = cells(shown)
    assert first[:3] == ["stakes", "backend=tracks", "4"]
    assert first[3:6] == [
        "0.90 (0.89 to 0.91)",
        "0.80 (0.79 to 0.81)",
        "4.0 (3.0 to 5.0)",
    ]
    assert first[6:8] == ["2.0 (1.0 to 3.0)", "0.50 (0.49 to 0.51)"]
    assert first[8:] == ["5 of 6 (≥ 50 %)", "–"]
    assert second[3:5] == ["–", "0.80"]
    assert "over groups, the same groups" in shown.notes[0]
    assert shown.notes[1].endswith(
        "differently on the same map: stakes and backend=tracks."
    )


@pytest.mark.parametrize(("second", "sign"), [(-3.0, "differs"), (4.0, "same")])
def test_hypotheses_have_a_column_per_world(second: float, sign: str) -> None:
    tests = []
    for world, difference in zip(WORLDS, (6.0, second), strict=True):
        test = {"one": "a", "other": "b", "metric": "success", "kind": "difference"}
        test |= {"direction": "higher", "margin": 0.0, "number": 1, "world": world}
        test |= {"registered": world == WORLDS[1], "difference": difference}
        test |= {
            "low": difference - 2,
            "high": difference + 2,
            "p": 0.04,
            "unit": "points",
        }
        test |= {"low_90": difference - 1, "high_90": difference + 1}
        tests.append(test)
    margin = [t | {"number": 2, "kind": "equivalence", "direction": ""} for t in tests]
    sides = (LABELS | {"risk": "cvar:0.8"}, LABELS | {"risk": "mean"})
    base = some_worse().settings
    results = BetweenWorlds(
        settings=base,
        hypotheses=pd.DataFrame([*tests, *margin[:1]]),
        setting_labels={1: sides, 2: sides},
    )
    *_, table = between_tables(results, "map")
    row, equivalence = table.rows
    assert row[1] == "success of CVaR₀.₈ is higher than that of mean"
    assert row[2] == "+6.0 points (+4.0 to +8.0), p = 0.04"
    assert not isinstance(row[2], Bold)
    assert isinstance(row[3], Bold)
    assert row[4] == sign
    assert "(+5.0 to +7.0)" in equivalence[2]
    assert equivalence[3] == "–"
