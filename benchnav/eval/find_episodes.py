"""Which episodes of a run are meant, by what tables call their conditions."""

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
from benchnav.eval.recording import GROUND, Ground


def find_episodes(
    folder: Path,
    labels: Mapping[str, Sequence[str]],
    seed: int | None,
    realisation: int,
    map_index: int,
) -> list[tuple[Unit, int]]:
    """Finds an episode of each condition that is asked for, all of them on one map.

    Args:
        folder: a run.
        labels: what tables call the conditions, by column; several of a column ask for
            several conditions, and of the columns that are left out the first condition
            that fits is taken.
        seed: root seed; the first condition's first when None.
        realisation: draw of λ.
        map_index: map of the split.

    Returns:
        Units, and which of their episodes.

    Raises:
        ConfigError: the run has no such episode, or they are not on one map.
    """
    run = open_run(folder)
    conditions = [condition for condition, _ in run.conditions.values()]
    known = {}
    for name in LABELS:
        labelled = dict.fromkeys(condition.labels[name] for condition in conditions)
        stood_for = dict.fromkeys(
            label for one in conditions for label in one.stands_for.get(name, ())
        )
        known[name] = [label for label in labelled | stood_for if label != NOT_USED]
    found: dict[str, tuple[Unit, int]] = {}
    for values in itertools.product(*labels.values()):
        asked = dict(zip(labels, values, strict=True))
        unit = _find(run, asked, (seed, realisation, map_index))
        # A blind planner has no risk setting and fits any, but not one that no planner
        # of the run has.
        strange = [
            name
            for name, label in asked.items()
            if known[name] and label not in known[name]
        ]
        if unit is None or strange:
            words = [f"{name} {label!r}" for name, label in asked.items()]
            words += [f"realisation {realisation}", f"map {map_index}"]
            words += [] if seed is None else [f"seed {seed}"]
            near = "".join(hint(asked[name], known[name]) for name in strange[:1])
            held = [
                f"{name} {', '.join(labels)}"
                for name, labels in known.items()
                if labels
            ]
            held.append(
                f"map 0 to {max(extent.maps for _, extent in run.conditions.values()) - 1}"
            )
            raise ConfigError(
                f"Expected an episode of the run, got {', '.join(words)}. It has "
                f"{'; '.join(held)}.{near}"
            )
        seed = unit.seed
        found.setdefault(unit.condition.id, (unit, unit.maps.index(map_index)))
    episodes = list(found.values())
    maps = dict.fromkeys(
        f"{unit.condition.data} {unit.condition.scenario}" for unit, _ in episodes
    )
    if len(maps) > 1:
        raise ConfigError(
            f"Expected conditions on one map to show together, got {', '.join(maps)}."
        )
    return episodes


def propose(folder: Path) -> tuple[dict[str, list[str]], dict[str, int]]:
    """Proposes what to play back: conditions with unlike outcomes on the map on which
    outcomes differ most.

    Args:
        folder: a finished run.

    Returns:
        Labels by column, of one condition or of two that differ in their risk setting
        alone, those of the first hypothesis that has such; and `map`, `seed` and
        `realisation`.
    """
    run = open_run(folder)
    every = [condition.labels for condition, _ in run.conditions.values()]
    # What looks at a prediction has more to show.
    first = next((labels for labels in every if labels["risk"] != NOT_USED), every[0])
    if not (folder / GROUND).exists():
        return {name: [label] for name, label in first.items()}, {"map": 0}
    about = Ground.load(folder / GROUND).about
    rows = read_table(folder, EPISODES)
    rows = rows[(rows[list(about)] == pd.Series(about)).all(axis=1)]
    # Those of the first hypothesis come first.
    tests = run.about.get("hypotheses", {}).get("tests", ())
    asked = [condition for test in tests for condition in (test["one"], test["other"])]
    turn = {
        condition: place
        for place, condition in enumerate(dict.fromkeys([*asked, *rows["condition"]]))
    }
    labels = [
        (run.conditions[row["condition"]][0].labels, bool(row["success"]))
        for row in sorted(
            rows.to_dict("records"), key=lambda row: turn[row["condition"]]
        )
        if row["risk"] != NOT_USED
    ]
    place = {name: int(about[name]) for name in ("map", "seed", "realisation")}
    for (one, arrived), (other, also) in itertools.combinations(labels, 2):
        if arrived != also and all(
            one[name] == other[name] for name in LABELS if name != "risk"
        ):
            return {
                name: list(dict.fromkeys((one[name], other[name]))) for name in LABELS
            }, place
    shown = (
        labels[0][0] if labels else run.conditions[rows["condition"].iloc[0]][0].labels
    )
    return {name: [label] for name, label in shown.items()}, place


def _find(
    run: Run, asked: Mapping[str, str], episode: tuple[int | None, int, int]
) -> Unit | None:
    """The unit of the first condition that fits, of a run that is not finished of the
    first that has rows.

    One that does not use a part fits any label where no other does.

    Args:
        run: where.
        asked: labels.
        episode: seed, realisation and map.
    """
    seed, realisation, map_index = episode
    is_finished = (run.folder / EPISODES).exists()
    first = None
    for others in (set(), {NOT_USED}):
        for condition, extent in run.conditions.values():
            own = {
                condition.labels[name]
                for name, label in asked.items()
                if condition.labels[name] != label
            }
            wanted = extent.seeds[0] if seed is None else seed
            for unit in (
                units({condition.id: (condition, extent)}) if own <= others else ()
            ):
                if (unit.seed, unit.realisation) == (
                    wanted,
                    realisation,
                ) and map_index in unit.maps:
                    if is_finished or find_units(run.folder, unit):
                        return unit
                    first = first or unit
        if first:
            return first
    return None
