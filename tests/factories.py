"""Small terrains, problems and datasets for the tests."""

from dataclasses import replace
from pathlib import Path

import torch

from benchnav.datagen.create import create
from benchnav.datagen.scenario import Recipe, load_recipe
from benchnav.planning.dynamics import Unicycle
from benchnav.planning.objective import GoalDistance
from benchnav.planning.problem import Problem, heading_to
from benchnav.terrain import Grid, Terrain

GRID = Grid(16, 16, 0.5)


def terrain(mean: torch.Tensor, std: float = 0.1) -> Terrain:
    """Flat terrain of one class with the given latent traversability, shape [B, H, W]."""
    batch, height, width = mean.shape
    flat = torch.zeros_like(mean)
    return Terrain(
        rgb=torch.full((batch, 3, height, width), 128, dtype=torch.uint8),
        class_id=flat.long(),
        elevation_m=flat,
        slope_deg=flat,
        traversability_mean=mean,
        traversability_std=torch.full_like(mean, std),
        traversability=mean.clamp(0, 1),
        grid=Grid(height, width, 0.5),
    )


def problem(
    traversability: torch.Tensor,
    start: tuple[float, float] = (1.25, 1.25),
    goal: tuple[float, float] = (6.75, 6.75),
    **changes: object,
) -> Problem:
    """A problem on a flat map with the given λ̂, shape [B, H, W]."""
    batch, height, width = traversability.shape
    start_m, goal_m = (torch.tensor([position] * batch) for position in (start, goal))
    made = Problem(
        grid=Grid(height, width, 0.5),
        elevation_m=torch.zeros_like(traversability),
        traversability=traversability,
        dynamics=Unicycle(),
        objective=GoalDistance(),
        start=heading_to(start_m, goal_m),
        goal_m=goal_m,
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def tiny_recipe(**maps: int) -> Recipe:
    """The shipped `tiny-v1` with fewer maps; keyword names have `_` for `/` in split names."""
    recipe = load_recipe("tiny-v1")
    sizes = {"train": 8, "valid": 3, "test_std": 2, "test_hg": 2, "test_hs": 2} | maps
    splits = {
        name: replace(split, maps=sizes[name.replace("/", "_")]) for name, split in recipe.splits.items()
    }
    return replace(recipe, splits=splits)


def tiny_dataset(path: Path, recipe: Recipe | None = None, jobs: int = 1) -> Path:
    """Writes a dataset of `tiny_recipe` and gives its path."""
    for _ in create(recipe or tiny_recipe(), path, jobs=jobs):
        pass
    return path
