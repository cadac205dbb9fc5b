"""How fast planners, risk measures, environments and commands are, beside a peer in the same run.

    python benchmarks/engine.py [FILE.json]

One thread. Each figure is the median of the repeats, on maps of `paper-v1-test`; ratios are to the peer's median.
Peers: for MPPI the same rollouts as ten plain lines of PyTorch, with as many normals drawn a step; with risk on the
cost as many rollouts on the risk map; for A*+DWA the same planner uncompiled; for the optimal planner A*'s search of
the map; for risk maps thirty halvings of every cell; for the environment its step in which none begins anew.
"""

import json
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import gymnasium
import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchnav.core.mixture import TraversabilityMixture
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models.base import predict
from benchnav.models.predictor import load_model
from benchnav.planning.objective import GoalDistance
from benchnav.planning.planners.astar.astar_dwa import AStarDWA
from benchnav.planning.planners.mppi import MPPI, MPPIConfig
from benchnav.planning.planners.optimal.optimal import Optimal
from benchnav.planning.problem import Problem, Rules, Task, pose_problem
from benchnav.planning.robots import Unicycle
from benchnav.planning.sensing.belief import Fields, Law, Static
from benchnav.planning.sensing.sensor import Step

REPEATS = 31
LEVELS = (0.3, 0.5, 0.7, 0.9, 0.95)
COMMANDS = (
    "benchnav-datagen --help",
    "benchnav-train --help",
    "benchnav-eval --help",
    "benchnav-datagen list",
)


def milliseconds(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Median time of some work, which is done three times before."""
    for _ in range(3):
        work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return 1e3 * median(times)


def problem_of(episodes: int) -> Problem:
    """The first maps of std, known as they are."""
    dataset = TerrainDataset(find_dataset("paper-v1-test"))
    terrain = dataset.terrain("test/std", range(episodes))
    places = dataset.read("test/std", range(episodes), ["start_m", "goal_m"])
    start_m, goal_m = (torch.from_numpy(places[name]) for name in ("start_m", "goal_m"))
    task = Task(robot=Unicycle(), objective=GoalDistance(), rules=Rules())
    believed = Static().init(terrain.truth, Law(grid=terrain.grid, correlation_m=1.5))
    return pose_problem(
        task, terrain.observe(), terrain.truth, terrain.truth.mean(), start_m, goal_m, 100.0,
        fields=Fields(Static(), believed, tuple(range(episodes))),
    )  # fmt: skip


def plan_ms(planner: Any, problem: Problem) -> float:
    """Time of a step of a planner that has begun, an episode."""
    state = planner.init(problem, torch.Generator().manual_seed(0))
    observed = torch.full((len(problem),), torch.nan)
    step = Step(state=problem.start, traversability=observed, time_s=0.0)
    _, state, _ = planner.plan(step, state)
    return milliseconds(lambda: planner.plan(step, state)) / len(problem)


def plain_mppi(problem: Problem, mean: Tensor, generator: torch.Generator, samples: int = 5000) -> Tensor:
    """MPPI for one episode in plain PyTorch: the peer."""
    ground, resolution = problem.risk_map[0], problem.grid.resolution_m
    noise = torch.randn((mean.shape[0], 2, samples), generator=generator) * 0.5
    x, y, heading = (value.expand(samples) for value in problem.start[0, :3])
    cost = torch.zeros(samples)
    speed = (mean[:, 0, None] + noise[:, 0]).clamp(0, 1)
    turn = (mean[:, 1, None] + noise[:, 1]).clamp(-1, 1)
    for v, w in zip(speed, turn, strict=True):
        row, column = (y / resolution).long().clamp(0, 63), (x / resolution).long().clamp(0, 63)
        traversability = ground[row, column]
        cost = cost + torch.hypot(x - problem.goal_m[0, 0], y - problem.goal_m[0, 1])
        cost = cost + 1e4 * (traversability <= 0.3)
        moved = 0.1 * traversability * v
        x, y, heading = (
            x + moved * heading.cos(),
            y + moved * heading.sin(),
            heading + 0.1 * traversability * w,
        )
    weights = torch.softmax(-cost / 0.5, dim=0)
    return torch.stack(((speed * weights).sum(1), (turn * weights).sum(1)), dim=1)


def halved_cvar(mixture: TraversabilityMixture, tail: float) -> Tensor:
    """CVaR by thirty halvings in float64: the peer."""
    weights, means, stds = (values[0].double() for values in (mixture.weights, mixture.means, mixture.stds))

    def terms(value: Tensor) -> tuple[Tensor, Tensor]:
        z = (value - means) / stds
        below = torch.special.ndtr(z)
        density = torch.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
        return (weights * below).sum(0), (weights * stds * (z * below + density)).sum(0)

    low, width = torch.zeros_like(means[0]), 1.0
    for _ in range(30):
        width /= 2
        low = torch.where(terms(low + width)[0] < tail, low + width, low)
    return low - (terms(low)[1] - terms(torch.zeros_like(low))[1]) / tail


def planners() -> list[dict[str, Any]]:
    rows = []
    one = problem_of(1)
    mean, generator = torch.zeros(50, 2), torch.Generator().manual_seed(0)
    peer = milliseconds(lambda: plain_mppi(one, mean, generator))
    for episodes in (1, 20):
        name = "MPPI 5 000 × 50, one episode" if episodes == 1 else f"the same, an episode of {episodes}"
        own = plan_ms(MPPI(), problem_of(episodes))
        rows.append({"work": name, "ms": own, "peer": "plain PyTorch", "peer_ms": peer})
    on_cost = MPPIConfig(samples=1024, risk_on="cost", level=0.8, fields=64)
    for episodes in (1, 20):
        problem = problem_of(episodes)
        name = "MPPI 1 024 × 50 on 64 fields" if episodes == 1 else f"the same, an episode of {episodes}"
        own, peer = (plan_ms(MPPI(config), problem) for config in (on_cost, MPPIConfig(samples=1024 * 64)))
        rows.append({"work": name, "ms": own, "peer": "as many on the map", "peer_ms": peer})
    several = problem_of(10)
    own, peer = (
        milliseconds(lambda planner=planner: planner.init(several, torch.Generator()), 3) / 10
        for planner in (Optimal(), AStarDWA())
    )
    rows.append({"work": "optimal, a map of 10", "ms": own, "peer": "A*", "peer_ms": peer})
    for episodes in (1, 20):
        problem = problem_of(episodes)
        name = "A*+DWA step, one episode" if episodes == 1 else f"the same, an episode of {episodes}"
        own = plan_ms(AStarDWA(), problem)
        with torch._dynamo.config.patch(disable=True):
            peer = plan_ms(AStarDWA(), problem)
        rows.append({"work": name, "ms": own, "peer": "uncompiled", "peer_ms": peer})
    return rows


def risk_maps() -> list[dict[str, Any]]:
    dataset = TerrainDataset(find_dataset("paper-v1-test"))
    model = load_model("paper-v1")
    seen = predict(model, dataset.terrain("test/hs", [0]))
    peer = milliseconds(lambda: halved_cvar(seen, 0.1))
    one = milliseconds(lambda: seen.cvar(0.9))
    five = milliseconds(lambda: [seen.cvar(level) for level in LEVELS])
    time_ms = milliseconds(lambda: seen.expected_time(0.05))
    return [
        {"work": "CVaR of 64 × 64 cells, 10 components", "ms": one, "peer": "30 halvings", "peer_ms": peer},
        {"work": "the same at 5 levels", "ms": five, "peer": "30 halvings, 5 times", "peer_ms": 5 * peer},
        {"work": "expected time of the same cells", "ms": time_ms, "peer": "", "peer_ms": float("nan")},
    ]


def environments(size: int = 512) -> list[dict[str, Any]]:
    envs = gymnasium.make_vec(
        "benchnav/OffRoad-v0", num_envs=size, vectorization_mode="vector_entry_point", data="paper-v1-test",
        split="test/std", world="paper",
    )  # fmt: skip
    envs.reset(seed=0)
    own: Any = envs.unwrapped
    still = np.zeros(envs.action_space.shape, np.float32)

    def with_reset() -> None:
        own._ended[7] = True  # as if its episode had ended with the last step
        envs.step(still)

    plain, anew = milliseconds(lambda: envs.step(still), 15), milliseconds(with_reset, 15)
    return [
        {"work": f"vector environment, {size}, a step", "ms": plain, "peer": "", "peer_ms": float("nan")},
        {
            "work": "the same, one of them begins anew",
            "ms": anew, "peer": "none does", "peer_ms": plain,
        },
    ]  # fmt: skip


def commands() -> list[dict[str, Any]]:
    rows = []
    folder = Path(sys.executable).parent
    bare = milliseconds(lambda: subprocess.run([sys.executable, "-c", ""], check=True), 5)
    show = f"benchnav-datagen show {find_dataset('paper-v1-test')}"
    for command in (*COMMANDS, show):
        name, *arguments = command.split()
        run = [str(folder / name), *arguments]
        own = milliseconds(lambda run=run: subprocess.run(run, check=True, capture_output=True), 5)  # type: ignore[misc]
        shown = " ".join((name, *(Path(argument).name for argument in arguments)))
        rows.append({"work": shown, "ms": own, "peer": "bare Python", "peer_ms": bare})
    return rows


def main() -> None:
    torch.set_num_threads(1)
    rows = [*planners(), *risk_maps(), *environments(), *commands()]
    table = Table("work", "ms", "peer", "its ms", "times as fast")
    for row in rows:
        known = row["peer_ms"] == row["peer_ms"]
        ratio = f"{row['peer_ms'] / row['ms']:.2g}" if known else ""
        table.add_row(
            row["work"], f"{row['ms']:.3g}", row["peer"], f"{row['peer_ms']:.3g}" if known else "", ratio
        )
    Console().print(table)
    if len(sys.argv) > 1:
        about = {
            "python": platform.python_version(),
            "torch": torch.__version__,
            "machine": platform.machine(),
        }
        plain = [{name: None if value != value else value for name, value in row.items()} for row in rows]
        Path(sys.argv[1]).write_text(json.dumps({"about": about, "rows": plain}, indent=1))


if __name__ == "__main__":
    main()
