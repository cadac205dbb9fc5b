"""Small terrains, problems and datasets for the tests."""

from dataclasses import replace
from pathlib import Path

import torch

from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Observation, Terrain
from benchnav.datagen.files.create import create
from benchnav.datagen.recipe.load import shipped_recipe
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.planning.free_space import Rules
from benchnav.planning.objective import GoalDistance, Objective
from benchnav.planning.problem import Prediction, Problem, Task, pose_problem
from benchnav.planning.robots import Robot, Unicycle
from benchnav.planning.world.world import Endpoints

GRID = Grid(16, 16, 0.5)


def normal(mean: torch.Tensor, std: torch.Tensor) -> TraversabilityMixture:
    """One Gaussian a cell, clipped to [0, 1], from maps [B, H, W]."""
    means = mean.unsqueeze(1)
    return TraversabilityMixture(torch.ones_like(means), means, std.unsqueeze(1), (0,))


def draw(
    mixture: TraversabilityMixture, count: int, generator: torch.Generator
) -> torch.Tensor:
    """Draws λ independently in each cell, component first, shape [count, *B, H, W]."""
    shape, expanded = (
        (count, *mixture.weights.movedim(-3, 0).shape[1:]),
        (count, *mixture.weights.shape),
    )
    pick = torch.rand(shape, generator=generator, dtype=mixture.weights.dtype)
    edges = mixture.weights.cumsum(-3)
    component = (
        (pick.unsqueeze(-3) >= edges)
        .sum(-3, keepdim=True)
        .clamp(max=edges.shape[-3] - 1)
    )
    mean, std = (
        torch.gather(values.expand(expanded), -3, component).squeeze(-3)
        for values in (mixture.means, mixture.stds)
    )
    noise = torch.randn(shape, generator=generator, dtype=mixture.weights.dtype)
    return (mean + std * noise).clamp(0, 1)


def terrain(mean: torch.Tensor, std: float = 0.1) -> Terrain:
    """Flat terrain of one class with the given latent traversability, shape [B, H, W]."""
    batch, height, width = mean.shape
    flat = torch.zeros_like(mean)
    return Terrain(
        rgb=torch.full((batch, 3, height, width), 128, dtype=torch.uint8),
        class_id=flat.long(),
        elevation_m=flat,
        slope_deg=flat,
        truth=normal(mean, torch.full_like(mean, std)),
        traversability=mean.clamp(0, 1),
        grid=Grid(height, width, 0.5),
    )


def places(goal_m: torch.Tensor, start_m: torch.Tensor | None = None) -> Endpoints:
    """Goals [B, 2], with starts at (1.25, 1.25) unless they are given, and no reference
    times.
    """
    start_m = torch.full_like(goal_m, 1.25) if start_m is None else start_m
    return Endpoints(
        start_m=start_m,
        goal_m=goal_m,
        reference_time_s=torch.full_like(goal_m[:, 0], torch.nan),
    )


def task(
    robot: Robot | None = None,
    objective: Objective | None = None,
    rules: Rules | None = None,
) -> Task:
    """The paper's task, with some of its parts replaced."""
    return Task(
        robot=robot or Unicycle(),
        objective=objective or GoalDistance(),
        rules=rules or Rules(),
    )


def certain(traversability: torch.Tensor) -> TraversabilityMixture:
    """A prediction without doubt, from λ of shape [B, H, W]."""
    means = traversability.unsqueeze(1)
    return TraversabilityMixture(
        torch.ones_like(means), means, torch.zeros_like(means), (0,)
    )


def problem(
    traversability: torch.Tensor,
    start: tuple[float, float] = (1.25, 1.25),
    goal: tuple[float, float] = (6.75, 6.75),
    robot: Robot | None = None,
    objective: Objective | None = None,
    rules: Rules | None = None,
    elevation_m: torch.Tensor | None = None,
    time_budget_s: float = 100.0,
) -> Problem:
    """A problem on maps with the given λ̂, shape [B, H, W], flat unless elevations are
    given.
    """
    batch, height, width = traversability.shape
    start_m, goal_m = (
        torch.tensor([position] * batch, dtype=torch.float32)
        for position in (start, goal)
    )
    flat = torch.zeros_like(traversability)
    rgb = torch.full((batch, 3, height, width), 128, dtype=torch.uint8)
    elevation_m = flat if elevation_m is None else elevation_m
    observation = Observation(rgb, elevation_m, flat, Grid(height, width, 0.5))
    made = task(robot, objective, rules)
    prediction = Prediction(observation, certain(traversability), traversability)
    return pose_problem(made, prediction, start_m, goal_m, time_budget_s)


def tiny_recipe(**maps: int) -> Recipe:
    """The shipped `tiny-v1` with fewer maps; keyword names have `_` for `/` in split
    names.
    """
    recipe = shipped_recipe("tiny-v1")
    sizes = {"train": 8, "valid": 3, "test_std": 2, "test_hg": 2, "test_hs": 2} | maps
    splits = {
        name: replace(split, maps=sizes[name.replace("/", "_")])
        for name, split in recipe.splits.items()
    }
    return replace(recipe, splits=splits)


def tiny_dataset(path: Path, recipe: Recipe | None = None, jobs: int = 1) -> Path:
    """Writes a dataset of `tiny_recipe` and gives its path."""
    for _ in create(recipe or tiny_recipe(), path, jobs=jobs):
        pass
    return path
