"""What a run says, in sentences made from its numbers; whether one setting beats
another is for the tests to say.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from benchnav.eval.experiment.condition import LABELS
from benchnav.eval.stats.best import BLOCK, PRIVILEGED, competing
from benchnav.eval.words import (
    FAILURE_COUNTS,
    blocks,
    p_in_words,
    rate_in_words,
    with_names,
)
from benchnav.stats.best import FEWEST_MAPS
from benchnav.stats.holm import ALPHA

_MOST_NAMED = 6


def findings(
    summary: pd.DataFrame, failures: pd.DataFrame, predicted: Mapping[str, np.ndarray]
) -> dict[str, list[str]]:
    """Says of each block which setting is best, by how much, how sure that is, and how
    the failures failed.

    Args:
        summary: from `summary.summarise`, joined with `best.against_best`.
        failures: from `failures.failures_table`.
        predicted: by condition the λ̂ where its failed episodes ended, where that is
            known.

    Returns:
        By the title of a block its sentences.
    """
    every = blocks(with_names(summary))
    apart = [_apart(block, summary) for _, block in every]
    return {
        title: list(_sentences(block, failures, predicted, unlike))
        for (title, block), unlike in zip(every, apart, strict=True)
    }


def _apart(rows: pd.DataFrame, summary: pd.DataFrame) -> dict[str, bool]:
    """By which labels settings on the same maps are in other blocks, and whether
    `compare` pairs them by that label.
    """
    own, kept = rows.iloc[0], [name for name in LABELS if name not in BLOCK]
    same_maps = summary[
        (summary["data"] == own["data"]) & (summary["scenario"] == own["scenario"])
    ]
    settings, found = set(rows[kept].itertuples(index=False, name=None)), {}
    for name in ("robot", "objective", "world"):
        rest = [label for label in BLOCK if label != name]
        others = same_maps[
            (same_maps[rest] == own[rest]).all(axis=1) & (same_maps[name] != own[name])
        ]
        if not others.empty:
            # Worlds may draw unlike λ, and are then not paired.
            paired = name != "world" and bool(
                settings & set(others[kept].itertuples(index=False, name=None))
            )
            found[name] = paired
    return found


def _sentences(
    rows: pd.DataFrame,
    failures: pd.DataFrame,
    predicted: Mapping[str, np.ndarray],
    apart: Mapping[str, bool],
) -> Iterable[str]:
    rivals = rows[competing(rows)]
    best = rivals[rivals["condition"] == rivals["best"].iloc[0]].to_dict("records")[0]
    others = rivals[rivals["condition"] != best["condition"]].sort_values(
        "best_difference", kind="stable"
    )
    shared = int((others["success_rate"] == best["success_rate"]).sum())
    named = (
        f"{best['name']} and {shared} more have" if shared else f"{best['name']} has"
    )
    yield (
        f"{named} the highest success rate: {rate_in_words(best)} % of the episodes "
        "reached the goal (95 % interval "
        f"{100 * best['success_low']:.0f} to {100 * best['success_high']:.0f} %)."
    )
    common = int(best["best_episodes"])
    if not others.empty and (rivals["n_episodes"] > common).any():
        yield f"The comparison uses the {common} episodes that all settings have."
    yield from _rank(best, others, apart)
    yield from _why(best, failures, predicted)
    count = int(rivals["n_episodes"].sum())
    failed = rivals[list(FAILURE_COUNTS)].to_numpy().sum()
    if failed and len(rivals) > 1:
        every = "Both" if len(rivals) == 2 else f"All {len(rivals)}"
        yield (
            f"{every} compared settings together failed in {failed} of {count} "
            f"episodes: {_shares(rivals)}."
        )
    references = rows[~competing(rows)].sort_values("success_rate", kind="stable")
    for part in reversed(PRIVILEGED):
        for most in (
            references[references["privileged"] == part].tail(1).to_dict("records")
        ):
            yield (
                f"For reference, {most['name']} reached {rate_in_words(most)} % with "
                "the privileged model "
                f"{most['model']}."
            )


def _rank(
    best: Mapping[Any, Any], others: pd.DataFrame, apart: Mapping[str, bool]
) -> Iterable[str]:
    if others.empty:
        with_this = f" with this {' and '.join(apart)}" if apart else ""
        yield f"There is no other setting{with_this} to compare it with."
        for name in (name for name, paired in apart.items() if paired):
            yield f"benchnav-eval compare --by {name} compares the {name}s of the run."
        return
    alike, worse = others[others["best_alike"]], others[~others["best_alike"]]
    unit = "group" if best["n_groups"] < best["n_maps"] else "map"
    test = f"max-T bootstrap test by {unit} over {len(others) + 1} settings"
    if best["best_maps"] < FEWEST_MAPS:
        yield (
            f"No setting is marked: with fewer than {FEWEST_MAPS} {unit}s none can "
            "be called worse."
        )
        return
    if worse.empty:
        shown, p = others["best_shown"].max(), others["best_p"].min()
        maps = f"{int(best['best_maps'])} {unit}s"
        power = (
            f"; {maps} detect differences of {100 * shown:.0f} points or more "
            "with 80 % power"
        )
        yield (
            f"There is no significant difference between the settings ({test}, p "
            f"{'=' if p >= 1 else '≥'} "
            f"{max(np.floor(100 * p) / 100, ALPHA):g}{power if shown <= 1 else ''})."
        )
        return
    if alike.empty:
        other = (
            "The other setting is"
            if len(worse) == 1
            else f"All {len(worse)} other settings are"
        )
        yield f"{other} significantly worse."
    else:
        listed = list(alike["name"])
        more = (
            f" and {len(listed) - _MOST_NAMED} more"
            if len(listed) > _MOST_NAMED
            else ""
        )
        verb = (
            "1 other setting is"
            if len(listed) == 1
            else f"{len(listed)} other settings are"
        )
        yield (
            f"{verb} not significantly worse (p ≥ {ALPHA}): "
            f"{'; '.join(listed[:_MOST_NAMED])}{more}."
        )
    following = worse.iloc[0]
    low, high = 100 * following["best_low"], 100 * following["best_high"]
    verb = (
        "is significantly worse"
        if len(worse) == 1
        else "is the best of those that are significantly worse"
    )
    yield (
        f"{following['name']} {verb}: {rate_in_words(following)} %, "
        f"{100 * following['best_difference']:.1f} points "
        f"less (95 % interval of this pair alone {low:.1f} to {high:.1f}), "
        f"{p_in_words(following['best_p'])} ({test})."
    )


def _why(
    best: Mapping[Any, Any], failures: pd.DataFrame, predicted: Mapping[str, np.ndarray]
) -> Iterable[str]:
    """How the best setting's failures failed, and on what ground."""
    failed = sum(best[column] for column in FAILURE_COUNTS)
    if not failed:
        yield f"{best['name']} never failed."
        return
    yield (
        f"{best['name']} failed in {failed} of {best['n_episodes']} episodes: "
        f"{_shares(pd.DataFrame([best]))}."
    )
    observed = failures.loc[
        failures["condition"] == best["condition"], "last_traversability"
    ].median()
    # An end outside the map has no λ̂.
    given = pd.Series(predicted.get(best["condition"]), dtype=float).median()
    if not np.isnan(observed) and not np.isnan(given):
        yield (
            f"Where they ended, the predicted λ̂ was {given:.2f}; the robot observed "
            f"λ = {observed:.2f} in the last 2 s "
            "(medians)."
        )
    elif not np.isnan(observed):
        yield f"The robot observed λ = {observed:.2f} in their last 2 s (median)."


def _shares(rows: pd.DataFrame) -> str:
    """Counts of how conditions failed with their shares of all failures, the most
    frequent first.
    """
    counts = rows[list(FAILURE_COUNTS)].sum().rename(FAILURE_COUNTS)
    words = []
    for name, count in (
        counts[counts > 0].sort_values(ascending=False, kind="stable").items()
    ):
        share = 100 * count / counts.sum()
        words.append(f"{count} {name} ({f'{share:.0f}' if share >= 0.5 else '< 1'} %)")
    return ", ".join(words)
