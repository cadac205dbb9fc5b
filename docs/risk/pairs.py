"""Paired comparisons of risk settings, for docs/risk.md.

    python docs/risk/pairs.py runs/stakes                      # all pairs of settings, a family a planner
    python docs/risk/pairs.py runs/look-alikes --against cvar:0
    python docs/risk/pairs.py runs/stakes --by model           # models in place of settings
    python docs/risk/pairs.py runs/sweep-length --order        # best and worst setting of each variant

Episodes on the same map met the same luck. A difference of success is in percentage points, with a bootstrap
interval over maps (percentiles of 10 000 draws) and the exact McNemar test; one of time is of T_total, where a
failure counts as T, with Wilcoxon's signed-rank test. Holm's correction is over all pairs of one family: the
same data, scenario, world, planner and model (or setting).
"""

import argparse
import sys
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import binomtest, wilcoxon

sys.path.insert(0, str(Path(__file__).parents[1]))
from results import holm

KEYS = ["seed", "realisation", "instance"]
PARTS = ["data", "scenario", "world", "planner", "model", "risk"]
DRAWS = 10_000


def families(rows: pd.DataFrame, by: str) -> Iterator[tuple[str, dict[str, pd.DataFrame]]]:
    """A family's name, and the episodes of each of its members by name; those that stand alone are left out."""
    others = [name for name in PARTS if name != by]
    if by == "model":
        rows = for_each_risk(rows)
    several = [name for name in others if rows[name].nunique() > 1]
    for values, family in rows.groupby(others, sort=False):
        members = {name: member for name, member in family.groupby(by, sort=False) if name != "–"}
        if len(members) > 1:
            known = dict(zip(others, values, strict=True))
            yield ", ".join(str(known[name]) for name in several) or "all", members


def for_each_risk(rows: pd.DataFrame) -> pd.DataFrame:
    """Stands a model that is run once for all settings, the clairvoyant, beside each of them."""
    once = (rows["risk"] == "–") & (rows["model"] != "–")
    settings = [risk for risk in rows["risk"].unique() if risk != "–"]
    return pd.concat([rows[~once], *(rows[once].assign(risk=risk) for risk in settings)])


def compare(one: pd.DataFrame, other: pd.DataFrame) -> dict[str, float]:
    """What `one` gains on `other`, map by map."""
    both = one.merge(other, on=KEYS, suffixes=("", "_other"))
    gain = both["success"].astype(float) - both["success_other"].astype(float)
    by_map = (100 * gain).groupby(both["instance"]).mean().to_numpy()
    late = (both["total_time_s"] - both["total_time_s_other"]).groupby(both["instance"]).mean().to_numpy()
    draws = np.random.default_rng(0).integers(len(by_map), size=(DRAWS, len(by_map)))
    wins, losses = int((gain > 0).sum()), int((gain < 0).sum())
    return {
        "success": by_map.mean(),
        "success_low": np.percentile(by_map[draws].mean(1), 2.5),
        "success_high": np.percentile(by_map[draws].mean(1), 97.5),
        "success_p": binomtest(wins, wins + losses).pvalue if wins + losses else 1.0,
        "time": late.mean(),
        "time_low": np.percentile(late[draws].mean(1), 2.5),
        "time_high": np.percentile(late[draws].mean(1), 97.5),
        "time_p": wilcoxon(late).pvalue if np.any(late) else 1.0,
    }


def compared(members: dict[str, pd.DataFrame], against: str) -> pd.DataFrame:
    """All pairs of a family, or those with one of its members, with corrected p."""
    pairs = [
        (one, other) for other, one in combinations(members, 2) if not against or against in (one, other)
    ]
    if against:
        pairs = [(one, other) if other == against else (other, one) for one, other in pairs]
    made = [{"one": a, "other": b, **compare(members[a], members[b])} for a, b in pairs]
    table = pd.DataFrame(made)
    for name in ("success_p", "time_p"):
        table[name] = holm(table[name])
    return table


def print_pairs(name: str, table: pd.DataFrame) -> None:
    """Prints a family as Markdown."""
    print(f"\n{name}\n\n| | against | Δ success [points] | 95 % | p | Δ T_total [s] | 95 % | p |")
    print("|---|---|---|---|---|---|---|---|")
    for row in table.to_dict("records"):
        print(
            f"| {row['one']} | {row['other']} | {row['success']:+.1f} | "
            f"{row['success_low']:+.1f} to {row['success_high']:+.1f} | {row['success_p']:.2g} | "
            f"{row['time']:+.1f} | {row['time_low']:+.1f} to {row['time_high']:+.1f} | {row['time_p']:.2g} |"
        )


def print_order(name: str, members: dict[str, pd.DataFrame]) -> None:
    """Prints a row: success of each member, and what the best gains on the worst."""
    success = {label: 100 * rows["success"].mean() for label, rows in members.items()}
    order = sorted(success, key=success.__getitem__)
    worst, best = order[0], order[-1]
    table = compared(members, "")
    found = table[table["one"].isin((best, worst)) & table["other"].isin((best, worst))].iloc[0]
    ends = found["success_low"], found["success_high"]
    if found["one"] == worst:
        ends = -ends[1], -ends[0]
    rates = " | ".join(f"{value:.0f}" for value in success.values())
    gap = f"{success[best] - success[worst]:+.0f} ({ends[0]:+.0f} to {ends[1]:+.0f})"
    print(f"| {name} | {rates} | {best} − {worst} {gap} | {found['success_p']:.2g} |")


def main() -> None:
    """Prints what was asked for of a run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--by", default="risk", choices=PARTS, help="what is compared")
    parser.add_argument("--against", default="", help="one of them; all pairs when not given")
    parser.add_argument("--order", action="store_true", help="a row a family instead")
    given = parser.parse_args()
    rows = pd.read_parquet(given.run / "episodes.parquet")
    heads: list[str] = []
    for name, members in families(rows, given.by):
        if not given.order:
            print_pairs(name, compared(members, given.against))
            continue
        if list(members) != heads:
            heads = list(members)
            print(f"\n| | {' | '.join(heads)} | best − worst [points] (95 %) | p |")
            print("|---" * (len(heads) + 3) + "|")
        print_order(name, members)


if __name__ == "__main__":
    main()
