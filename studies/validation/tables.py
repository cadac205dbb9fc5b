"""Tables of the trials next to the published ones, as Markdown.

Intervals are Wilson's, 95 %, over trials. Two settings, or two runs, on the same trials
are compared by the exact McNemar test, ours with theirs by Fisher's exact test and
Newcombe's interval (1998, "Interval estimation for the difference between independent
proportions: comparison of eleven methods", method 10).

What Cai et al. measured is counted in the log of trials that they publish with their
code, `mppi_benchmark/envs_40_trials_5_densities_4_date_20220907-2234.pickle` in
https://github.com/mit-acl/mppi_numba, method
`risk_dyn`: λ̂ is the mean of the lowest fraction α of the distribution, which is our
`cvar:1 − α`; α = 1 is our `mean`. `published.csv` has how many of 200 trials arrived
within 15 s, and the mean time of those; `published_pairs.csv` of each density the
trials in which `cvar:0.8` arrived and `mean` did not, and the reverse.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import fisher_exact
from statsmodels.stats.proportion import confint_proportions_2indep

from benchnav.core.tables import NOTHING
from benchnav.stats.flips import sign_flip_p
from benchnav.stats.holm import holm
from benchnav.stats.intervals import wilson_interval

TRIALS = 200
LINE = ["density", "setting"]
PUBLISHED = pd.read_csv(Path(__file__).with_name("published.csv")).set_index(LINE)
PUBLISHED_PAIRS = pd.read_csv(
    Path(__file__).with_name("published_pairs.csv")
).set_index("density")
# What is compared on the same trials; of the first the log of theirs is counted too.
PAIRS = (("cvar:0.8", "mean"), ("cost-cvar:0.6", "cost"), ("cost-cvar:0.6", "cvar:0.6"))


def tabulate(rows: pd.DataFrame) -> str:
    """Return the table of success, and those of the pairs of settings that were run.

    Args:
        rows: trials, from `run_trials`.
    """
    settings = set(rows["setting"])
    pairs = [tabulate_pairs(rows, *pair) for pair in PAIRS if {*pair} <= settings]
    return "\n\n".join([tabulate_success(rows), *pairs])


def tabulate_success(rows: pd.DataFrame) -> str:
    """Return success and mean time of the successes, ours and theirs; p is corrected by
    Holm's method over all lines.

    Args:
        rows: trials, from `run_trials`.
    """
    ours = rows.groupby(LINE, sort=False).agg(
        arrived=("success", "sum"),
        trials=("success", "size"),
        mean_s=("time_s", "mean"),
    )
    lines, p = [], []
    for row in ours.join(PUBLISHED).itertuples():
        line = [
            *show_line(row.Index),
            show_share(row.arrived, row.trials),
            show_time(row.mean_s),
        ]
        if not np.isnan(row.successes):
            theirs = int(row.successes)
            table = [[row.arrived, row.trials - row.arrived], [theirs, TRIALS - theirs]]
            p.append(fisher_exact(table).pvalue)
            line += [show_share(theirs, TRIALS), show_time(row.time_s)]
            line += [show_difference(row.arrived, row.trials, theirs, TRIALS)]
        lines.append(line)
    corrected = map(show_p, holm(np.array(p)))
    lines = [
        [*line, next(corrected)] if len(line) == 7 else [*line, *4 * [NOTHING]]
        for line in lines
    ]
    header = ["vegetation", "setting", "success, %", "time, s"]
    return markdown(
        [*header, "theirs, %", "theirs, s", "ours − theirs", "p of ours = theirs"],
        lines,
    )


def tabulate_pairs(rows: pd.DataFrame, one: str, other: str) -> str:
    """Return what a setting gains over another on the same trials; of the first of
    `PAIRS` also in theirs.

    Args:
        rows: trials, from `run_trials`; both settings are among them.
        one: a setting.
        other: the other.
    """
    won = wins(rows)
    sides = (won.xs(setting, level="setting") for setting in (one, other))
    header = ["points", f"`{one}` alone, `{other}` alone", "p"]
    has_theirs = (one, other) == PAIRS[0]
    lines = []
    for density, changed in changes(*sides, ["density"]).items():
        line = [f"{100 * density:.0f} %", *show_changes(changed, sign_flip_p(changed))]
        if has_theirs and density in PUBLISHED_PAIRS.index:
            gained, lost = PUBLISHED_PAIRS.loc[density]
            theirs = np.repeat([1, -1, 0], [gained, lost, TRIALS - gained - lost])
            line += show_changes(theirs, sign_flip_p(theirs))
        lines.append(line + [NOTHING] * (3 * has_theirs + 4 - len(line)))
    return markdown(
        ["vegetation", *header, *(f"theirs: {name}" for name in header if has_theirs)],
        lines,
    )


def tabulate_runs(runs: Mapping[str, pd.DataFrame]) -> str:
    """Return success and mean time of several runs of the same trials, and what each
    changes on the first.

    Args:
        runs: trials by name, from `run_trials`; p is corrected by Holm's method over
            the lines of a run.
    """
    first, *others = runs
    means = {
        name: rows.groupby(LINE, sort=False)[["success", "time_s"]].mean()
        for name, rows in runs.items()
    }
    means["theirs"] = PUBLISHED.assign(success=PUBLISHED["successes"] / TRIALS)
    cells = {
        name: {
            row.Index: f"{100 * row.success:.1f}, {show_time(row.time_s)} s"
            for row in own.itertuples()
        }
        for name, own in means.items()
    }
    lines = [
        [*show_line(line), *(own.get(line, NOTHING) for own in cells.values())]
        for line in means[first].index
    ]
    tables = [markdown(["vegetation", "setting", *cells], lines)]
    for name in others:
        changed = changes(wins(runs[name]), wins(runs[first]), LINE)
        corrected = holm(np.array([sign_flip_p(own) for own in changed.values()]))
        lines = [
            [*show_line(line), *show_changes(own, p)]
            for (line, own), p in zip(changed.items(), corrected, strict=True)
        ]
        won = f"won with {name} alone, with {first} alone"
        tables.append(markdown(["vegetation", "setting", "points", won, "p"], lines))
    return "\n\n".join(tables)


def wins(rows: pd.DataFrame) -> pd.Series:
    """Return which trials were won."""
    return rows.set_index([*LINE, "map", "realisation"])["success"].astype(int)


def changes(
    one: pd.Series, other: pd.Series, by: list[str]
) -> dict[tuple[float, str], np.ndarray]:
    """Return by line which trials only one won, 1, and which only the other, −1; in the
    order of the other.
    """
    both = other.to_frame("other").join(one.rename("one"), how="inner")
    lines = (both["one"] - both["other"]).groupby(
        by[0] if len(by) == 1 else by, sort=False
    )
    return {line: changed.to_numpy() for line, changed in lines}


def show_changes(changed: np.ndarray, p: float) -> list[str]:
    """Write a difference in points, the counts that make it, and p."""
    return [
        f"{100 * changed.mean():+.1f}",
        f"{(changed > 0).sum()}, {(changed < 0).sum()}",
        show_p(p),
    ]


def show_line(line: tuple[float, str]) -> list[str]:
    """Write density and setting."""
    return [f"{100 * line[0]:.0f} %", f"`{line[1]}`"]


def show_share(successes: int, trials: int) -> str:
    """Write a fraction in per cent with its interval."""
    low, high = wilson_interval(successes / trials, trials)
    return f"{100 * successes / trials:.1f} [{100 * low:.0f}, {100 * high:.0f}]"


def show_difference(a: int, n_a: int, b: int, n_b: int) -> str:
    """Write a difference of two independent rates in points, a/n_a − b/n_b, with its
    interval.
    """
    low, high = confint_proportions_2indep(a, n_a, b, n_b, method="newcomb")
    return f"{100 * (a / n_a - b / n_b):+.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def show_time(seconds: float) -> str:
    """Write seconds, or a dash if nothing arrived."""
    return NOTHING if np.isnan(seconds) else f"{seconds:.1f}"


def show_p(p: float) -> str:
    """Write a p-value."""
    return f"{p:.2f}" if p >= 0.1 else f"{p:.1g}"


def markdown(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Write a Markdown table whose cells may hold Markdown."""
    return "\n".join(
        f"| {' | '.join(line)} |" for line in [header, ["---"] * len(header), *lines]
    )
