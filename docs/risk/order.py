"""The order of risk settings under each value of a sweep, for docs/risk.md.

    python docs/risk/order.py runs/sweep-length

A row a variant: success of each setting, what the best gains on the worst with its interval, and p of the
sign-flip test, with Holm's correction over all pairs of settings of the variant. Best and worst are chosen
by what was seen, so that the gain leans upward.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchnav.eval.compare import read_trials
from benchnav.eval.folder.folder import open_run
from benchnav.eval.stats.comparison import compare
from benchnav.eval.stats.pairing import Pair, find_pairs

NAMES = ("data", "scenario", "world", "planner", "model")


def variants(pairs: Sequence[Pair]) -> dict[str, list[Pair]]:
    """Pairs of settings by what else they are of, named by what differs."""
    several = [name for name in NAMES if len({pair.shared[name] for pair in pairs}) > 1]
    found: dict[str, list[Pair]] = {}
    for pair in pairs:
        shared = {**pair.shared, "data": Path(pair.shared["data"]).name}
        found.setdefault(", ".join(shared[name] for name in several) or "all", []).append(pair)
    return found


def row(pairs: Sequence[Pair]) -> tuple[dict[str, float], str, str]:
    """Success of each setting in per cent, what the best gains on the worst in points, and p."""
    table = compare(pairs)
    success = {}
    for one in table.to_dict("records"):
        success |= {one["other"]: 100 * one["success_other"], one["one"]: 100 * one["success_one"]}
    order = sorted(success, key=success.__getitem__)
    worst, best = order[0], order[-1]
    found = table[table["one"].isin((best, worst)) & table["other"].isin((best, worst))].iloc[0]
    ends = [100 * found["success_low"], 100 * found["success_high"]]
    if found["one"] == worst:
        ends = [-end for end in reversed(ends)]
    gain = f"{best} − {worst} {success[best] - success[worst]:+.1f} ({ends[0]:+.0f} to {ends[1]:+.0f})"
    return success, gain, f"{found['success_p_holm']:.2g}"


def main() -> None:
    """Prints the rows of a run as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    run = open_run(parser.parse_args().run)
    heads: list[str] = []
    for name, pairs in variants(find_pairs(read_trials([run]), by="risk")).items():
        success, gain, p = row(pairs)
        settings = sorted(success, key=[pair for both in pairs for pair in (both.other, both.one)].index)
        if settings != heads:
            heads = settings
            print(f"\n| | {' | '.join(heads)} | best − worst [points] (95 %) | p |")
            print("|---" * (len(heads) + 3) + "|")
        print(f"| {name} | {' | '.join(f'{success[setting]:.1f}' for setting in settings)} | {gain} | {p} |")


if __name__ == "__main__":
    main()
