"""What is said of worlds before anything of a suite is run: budgets that are too short, λ that cannot be drawn."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.eval.experiment.condition import Condition
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import BLOCK_MAPS
from benchnav.eval.run.episode import noise_key, read_maps
from benchnav.planning.world.frozen import check_correlation, draw_frozen
from benchnav.planning.world.realisation import check_known

Say = Callable[[str], None]
Datasets = Mapping[str, TerrainDataset]


def check_budgets(conditions: Sequence[Condition], datasets: Datasets, maps: int, say: Say) -> None:
    """Refuses time budgets without a step, and tells of goals that top speed does not reach within them.

    Args:
        conditions: what is to be run.
        datasets: by path or id.
        maps: of each split; 0 for all.
        say: is told, a line at a time.
    """
    seen = set()
    for condition in conditions:
        task = condition.make_task()
        top_speed, radius = task.robot.top_speed_mps, task.rules.goal_radius_m
        case = (condition.data, condition.split, condition.world, top_speed, task.robot.dt_s, radius)
        if case in seen:
            continue
        seen.add(case)
        chosen = range(maps or datasets[condition.data].map_count(condition.split))
        read = datasets[condition.data].read(
            condition.split, chosen, ["start_m", "goal_m", "reference_time_s"]
        )
        budget = condition.world.budget_s(torch.from_numpy(read["reference_time_s"]), top_speed)
        condition.world.steps(budget, task.robot.dt_s)
        way = np.linalg.norm(read["goal_m"] - read["start_m"], axis=1) - radius
        late = way / top_speed > budget.numpy()
        if late.any():
            say(
                f"in {late.sum()} of {len(late)} maps of {condition.split} a robot of {top_speed:g} m/s cannot "
                f"reach the goal within T"
            )


def check_known_ground(conditions: Sequence[Condition], datasets: Datasets, maps: int) -> None:
    """Refuses maps with cells whose λ a world cannot tell, which only maps that were imported have.

    Raises:
        ConfigError: there are such.
    """
    seen = set()
    for condition in conditions:
        case, dataset = (condition.data, condition.split, condition.world.noise), datasets[condition.data]
        imported = any("source" in part for part in dataset.splits[condition.split]["parts"])
        if case in seen or not imported:
            continue
        seen.add(case)
        chosen = range(maps or dataset.map_count(condition.split))
        for start in chosen[::BLOCK_MAPS]:
            check_known(dataset.terrain(condition.split, chosen[start : start + BLOCK_MAPS]), condition.world)


def check_draws(conditions: Sequence[Condition], datasets: Datasets, suite: Suite) -> None:
    """Draws λ of each frozen world once a map, so that a world in which it cannot be drawn is refused early.

    Raises:
        ConfigError: the correlation is too long for the maps, or no draw joins start and goal of some map.
    """
    seen = set()
    for condition in conditions:
        case = (condition.data, condition.split, condition.world)
        if condition.world.noise != "frozen" or case in seen:
            continue
        seen.add(case)
        dataset, noise = datasets[condition.data], noise_key(suite.all_seeds[0], condition.split, 0)
        check_correlation(condition.world, dataset.grid)
        every = range(suite.maps or dataset.map_count(condition.split))
        for start in every[::BLOCK_MAPS]:
            some = every[start : start + BLOCK_MAPS]
            block = read_maps(dataset, condition.split, some)
            draw_frozen(block.terrain, condition.world, block.places, noise, some)
