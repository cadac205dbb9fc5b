"""Repeats the experiment of Cai et al. with our planner and risk settings, beside what they published.

    python -m benchmarks.cai                                       # all of it
    python -m benchmarks.cai --density 0.4 1.0 --out trials.csv    # some of it
    python -m benchmarks.cai --setup.risk_map histogram            # with a choice of theirs
    python -m benchmarks.cai --risk cost cost-cvar:0.6 --density 0.4 1.0 --setup.fields 128     # risk on the cost

What is theirs, what is ours and what differs is said in `docs/studies/validation.md`.
"""

import sys
from pathlib import Path

import pandas as pd
from jsonargparse import ArgumentParser

from benchmarks.cai.run import SETTINGS, run_trials
from benchmarks.cai.tables import tabulate
from benchmarks.cai.task import Setup, planner_config
from benchnav.core.errors import ConfigError
from benchnav.core.progress import show_progress
from benchnav.core.store import replacing


def make_parser() -> ArgumentParser:
    parser = ArgumentParser(prog="python -m benchmarks.cai", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--density", type=float, nargs="+", default=[0.1, 0.4, 0.7, 1.0], help="Of vegetation."
    )
    parser.add_argument("--risk", type=str, nargs="+", default=list(SETTINGS), help="Risk settings.")
    parser.add_argument("--maps", type=int, default=40, help="How many.")
    parser.add_argument("--realisations", type=int, default=5, help="Draws of traction a map.")
    parser.add_argument("--seed", type=int, default=0, help="Root of all draws.")
    parser.add_argument("--out", type=Path, help="CSV file of trials to write.")
    parser.add_class_arguments(Setup, "setup")
    return parser


def in_order(rows: pd.DataFrame, densities: list[float], settings: list[str]) -> pd.DataFrame:
    """Rows by density and setting as they were asked for, then by map and realisation."""
    rank = {"density": densities.index, "setting": settings.index}
    return rows.sort_values(
        ["density", "setting", "map", "realisation"],
        key=lambda column: column.map(rank[column.name]) if column.name in rank else column,
        ignore_index=True,
    )


def main() -> int:
    parser = make_parser()
    words = parser.parse_args()
    try:
        given = parser.instantiate(words)
        units = run_trials(given.density, given.risk, given.maps, given.realisations, given.seed, given.setup)
        rows: list[pd.DataFrame] = []
        planners = {planner_config(setting, given.setup) for setting in given.risk}
        total = given.maps * given.realisations * len(planners)
        show_progress(((len(rows), total) for unit in units if rows.append(unit) is None), "trials a planner")
    except ConfigError as error:
        print(f"{parser.prog}: error: {error}", file=sys.stderr)
        return 2
    trials = in_order(pd.concat(rows, ignore_index=True), given.density, given.risk)
    if given.out:
        with replacing(given.out) as partial:
            trials.to_csv(partial, index=False)
    print(tabulate(trials))
    return 0


if __name__ == "__main__":
    sys.exit(main())
