"""Coverage of the intervals of a belief, with `oracle` and a trained model.

Robots plan with A*+DWA under `expected-time` and learn with `copula`. At four times of
each episode, drawn in advance, every unobserved cell within 2ℓ of the robot is checked:
is λ in the central 90 % interval of the belief? If λ is at an atom, its rank within the
atom is drawn (randomised PIT). The table has the fraction of cells with its 95 %
interval by maps (of a ratio of sums over maps), the fractions below and above the
interval, and the mean log scores of the belief and of the prediction.

In the world `stakes`, draws of λ without a feasible path are rejected. The covariance
model does not account for that. The rows `no draw rejected` are of a world that rejects
no draw and immobilises no robot. The table `rejection` quantifies the effect on λ: over
40 draws per map, the differences of E[λ] and P(λ < 0.1) between accepted draws and all,
within 3 m of the straight line from start to goal and elsewhere.

Sums of each unit are stored in the run's folder, so that an interrupted run resumes.
Delete the folder when the code has changed. The first 200 of 400 maps take 25 minutes
on one core, the fine maps 15.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import track
from torch import Tensor

from benchnav import Grid
from benchnav.core import rng
from benchnav.core.copula import correlated_normal
from benchnav.eval import Suite
from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.unit import Extent, Unit, units
from benchnav.eval.run.knowledge import KnowledgeTracker
from benchnav.eval.run.rollout import Observer
from benchnav.eval.run.unit import Settings, UnitInputs, read_block, simulate
from benchnav.planning.world.realisation import are_connected
from studies.study import Rows, Work
from studies.units import build_unit, one_unit, stakes_suite

MODELS = ("oracle", "stakes-v1")
GROUNDS = ("contact", "probe:1", "probe:2")
TIMES, LATEST_S = 4, 40.0
NEAR_M = 3.0  # 2ℓ
LAW = {"preset": "stakes", "immobile": None}
DRAWS = 40  # per map, for the table `rejection`


class Coverage:
    """Observer that sums cells and scores of a unit's episodes by map, shape [B, 6].

    The sums are of: cells, cells inside, below and above the interval, log scores of
    the belief, log scores of the prediction.
    """

    def __init__(self, unit: Unit, built: UnitInputs) -> None:
        """Draw the times at which the belief is checked."""
        assert built.learning is not None
        assert built.simulation.field is not None
        self._problem = built.problem
        self._learner = built.learning.learner
        self._field = built.simulation.field
        maps = np.array(unit.maps)
        dt_s = built.problem.dt_s
        # Checks are at steps at which robots may replan.
        replan_steps = round(unit.condition.rules.replan_every_s / dt_s)
        uniform = rng.uniform(rng.stream_key(0, "coverage"), maps, (TIMES,))
        steps = replan_steps * np.ceil(uniform * LATEST_S / dt_s / replan_steps)
        rank = rng.uniform(rng.stream_key(0, "rank"), maps, built.problem.grid.shape)
        self._steps = torch.from_numpy(steps).long()
        self._rank = torch.from_numpy(rank)
        self.sums = torch.zeros(len(maps), 6, dtype=torch.float64)

    def __call__(self, step: int, knowing: KnowledgeTracker) -> None:
        """Add the scores of robots that are still driving and have a check now."""
        knowledge, members = knowing.known, knowing.episode_indices
        footprint = knowledge.footprint
        has_check = (self._steps[members] == step).any(1)
        is_checked = has_check & footprint.flatten(1).any(1)
        cells = _near(footprint, self._problem.grid.resolution_m)
        cells &= ~knowledge.ever_sensed
        cells &= is_checked[:, None, None]
        if not bool(cells.any()):
            return
        value = self._field[members][cells][None]
        member = members[cells.nonzero()[:, 0]]
        rank = self._rank[members][cells][None]
        believed = self._learner.distribution(knowledge).at(cells)
        low, high = believed.cdf_limits(value)
        pit = torch.lerp(low.double(), high.double(), rank)
        predicted = self._problem.distribution.select(members).at(cells)
        scores = (
            torch.ones_like(pit),
            (pit - 0.5).abs() <= 0.45,
            pit < 0.05,
            pit > 0.95,
            believed.log_prob(value).clamp(min=-10),
            predicted.log_prob(value).clamp(min=-10),
        )
        self.sums.index_add_(
            0, member, torch.stack([part[0].double() for part in scores], 1)
        )


def _near(reached: Tensor, resolution_m: float) -> Tensor:
    """Return a mask of cells within `NEAR_M` of a footprint's centre, [B, H, W]."""
    row, column = (
        torch.arange(size, dtype=torch.float64) for size in reached.shape[1:]
    )
    count = reached.flatten(1).sum(1).clamp(min=1)
    middle = [
        (reached.sum(axis) * line).sum(1) / count
        for axis, line in ((2, row), (1, column))
    ]
    down = (row - middle[0][:, None])[:, :, None]
    across = (column - middle[1][:, None])[:, None]
    return torch.hypot(down, across) * resolution_m <= NEAR_M


def suite_of(data: Path, models: Sequence[str] = MODELS) -> Suite:
    """Return the suite of models, sensors and worlds."""
    common: dict[str, Any] = {"grounds": list(GROUNDS), "beliefs": ("copula",)}
    return stakes_suite(
        data,
        planners=("astar_dwa",),
        risks=("expected-time",),
        seeds=(),
        world="paper",
        conditions=(
            {"models": list(models), "world": "stakes", **common},
            {"models": ["oracle"], "world": LAW, **common},
        ),
    )


def sums_of(unit: Unit, settings: Settings, out: Path) -> Tensor:
    """Return the sums of a unit's episodes, read if they are stored, shape [B, 6]."""
    path = out / f"{unit.condition.id}-{unit.maps[0]}-{unit.maps[-1]}.npy"
    if not path.exists():
        built = build_unit(unit)
        coverage = Coverage(unit, built)
        simulate(unit, built, settings, observer=Observer(knowledge=coverage))
        part = path.with_suffix(".part.npy")
        np.save(part, coverage.sums.numpy())
        part.replace(path)
    return torch.from_numpy(np.load(path))


def measured(suite: Suite, maps: int, out: Path) -> Rows:
    """Return one row of coverage per condition."""
    conditions = {
        condition.id: (condition, Extent.product((0,), 1, maps))
        for condition in conditions_of(suite, lambda data: ["std"])
    }
    settings, sums_by_condition = Settings(), dict[str, list[Tensor]]()
    for unit in track(units(conditions), "units"):
        sums_by_condition.setdefault(unit.condition.id, []).append(
            sums_of(unit, settings, out)
        )
    rows = []
    for key, parts in sums_by_condition.items():
        labels, sums = conditions[key][0].labels, torch.cat(parts).numpy()
        cells = sums[:, 0].sum()
        inside, under, over, score, of_prediction = sums[:, 1:].sum(0) / cells
        # Standard error of a ratio of sums over maps, from the residuals of the maps.
        residual = sums[:, 1] - inside * sums[:, 0]
        error = 1.96 * np.sqrt((residual**2).sum()) / cells
        rows.append(
            {
                "model": labels["model"],
                "λ": "no draw rejected"
                if "immobile" in labels["world"]
                else "with rejection",
                "ground": labels["ground"],
                "cells": f"{cells:.0f}",
                "inside 90 % (95 % interval)": f"{inside:.3f} ({inside - error:.3f} "
                "to "
                f"{inside + error:.3f})",
                "under": f"{under:.3f}",
                "over": f"{over:.3f}",
                "log score": f"{score:.2f}",
                "of the prediction": f"{of_prediction:.2f}",
            }
        )
    return rows


def rejection(data: Path, maps: int) -> Rows:
    """Return the effect of rejecting draws on the distribution of λ."""
    first_unit = one_unit(suite_of(data), maps)
    world = first_unit.condition.world
    assert world.immobile is not None
    changes, n_rejected = [], 0
    for first in track(range(0, maps, 50), "draws"):
        unit = replace(first_unit, maps=tuple(range(first, min(first + 50, maps))))
        block = read_block(unit, Settings().origins().of(unit))
        grid, truth = block.terrain.grid, block.terrain.truth
        length = world.correlation_m / grid.resolution_m
        sums = torch.zeros(2, 3, *truth.shape, dtype=torch.float64)
        for draw in range(DRAWS):
            key = rng.stream_key(draw, "rejection")
            scores = correlated_normal(key, np.array(unit.maps), grid.shape, length)
            field = truth.from_normal(torch.from_numpy(scores).float()).double()
            is_immobile = field < world.immobile.below
            is_kept = are_connected(~is_immobile, grid, block.endpoints)
            drawn = torch.stack((torch.ones_like(field), field, is_immobile.double()))
            sums += torch.stack((drawn, drawn * is_kept[:, None, None]))
            n_rejected += int((~is_kept).sum())
        all_draws, kept_draws = (part[1:] / part[0].clamp(min=1) for part in sums)
        near = _near_line(block.endpoints.start_m, block.endpoints.goal_m, grid)
        # Maps whose draws were all rejected have no accepted λ to compare.
        for index in sums[1, 0].flatten(1).amax(1).nonzero()[:, 0].tolist():
            change = (kept_draws - all_draws)[:, index]
            changes.append(
                [
                    change[:, cells].mean(1).tolist()
                    for cells in (near[index], ~near[index])
                ]
            )
    return [
        {
            "draws rejected": f"{n_rejected / DRAWS / maps:.1%}",
            "cells": cells,
            "change of E[λ]": f"{mean:+.4f}",
            f"of P(λ < {world.immobile.below:g})": f"{probability:+.4f}",
        }
        for cells, (mean, probability) in zip(
            ("near the straight line", "elsewhere"),
            np.mean(changes, axis=0),
            strict=True,
        )
    ]


def _near_line(start_m: Tensor, goal_m: Tensor, grid: Grid) -> Tensor:
    """Return a mask of cells within `NEAR_M` of the line from start to goal, [B, H, W]."""
    row, column = torch.meshgrid(*map(torch.arange, grid.shape), indexing="ij")
    cell = torch.stack(grid.centre_of(row, column), -1)[None].double()
    start, line = (
        start_m.double()[:, None, None],
        (goal_m - start_m).double()[:, None, None],
    )
    part = (((cell - start) * line).sum(-1) / line.square().sum(-1)).clamp(0, 1)
    return (
        torch.linalg.vector_norm(cell - start - part[..., None] * line, dim=-1)
        <= NEAR_M
    )


def coverage(
    work: Work, folder: Path, data: str, maps: int, models: Sequence[str] = MODELS
) -> dict[str, Rows]:
    """Return the tables `rejection` and `coverage` on the first maps of a dataset."""
    path = work.maps_in / f"{data}.h5"
    return {
        "rejection": rejection(path, maps),
        "coverage": measured(suite_of(path, models), maps, folder),
    }
