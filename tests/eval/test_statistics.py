import numpy as np
import pandas as pd
import pytest

from benchnav.eval.statistics import summarise, wilson_interval


def test_wilson_interval_is_the_textbook_formula() -> None:
    for successes, trials in ((0, 20), (18, 20), (20, 20), (7, 13)):
        z, p = 1.959963984540054, successes / trials
        centre = (p + z**2 / (2 * trials)) / (1 + z**2 / trials)
        half = z * np.sqrt(p * (1 - p) / trials + z**2 / (4 * trials**2)) / (1 + z**2 / trials)
        low, high = wilson_interval(successes, trials)
        assert low == pytest.approx(max(0, centre - half), abs=1e-12)
        assert high == pytest.approx(min(1, centre + half), abs=1e-12)


def test_summary_counts_a_failure_at_the_budget_and_apart() -> None:
    rows = [
        ("std", "mppi", "cvar", True, "success", 30.0, 0.8),
        ("std", "mppi", "cvar", True, "success", 40.0, 0.6),
        ("std", "mppi", "cvar", False, "stuck", 100.0, 0.2),
        ("hg", "mppi", "cvar", False, "timeout", 100.0, 0.5),
    ]
    columns = ["scenario", "planner", "risk", "success", "outcome", "total_time_s", "traversability"]
    table = pd.DataFrame(rows, columns=columns).assign(
        time_ratio=1.0, path_length_m=2.0, stuck_share=0.0, roughness=0.0
    )
    summary = summarise(table)
    assert summary["scenario"].tolist() == ["std", "hg"]
    std = summary.iloc[0]
    assert std["success_rate"] == pytest.approx(2 / 3)
    assert std["total_time_mean_s"] == pytest.approx(170 / 3)
    assert std["success_time_mean_s"] == pytest.approx(35)
    assert std["success_time_std_s"] == pytest.approx(np.std([30, 40], ddof=1))
    assert std["traversability_mean"] == pytest.approx(1.6 / 3)
    assert std["stuck_count"] == 1
    assert np.isnan(summary.iloc[1]["success_time_mean_s"])
