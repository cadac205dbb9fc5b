"""Controls of the study of knowledge: a robot that learns what is not so, and one that
plans anew for nothing.

`primary.yaml` names them as `benchmarks/knowledge_parts.py:NAME`, where they were when
it was fixed; `study.yaml` says where they are.
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
    """The probe, of another draw of λ than the one that is driven on: what it tells is
    as plausible, and not so.

    The draw has the true distribution of each cell and the world's correlation; it is
    not rejected where no path is feasible.

    Args:
        correlation_m: ℓ of the draw.
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
        other = torch.full_like(field, torch.nan)
        drawn = torch.from_numpy(scores).to(field)[near]
        other[near] = terrain.truth.at(near).from_normal(drawn[None])[0].to(field.dtype)
        return super().sense(terrain, other, robot_state, noise_key)


@lru_cache(maxsize=256)
def _scores(key: int, shape: tuple[int, int], correlation_cells: float) -> np.ndarray:
    """Normal scores of an episode's other draw; kept, since every step asks for them."""
    return correlated_normal(
        rng.stream_key(key, "elsewhere"), np.arange(1), shape, correlation_cells
    )[0]


class Revising(AStarDWA):
    """A\\*+DWA that revises its plan as often as a robot that learns, though nothing is
    learnt.
    """

    def plan(self, step: Any, plan_state: Any) -> Any:
        problem = plan_state.problem
        every = steps_in(problem.task.rules.replan_every_s, problem.dt_s)
        if round(step.time_s / problem.dt_s) % every == 0:
            problem = replace(problem, start=step.state)
            # Maps are searched that have changed: all have, if all ground was of the
            # other kind.
            changed = replace(plan_state, problem=replace(problem, free=~problem.free))
            plan_state = self.revise(changed, problem)
        return super().plan(step, plan_state)
