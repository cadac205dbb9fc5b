"""Settings and provenance of a run in words, for its report."""

import json
from collections.abc import Mapping
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
    """Describe worlds, data, seeds, rejected draws and bounds of a run, a line each.

    Args:
        summary: from `summary.summarise`.
        episodes: rows of the run.
        manifest: contents of `run.json`.
        worlds: world of each condition, by id.
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
    seeds = dict.fromkeys(
        seed for condition in conditions for seed in condition["seeds"]
    )
    data = joined(summary["data"].unique()) or NOT_USED
    models = joined(summary["model"].unique()) or NOT_USED
    lines.append(f"Data: {data}. Models: {models}. Seeds: {joined(map(str, seeds))}.")
    if summary["revisions_mean"].notna().any():
        knowledge = (
            f"{kind} {joined(summary[kind].unique()) or NOT_USED}" for kind in KNOWLEDGE
        )
        lines.append(f"Sensing and belief: {'; '.join(knowledge)}.")
    if len(summary[["n_episodes", "n_maps", "n_groups"]].drop_duplicates()) == 1:
        maps = maps_in_words(summary["n_maps"][0], summary["n_groups"][0])
        lines.append(f"Each condition: {summary['n_episodes'][0]} episodes on {maps}.")
    options = dict.fromkeys(
        f"{condition['labels']['planner']} {change}"
        for condition in conditions
        for change in condition["changed"]
    )
    return [*lines, f"Planner options: {', '.join(options)}."] if options else lines


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
    # All conditions have the same draws, except where a model failed: none.
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
    """Return the bounds of the best possible T_total, from planners that are given λ."""
    lines = []
    for name, rows in episodes.groupby("condition", sort=False):
        rows = rows.assign(time_budget_s=time_budgets(rows, worlds[str(name)]))
        best = best_possible(rows)
        if np.isnan(best["time_bound"]):
            continue
        reached = rows["success"].mean()
        time_s = rows["total_time_s"].mean()
        labels = conditions[str(name)]["labels"]
        lines.append(
            f"The best possible result ({labels['scenario']}, "
            f"{labels['world']}) lies between a lower bound "
            f"and that of {planner_name(labels['planner'])}: T_total "
            f"{best['time_bound']:.1f} to {time_s:.1f} s, "
            f"success {100 * reached:.1f} to {100 * best['success_bound']:.1f} %."
        )
    return lines


def _world(value: Mapping[str, Any]) -> str:
    world = value["world"]
    free = value["rules"]["free_space"]
    words = [f"λ {world['noise']}"]
    if "correlation_m" in world:
        words[0] += f", correlated over {world['correlation_m']:g} m"
        words[0] += " (Matérn-3/2)" if world.get("kernel") == "matern32" else ""
    if "immobile" in world:
        immobile = world["immobile"]
        words.append(
            f"λ below {immobile['below']:g} for {immobile['for_s']:g} s immobilises the robot"
        )
    if "time_budget_ratio" in world:
        words.append(
            f"time budget T = {world['time_budget_ratio']:g} × the reference time at "
            "the top speed"
        )
    else:
        words.append(f"time budget T = {world['time_budget_s']:g} s")
    by = "mean λ" if free["by"] == "mean" else "λ̂"
    return "; ".join([*words, f"free terrain has {by} above {free['above']:g}"])


def provenance_lines(manifest: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the provenance of a run as (name, value).

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
        maps = ", ".join(
            f"{split} {len(digests)}" for split, digests in dataset["maps"].items()
        )
        lines.append((f"dataset {data}", f"{dataset['id']}; maps: {maps}"))
    lines += dict.fromkeys(part for code in codes for part in code["parts"].items())
    metrics = [entry for code in codes for entry in code.get(METRICS, {}).items()]
    lines += dict.fromkeys(
        (f"metric {column}", own["digest"]) for column, own in metrics
    )
    seeds = dict.fromkeys(
        seed
        for condition in manifest["conditions"].values()
        for seed in condition["seeds"]
    )
    lines.append(("seeds", ", ".join(map(str, seeds))))
    return [(name, value) for name, value in lines if value]
