"""Selection of episodes of a run by the labels of their conditions."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from benchnav.core.errors import ConfigError
from benchnav.core.settings import hint
from benchnav.eval.experiment.condition import LABELS, NOT_USED
from benchnav.eval.experiment.unit import Unit, units
from benchnav.eval.folder.run_folder import (
    EPISODES,
    Run,
    find_units,
    open_run,
    read_table,
)
from benchnav.eval.recording import GROUND, RecordedMap


def find_episodes(
    folder: Path,
    labels: Mapping[str, Sequence[str]],
    seed: int | None,
    realisation: int,
    map_index: int,
) -> list[tuple[Unit, int]]:
    """Find an episode of each requested condition, all on one map.

    Args:
        folder: a run folder.
        labels: labels of conditions by column; several labels of a column select
            several conditions. For a column without labels, the first matching label
            is taken.
        seed: root seed; if None, the first seed of the first condition.
        realisation: index of the draw of λ.
        map_index: index of the map in its split.

    Returns:
        Units, each with the index of the episode within the unit.

    Raises:
        ConfigError: If the run has no such episode, or the episodes are not all on the
            same map.
    """
    run = open_run(folder)
    labels_of_run = _labels_of(run)
    chosen: dict[str, tuple[Unit, int]] = {}
    for values in itertools.product(*labels.values()):
        requested = dict(zip(labels, values, strict=True))
        unit = _find(run, requested, (seed, realisation, map_index))
        # A condition that does not use a setting matches every label of the setting,
        # but the requested label must occur in the run.
        unknown = []
        for name, label in requested.items():
            if labels_of_run[name] and label not in labels_of_run[name]:
                unknown.append(name)
        if unit is None or unknown:
            words = [f"{name} {label!r}" for name, label in requested.items()]
            words += [f"realisation {realisation}", f"map {map_index}"]
            if seed is not None:
                words.append(f"seed {seed}")
            similar = ""
            if unknown:
                name = unknown[0]
                similar = hint(requested[name], labels_of_run[name])
            raise ConfigError(
                f"Expected an episode of the run, got {', '.join(words)}, which the "
                f"run does not have. The run has "
                f"{'; '.join(_available(run, labels_of_run))}.{similar}"
            )
        seed = unit.seed
        episode_index = unit.maps.index(map_index)
        chosen.setdefault(unit.condition.id, (unit, episode_index))
    episodes = list(chosen.values())
    maps: dict[str, None] = {}
    for unit, _ in episodes:
        maps[f"{unit.condition.data} {unit.condition.scenario}"] = None
    if len(maps) > 1:
        raise ConfigError(
            f"Expected conditions on the same map, got {', '.join(maps)}. Only "
            "episodes on the same map can be shown together. Select one dataset and "
            "one scenario."
        )
    return episodes


def _labels_of(run: Run) -> dict[str, list[str]]:
    """Return the labels of a run's conditions by column, without `NOT_USED`."""
    conditions = [condition for condition, _ in run.conditions.values()]
    labels_of_run = {}
    for name in LABELS:
        labels = [condition.labels[name] for condition in conditions]
        for condition in conditions:
            labels += condition.stands_for.get(name, ())
        used = [label for label in labels if label != NOT_USED]
        labels_of_run[name] = list(dict.fromkeys(used))
    return labels_of_run


def _available(run: Run, labels_of_run: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the labels and maps of a run in words."""
    words = []
    for name, labels in labels_of_run.items():
        if labels:
            words.append(f"{name} {', '.join(labels)}")
    n_maps = max(extent.maps for _, extent in run.conditions.values())
    return [*words, f"map 0 to {n_maps - 1}"]


def propose(folder: Path) -> tuple[dict[str, list[str]], dict[str, int]]:
    """Propose labels of conditions for a replay, on the map where outcomes differ most.

    Args:
        folder: a finished run.

    Returns:
        Labels by column, and indices: `map`, and for a run with a recorded map also
        `seed` and `realisation`. The labels are those of two conditions that differ
        only in their risk setting and have different outcomes; conditions that the
        run's hypotheses compare take precedence. Without such a pair, the labels are
        those of one condition.
    """
    run = open_run(folder)
    if not (folder / GROUND).exists():
        all_labels = [condition.labels for condition, _ in run.conditions.values()]
        # A replay of a planner that uses a prediction shows more.
        predicting = [labels for labels in all_labels if labels["risk"] != NOT_USED]
        first, *_ = [*predicting, *all_labels]
        return _as_lists(first), {"map": 0}
    map_keys = RecordedMap.load(folder / GROUND).about
    indices = {name: int(map_keys[name]) for name in ("map", "seed", "realisation")}
    rows = read_table(folder, EPISODES)
    is_on_map = (rows[list(map_keys)] == pd.Series(map_keys)).all(axis=1)
    rows = rows[is_on_map]
    first_id = rows["condition"].iloc[0]
    # Conditions that hypotheses compare come first.
    tests = run.manifest.get("hypotheses", {}).get("tests", ())
    tested = [condition for test in tests for condition in (test["one"], test["other"])]
    ordered = list(dict.fromkeys([*tested, *rows["condition"]]))
    rows = rows.sort_values(
        "condition", key=lambda ids: ids.map(ordered.index), kind="stable"
    )
    candidates = []
    for row in rows[rows["risk"] != NOT_USED].to_dict("records"):
        condition, _ = run.conditions[row["condition"]]
        candidates.append((condition.labels, bool(row["success"])))
    columns = [name for name in LABELS if name != "risk"]
    for (a, a_succeeded), (b, b_succeeded) in itertools.combinations(candidates, 2):
        is_same_setting = all(a[name] == b[name] for name in columns)
        if a_succeeded != b_succeeded and is_same_setting:
            pair = {name: list(dict.fromkeys((a[name], b[name]))) for name in LABELS}
            return pair, indices
    if candidates:
        labels, _ = candidates[0]
        return _as_lists(labels), indices
    condition, _ = run.conditions[first_id]
    return _as_lists(condition.labels), indices


def _as_lists(labels: Mapping[str, str]) -> dict[str, list[str]]:
    return {name: [label] for name, label in labels.items()}


def _find(
    run: Run, requested: Mapping[str, str], episode: tuple[int | None, int, int]
) -> Unit | None:
    """Return the unit of the first matching condition; prefer a finished unit.

    A condition that does not use a part matches any label of that part, unless another
    condition has the label.

    Args:
        run: opened run folder.
        requested: labels by column.
        episode: seed, realisation and map index; if the seed is None, the first seed of
            each condition.
    """
    seed, realisation, map_index = episode
    is_finished = (run.folder / EPISODES).exists()
    first = None
    for ignored in (set(), {NOT_USED}):
        for condition, extent in run.conditions.values():
            differing = set()
            for name, label in requested.items():
                if condition.labels[name] != label:
                    differing.add(condition.labels[name])
            if not differing <= ignored:
                continue
            unit_seed = extent.seeds[0] if seed is None else seed
            draw = (unit_seed, realisation)
            for unit in units({condition.id: (condition, extent)}):
                if (unit.seed, unit.realisation) != draw:
                    continue
                if map_index not in unit.maps:
                    continue
                if is_finished or find_units(run.folder, unit):
                    return unit
                first = first or unit
        if first:
            return first
    return None
