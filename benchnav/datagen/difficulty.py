"""Difficulty of the maps of a dataset, split by split.

It is measured before training and evaluation: if a straight line to the goal is free on
nearly every map, planners have nothing to plan. Letters in shapes: B maps, H×W cells.
"""

import numpy as np
from numpy import ndarray

from benchnav.core.grid import Grid
from benchnav.core.tables import NOTHING, Table
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe import latent
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.schema import UNLABELLED, Maps, join_maps

_HEADINGS = (
    "split",
    "stuck\n%",
    "soft\nground %",
    "soft\nspots %",
    "time s,\nmedian",
    "time s,\nrange",
    "straight\nfree",
)
_NOTES = (
    "stuck: true mean λ ≤ λ_stuck. soft ground: classes with soft spots, which no "
    "colour shows. soft spots: of all.",
    "time s: fastest path around stuck cells (solvable splits). straight free: maps "
    "with no stuck cell on the line.",
)


def of_split(dataset: TerrainDataset, split: str) -> Maps:
    """Return the difficulty of all maps of a split, measured in chunks; see `measure`.

    Raises:
        DatasetError: If there is no such split, or its data are damaged.
    """
    fields = (
        "class_id",
        "slope_deg",
        "start_m",
        "goal_m",
        "reference_time_s",
        *dataset.truth_names,
    )
    chunks = dataset.chunks(split, fields)
    return join_maps([measure(maps, dataset.recipe) for _, maps in chunks])


def measure(maps: Maps, recipe: Recipe) -> Maps:
    """Return the difficulty of some maps.

    Args:
        maps: `class_id`, `slope_deg`, `start_m`, `goal_m` and `reference_time_s`, as
            stored, and the fields of `schema.TRUTH`, if the dataset has them.
        recipe: class table, resolution and λ_stuck.

    Returns:
        Arrays of shape [B]; fractions are relative to all labelled cells of a map:
            stuck: fraction of cells whose true E[λ] is at most λ_stuck.
            soft_ground: fraction of cells whose class has soft spots.
            soft_spots: expected fraction of soft spots over all draws of λ.
            straight: whether all cells of the straight line from start to goal have a
                true E[λ] above λ_stuck.
            reference_times_s: grid reference time, non-finite if it is missing.
    """
    truth = latent.stored_truth(maps, recipe.classes)
    stuck = latent.expected_of(truth) <= recipe.stuck_threshold  # False at NaN
    soft_weight = truth[0][:, 1:].sum(axis=1)
    labelled = maps["class_id"] != UNLABELLED
    on_line = crossed_cells(recipe.grid, maps["start_m"], maps["goal_m"])
    counts = np.maximum(1, labelled.sum(axis=(1, 2)))

    def mean(values: ndarray) -> ndarray:
        return (values * labelled).sum(axis=(1, 2)) / counts

    return {
        "stuck": mean(stuck),
        "soft_ground": mean(soft_weight > 0),
        "soft_spots": mean(soft_weight),
        "straight": ~(stuck & on_line).any(axis=(1, 2)),
        "reference_times_s": maps["reference_time_s"].astype(np.float64),
    }


def crossed_cells(grid: Grid, start_m: ndarray, goal_m: ndarray) -> ndarray:
    """Return a mask of the cells that straight lines cross.

    A line along a border between cells lies in the cells beyond it, as positions do. A
    corner that a line only touches is not crossed.

    Args:
        grid: size and resolution of the maps.
        start_m: (x, y) in metres, shape [B, 2].
        goal_m: (x, y) in metres, shape [B, 2].

    Returns:
        bool, shape [B, H, W].
    """
    start = start_m.astype(np.float64) / grid.resolution_m
    along = goal_m.astype(np.float64) / grid.resolution_m - start
    # Cuts with the borders of rows and columns, as fractions of the line's length; a
    # line along a border lies beyond it.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        cuts = (np.arange(max(grid.shape) + 1) - start[..., None]) / along[..., None]
    cuts = np.nan_to_num(cuts, nan=-np.inf)
    first = np.minimum(cuts[..., 1:], cuts[..., :-1]).clip(0, 1)
    last = np.maximum(cuts[..., 1:], cuts[..., :-1]).clip(0, 1)
    x_in, y_in = np.moveaxis(first, 1, 0)
    x_out, y_out = np.moveaxis(last, 1, 0)
    enter = np.maximum(x_in[:, None, : grid.width], y_in[:, : grid.height, None])
    leave = np.minimum(x_out[:, None, : grid.width], y_out[:, : grid.height, None])
    # Cuts of both kinds at a corner may differ in their last bits.
    return leave - enter > 1e-12


def table(dataset: TerrainDataset) -> Table:
    """Return a table of the difficulty of each split of a dataset."""
    stuck = dataset.recipe.stuck_threshold
    rows = []
    for split in dataset.splits:
        measured = of_split(dataset, split)
        percent = (
            f"{100 * measured[name].mean():.1f}"
            for name in ("stuck", "soft_ground", "soft_spots")
        )
        times = measured["reference_times_s"]
        times = times[np.isfinite(times)]
        median = time_range = NOTHING
        if len(times):
            median = f"{np.median(times):.1f}"
            time_range = f"{times.min():.1f}–{times.max():.1f}"
        straight = measured["straight"]
        straight_free = f"{straight.sum()}/{len(straight)}"
        rows.append((split, *percent, median, time_range, straight_free))
    return Table(
        title=f"how hard the maps are (λ_stuck {stuck:g})",
        headings=_HEADINGS,
        numbers=True,
        rows=tuple(rows),
        notes=_NOTES,
    )
