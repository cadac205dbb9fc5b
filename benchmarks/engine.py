"""Time of planners, risk measures, environments and commands, compared with a peer.

    python -m benchmarks.engine [FILE.json]

All run on one thread. Each figure is the median of the repeats, on maps of
`paper-v1-test`. Ratios are to the median of the peer in the same run. The peers are:

- MPPI: the same rollouts in ten lines of plain PyTorch, with the same number of normal
  draws per step;
- MPPI with risk on the cost: the same number of rollouts on the risk map;
- A*+DWA: the same planner uncompiled;
- the optimal planner: the A* search of the map;
- risk maps: thirty bisections per cell;
- the environment: a step without a reset.
"""

import json
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
import torch
from torch import Tensor

from benchmarks.timing import milliseconds, plan_ms, problem_of, show
from benchnav import TraversabilityMixture
from benchnav.datagen import TerrainDataset, find_dataset
from benchnav.models import load_model, predict
from benchnav.planning import MPPI, AStarDWA, MPPIConfig, Optimal, Problem

LEVELS = (0.3, 0.5, 0.7, 0.9, 0.95)
COMMANDS = (
    "benchnav-datagen --help",
    "benchnav-train --help",
    "benchnav-eval --help",
    "benchnav-datagen list",
)


def row(
    work: str, ms: float, peer: str = "", peer_ms: float = float("nan")
) -> dict[str, Any]:
    """Return a row of the table, with times in milliseconds."""
    return {"work": work, "ms": ms, "peer": peer, "peer_ms": peer_ms}


def plain_mppi(
    problem: Problem, mean: Tensor, generator: torch.Generator, samples: int = 5000
) -> Tensor:
    """Plan a step of one episode with MPPI in plain PyTorch, the peer."""
    ground, resolution = problem.risk_map[0], problem.grid.resolution_m
    noise = torch.randn((mean.shape[0], 2, samples), generator=generator) * 0.5
    x, y, heading = (value.expand(samples) for value in problem.start[0, :3])
    cost = torch.zeros(samples)
    speed = (mean[:, 0, None] + noise[:, 0]).clamp(0, 1)
    turn = (mean[:, 1, None] + noise[:, 1]).clamp(-1, 1)
    for v, w in zip(speed, turn, strict=True):
        row, column = (
            (y / resolution).long().clamp(0, 63),
            (x / resolution).long().clamp(0, 63),
        )
        traversability = ground[row, column]
        cost = cost + torch.hypot(x - problem.goal_m[0, 0], y - problem.goal_m[0, 1])
        cost = cost + 1e4 * (traversability <= 0.3)
        advance = 0.1 * traversability * v
        x = x + advance * heading.cos()
        y = y + advance * heading.sin()
        heading = heading + 0.1 * traversability * w
    weights = torch.softmax(-cost / 0.5, dim=0)
    return torch.stack(((speed * weights).sum(1), (turn * weights).sum(1)), dim=1)


def halved_cvar(mixture: TraversabilityMixture, tail: float) -> Tensor:
    """Return CVaR by thirty bisections in float64, the peer."""
    weights, means, stds = (
        values[0].double() for values in (mixture.weights, mixture.means, mixture.stds)
    )

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
    """Measure a step of each planner per episode, with one episode and with twenty."""
    single, twenty, ten = problem_of(1), problem_of(20), problem_of(10)
    mean, generator = torch.zeros(50, 2), torch.Generator().manual_seed(0)
    peer = milliseconds(lambda: plain_mppi(single, mean, generator))
    on_cost = MPPIConfig(samples=1024, risk_on="cost", level=0.8, fields=64)
    on_map = MPPIConfig(samples=1024 * 64)
    again = "the same, per episode of a batch of 20"
    rows = [
        row(
            "MPPI 5 000 × 50, one episode",
            plan_ms(MPPI(), single),
            "plain PyTorch",
            peer,
        ),
        row(again, plan_ms(MPPI(), twenty), "plain PyTorch", peer),
    ]
    for name, problem in (("MPPI 1 024 × 50 on 64 fields", single), (again, twenty)):
        ms, peer = (plan_ms(MPPI(config), problem) for config in (on_cost, on_map))
        rows.append(row(name, ms, "as many on the map", peer))
    ms, peer = (
        milliseconds(lambda planner=planner: planner.init(ten, torch.Generator()), 3)
        / 10
        for planner in (Optimal(), AStarDWA())
    )
    rows.append(row("optimal, a map of 10", ms, "A*", peer))
    for name, problem in (("A*+DWA step, one episode", single), (again, twenty)):
        ms = plan_ms(AStarDWA(), problem)
        with torch._dynamo.config.patch(disable=True):
            rows.append(row(name, ms, "uncompiled", plan_ms(AStarDWA(), problem)))
    return rows


def risk_maps() -> list[dict[str, Any]]:
    """Measure risk maps of 64 × 64 cells with 10 components."""
    mixture = predict(
        load_model("paper-v1"),
        TerrainDataset(find_dataset("paper-v1-test")).terrain("test/hs", [0]),
    )
    peer_ms = milliseconds(lambda: halved_cvar(mixture, 0.1))
    five_levels_ms = milliseconds(lambda: [mixture.cvar(level) for level in LEVELS])
    return [
        row(
            "CVaR of 64 × 64 cells, 10 components",
            milliseconds(lambda: mixture.cvar(0.9)),
            "30 halvings",
            peer_ms,
        ),
        row(
            "the same at 5 levels", five_levels_ms, "30 halvings, 5 times", 5 * peer_ms
        ),
        row(
            "expected time of the same cells",
            milliseconds(lambda: mixture.expected_time(0.05)),
        ),
    ]


def environments(size: int = 512) -> list[dict[str, Any]]:
    """Measure a step of the vector environment without and with a reset."""
    envs = gymnasium.make_vec(
        "benchnav/OffRoad-v0",
        num_envs=size,
        vectorization_mode="vector_entry_point",
        data="paper-v1-test",
        split="test/std",
        world="paper",
    )
    envs.reset(seed=0)
    vector_env: Any = envs.unwrapped
    no_motion = np.zeros(envs.action_space.shape, np.float32)

    def with_reset() -> None:
        vector_env._ended[7] = True  # as if its episode had ended with the last step
        envs.step(no_motion)

    plain, reset = (
        milliseconds(lambda: envs.step(no_motion), 15),
        milliseconds(with_reset, 15),
    )
    name = f"vector environment, {size}, a step"
    return [
        row(name, plain),
        row("the same, one of them is reset", reset, "none is", plain),
    ]


def commands() -> list[dict[str, Any]]:
    """Measure commands, each as a whole process."""

    def process_ms(program: str, *words: str) -> float:
        command = [Path(sys.executable).with_name(program), *words]
        return milliseconds(
            lambda: subprocess.run(command, check=True, capture_output=True), 5
        )

    bare = process_ms(Path(sys.executable).name, "-c", "")
    data = find_dataset("paper-v1-test")
    rows = [
        row(command, process_ms(*command.split()), "bare Python", bare)
        for command in COMMANDS
    ]
    show_ms = process_ms("benchnav-datagen", "show", str(data))
    return [
        *rows,
        row(f"benchnav-datagen show {data.name}", show_ms, "bare Python", bare),
    ]


def main() -> None:
    """Print the table, and write it to the file if one is given."""
    torch.set_num_threads(1)
    rows = [*planners(), *risk_maps(), *environments(), *commands()]
    show([entry | {"times as fast": entry["peer_ms"] / entry["ms"]} for entry in rows])
    if len(sys.argv) > 1:
        versions = {
            "python": platform.python_version(),
            "torch": torch.__version__,
            "machine": platform.machine(),
        }
        plain = json.loads(pd.DataFrame(rows).to_json(orient="records"))
        Path(sys.argv[1]).write_text(
            json.dumps({"about": versions, "rows": plain}, indent=1)
        )


if __name__ == "__main__":
    main()
