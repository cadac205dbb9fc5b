"""Settings and provenance of a run in words, for its report."""

import json
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from benchnav.eval.experiment.condition import KNOWLEDGE
from benchnav.eval.folder.provenance import METRICS
from benchnav.eval.recording import MAP
from benchnav.eval.stats.regret import best_possible
from benchnav.eval.stats.summary import time_budgets
from benchnav.eval.words import NOT_USED, joined, maps_in_words
from benchnav.viz.style import planner_name


def header_lines(
    summary: pd.DataFrame,
    episodes: pd.DataFrame,
    manifest: Mapping[str, Any],
    worlds: Mapping[str, Mapping[str, Any]],
) -> tuple[str, ...]:
    """Return lines on a run: worlds, data, models, seeds, rejected draws and bounds.

    Args:
        summary: table from `summary.summarise`.
        episodes: rows of the run.
        manifest: contents of `run.json`.
        worlds: world of each condition by id, as in `run.json`.
    """
    conditions = manifest["conditions"]
    return (
        *_header(summary, manifest),
        *_rejected_draws(episodes, conditions),
        *_bracket(episodes, conditions, worlds),
    )


def _header(summary: pd.DataFrame, manifest: Mapping[str, Any]) -> list[str]:
    conditions = [
        manifest["conditions"][condition] for condition in summary["condition"]
    ]
    worlds = {
        condition["labels"]["world"]: _world(condition["value"])
        for condition in conditions
    }
    lines = [f"World {label}: {text}." for label, text in worlds.items()]
    data = _distinct(summary["data"])
    models = _distinct(summary["model"])
    seeds = joined(map(str, _seeds(conditions)))
    lines.append(f"Data: {data}. Models: {models}. Seeds: {seeds}.")
    if summary["revisions_mean"].notna().any():
        knowledge = [f"{kind} {_distinct(summary[kind])}" for kind in KNOWLEDGE]
        lines.append(f"Sensing and belief: {'; '.join(knowledge)}.")
    counts = summary[["n_episodes", "n_maps", "n_groups"]].drop_duplicates()
    if len(counts) == 1:
        n_episodes, n_maps, n_groups = counts.iloc[0]
        maps = maps_in_words(n_maps, n_groups)
        lines.append(f"Each condition: {n_episodes} episodes on {maps}.")
    options: dict[str, None] = {}
    for condition in conditions:
        planner = condition["labels"]["planner"]
        options |= dict.fromkeys(f"{planner} {text}" for text in condition["changed"])
    if options:
        lines.append(f"Planner options: {', '.join(options)}.")
    return lines


def _distinct(labels: pd.Series) -> str:
    return joined(labels.unique()) or NOT_USED


def _seeds(conditions: Iterable[Mapping[str, Any]]) -> list[int]:
    """Return the distinct seeds of conditions, in order."""
    seeds = [seed for condition in conditions for seed in condition["seeds"]]
    return list(dict.fromkeys(seeds))


def _rejected_draws(episodes: pd.DataFrame, conditions: Mapping[str, Any]) -> list[str]:
    """Return a line on the fraction of rejected draws of frozen λ."""
    frozen = [
        name
        for name, entry in conditions.items()
        if entry["value"]["world"]["noise"] == "frozen"
    ]
    episodes = episodes[episodes["condition"].isin(frozen)]
    if not episodes["rejected_draws"].any():
        return []
    # All conditions have the same draws, except that a failed model has no draw.
    rejected = episodes.groupby(MAP)["rejected_draws"].max()
    fraction = rejected.sum() / (rejected + 1).sum()
    return [
        f"{100 * fraction:.1f} % of the draws of λ had no feasible path from start to "
        "goal and were rejected."
    ]


def _bracket(
    episodes: pd.DataFrame,
    conditions: Mapping[str, Any],
    worlds: Mapping[str, Mapping[str, Any]],
) -> list[str]:
    """Return lines with bounds of the best possible results, one per reference."""
    lines = []
    for name, rows in episodes.groupby("condition", sort=False):
        budgets = time_budgets(rows, worlds[str(name)])
        best = best_possible(rows.assign(time_budget_s=budgets))
        if np.isnan(best["time_bound"]):
            continue
        success = 100 * rows["success"].mean()
        success_bound = 100 * best["success_bound"]
        time_s = rows["total_time_s"].mean()
        labels = conditions[str(name)]["labels"]
        block = f"{labels['scenario']}, {labels['world']}"
        planner = planner_name(labels["planner"])
        lines.append(
            f"The best possible result ({block}) lies between the result of {planner} "
            f"and a bound: T_total {best['time_bound']:.1f} to {time_s:.1f} s, "
            f"success {success:.1f} to {success_bound:.1f} %."
        )
    return lines


def _world(value: Mapping[str, Any]) -> str:
    world = value["world"]
    free = value["rules"]["free_space"]
    noise = f"λ {world['noise']}"
    if "correlation_m" in world:
        noise += f", correlated over {world['correlation_m']:g} m"
        if world.get("kernel") == "matern32":
            noise += " (Matérn-3/2)"
    words = [noise]
    if "immobile" in world:
        limit = world["immobile"]["below"]
        dwell_s = world["immobile"]["for_s"]
        words.append(f"λ below {limit:g} for {dwell_s:g} s immobilises the robot")
    if "time_budget_ratio" in world:
        ratio = world["time_budget_ratio"]
        budget = f"{ratio:g} × the reference time at the top speed"
    else:
        budget = f"{world['time_budget_s']:g} s"
    words.append(f"time budget T = {budget}")
    by = "mean λ" if free["by"] == "mean" else "λ̂"
    return "; ".join([*words, f"free terrain has {by} above {free['above']:g}"])


def provenance_lines(manifest: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the provenance of a run as pairs (name, value).

    Args:
        manifest: contents of `run.json`.
    """
    machine = manifest["machine"]
    codes = manifest["codes"].values()
    last = manifest["history"][-1]
    lines = [
        ("commit of benchnav", last["commit"]),
        ("version of benchnav", last["benchnav"]),
    ]
    environments = {
        json.dumps(code["environment"]): code["environment"] for code in codes
    }
    for environment in environments.values():
        lines += [(name, str(value)) for name, value in environment.items()]
    lines.append(("machine", f"{machine['processor']}, {machine['cores']} cores"))
    for data, dataset in manifest["datasets"].items():
        counts = [f"{split} {len(maps)}" for split, maps in dataset["maps"].items()]
        text = f"{dataset['id']}; maps: {', '.join(counts)}"
        lines.append((f"dataset {data}", text))
    lines += dict.fromkeys(part for code in codes for part in code["parts"].items())
    metrics = [entry for code in codes for entry in code.get(METRICS, {}).items()]
    digests = [(f"metric {column}", entry["digest"]) for column, entry in metrics]
    lines += dict.fromkeys(digests)
    seeds = _seeds(manifest["conditions"].values())
    lines.append(("seeds", ", ".join(map(str, seeds))))
    return [(name, value) for name, value in lines if value]
