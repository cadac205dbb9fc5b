"""Findings of a run in sentences, based on statistical tests."""

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

_MAX_NAMED = 6


def findings(
    summary: pd.DataFrame, failures: pd.DataFrame, predicted: Mapping[str, np.ndarray]
) -> dict[str, list[str]]:
    """Describe the best setting of each block, its margin, significance and failures.

    Args:
        summary: table from `summary.summarise`, joined with `best.against_best`.
        failures: table from `failures.failures_table`.
        predicted: λ̂ at the end of failed episodes, by condition, each of shape [number
            of failures].

    Returns:
        Sentences by title of the block.
    """
    by_title = {}
    for title, block in blocks(with_names(summary)):
        pairing = _pairing_by_label(block, summary)
        by_title[title] = list(_sentences(block, failures, predicted, pairing))
    return by_title


def _pairing_by_label(rows: pd.DataFrame, summary: pd.DataFrame) -> dict[str, bool]:
    """Return the columns in which other blocks on the same maps differ from a block.

    Args:
        rows: summary of the block.
        summary: summary of the run.

    Returns:
        For each column, whether `compare` can pair settings by it.
    """
    first = rows.iloc[0]
    setting_columns = [name for name in LABELS if name not in BLOCK]
    same_maps = summary[
        (summary["data"] == first["data"]) & (summary["scenario"] == first["scenario"])
    ]
    settings = set(rows[setting_columns].itertuples(index=False, name=None))
    is_paired_by = {}
    for name in ("robot", "objective", "world"):
        fixed = [label for label in BLOCK if label != name]
        other_rows = same_maps[
            (same_maps[fixed] == first[fixed]).all(axis=1)
            & (same_maps[name] != first[name])
        ]
        if not other_rows.empty:
            other_labels = other_rows[setting_columns]
            other_settings = other_labels.itertuples(index=False, name=None)
            has_common_setting = not settings.isdisjoint(other_settings)
            # Settings of different worlds are not paired, since λ may differ.
            is_paired_by[name] = name != "world" and has_common_setting
    return is_paired_by


def _sentences(
    rows: pd.DataFrame,
    failures: pd.DataFrame,
    predicted: Mapping[str, np.ndarray],
    pairing: Mapping[str, bool],
) -> Iterable[str]:
    rivals = rows[competing(rows)]
    best = rivals[rivals["condition"] == rivals["best"].iloc[0]].to_dict("records")[0]
    rivals_of_best = rivals[rivals["condition"] != best["condition"]].sort_values(
        "best_difference", kind="stable"
    )
    shared = int((rivals_of_best["success_rate"] == best["success_rate"]).sum())
    subject = f"{best['name']} has"
    if shared:
        subject = f"{best['name']} and {shared} more have"
    low = 100 * best["success_low"]
    high = 100 * best["success_high"]
    yield (
        f"{subject} the highest success rate: {rate_in_words(best)} % of the episodes "
        f"reached the goal (95 % interval {low:.0f} to {high:.0f} %)."
    )
    common = int(best["best_episodes"])
    if not rivals_of_best.empty and (rivals["n_episodes"] > common).any():
        yield f"The comparison uses the {common} episodes that all settings have."
    yield from _rank(best, rivals_of_best, pairing)
    yield from _failure_sentences(best, failures, predicted)
    count = int(rivals["n_episodes"].sum())
    failed = rivals[list(FAILURE_COUNTS)].to_numpy().sum()
    if failed and len(rivals) > 1:
        all_settings = "Both" if len(rivals) == 2 else f"All {len(rivals)}"
        yield (
            f"{all_settings} compared settings together failed in {failed} of {count} "
            f"episodes: {_failure_percentages(rivals)}."
        )
    references = rows[~competing(rows)].sort_values("success_rate", kind="stable")
    for part in reversed(PRIVILEGED):
        strongest = references[references["privileged"] == part].tail(1)
        for reference in strongest.to_dict("records"):
            yield (
                f"For reference, {reference['name']} reached "
                f"{rate_in_words(reference)} % with the privileged model "
                f"{reference['model']}."
            )


def _rank(
    best: Mapping[Any, Any], other_rows: pd.DataFrame, pairing: Mapping[str, bool]
) -> Iterable[str]:
    if other_rows.empty:
        with_this = f" with this {' and '.join(pairing)}" if pairing else ""
        yield f"There is no other setting{with_this} to compare it with."
        for name, is_paired in pairing.items():
            if is_paired:
                yield (
                    f"benchnav-eval compare --by {name} compares the {name}s of the "
                    "run."
                )
        return
    alike = other_rows[other_rows["best_alike"]]
    worse = other_rows[~other_rows["best_alike"]]
    unit = "group" if best["n_groups"] < best["n_maps"] else "map"
    test = f"max-T bootstrap test by {unit} over {len(other_rows) + 1} settings"
    if best["best_maps"] < FEWEST_MAPS:
        yield (
            f"No setting is marked: with fewer than {FEWEST_MAPS} {unit}s, no setting "
            "can be called worse."
        )
        return
    if worse.empty:
        shown = other_rows["best_shown"].max()
        p = other_rows["best_p"].min()
        maps = f"{int(best['best_maps'])} {unit}s"
        power = ""
        if shown <= 1:
            power = (
                f"; {maps} detect differences of {100 * shown:.0f} points or more "
                "with 80 % power"
            )
        relation = "=" if p >= 1 else "≥"
        rounded_p = max(np.floor(100 * p) / 100, ALPHA)
        yield (
            f"There is no significant difference between the settings ({test}, p "
            f"{relation} {rounded_p:g}{power})."
        )
        return
    if alike.empty:
        subject = f"All {len(worse)} other settings are"
        if len(worse) == 1:
            subject = "The other setting is"
        elif len(worse) == 2:
            subject = "Both other settings are"
        yield f"{subject} significantly worse."
    else:
        listed = list(alike["name"])
        remainder = ""
        if len(listed) > _MAX_NAMED:
            remainder = f" and {len(listed) - _MAX_NAMED} more"
        verb = "1 other setting is"
        if len(listed) != 1:
            verb = f"{len(listed)} other settings are"
        yield (
            f"{verb} not significantly worse (p ≥ {ALPHA}): "
            f"{'; '.join(listed[:_MAX_NAMED])}{remainder}."
        )
    following = worse.iloc[0]
    low = 100 * following["best_low"]
    high = 100 * following["best_high"]
    difference = 100 * following["best_difference"]
    verb = "is the best of those that are significantly worse"
    if len(worse) == 1:
        verb = "is significantly worse"
    yield (
        f"{following['name']} {verb}: {rate_in_words(following)} %, "
        f"{difference:.1f} points less (95 % interval {low:.1f} to {high:.1f}, of this "
        f"pair only), {p_in_words(following['best_p'])} ({test})."
    )


def _failure_sentences(
    best: Mapping[Any, Any], failures: pd.DataFrame, predicted: Mapping[str, np.ndarray]
) -> Iterable[str]:
    """Yield sentences on the failures of the best setting, and on λ at their ends."""
    failed = sum(best[column] for column in FAILURE_COUNTS)
    if not failed:
        yield f"{best['name']} never failed."
        return
    yield (
        f"{best['name']} failed in {failed} of {best['n_episodes']} episodes: "
        f"{_failure_percentages(pd.DataFrame([best]))}."
    )
    observed = failures.loc[
        failures["condition"] == best["condition"], "last_traversability"
    ].median()
    # λ̂ is NaN if an episode ended outside the map.
    predicted_median = pd.Series(predicted.get(best["condition"]), dtype=float).median()
    if not np.isnan(observed) and not np.isnan(predicted_median):
        yield (
            f"Where these episodes ended, λ̂ was {predicted_median:.2f}; in the last "
            f"2 s, the robot observed λ = {observed:.2f} (medians)."
        )
    elif not np.isnan(observed):
        yield (
            "In the last 2 s of these episodes, the robot observed λ = "
            f"{observed:.2f} (median)."
        )


def _failure_percentages(rows: pd.DataFrame) -> str:
    """Return the count and percentage of each outcome of failures, sorted by count."""
    counts = rows[list(FAILURE_COUNTS)].sum().rename(FAILURE_COUNTS)
    ordered = counts[counts > 0].sort_values(ascending=False, kind="stable")
    words = []
    for name, count in ordered.items():
        percentage = 100 * count / counts.sum()
        rounded = f"{percentage:.0f}" if percentage >= 0.5 else "< 1"
        words.append(f"{count} {name} ({rounded} %)")
    return ", ".join(words)
