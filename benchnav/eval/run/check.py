"""Before a run: every condition is built on one map, so that what cannot be run is refused before anything is.

Nothing is predicted and nothing is planned. Combinations of parts that cannot be run are left out; see `combinations`.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.core.quantity import Quantity
from benchnav.core.settings import hint
from benchnav.core.store import text_digest
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.recipe import load_recipe, shipped_recipes
from benchnav.eval.experiment.condition import KNOWLEDGE, PART_KINDS, Condition, conditions_of, is_checkpoint
from benchnav.eval.experiment.hypotheses import fix_hypotheses
from benchnav.eval.experiment.metrics import NamedMetric, quantities, read_metrics
from benchnav.eval.experiment.suite import Suite, check_size
from benchnav.eval.experiment.unit import BLOCK_MAPS, Conditions, Extent
from benchnav.eval.folder import provenance
from benchnav.eval.run.combinations import LeftOut, find_left_out
from benchnav.eval.run.unit import noise_key, read_maps
from benchnav.models.checkpoint import load_checkpoint
from benchnav.models.predictor import class_mismatch, find_checkpoint, find_ground_statistics, load_model
from benchnav.planning.problem import Task
from benchnav.planning.world.realisation import check_known
from benchnav.planning.world.simulation import Simulation

Say = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Checked:
    """What of a suite is to be run.

    Args:
        conditions: by id, with how often each is to be run.
        dropped: combinations that cannot be run: the labels that do not go together, by column, and the `reason`.
        warnings: what readers of the results should know.
        hypotheses: from `fix_hypotheses`.
        metrics: that rows have besides those that every run has.
    """

    conditions: dict[str, tuple[Condition, Extent]]
    dropped: tuple[dict[str, str], ...]
    warnings: tuple[str, ...]
    hypotheses: dict[str, Any]
    metrics: tuple[NamedMetric, ...] = ()


def check_suite(suite: Suite, elsewhere: bool) -> Checked:
    """Makes the conditions of a suite and refuses what cannot be run.

    Args:
        suite: what is evaluated.
        elsewhere: parts are made in other processes.

    Raises:
        ConfigError: a part, scenario or map cannot be had, no combination can be run, or a hypothesis names one that
            cannot.
        DatasetError: there is no such dataset.
    """
    for figure in suite.figures:
        registry.take("figure", figure)
    conditions = conditions_of(suite, scenarios_of)
    if not conditions:
        raise ConfigError(
            f"Expected a suite with at least one condition, got none; data has {scenarios_of(suite.data)}."
        )
    for condition in conditions:
        check_split(condition, suite.maps)
    most_maps = suite.maps or max(_open(one).map_count(one.split) for one in conditions)
    check_size(len(conditions), len(suite.all_seeds), suite.realisations, most_maps, BLOCK_MAPS)
    left_out = find_left_out(conditions)
    kept = [condition for condition in conditions if condition.id not in left_out]
    if not kept:
        raise ConfigError(next(iter(left_out.values())).reason)
    robots = {condition.robot.label: condition.task.robot for condition in kept}
    metrics = read_metrics(suite.metrics, robots.values())
    if elsewhere:
        check_everywhere(kept, metrics)
    extents = {condition.id: _extent(condition, suite) for condition in conditions}
    known = quantities(metric.quantity for metric in metrics)
    hypotheses = _fix_hypotheses(suite, {c.id: (c, extents[c.id]) for c in conditions}, left_out, known)
    warnings = build_each(kept, suite.all_seeds[0], suite.maps)
    for condition in kept:
        warnings += _doubts(condition, _open(condition))
    lone = [part for condition in kept for part in condition.unreproducible]
    lone += [f"metric {metric.quantity.name}" for metric in metrics if metric.is_object]
    warnings += [f"not reproducible: {part} is an object of one process" for part in lone]
    return Checked(
        conditions={condition.id: (condition, extents[condition.id]) for condition in kept},
        dropped=tuple(provenance.join(one.entry for one in left_out.values())),
        warnings=tuple(dict.fromkeys(warnings)),
        hypotheses=hypotheses,
        metrics=metrics,
    )


def _extent(condition: Condition, suite: Suite) -> Extent:
    maps = suite.maps or _open(condition).map_count(condition.split)
    return Extent.product(suite.all_seeds, suite.realisations, maps)


def _fix_hypotheses(
    suite: Suite,
    conditions: Conditions,
    left_out: Mapping[str, LeftOut],
    known: Mapping[str, Quantity],
) -> dict[str, Any]:
    """Fixes the hypotheses of a suite on the conditions that are run.

    Raises:
        ConfigError: If a hypothesis compares a condition that is run with one that is left out, or is invalid.
    """
    kept = {i: entry for i, entry in conditions.items() if i not in left_out}
    try:
        tests = fix_hypotheses(suite.hypotheses, conditions, known).get("tests", ())
    except ConfigError:  # perhaps of a combination that is left out
        tests = ()
    for test in tests:
        lost = [left_out[test[side]] for side in ("one", "other") if test[side] in left_out]
        if len(lost) == 1:
            raise ConfigError(
                f"Expected hypotheses on conditions that can be run, got {test['claim']!r}, which names one that "
                f"cannot: {lost[0].reason}"
            )
    return fix_hypotheses(suite.hypotheses, kept, known)


def _open(condition: Condition) -> TerrainDataset:
    return TerrainDataset(find_dataset(condition.data))


def scenarios_of(data: str) -> list[str]:
    """The scenarios of a dataset's test splits."""
    splits = TerrainDataset(find_dataset(data)).splits
    return [name.removeprefix("test/") for name in splits if name.startswith("test/")]


def check_split(condition: Condition, maps: int) -> None:
    """Refuses a scenario that a dataset lacks, and more maps than it has."""
    dataset, known = _open(condition), scenarios_of(condition.data)
    if condition.scenario not in known:
        raise ConfigError(
            f"Expected `scenarios` among {known} of {dataset.path}, got {condition.scenario!r}."
            f"{hint(condition.scenario, known)}{_make_all(dataset, condition.split, 1)}"
        )
    count = dataset.map_count(condition.split)
    if maps > count:
        raise ConfigError(
            f"Expected `maps` at most {count}, the maps of {condition.split} in {dataset.path}, got {maps}. "
            f"0 takes all.{_make_all(dataset, condition.split, maps)}"
        )


def build_each(conditions: Sequence[Condition], seed: int, maps: int) -> list[str]:
    """Build conditions on the first map of their splits, without a prediction or a plan.

    Args:
        conditions: what is built; what several share is built once.
        seed: root seed of the draw of λ.
        maps: number of maps of each split; 0 for all.

    Returns:
        What readers of the results should know.

    Raises:
        BenchnavError: If a condition cannot be run.
    """
    warnings: list[str] = []
    for condition in _distinct(conditions, "data", "scenario", "world"):
        _check_known_ground(condition, _open(condition), maps)
    for condition in _distinct(conditions, "data", "scenario", "world", "rules", "robot"):
        warnings += _check_world(condition, _open(condition), seed, maps)
    for condition in _distinct(conditions, "data", "scenario", "model", *KNOWLEDGE):
        if condition.needs_statistics:
            find_ground_statistics(condition.model, _open(condition))
    for condition in _distinct([one for one in conditions if not one.blind], "data", "model"):
        warnings += _check_model(condition, _open(condition))
    return warnings


def _distinct(conditions: Sequence[Condition], *names: str) -> list[Condition]:
    """Return the first condition of each combination of values of some fields."""
    first: dict[str, Condition] = {}
    for condition in conditions:
        value = {**condition.value, "data": condition.data, "scenario": condition.scenario}
        first.setdefault(text_digest({name: value.get(name) for name in names}), condition)
    return list(first.values())


def _check_world(condition: Condition, dataset: TerrainDataset, seed: int, maps: int) -> list[str]:
    """Build the simulation on one map, and warn of goals that top speed does not reach within T."""
    block = read_maps(dataset, condition.split, [0])
    noise = noise_key(seed, condition.split, 0)
    Simulation(block.terrain, condition.task, condition.world, block.places, noise, [0])
    return _late(condition, condition.task, dataset, maps)


def _make_all(dataset: TerrainDataset, split: str, maps: int) -> str:
    """How to make the maps that a file lacks, where its shipped recipe has them."""
    if dataset.id not in shipped_recipes():
        return ""
    whole = load_recipe(dataset.id).splits.get(split)
    if whole is None or whole.maps < maps:
        return ""
    return f" All maps of {dataset.id} are made with `benchnav-datagen create {dataset.id}`."


def _check_known_ground(condition: Condition, dataset: TerrainDataset, maps: int) -> None:
    """Refuses maps with cells whose λ a world cannot tell, which only maps that were imported have."""
    if not any("source" in part for part in dataset.splits[condition.split]["parts"]):
        return
    chosen = range(maps or dataset.map_count(condition.split))
    for start in chosen[::BLOCK_MAPS]:
        check_known(dataset.terrain(condition.split, chosen[start : start + BLOCK_MAPS]), condition.world)


def _late(condition: Condition, task: Task, dataset: TerrainDataset, maps: int) -> list[str]:
    """Tells of goals that top speed does not reach within T; refuses a T without a step."""
    chosen = range(maps or dataset.map_count(condition.split))
    read = dataset.read(condition.split, chosen, ["start_m", "goal_m", "reference_time_s"])
    top_speed = task.robot.top_speed_mps
    budget = condition.world.budget_s(torch.from_numpy(read["reference_time_s"]), top_speed)
    condition.world.steps(budget, task.robot.dt_s)
    way = np.linalg.norm(read["goal_m"] - read["start_m"], axis=1) - task.rules.goal_radius_m
    late = way / top_speed > budget.numpy()
    if not late.any():
        return []
    return [
        f"in {late.sum()} of {len(late)} maps of {condition.split} a robot of {top_speed:g} m/s cannot reach the goal "
        "within the time budget T"
    ]


def _check_model(condition: Condition, dataset: TerrainDataset) -> list[str]:
    """Loads the model, which may reject its options; warns of another class table."""
    part = condition.model.part
    model: Any = load_model(condition.model)
    if is_checkpoint("model", part):
        model = load_checkpoint(find_checkpoint(part))  # which has a class table in any case
    line = class_mismatch(model, dataset.recipe, f"model {condition.model.label}")
    return [line] if line else []


def check_everywhere(conditions: Iterable[Condition], metrics: Iterable[NamedMetric] = ()) -> None:
    """Refuses parts that other processes would not find.

    Raises:
        ConfigError: there are such.
    """
    parts = [(kind, getattr(condition, kind).part) for condition in conditions for kind in PART_KINDS]
    parts += [("metric", metric.part.part) for metric in metrics]
    for kind, source in parts:
        if not is_checkpoint(kind, source) and not registry.find(kind, source).everywhere:
            raise ConfigError(
                f"Expected a {kind} that other processes can load (for `jobs` > 1, `scheduler` or "
                f"`planner_limit_s`), got {source!r}, which only this process has. Write its class into a file, "
                "and import it from there or name it as path/to/file.py:Name."
            )


def _doubts(condition: Condition, dataset: TerrainDataset) -> list[str]:
    lines = []
    threshold = dataset.recipe.stuck_threshold
    if condition.rules.free_space.above != threshold:
        lines.append(
            f"maps of {dataset.id} have a feasible path over ground above {threshold:g}, but free ground is above "
            f"{condition.rules.free_space.above:g} in this run"
        )
    split = dataset.recipe.splits.get(condition.split)
    if split is not None and not split.solvable:
        lines.append(
            f"maps of {dataset.id} {condition.split} may have no feasible path to the goal (no `solvable: true`), "
            "so that a planner may fail on them for that alone"
        )
    return lines
