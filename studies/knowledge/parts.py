"""Controls of the study of knowledge: false measurements, and replanning without news.

`primary.yaml` names them as `benchmarks/knowledge_parts.py:NAME`, which was their path
when the suite was fixed; `study.yaml` maps that path to this file.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchnav import Terrain
from benchnav.core import rng
from benchnav.core.copula import correlated_normal
from benchnav.planning import AStarDWA, Measurement, NoiseKey, Probe
from benchnav.planning.robots import steps_in


@dataclass(frozen=True)
class Elsewhere(Probe):
    """Probe that measures another draw of λ than the robot drives on.

    Its measurements are plausible but false. The draw has the true distribution of each
    cell and the world's correlation. It is not rejected if no path is feasible.

    Args:
        correlation_m: correlation length ℓ of the draw, in metres.
    """

    correlation_m: float = 1.5

    def sense(
        self, terrain: Terrain, field: Tensor, robot_state: Tensor, noise_key: NoiseKey
    ) -> Measurement:
        near = self._in_range(terrain, robot_state)
        cells = self.correlation_m / terrain.grid.resolution_m
        scores = np.stack(
            [_scores(key, terrain.grid.shape, cells) for key in noise_key.keys]
        )
        other_field = torch.full_like(field, torch.nan)
        drawn = torch.from_numpy(scores).to(field)[near]
        other_field[near] = (
            terrain.truth.at(near).from_normal(drawn[None])[0].to(field.dtype)
        )
        return super().sense(terrain, other_field, robot_state, noise_key)


@lru_cache(maxsize=256)
def _scores(key: int, shape: tuple[int, int], correlation_cells: float) -> np.ndarray:
    """Return the normal scores of an episode's false draw, cached for its steps."""
    return correlated_normal(
        rng.stream_key(key, "elsewhere"), np.arange(1), shape, correlation_cells
    )[0]


class Revising(AStarDWA):
    """A\\*+DWA that replans as often as a robot that learns, without new observations."""

    def plan(self, step: Any, plan_state: Any) -> Any:
        problem = plan_state.problem
        replan_steps = steps_in(problem.task.rules.replan_every_s, problem.dt_s)
        if round(step.time_s / problem.dt_s) % replan_steps == 0:
            problem = replace(problem, start=step.state)
            # Only changed maps are searched again. Inverting the free mask marks all
            # of them as changed.
            changed = replace(plan_state, problem=replace(problem, free=~problem.free))
            plan_state = self.revise(changed, problem)
        return super().plan(step, plan_state)
