"""What it costs to learn on the way: episodes with the belief `copula` beside the same ones without.

    python benchmarks/knowledge.py

50 episodes on maps of `stakes-v1-test` in the world `stakes`, A*+DWA, the oracle under expected-time, one thread. A row
has the processor's time of a second of driving of an episode, beside that of `static` in the same turn, and how much of
it is learning and planning: medians of three turns. `copula` is told λ within 1 m and may plan anew each 0.5 s; it is
to take at most 5 times as long. Another table has what a window of observations costs and loses: milliseconds of an
update of all episodes, and the largest differences of mean, CVaR and P(λ < 0.1) from a belief that looks at all
observations, over the cells within 2ℓ of the robots at the end of the way. Some four minutes.
"""

import time
from functools import partial
from statistics import median
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from benchnav.core import rng
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.eval.run.knowledge import Learning
from benchnav.eval.run.rollout import run_episodes
from benchnav.models.base import predict
from benchnav.models.predictor import Oracle
from benchnav.planning import risk
from benchnav.planning.objective import TravelTime
from benchnav.planning.planners.astar.astar_dwa import AStarDWA
from benchnav.planning.problem import Problem, Task, pose_problem
from benchnav.planning.robots import Unicycle
from benchnav.planning.sensing.belief import Law
from benchnav.planning.sensing.copula import Copula
from benchnav.planning.sensing.knowledge import Learner, Truth
from benchnav.planning.sensing.sensor import Full, Moment, Probe, Sensed
from benchnav.planning.world.simulation import Simulation
from benchnav.planning.world.world import PRESETS, Places

EPISODES, STEPS = 50, 100  # steps of 0.1 s
TIMES = 3
UPDATES = 40  # of the second table, 0.5 m apart
WINDOWS = (64, 128, 256)


def drive() -> tuple[Problem, Simulation, Terrain, Law]:
    """The first maps, predicted as they are."""
    dataset, preset = TerrainDataset(find_dataset("stakes-v1-test")), PRESETS["stakes"]
    split = next(iter(dataset.splits))
    terrain = dataset.terrain(split, range(EPISODES))
    names = ("start_m", "goal_m", "reference_time_s")
    read = dataset.read(split, range(EPISODES), names)
    start, goal, reference = (torch.from_numpy(read[name]) for name in names)
    robot = Unicycle()
    objective = TravelTime(robot=robot, goal_radius_m=preset.rules.goal_radius_m)
    task = Task(robot=robot, objective=objective, rules=preset.rules)
    places = Places(start_m=start, goal_m=goal, reference_time_s=reference)
    key = rng.stream_key(0, "noise")
    simulation = Simulation(terrain, task, preset.world, places, key, range(EPISODES))
    problem = pose_problem(task, terrain.observe(), terrain.truth, measure(terrain.truth), start, goal, 100.0)
    return problem, simulation, terrain, Law(grid=terrain.grid, correlation_m=preset.world.correlation_m)


def measure(distribution: Any) -> torch.Tensor:
    return risk.expected_time(distribution, 0.05)


def learns(belief: Copula, problem: Problem, terrain: Terrain, field: torch.Tensor, law: Law) -> Learning:
    """How robots learn by a belief, and what they know when they set out."""
    learner = Learner(
        sensor=Full(), ground=Probe(1.0), belief=belief, law=law, measure=measure, rules=problem.task.rules,
        predict=partial(predict, Oracle()),
    )  # fmt: skip
    truth = Truth(terrain=terrain, field=field, keys=tuple(range(EPISODES)))
    start = learner.begin(truth, problem.start, problem.distribution)
    return Learning(learner=learner, start=start, truth=truth)


def driven_ms(
    problem: Problem, simulation: Simulation, learning: Learning | None
) -> tuple[float, float, float]:
    """Milliseconds of a second of driving of an episode, and which shares of it are learning and planning."""
    generator = torch.Generator().manual_seed(0)
    start, began = time.process_time(), time.perf_counter()
    found = run_episodes(
        AStarDWA(), problem, simulation, generator, enough=lambda step: step == STEPS, learning=learning
    )
    took, waited = time.process_time() - start, time.perf_counter() - began
    driven_s = problem.dt_s * int(found.steps.sum())
    return 1e3 * took / driven_s, found.learning_s / waited, float(found.planning_s.sum()) / waited


def looks(problem: Problem, terrain: Terrain, field: torch.Tensor) -> list[Sensed]:
    """What robots sense that drive straight at their goals."""
    ahead = problem.goal_m - problem.start[:, :2]
    unit = ahead / torch.linalg.vector_norm(ahead, dim=1, keepdim=True)
    state = problem.start.clone()
    found = []
    for number in range(UPDATES):
        state[:, :2] = problem.start[:, :2] + 0.5 * number * unit
        found.append(Probe(1.0).sense(terrain, field, state, Moment(list(range(EPISODES)), number)))
    return found


def update_ms(belief: Copula, problem: Problem, law: Law, told: list[Sensed]) -> tuple[float, Any]:
    """Median milliseconds of an update in the second half of a way, and what is known at its end."""
    state, times = belief.init(problem.distribution, law), []
    for sensed in told:
        start = time.process_time()
        state = belief.update(state, sensed)
        times.append(1e3 * (time.process_time() - start))
    return median(times[UPDATES // 2 :]), state


def main() -> None:
    torch.set_num_threads(1)
    problem, simulation, terrain, law = drive()
    field = simulation.field
    assert field is not None
    learning = learns(Copula(), problem, terrain, field, law)
    beliefs = {
        "static": None,
        "copula": learning,
        "copula, estimated ℓ": learns(Copula("estimated"), problem, terrain, field, law),
    }
    for how in beliefs.values():  # compiles, and loads what is loaded once
        run_episodes(
            AStarDWA(), problem, simulation, torch.Generator(), enough=lambda step: step == 10, learning=how
        )
    turns = [
        {name: driven_ms(problem, simulation, how) for name, how in beliefs.items()} for _ in range(TIMES)
    ]
    table = Table("belief", "ms a second driven", "learning", "planning", "beside static")
    for name in beliefs:
        whole, learnt, planned = (median(turn[name][place] for turn in turns) for place in range(3))
        ratio = median(turn[name][0] / turn["static"][0] for turn in turns)
        table.add_row(
            name, f"{whole:.1f}", f"{100 * learnt:.0f} %", f"{100 * planned:.0f} %", f"{ratio:.1f} ×"
        )
    Console().print(table)
    told = looks(problem, terrain, field)
    every = torch.stack([sensed.mask for sensed in told]).any(0)
    near = torch.nn.functional.max_pool2d(
        told[-1].mask.float(), 2 * round(2 * law.correlation_cells) + 1, 1, round(2 * law.correlation_cells)
    ).bool()
    exact = Copula(window=int(every.flatten(1).sum(1).max()))
    _, wanted = update_ms(exact, problem, law, told)
    table = Table("window", "ms of an update", "mean", "CVaR 0.8", "P(λ < 0.1)")
    for window in WINDOWS:
        took, state = update_ms(Copula(window=window), problem, law, told)
        one, other = (Copula().at(own, near) for own in (state, wanted))
        lost = [
            float((of(one) - of(other)).abs().max())
            for of in (lambda d: d.mean(), lambda d: d.cvar(0.8), lambda d: d.cdf(0.1))
        ]
        table.add_row(str(window), f"{took:.0f}", *(f"{value:.3f}" for value in lost))
    Console().print(table)


if __name__ == "__main__":
    main()
