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
    "straight\nline free",
)
_NOTES = (
    "stuck: true mean λ ≤ λ_stuck. soft ground: classes with soft spots. soft spots: "
    "expected part of all cells.",
    "time s: fastest path around stuck cells, in solvable splits. straight line free: "
    "maps with no stuck cell on it.",
)


def of_split(dataset: TerrainDataset, split: str) -> Maps:
    """Return the results of `measure` for all maps of a split, read in chunks.

    Raises:
        DatasetError: If the dataset has no such split, or its data are damaged.
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
    measured = [measure(maps, dataset.recipe) for _, maps in chunks]
    return join_maps(measured)


def measure(maps: Maps, recipe: Recipe) -> Maps:
    """Return measures of the difficulty of maps.

    Args:
        maps: stored fields `class_id`, `slope_deg`, `start_m`, `goal_m` and
            `reference_time_s`, and the fields of `schema.TRUTH`, if the dataset has
            them.
        recipe: recipe of the maps, with the class table, resolution and λ_stuck.

    Returns:
        Arrays of shape [B] by name; fractions are of all labelled cells of a map:
            stuck: fraction of cells whose true E[λ] is at most λ_stuck.
            soft_ground: fraction of cells whose class has soft spots.
            soft_spots: expected fraction of soft spots over all draws of λ.
            straight: whether all cells of the straight line from start to goal have a
                true E[λ] above λ_stuck.
            reference_times_s: grid reference time in seconds, non-finite if missing.
    """
    truth = latent.stored_truth(maps, recipe.classes)
    expected = latent.expected_of(truth)
    stuck = expected <= recipe.stuck_threshold  # False at NaN
    weights = truth[0]
    # The first component is firm terrain; a second one is soft spots.
    soft_weight = weights[:, 1:].sum(axis=1)
    labelled = maps["class_id"] != UNLABELLED
    n_labelled = labelled.sum(axis=(1, 2))
    divisor = np.maximum(1, n_labelled)
    on_line = crossed_cells(recipe.grid, maps["start_m"], maps["goal_m"])
    blocked = stuck & on_line

    def mean(values: ndarray) -> ndarray:
        total = (values * labelled).sum(axis=(1, 2))
        return total / divisor

    return {
        "stuck": mean(stuck),
        "soft_ground": mean(soft_weight > 0),
        "soft_spots": mean(soft_weight),
        "straight": ~blocked.any(axis=(1, 2)),
        "reference_times_s": maps["reference_time_s"].astype(np.float64),
    }


def crossed_cells(grid: Grid, start_m: ndarray, goal_m: ndarray) -> ndarray:
    """Return a mask of the cells that straight lines cross.

    A line along the border of two cells crosses the cell with the larger index, since
    a position on the border belongs to that cell. A line that only touches a cell's
    corner does not cross the cell.

    Args:
        grid: size and resolution of the maps.
        start_m: one end (x, y) of each line in metres, shape [B, 2].
        goal_m: the other end in metres, shape [B, 2].

    Returns:
        bool, shape [B, H, W].
    """
    start = start_m.astype(np.float64) / grid.resolution_m
    goal = goal_m.astype(np.float64) / grid.resolution_m
    along = goal - start
    # Intersections of the lines with the borders of rows and columns, as fractions of
    # a line's length. A line along a border counts as beyond it: 0/0 becomes −∞.
    borders = np.arange(max(grid.shape) + 1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        crossings = (borders - start[..., None]) / along[..., None]
    crossings = np.nan_to_num(crossings, nan=-np.inf)
    lower = crossings[..., :-1]
    upper = crossings[..., 1:]
    first = np.minimum(upper, lower).clip(0, 1)
    last = np.maximum(upper, lower).clip(0, 1)
    x_in, y_in = np.moveaxis(first, 1, 0)
    x_out, y_out = np.moveaxis(last, 1, 0)
    columns = np.s_[:, None, : grid.width]
    rows = np.s_[:, : grid.height, None]
    enter = np.maximum(x_in[columns], y_in[rows])
    leave = np.minimum(x_out[columns], y_out[rows])
    # At a cell's corner, the intersections with the borders of the row and the column
    # may differ by a rounding error.
    return leave - enter > 1e-12


def table(dataset: TerrainDataset) -> Table:
    """Return a table of the difficulty of each split of a dataset."""
    stuck = dataset.recipe.stuck_threshold
    rows = []
    for split in dataset.splits:
        measured = of_split(dataset, split)
        percent = []
        for name in ("stuck", "soft_ground", "soft_spots"):
            mean = measured[name].mean()
            percent.append(f"{100 * mean:.1f}")
        times = measured["reference_times_s"]
        times = times[np.isfinite(times)]
        median = NOTHING
        time_range = NOTHING
        if len(times):
            median = f"{np.median(times):.1f}"
            time_range = f"{times.min():.1f}–{times.max():.1f}"
        straight = measured["straight"]
        straight_free = f"{straight.sum()}/{len(straight)}"
        rows.append((split, *percent, median, time_range, straight_free))
    return Table(
        title=f"difficulty of the maps (λ_stuck {stuck:g})",
        headings=_HEADINGS,
        numbers=True,
        rows=tuple(rows),
        notes=_NOTES,
    )
