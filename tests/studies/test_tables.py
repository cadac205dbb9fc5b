"""Tables of the studies' pages say what is so."""

from collections.abc import Sequence
from math import comb
from pathlib import Path

import pandas as pd
from scipy.stats import t

from benchnav.core.tables import to_markdown
from studies import tables
from studies.results.paper import paper
from tests.eval.report.made import condition, row, rows
from tests.eval.test_compare import run_folder


def made(**success: Sequence[bool]) -> pd.DataFrame:
    """Episodes on the same maps under settings."""
    return rows(
        row(condition("mppi", risk), i, 30.0 if won else None)
        for risk, each in success.items()
        for i, won in enumerate(each)
    )


def sweep(folder: Path) -> list[str]:
    return to_markdown(tables.sweep(folder)).split("\n")


def test_the_best_is_told_from_the_worst(tmp_path: Path) -> None:
    # 10 of 12 maps are won by the best alone: the exact test is 2 / 2¹⁰, threefold by
    # Holm's correction.
    episodes = made(
        cvar=[True] * 11 + [False], mean=[True] + [False] * 11, var=[True, False] * 6
    )
    lines = sweep(run_folder(tmp_path / "run", episodes))
    assert lines[0] == "| cvar | mean | var | best − worst [points] (95 %) | p |"
    assert lines[2].startswith("| 91.7 | 8.3 | 50.0 | cvar − mean +83.3 (+")
    assert lines[2].endswith(f"| {3 * 2 / 2**10:.2g} |")


def test_settings_stand_beside_one_another_with_their_success_and_time(
    tmp_path: Path,
) -> None:
    shared = dict.fromkeys(tables.NEXT_TO_RISK, "x") | {"planner": "mppi"}
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
    head, _, line = to_markdown(tables.settings(tmp_path)).rstrip().split("\n")
    assert head == "| planner | mean | cvar |"
    assert line == "| mppi | 100.0 (90–100), 30.0 s | 50.0 (30–70), 65.0 s |"


def test_the_papers_rows_stand_beside_those_of_mppi_under_cvar(tmp_path: Path) -> None:
    numbers = {"success_low": 0.8, "success_high": 1.0, "n_episodes": 200}
    time = {
        "total_time_mean_s": 40.0,
        "total_time_low_s": 39.0,
        "total_time_high_s": 41.0,
    }
    made = [
        {
            "scenario": scenario,
            "planner": planner,
            "risk": risk,
            "success_rate": rate,
            **numbers,
            **time,
        }
        | {"total_time_std_s": 10.0}
        for scenario, planner, risk, rate in (
            ("std", "mppi", "cvar", 0.9),
            ("std", "mppi", "mean", 0.1),
            ("std", "astar_dwa", "cvar", 0.2),
            ("hg", "mppi", "cvar", 0.995),
        )
    ]
    pd.DataFrame(made).to_csv(tmp_path / "summary.csv")
    _, _, std, hg = to_markdown(paper(tmp_path)).rstrip().split("\n")
    # Of 18 in 20 and 180 in 200 no table is likelier, so p is 1; that of 16 and 199 is
    # a sum of hypergeometric terms.
    at_most = {
        won: comb(20, won) * comb(200, 215 - won) / comb(220, 215)
        for won in range(15, 21)
    }
    p = sum(value for value in at_most.values() if value <= at_most[16] * (1 + 1e-9))
    assert std.startswith(
        "| std | 90 (70–97) | 90.0 (80–100) | 1 | 52.7 (42.2–63.2) | 40.0 (39.0–41.0) |"
    )
    assert hg.startswith(
        f"| hg | 80 (58–92) | 99.5 (80–100) | {2 * p:.2g} | 60.2 (48.0–72.4) |"
    )
    # Welch's: 12.7 s over √(22.5² / 20 + 10² / 200) s, 19.8 degrees of freedom; the
    # larger of two p.
    errors = (22.5**2 / 20, 10**2 / 200)
    freedom = sum(errors) ** 2 / (errors[0] ** 2 / 19 + errors[1] ** 2 / 199)
    assert std.endswith(f" {2 * t.sf(12.7 / sum(errors) ** 0.5, freedom):.2g} |")
