"""What it costs to learn on the way: episodes with the belief `copula` beside the same ones without.

    python benchmarks/knowledge.py

50 episodes on maps of `stakes-v1-test` in the world `stakes`, A*+DWA, the oracle under expected-time, one thread. A row
has the processor's time of a second of driving of an episode, beside that of `static` in the same turn, and how much of
it is learning and planning: medians of three turns. `copula` is told λ within 1 m and may plan anew each 0.5 s; it is
to take at most 5 times as long. Another table has the milliseconds of an update of one episode, at the beginning of a
way and at its end: they grow with the cells that a probe reaches, and not with the way. Some two minutes.
"""

import time
from functools import partial
from itertools import product
from statistics import median
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from benchnav.core import rng
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
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
from benchnav.planning.sensing.belief import Law, draw_scores
from benchnav.planning.sensing.copula import Copula
from benchnav.planning.sensing.knowledge import Learner, Truth
from benchnav.planning.sensing.sensor import Full, Moment, Probe
from benchnav.planning.world.simulation import Simulation
from benchnav.planning.world.world import PRESETS, Places

EPISODES, STEPS = 50, 100  # steps of 0.1 s
TIMES = 3


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
    return risk.ExpectedTime(0.05)(distribution)


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


def update_ms(resolution_m: float, radius_m: float) -> tuple[float, float, int]:
    """Milliseconds of an update on the first and the last 4 m of 24 m of driving, and how many cells were sensed."""
    height, width = round(12 / resolution_m), round(28 / resolution_m)
    law = Law(grid=Grid(height, width, resolution_m), correlation_m=1.5)
    parameters = (
        torch.tensor(pair).view(1, 2, 1, 1).expand(1, 2, height, width)
        for pair in ((0.1, 0.9), (0.05, 0.7), (0.1, 0.1))
    )
    prior = TraversabilityMixture(*(values.contiguous() for values in parameters))
    field = prior.from_normal(draw_scores(law, 1, (0,))[:, 0].float())
    flat = torch.zeros(1, height, width)
    terrain = Terrain(
        rgb=torch.zeros(1, 3, height, width, dtype=torch.uint8), class_id=flat.long(), elevation_m=flat, slope_deg=flat,
        truth=prior, traversability=field, grid=law.grid,
    )  # fmt: skip
    belief, times = Copula(), []
    state = belief.init(prior, law)
    for number in range(49):
        pose = torch.tensor([[2 + 0.5 * number, 6.0, 0.0]])
        sensed = Probe(radius_m).sense(terrain, field, pose, Moment((0,), number))
        start = time.process_time()
        state = belief.update(state, sensed)
        times.append(1e3 * (time.process_time() - start))
    return median(times[1:9]), median(times[-8:]), int(state.observed.sum())


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
    table = Table("cells", "probe", "sensed in 24 m", "ms an update, first 4 m", "last 4 m")
    for resolution_m, radius_m in product((0.5, 0.25), (1.0, 2.0, 4.0)):
        early, late, count = update_ms(resolution_m, radius_m)
        table.add_row(f"{resolution_m:g} m", f"{radius_m:g} m", str(count), f"{early:.1f}", f"{late:.1f}")
    Console().print(table)


if __name__ == "__main__":
    main()
