"""Tables of the trials next to the published ones, as Markdown.

Intervals are Wilson's, 95 %, over trials. Two settings, or two runs, on the same trials are compared by the exact
McNemar test, ours with theirs by Fisher's exact test and Newcombe's interval.
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd
from scipy.stats import binomtest, fisher_exact
from statsmodels.stats.proportion import confint_proportions_2indep

from benchnav.stats.holm import holm
from benchnav.stats.intervals import wilson_interval
from studies.validation.published import PUBLISHED, PUBLISHED_PAIRS, TRIALS

# What is compared on the same trials; of the first the log of theirs is counted too.
PAIRS = (("cvar:0.8", "mean"), ("cost-cvar:0.6", "cost"), ("cost-cvar:0.6", "cvar:0.6"))
_NONE = "–"


def tabulate(rows: pd.DataFrame) -> str:
    """Return the table of success, and those of the pairs of settings that were run.

    Args:
        rows: trials, from `run_trials`.
    """
    settings = set(rows["setting"])
    pairs = [tabulate_pairs(rows, *pair) for pair in PAIRS if {*pair} <= settings]
    return "\n\n".join([tabulate_success(rows), *pairs])


def tabulate_success(rows: pd.DataFrame) -> str:
    """Success and mean time of the successes, ours and theirs; p is corrected by Holm's method over all lines.

    Args:
        rows: trials, from `run_trials`.
    """
    lines, compared = [], {}
    for (density, setting), group in rows.groupby(["density", "setting"], sort=False):
        arrived, trials = int(group["success"].sum()), len(group)
        cells = [
            f"{100 * density:.0f} %",
            f"`{setting}`",
            show_share(arrived, trials),
            show_time(group["time_s"].mean()),
        ]
        theirs = PUBLISHED.get((density, setting))
        if theirs is None:
            lines.append([*cells, _NONE, _NONE, _NONE, _NONE])
            continue
        table = [[arrived, trials - arrived], [theirs.successes, TRIALS - theirs.successes]]
        compared[len(lines)] = fisher_exact(table).pvalue
        published = show_share(theirs.successes, TRIALS), show_time(theirs.time_s)
        lines.append([*cells, *published, show_difference(arrived, trials, theirs.successes, TRIALS)])
    corrected = holm(np.array(list(compared.values())))
    for place, p in zip(compared, corrected, strict=True):
        lines[place].append(show_p(p))
    return markdown(
        [
            "vegetation", "setting", "success, %", "time, s", "theirs, %", "theirs, s", "ours − theirs",
            "p of ours = theirs",
        ],
        lines,
    )  # fmt: skip


def tabulate_pairs(rows: pd.DataFrame, one: str, other: str) -> str:
    """What a setting gains over another on the same trials, and of the first of `PAIRS` what it gained in theirs.

    Args:
        rows: trials, from `run_trials`; both settings are among them.
        one: a setting.
        other: the other.
    """
    ours, lines = ["points", f"`{one}` alone, `{other}` alone", "p"], []
    counted = PUBLISHED_PAIRS if (one, other) == PAIRS[0] else {}
    for density, group in rows.groupby("density", sort=False):
        won = group.pivot(index=["map", "realisation"], columns="setting", values="success")
        trials = won.reindex(columns=[one, other]).dropna().astype(bool)
        if trials.empty:
            continue
        gained = int((trials[one] & ~trials[other]).sum())
        lost = int((trials[other] & ~trials[one]).sum())
        line = [f"{100 * density:.0f} %", *show_pair(gained, lost, len(trials))]
        if counted:
            theirs = counted.get(density)
            line += [_NONE] * 3 if theirs is None else show_pair(*theirs, TRIALS)
        lines.append(line)
    return markdown(["vegetation", *ours, *(f"theirs: {name}" for name in ours if counted)], lines)


def tabulate_runs(runs: Mapping[str, pd.DataFrame]) -> str:
    """Success and mean time of several runs of the same trials, and what each changes on the first.

    Args:
        runs: trials by name, from `run_trials`; p is corrected by Holm's method over the lines of a run.
    """
    first, *others = runs
    settings = list(runs[first].groupby(["density", "setting"], sort=False).groups)
    keys = ["density", "setting", "map", "realisation"]
    won = {name: rows.set_index(keys)["success"].astype(bool).sort_index() for name, rows in runs.items()}
    took = {name: rows.set_index(keys)["time_s"].sort_index() for name, rows in runs.items()}
    header, lines = ["vegetation", "setting", *runs, "theirs"], []
    for line in settings:
        cells = [
            f"{100 * won[name][line].mean():.1f}, {show_time(took[name][line].mean())} s" for name in runs
        ]
        theirs = PUBLISHED.get(line)
        cells.append(
            f"{100 * theirs.successes / TRIALS:.1f}, {show_time(theirs.time_s)} s" if theirs else _NONE
        )
        lines.append([f"{100 * line[0]:.0f} %", f"`{line[1]}`", *cells])
    tables = [markdown(header, lines)]
    for name in others:
        changes = [(won[name][line], won[first][line]) for line in settings]
        counts = [(int((one & ~other).sum()), int((other & ~one).sum())) for one, other in changes]
        corrected = holm(np.array([mcnemar_p(*pair) for pair in counts]))
        lines = [
            [f"{100 * line[0]:.0f} %", f"`{line[1]}`", f"{100 * (gained - lost) / len(one):+.1f}", f"{gained}, {lost}",
             show_p(p)]
            for line, (gained, lost), (one, _), p in zip(settings, counts, changes, corrected, strict=True)
        ]  # fmt: skip
        tables.append(
            markdown(
                ["vegetation", "setting", "points", f"won with {name} alone, with {first} alone", "p"], lines
            )
        )
    return "\n\n".join(tables)


def mcnemar_p(gained: int, lost: int) -> float:
    """Two-sided p of the exact McNemar test, from the trials that only one of two settings won."""
    return float(binomtest(gained, gained + lost).pvalue) if gained + lost else 1.0


def show_pair(gained: int, lost: int, trials: int) -> list[str]:
    """Difference in points, the counts that make it, and their p."""
    return [f"{100 * (gained - lost) / trials:+.1f}", f"{gained}, {lost}", show_p(mcnemar_p(gained, lost))]


def show_share(successes: int, trials: int) -> str:
    """A share in per cent with its interval."""
    low, high = wilson_interval(successes / trials, trials)
    return f"{100 * successes / trials:.1f} [{100 * low:.0f}, {100 * high:.0f}]"


def show_difference(a: int, n_a: int, b: int, n_b: int) -> str:
    """A difference of two independent rates in points, a/n_a − b/n_b, with its interval.

    Source: Newcombe (1998), "Interval estimation for the difference between independent proportions: comparison of
    eleven methods", method 10.
    """
    low, high = confint_proportions_2indep(a, n_a, b, n_b, method="newcomb")
    return f"{100 * (a / n_a - b / n_b):+.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def show_time(seconds: float) -> str:
    """Seconds, or a dash where there was no arrival."""
    return _NONE if seconds != seconds else f"{seconds:.1f}"


def show_p(p: float) -> str:
    """A p-value."""
    return f"{p:.2f}" if p >= 0.1 else f"{p:.1g}"


def markdown(header: list[str], lines: list[list[str]]) -> str:
    """A Markdown table."""
    return "\n".join(f"| {' | '.join(line)} |" for line in [header, ["---"] * len(header), *lines])
