"""Checks before a run: the conditions of a suite are built, without planning.

A suite is a product, and some of its combinations may be invalid, such as a planner
that cannot steer a robot, or `single-class` with a model without classes. Invalid
combinations are left out, each with a reason.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from benchnav.core.errors import ConfigError
from benchnav.core.quantity import Quantity
from benchnav.core.settings import hint
from benchnav.core.store import text_digest
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe.load import shipped_recipes, shipped_sizes
from benchnav.eval.experiment.condition import (
    KNOWLEDGE,
    Condition,
    conditions_of,
    scenarios_of,
)
from benchnav.eval.experiment.hypotheses import fix_hypotheses
from benchnav.eval.experiment.metrics import NamedMetric, quantities, read_metrics
from benchnav.eval.experiment.suite import Suite, check_size
from benchnav.eval.experiment.sweep import read_parts
from benchnav.eval.experiment.unit import BLOCK_MAPS, Conditions, Extent
from benchnav.eval.folder.run_folder import caveats
from benchnav.eval.run.combinations import LeftOut, find_left_out
from benchnav.eval.run.unit import read_maps
from benchnav.models.checkpoint import load_checkpoint
from benchnav.models.predictor import class_mismatch
from benchnav.planning.world.physics.maps import check_physics_maps
from benchnav.planning.world.realisation import check_traversability
from benchnav.planning.world.tracks import create_simulation

Say = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Checked:
    """The conditions of a suite that can be run, and notes on its other combinations.

    Args:
        conditions: conditions that can be run, by id, each with its extent.
        dropped: combinations that cannot be run, each with a reason.
        warnings: warnings for readers of the results.
        hypotheses: entry of hypotheses from `fix_hypotheses`.
        metrics: metrics in addition to the built-in ones.
    """

    conditions: dict[str, tuple[Condition, Extent]]
    dropped: tuple[LeftOut, ...]
    warnings: tuple[str, ...]
    hypotheses: dict[str, Any]
    metrics: tuple[NamedMetric, ...] = ()

    @property
    def caveats(self) -> list[str]:
        """Lines with the warnings and the left-out combinations."""
        return caveats(vars(self))


def check_suite(suite: Suite, uses_workers: bool) -> Checked:
    """Build the conditions of a suite, and reject a suite that cannot be run.

    Args:
        suite: suite, as a user wrote it.
        uses_workers: whether other processes also create the parts.

    Raises:
        ConfigError: If a part, scenario or map is missing, no combination can be run,
            or a hypothesis names a combination that cannot be run.
        DatasetError: If the dataset is missing.
    """
    conditions = conditions_of(suite)
    if not conditions:
        raise ConfigError(
            "Expected a suite with at least one condition, got none. `data` has the "
            f"scenarios {scenarios_of(suite.data)}. The dataset needs a split "
            "test/SCENARIO."
        )
    maps = {
        condition.id: check_split(condition, suite.maps) for condition in conditions
    }
    check_size(
        len(conditions),
        len(suite.all_seeds),
        suite.realisations,
        max(maps.values()),
        BLOCK_MAPS,
    )
    left_out = find_left_out(conditions)
    runnable = [condition for condition in conditions if condition.id not in left_out]
    if not runnable:
        raise ConfigError(next(iter(left_out.values()))["reason"])
    for figure in suite.figures:
        for part in read_parts("figure", figure):
            _ = part.object  # creating the figure may reject its options
    robots = {condition.robot.label: condition.task.robot for condition in runnable}
    metrics = read_metrics(suite.metrics, robots.values())
    all_quantities = quantities(metric.quantity for metric in metrics)
    if uses_workers:
        check_everywhere(runnable, metrics)
    conditions_by_id = {}
    for condition in conditions:
        n_maps = maps[condition.id]
        extent = Extent(draws=tuple((*draw, n_maps) for draw in suite.draws))
        conditions_by_id[condition.id] = condition, extent
    hypotheses = _fix_hypotheses(suite, conditions_by_id, left_out, all_quantities)
    warnings = build_each(runnable, suite.maps)
    objects = [part for condition in runnable for part in condition.unreproducible]
    for metric in metrics:
        if metric.is_object:
            objects.append(f"metric {metric.quantity.name}")
    for name in objects:
        warnings.append(f"not reproducible: {name} is an object of one process")
    dropped = {json.dumps(entry): entry for entry in left_out.values()}
    return Checked(
        conditions={
            condition.id: conditions_by_id[condition.id] for condition in runnable
        },
        dropped=tuple(dropped.values()),
        warnings=tuple(dict.fromkeys(warnings)),
        hypotheses=hypotheses,
        metrics=metrics,
    )


def _fix_hypotheses(
    suite: Suite,
    conditions: Conditions,
    left_out: Mapping[str, LeftOut],
    all_quantities: Mapping[str, Quantity],
) -> dict[str, Any]:
    """Fix the hypotheses of a suite, on the conditions that can be run.

    Raises:
        ConfigError: If a hypothesis is invalid, or compares a condition that can be run
            with a left-out combination.
    """
    try:
        fixed = fix_hypotheses(suite.hypotheses, conditions, all_quantities)
        tests = fixed.get("tests", ())
    except ConfigError:  # raised again below if it concerns runnable conditions
        tests = ()
    for test in tests:
        sides = (test["one"], test["other"])
        lost = [left_out[side] for side in sides if side in left_out]
        if len(lost) == 1:
            raise ConfigError(
                "Expected hypotheses on conditions that can be run, got "
                f"{test['claim']!r}, in which one condition cannot be run: "
                f"{lost[0]['reason']}"
            )
    runnable = {i: entry for i, entry in conditions.items() if i not in left_out}
    return fix_hypotheses(suite.hypotheses, runnable, all_quantities)


def check_split(condition: Condition, maps: int) -> int:
    """Return the number of maps that are run; reject a missing scenario or map.

    Args:
        condition: condition whose dataset and scenario are checked.
        maps: requested number of maps; 0 for all.

    Raises:
        ConfigError: If the dataset has no such scenario, or too few maps.
    """
    dataset = condition.dataset
    scenarios = scenarios_of(condition.data)
    if condition.scenario not in scenarios:
        suggestion = hint(condition.scenario, scenarios)
        raise ConfigError(
            f"Expected `scenarios` among {scenarios} for {dataset.path}, got "
            f"{condition.scenario!r}.{suggestion}{_remedy(dataset, condition.split, 1)}"
        )
    count = dataset.map_count(condition.split)
    if maps > count:
        raise ConfigError(
            f"Expected `maps` at most {count}, which is the number of maps of "
            f"{condition.split} in {dataset.path}, got {maps}. Use 0 for all "
            f"maps.{_remedy(dataset, condition.split, maps)}"
        )
    return maps or count


def _remedy(dataset: TerrainDataset, split: str, maps: int) -> str:
    """Return a sentence with the command that creates missing maps; may be empty."""
    if dataset.id not in shipped_recipes():
        return ""
    if shipped_sizes(dataset.id).get(split, 0) < maps:
        return ""
    command = f"benchnav-datagen create {dataset.id}"
    return f" Create all maps of {dataset.id} by `{command}`."


def check_everywhere(
    conditions: Iterable[Condition], metrics: Iterable[NamedMetric] = ()
) -> None:
    """Reject parts that other processes cannot load.

    Raises:
        ConfigError: If there are such parts.
    """
    parts = [part for condition in conditions for part in condition.parts.values()]
    parts += [metric.part for metric in metrics]
    for part in parts:
        if not part.found.everywhere:
            raise ConfigError(
                f"Expected a {part.kind} that other processes can load, got "
                f"{part.part!r}, which exists only in this process. `jobs`, "
                "`scheduler` or `planner_limit_s` uses other processes. Write the "
                "class into a file, and import it from the file or name it as "
                "path/to/file.py:Name."
            )


def build_each(conditions: Sequence[Condition], maps: int) -> list[str]:
    """Build conditions on the first map of their splits, without prediction or plan.

    Args:
        conditions: conditions; parts that several conditions have are built once.
        maps: number of maps of each split; 0 for all.

    Returns:
        Warnings for readers of the results.

    Raises:
        BenchnavError: If a condition cannot be run.
    """
    warnings: list[str] = []
    world_keys = ("data", "scenario", "world", "rules", "robot")
    for condition in _distinct(conditions, *world_keys):
        warnings += _check_world(condition, condition.dataset, maps)
    for condition in _distinct(conditions, "data", "scenario", "model", *KNOWLEDGE):
        _ = condition.statistics  # raises if needed statistics are missing
    predicting = [condition for condition in conditions if not condition.blind]
    for condition in _distinct(predicting, "data", "model"):
        warnings += _check_model(condition)
    for condition in conditions:
        warnings += _recipe_warnings(condition, condition.dataset)
    return warnings


def _distinct(conditions: Sequence[Condition], *names: str) -> list[Condition]:
    """Return the first of all conditions that agree in the named fields."""
    first: dict[str, Condition] = {}
    for condition in conditions:
        value = {**condition.value, "scenario": condition.scenario}
        key = text_digest({name: value.get(name) for name in names})
        first.setdefault(key, condition)
    return list(first.values())


def _check_model(condition: Condition) -> list[str]:
    """Load the model, which may reject its options; warn if its class table differs."""
    model = condition.model.object
    name = f"model {condition.model.label}"
    folder = condition.model.folder
    # A checkpoint has a class table, whether or not its model predicts classes.
    owner = load_checkpoint(folder) if folder else model
    line = class_mismatch(owner, condition.dataset.recipe, name)
    return [line] if line else []


def _check_world(condition: Condition, dataset: TerrainDataset, maps: int) -> list[str]:
    """Check T and the maps, draw λ of the first map, and warn of unreachable goals."""
    task = condition.task
    world = condition.world
    split = condition.split
    chosen = range(maps or dataset.map_count(split))
    read = dataset.read(split, chosen, ["start_m", "goal_m", "reference_time_s"])
    top_speed_mps = task.robot.top_speed_mps
    reference_s = torch.from_numpy(read["reference_time_s"])
    budget_s = world.budget_s(reference_s, top_speed_mps)
    world.steps(budget_s, task.robot.dt_s)
    # Only imported maps have cells without λ.
    is_imported = any("source" in part for part in dataset.splits[split]["parts"])
    checked = chosen if is_imported else chosen[:1]
    warnings: list[str] = []
    for start in checked[::BLOCK_MAPS]:
        block = read_maps(dataset, split, checked[start : start + BLOCK_MAPS])
        check_traversability(block.terrain, world)
        if world.physics is not None:
            warnings += check_physics_maps(block.terrain, world.physics, dataset.id)
        if start == 0:
            first = torch.tensor([0])
            terrain = block.terrain.select(first)
            endpoints = block.endpoints.select(first)
            create_simulation(terrain, task, world, endpoints, 0, [0])
    centre_distance_m = np.linalg.norm(read["goal_m"] - read["start_m"], axis=1)
    distance_m = centre_distance_m - task.rules.goal_radius_m
    is_late = distance_m / top_speed_mps > budget_s.numpy()
    if not is_late.any():
        return warnings
    return [
        *warnings,
        f"in {is_late.sum()} of {len(is_late)} maps of {condition.split}, a robot with "
        f"a top speed of {top_speed_mps:g} m/s cannot reach the goal within the time "
        "budget T",
    ]


def _recipe_warnings(condition: Condition, dataset: TerrainDataset) -> Iterator[str]:
    """Yield warnings if the maps' recipe does not ensure a feasible path in the task."""
    threshold = dataset.recipe.stuck_threshold
    above = condition.rules.free_space.above
    if above != threshold:
        yield (
            f"maps of {dataset.id} have a feasible path over cells with λ above "
            f"{threshold:g}, but free cells have λ above {above:g} in this run"
        )
    split = dataset.recipe.splits.get(condition.split)
    if split is not None and not split.solvable:
        yield (
            f"maps of {dataset.id} {condition.split} may have no feasible path to the "
            "goal, since the recipe does not set `solvable: true`; planners then fail"
        )
