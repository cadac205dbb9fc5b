"""What a run says, in sentences made from its numbers; whether one setting beats another is for the tests to say."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from benchnav.eval.report.words import (
    blocks,
    condition_name,
    outcome_in_words,
    p_in_words,
    rate_in_words,
    several_models,
)
from benchnav.eval.stats.best import PRIVILEGED, competing
from benchnav.eval.stats.comparison import ALPHA
from benchnav.planning.world.outcome import FAILURES

_MOST_NAMED = 6


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What the run says of one block.

    Args:
        title: names the block.
        sentences: in order.
    """

    title: str
    sentences: tuple[str, ...]


def findings(
    summary: pd.DataFrame, failures: pd.DataFrame, predicted: Mapping[str, np.ndarray] | None = None
) -> list[Finding]:
    """Says of each block which setting is best, by how much, how sure that is, and how the failures failed.

    Args:
        summary: from `summary.summarise`, joined with `best.against_best`.
        failures: from `failures.failures_table`.
        predicted: by condition the λ̂ where its failed episodes ended, where that is known.
    """
    several = several_models(summary)
    names = {row["condition"]: condition_name(row, several) for row in summary.to_dict("records")}
    return [
        Finding(title=title, sentences=tuple(_sentences(block, names, failures, predicted or {})))
        for title, block in blocks(summary)
    ]


def _sentences(
    rows: pd.DataFrame, names: Mapping[str, str], failures: pd.DataFrame, predicted: Mapping[str, np.ndarray]
) -> Iterable[str]:
    rivals = rows[competing(rows)]
    best = rivals[rivals["condition"] == rivals["best"].iloc[0]].to_dict("records")[0]
    others = rivals[rivals["condition"] != best["condition"]].sort_values("best_difference", kind="stable")
    shared = int((others["success_rate"] == best["success_rate"]).sum())
    also = f" and {shared} more" if shared else ""
    yield (
        f"The highest success rate is that of {names[best['condition']]}{also}: {_rate(best)} of its episodes "
        f"reached the goal (95 % interval {100 * best['success_low']:.0f} to {100 * best['success_high']:.0f} %)."
    )
    common = int(best["best_episodes"])
    if not others.empty and (rivals["n_episodes"] > common).any():
        yield f"The settings are compared on the {common} episodes that all of them have."
    yield from _rank(best, others, names)
    yield from _why(best, names, failures, predicted)
    count = int(rivals["n_episodes"].sum())
    failed = count - round(float((rivals["success_rate"] * rivals["n_episodes"]).sum()))
    if failed and len(rivals) > 1:
        outcomes = rivals[[f"{outcome.name.lower()}_count" for outcome in FAILURES]].sum()
        yield (
            f"All {len(rivals)} compared settings together failed in {failed} of {count} episodes: {_shares(outcomes)}."
        )
    privileged = rows[~rows["condition"].isin(rivals["condition"])]
    for part in [part for part in reversed(PRIVILEGED) if (privileged["privileged"] == part).any()]:
        most = (
            privileged[privileged["privileged"] == part].sort_values("success_rate", kind="stable").iloc[-1]
        )
        yield (f"With the privileged model {most['model']} {names[most['condition']]} reached {_rate(most)}.")


def _rank(best: Mapping[Any, Any], others: pd.DataFrame, names: Mapping[str, str]) -> Iterable[str]:
    if others.empty:
        yield "There is no other setting to compare it with."
        return
    alike, worse = others[others["best_alike"]], others[~others["best_alike"]]
    settings = f"{len(others) + 1} settings"
    unit = "group" if best["n_groups"] < best["n_maps"] else "map"
    test = f"max-T sign-flip test by {unit} over {settings}"
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
        listed = [names[condition] for condition in alike["condition"]]
        more = f" and {len(listed) - _MOST_NAMED} more" if len(listed) > _MOST_NAMED else ""
        verb = "1 other setting is" if len(listed) == 1 else f"{len(listed)} other settings are"
        yield f"{verb} not significantly worse (p ≥ {ALPHA}): {'; '.join(listed[:_MOST_NAMED])}{more}."
    following = worse.iloc[0]
    place = "The next" if alike.empty else "The next that is significantly worse"
    low, high = 100 * following["best_low"], 100 * following["best_high"]
    yield (
        f"{place} is {names[following['condition']]} with {_rate(following)}: the difference is "
        f"{100 * following['best_difference']:.1f} points (95 % interval of the pair alone {low:.1f} to "
        f"{high:.1f}), {p_in_words(following['best_p'])} ({test})."
    )


def _why(
    best: Mapping[Any, Any],
    names: Mapping[str, str],
    failures: pd.DataFrame,
    predicted: Mapping[str, np.ndarray],
) -> Iterable[str]:
    """How the best setting's failures failed, and on what ground."""
    outcomes = pd.Series({f"{o.name.lower()}_count": best[f"{o.name.lower()}_count"] for o in FAILURES})
    if not outcomes.sum():
        yield "It never failed."
        return
    yield f"It failed in {int(outcomes.sum())} of {best['n_episodes']} episodes: {_shares(outcomes)}."
    met = failures.loc[failures["condition"] == best["condition"], "last_traversability"].median()
    known = predicted.get(best["condition"], np.empty(0))
    known = known[~np.isnan(known)]  # an end outside the map has none
    if np.isnan(met):
        return
    if len(known):
        yield (
            f"At the place where they ended, the predicted λ̂ was {np.median(known):.2f}, and in the last 2 s "
            f"the robot observed λ = {met:.2f} (medians)."
        )
    else:
        yield f"In their last 2 s the robot observed λ = {met:.2f} (median)."


def _rate(row: Mapping[Any, Any]) -> str:
    # Never 100 % of what failed once, nor 0 % of what once arrived.
    return f"{rate_in_words(row)} %"


def _shares(outcomes: pd.Series) -> str:
    """Counts of outcomes with their shares of all failures, the most frequent first."""
    counted = outcomes[outcomes > 0].sort_values(ascending=False, kind="stable")
    total = counted.sum()
    words = []
    for name, count in counted.items():
        share = f"{100 * count / total:.0f}" if count / total >= 0.005 else "< 1"
        words.append(f"{count} {outcome_in_words(str(name).removesuffix('_count'))} ({share} %)")
    return ", ".join(words)
