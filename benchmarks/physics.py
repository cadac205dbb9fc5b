"""Speed of rigid bodies on soil, and of episodes in the three backends.

    python -m benchmarks.physics [MAPS]

The first table has the time of a sub-step and of a step of one robot and of a batch on
rough terrain, and how many times faster than real time they are. The second has
episodes of A*+DWA under CVaR₀.₈ on the first maps of `stakes-v1` std, by backend. One
process with one thread runs all.
"""

import sys
import time
from typing import Any

import numpy as np
import torch

from benchmarks.timing import seconds, show
from benchnav import Grid, Terrain, TraversabilityMixture
from benchnav.core import rng
from benchnav.eval import Suite
from benchnav.eval.run.unit import Settings, one_thread, simulate
from benchnav.planning import SkidSteer, create_simulation
from benchnav.planning.free_space import Rules
from benchnav.planning.objective import GoalDistance
from benchnav.planning.problem import Task
from benchnav.planning.world.physics.body import drive_of
from benchnav.planning.world.physics.settings import Physics
from benchnav.planning.world.physics.simulation import PhysicsState
from benchnav.planning.world.physics.workspace import Maps, workspace
from benchnav.planning.world.world import Endpoints, World
from studies.units import build_unit, one_unit

SIZE = 64
STEPS = 200
DATA = "stakes-v1"
WORLDS: dict[str, dict[str, Any]] = {
    "kinematic": {},
    "tracks": {"backend": "tracks"},
    "physics, no entrapment": {"backend": "physics", "physics": {"entrapment": None}},
    "physics": {"backend": "physics"},
}


def rough_terrain(batch: int) -> Terrain:
    """Return hills of a few metres with random λ."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.rand(batch, 1, 12, 12, generator=generator)
    hills = torch.nn.functional.interpolate(noise, size=(SIZE, SIZE), mode="bicubic")
    field = torch.rand(batch, SIZE, SIZE, generator=generator)
    ones = torch.ones(batch, 1, SIZE, SIZE)
    return Terrain(
        rgb=torch.zeros(batch, 3, SIZE, SIZE, dtype=torch.uint8),
        class_id=torch.zeros(batch, SIZE, SIZE, dtype=torch.int64),
        elevation_m=4 * hills[:, 0],
        slope_deg=torch.full((batch, SIZE, SIZE), 8.0),
        truth=TraversabilityMixture(ones, field[:, None], 0.1 * ones, (0,)),
        traversability=field,
        grid=Grid(SIZE, SIZE, 0.5),
        slope_law=lambda slope_deg: (0.9 - 0.01 * slope_deg).clamp(0, 1)[None],
    )


def sub_step_row() -> dict[str, Any]:
    """Return the time of sub-steps of one robot, without PyTorch."""
    physics = Physics()
    space = workspace(physics, drive_of(SkidSteer()))
    terrain = rough_terrain(1)
    maps = Maps(terrain.elevation_m.double().numpy(), 0.5, None, 1.0)
    cells = np.full((1, 4, 3), [0.8, 8.0, -1.0])
    start = np.array([[8.0, 16.0, 0.5]])
    state, memory, _ = space.place(maps, 125, start, cells)
    command = np.array([[0.5, 0.3]])
    count = 2500

    def drive() -> None:
        episodes = np.zeros(1, np.int32)
        space.advance(maps, episodes, count, state, memory, command, cells)

    best_s = min(seconds(drive, 5))
    per_step_s = best_s / count
    return {
        "what": "sub-step of one robot",
        "µs": 1e6 * per_step_s,
        "× real time": physics.substep_s / per_step_s,
    }


def step_row(batch: int) -> dict[str, Any]:
    """Return the time of a step of the simulation, per episode."""
    goals = torch.full((batch, 2), 300.0)
    places = Endpoints(
        start_m=torch.full((batch, 2), 16.0),
        goal_m=goals,
        reference_time_s=torch.full((batch,), torch.nan),
    )
    robot = SkidSteer()
    simulation = create_simulation(
        rough_terrain(batch),
        Task(robot=robot, objective=GoalDistance(), rules=Rules()),
        World(backend="physics", noise="stored"),
        places,
        rng.stream_key(0, "noise"),
        range(batch),
    )
    now: Any = simulation.init(torch.tensor([[16.0, 16.0, 0.5]]).expand(batch, 3))
    assert isinstance(now, PhysicsState)
    action = torch.tensor([[0.3, 0.3]]).expand(batch, 2)
    start_s = time.perf_counter()
    for _ in range(STEPS):
        now, _ = simulation.step(now, action)
    elapsed_s = time.perf_counter() - start_s
    each_s = elapsed_s / STEPS / batch
    return {
        "what": f"step of {batch} robot{'s' if batch > 1 else ''}, per robot",
        "µs": 1e6 * each_s,
        "× real time": robot.dt_s / each_s,
    }


def episodes_row(name: str, world: dict[str, Any], maps: int) -> dict[str, Any]:
    """Return the rate of episodes in a world."""
    suite = Suite(
        data=DATA,
        model="oracle",
        world=({"preset": "stakes"} | world,),
        scenarios=("std",),
        objectives=("travel_time",),
        robots=("skid_steer",),
        planners=("astar_dwa",),
        risks=("cvar:0.8",),
        maps=maps,
    )
    unit = one_unit(suite, maps)
    inputs = build_unit(unit)
    start_s = time.perf_counter()
    episodes, _ = simulate(unit, inputs, Settings())
    elapsed_s = time.perf_counter() - start_s
    driven_s = 0.1 * float(episodes.steps.sum())
    return {
        "backend": name,
        "episodes per hour": 3600 * maps / elapsed_s,
        "× real time": driven_s / elapsed_s,
        "planning [%]": 100 * float(episodes.planning_s.sum()) / elapsed_s,
    }


def main(maps: int = 50) -> None:
    """Print both tables."""
    with one_thread():
        show([sub_step_row(), step_row(1), step_row(50)])
        episodes_row("kinematic", WORLDS["kinematic"], maps)  # compile the planner
        show([episodes_row(name, world, maps) for name, world in WORLDS.items()])


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
