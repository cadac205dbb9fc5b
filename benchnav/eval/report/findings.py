"""What a run says, in sentences made from its numbers; whether one setting beats another is for the tests to say."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from benchnav.eval.report.words import FAILURE_COUNTS, blocks, p_in_words, rate_in_words, with_names
from benchnav.eval.stats.best import PRIVILEGED, competing
from benchnav.eval.stats.comparison import ALPHA

_MOST_NAMED = 6


def findings(
    summary: pd.DataFrame, failures: pd.DataFrame, predicted: Mapping[str, np.ndarray]
) -> dict[str, list[str]]:
    """Says of each block which setting is best, by how much, how sure that is, and how the failures failed.

    Args:
        summary: from `summary.summarise`, joined with `best.against_best`.
        failures: from `failures.failures_table`.
        predicted: by condition the λ̂ where its failed episodes ended, where that is known.

    Returns:
        By the title of a block its sentences.
    """
    every = blocks(with_names(summary))
    return {title: list(_sentences(block, failures, predicted)) for title, block in every}


def _sentences(
    rows: pd.DataFrame, failures: pd.DataFrame, predicted: Mapping[str, np.ndarray]
) -> Iterable[str]:
    rivals = rows[competing(rows)]
    best = rivals[rivals["condition"] == rivals["best"].iloc[0]].to_dict("records")[0]
    others = rivals[rivals["condition"] != best["condition"]].sort_values("best_difference", kind="stable")
    shared = int((others["success_rate"] == best["success_rate"]).sum())
    also = f" and {shared} more" if shared else ""
    yield (
        f"The highest success rate is that of {best['name']}{also}: {rate_in_words(best)} % of its episodes "
        f"reached the goal (95 % interval {100 * best['success_low']:.0f} to {100 * best['success_high']:.0f} %)."
    )
    common = int(best["best_episodes"])
    if not others.empty and (rivals["n_episodes"] > common).any():
        yield f"The settings are compared on the {common} episodes that all of them have."
    yield from _rank(best, others)
    yield from _why(best, failures, predicted)
    count = int(rivals["n_episodes"].sum())
    failed = rivals[list(FAILURE_COUNTS)].to_numpy().sum()
    if failed and len(rivals) > 1:
        yield (
            f"All {len(rivals)} compared settings together failed in {failed} of {count} episodes: {_shares(rivals)}."
        )
    references = rows[~competing(rows)].sort_values("success_rate", kind="stable")
    for part in reversed(PRIVILEGED):
        for most in references[references["privileged"] == part].tail(1).to_dict("records"):
            yield f"With the privileged model {most['model']} {most['name']} reached {rate_in_words(most)} %."


def _rank(best: Mapping[Any, Any], others: pd.DataFrame) -> Iterable[str]:
    if others.empty:
        yield "There is no other setting to compare it with."
        return
    alike, worse = others[others["best_alike"]], others[~others["best_alike"]]
    unit = "group" if best["n_groups"] < best["n_maps"] else "map"
    test = f"max-T sign-flip test by {unit} over {len(others) + 1} settings"
    if worse.empty:
        shown, p = others["best_shown"].max(), others["best_p"].min()
        maps = f"{int(best['best_maps'])} {unit}s"
        power = f"; {maps} detect differences of {100 * shown:.0f} points or more with 80 % power"
        yield (
            f"No setting is significantly worse ({test}, p {'=' if p >= 1 else '≥'} "
            f"{max(np.floor(100 * p) / 100, ALPHA):g}"
            f"{power if shown <= 1 else ''}): the run does not say which is best."
        )
        return
    if alike.empty:
        other = "The other setting is" if len(worse) == 1 else f"All {len(worse)} other settings are"
        yield f"{other} significantly worse: it is the best here."
    else:
        listed = list(alike["name"])
        more = f" and {len(listed) - _MOST_NAMED} more" if len(listed) > _MOST_NAMED else ""
        verb = "1 other setting is" if len(listed) == 1 else f"{len(listed)} other settings are"
        yield f"{verb} not significantly worse (p ≥ {ALPHA}): {'; '.join(listed[:_MOST_NAMED])}{more}."
    following = worse.iloc[0]
    place = "The next" if alike.empty else "The next that is significantly worse"
    low, high = 100 * following["best_low"], 100 * following["best_high"]
    yield (
        f"{place} is {following['name']} with {rate_in_words(following)} %: the difference is "
        f"{100 * following['best_difference']:.1f} points (95 % interval of the pair alone {low:.1f} to "
        f"{high:.1f}), {p_in_words(following['best_p'])} ({test})."
    )


def _why(
    best: Mapping[Any, Any], failures: pd.DataFrame, predicted: Mapping[str, np.ndarray]
) -> Iterable[str]:
    """How the best setting's failures failed, and on what ground."""
    failed = sum(best[column] for column in FAILURE_COUNTS)
    if not failed:
        yield f"{best['name']} never failed."
        return
    yield f"{best['name']} failed in {failed} of {best['n_episodes']} episodes: {_shares(pd.DataFrame([best]))}."
    observed = failures.loc[failures["condition"] == best["condition"], "last_traversability"].median()
    # An end outside the map has no λ̂.
    given = pd.Series(predicted.get(best["condition"]), dtype=float).median()
    if not np.isnan(observed) and not np.isnan(given):
        yield (
            f"At the place where they ended, the predicted λ̂ was {given:.2f}, and in the last 2 s "
            f"the robot observed λ = {observed:.2f} (medians)."
        )
    elif not np.isnan(observed):
        yield f"In their last 2 s the robot observed λ = {observed:.2f} (median)."


def _shares(rows: pd.DataFrame) -> str:
    """Counts of how conditions failed with their shares of all failures, the most frequent first."""
    counts = rows[list(FAILURE_COUNTS)].sum().rename(FAILURE_COUNTS)
    words = []
    for name, count in counts[counts > 0].sort_values(ascending=False, kind="stable").items():
        share = 100 * count / counts.sum()
        words.append(f"{count} {name} ({f'{share:.0f}' if share >= 0.5 else '< 1'} %)")
    return ", ".join(words)
