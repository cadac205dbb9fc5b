"""What is said of worlds before anything of a suite is run: budgets that are too short, λ that cannot be drawn."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch

from benchnav.datagen.files.reader import TerrainDataset
from benchnav.eval.run.episode import luck_key, read_maps
from benchnav.eval.suite import Suite
from benchnav.eval.trial import Trial
from benchnav.eval.unit import BLOCK_INSTANCES
from benchnav.planning.world.frozen import check_correlation, draw_frozen
from benchnav.planning.world.realisation import check_known

Say = Callable[[str], None]
Datasets = Mapping[str, TerrainDataset]


def check_budgets(trials: Sequence[Trial], datasets: Datasets, instances: int, say: Say) -> None:
    """Refuses time budgets without a step, and tells of goals that top speed does not reach within them.

    Args:
        trials: what is to be run.
        datasets: by path or id.
        instances: of each split; 0 for all.
        say: is told, a line at a time.
    """
    seen = set()
    for trial in trials:
        task = trial.make_task()
        top_speed, radius = task.robot.top_speed_mps, task.rules.goal_radius_m
        case = (trial.data, trial.split, trial.world, top_speed, task.robot.dt_s, radius)
        if case in seen:
            continue
        seen.add(case)
        chosen = range(instances or datasets[trial.data].map_count(trial.split))
        read = datasets[trial.data].read(trial.split, chosen, ["start_m", "goal_m", "reference_time_s"])
        budget = trial.world.budget_s(torch.from_numpy(read["reference_time_s"]), top_speed)
        trial.world.steps(budget, task.robot.dt_s)
        way = np.linalg.norm(read["goal_m"] - read["start_m"], axis=1) - radius
        late = way / top_speed > budget.numpy()
        if late.any():
            say(
                f"in {late.sum()} of {len(late)} instances of {trial.split} a robot of {top_speed:g} m/s cannot "
                f"reach the goal within T"
            )


def check_known_ground(trials: Sequence[Trial], datasets: Datasets, instances: int) -> None:
    """Refuses maps with cells whose λ a world cannot tell, which only maps that were imported have.

    Raises:
        ConfigError: there are such.
    """
    seen = set()
    for trial in trials:
        case, dataset = (trial.data, trial.split, trial.world.noise), datasets[trial.data]
        imported = any("source" in part for part in dataset.splits[trial.split]["parts"])
        if case in seen or not imported:
            continue
        seen.add(case)
        chosen = range(instances or dataset.map_count(trial.split))
        for start in chosen[::BLOCK_INSTANCES]:
            check_known(dataset.terrain(trial.split, chosen[start : start + BLOCK_INSTANCES]), trial.world)


def check_luck(trials: Sequence[Trial], datasets: Datasets, suite: Suite) -> None:
    """Draws λ of each frozen world once a map, so that a world in which it cannot be drawn is refused early.

    Raises:
        ConfigError: the correlation is too long for the maps, or no draw joins start and goal of some map.
    """
    seen = set()
    for trial in trials:
        case = (trial.data, trial.split, trial.world)
        if trial.world.noise != "frozen" or case in seen:
            continue
        seen.add(case)
        dataset, luck = datasets[trial.data], luck_key(suite.all_seeds[0], trial.split, 0)
        check_correlation(trial.world, dataset.grid)
        every = range(suite.instances or dataset.map_count(trial.split))
        for start in every[::BLOCK_INSTANCES]:
            some = every[start : start + BLOCK_INSTANCES]
            block = read_maps(dataset, trial.split, some)
            draw_frozen(block.terrain, trial.world, block.places, luck, some)
