"""How the time of a plan grows: with samples, horizon, episodes and the size of the map.

    python benchmarks/scaling.py OUT.png

One thread, medians. Each curve changes one setting of: 5 000 samples, 5 s (50 steps), 20 episodes, a map of 64 × 64
cells.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from engine import milliseconds
from rich.console import Console
from rich.progress import track

from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Observation
from benchnav.planning.objective import GoalDistance
from benchnav.planning.planners.astar.astar_dwa import AStarDWA
from benchnav.planning.planners.mppi import MPPI, MPPIConfig
from benchnav.planning.planners.planner import Planner
from benchnav.planning.problem import Problem, Rules, Task, pose_problem
from benchnav.planning.robots import Unicycle
from benchnav.planning.sensing.sensor import Step

SAMPLES = (2000, 5000, 10_000, 20_000, 50_000)
HORIZONS_S = (1, 2, 5, 10, 20)
EPISODES = (1, 2, 5, 10, 20, 50, 100)
SIZES = (64, 128, 256, 512, 1024)


def problem_of(episodes: int, size: int) -> Problem:
    """Uneven ground, the same for all."""
    generator = torch.Generator().manual_seed(0)
    ground = 0.35 + 0.6 * torch.rand((1, size, size), generator=generator).expand(episodes, -1, -1)
    ones = torch.ones_like(ground).unsqueeze(1)
    mixture = TraversabilityMixture(ones, ground.unsqueeze(1), 0.1 * ones)
    seen = Observation(
        torch.zeros(episodes, 3, size, size, dtype=torch.uint8), 0 * ground, 0 * ground, Grid(size, size, 0.5)
    )
    start_m, goal_m = (torch.full((episodes, 2), place) for place in (4.0, size / 2 - 4.0))
    task = Task(robot=Unicycle(), objective=GoalDistance(), rules=Rules())
    return pose_problem(task, seen, mixture, ground, start_m, goal_m, 100.0)


def plan_ms(planner: Planner[object], problem: Problem) -> float:
    """Time of a step, an episode."""
    state = planner.init(problem, torch.Generator().manual_seed(0))
    step = Step(state=problem.start, traversability=torch.full((len(problem),), torch.nan), time_s=0.0)
    _, state, _ = planner.plan(step, state)
    return milliseconds(lambda: planner.plan(step, state), 11) / len(problem)


def main() -> None:
    torch.set_num_threads(1)
    small = problem_of(20, 64)
    curves = {
        "samples": {n: plan_ms(MPPI(MPPIConfig(samples=n)), small) for n in track(SAMPLES)},
        "horizon [s]": {s: plan_ms(MPPI(MPPIConfig(horizon_s=s)), small) for s in track(HORIZONS_S)},
        "episodes": {n: plan_ms(MPPI(), problem_of(n, 64)) for n in track(EPISODES)},
        "cells along a side of the map": {n: plan_ms(MPPI(), problem_of(20, n)) for n in track(SIZES)},
    }
    guided = {n: plan_ms(AStarDWA(), problem_of(n, 64)) for n in track(EPISODES)}
    figure, panels = plt.subplots(1, 4, figsize=(11, 2.8), sharey=True, layout="constrained")
    for panel, (name, curve) in zip(panels, curves.items(), strict=True):
        panel.plot(list(curve), list(curve.values()), marker="o", label="MPPI")
        if name == "episodes":
            panel.plot(list(guided), list(guided.values()), marker="s", label="A*+DWA")
            panel.legend(frameon=False)
        panel.set(xscale="log", yscale="log", xlabel=name)
        panel.set_xticks(list(curve), [f"{n:,}".replace(",", " ") for n in curve], rotation=45)
        panel.minorticks_off()
        panel.grid(visible=True, alpha=0.3)
    panels[0].set_yticks([0.2, 0.5, 1, 2, 5, 10], ["0.2", "0.5", "1", "2", "5", "10"])
    panels[0].set_ylabel("ms a step and episode")
    figure.savefig(Path(sys.argv[1]), dpi=150)
    for name, curve in (*curves.items(), ("episodes, A*+DWA", guided)):
        Console().print(name, {n: round(ms, 3) for n, ms in curve.items()})


if __name__ == "__main__":
    main()
