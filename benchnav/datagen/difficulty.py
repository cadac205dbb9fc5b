"""How hard the maps of a dataset are to cross, a split at a time.

Hard ground is told before anything is trained or driven on it: where a straight line to
the goal is free on nearly every map, no planner has anything to plan. Letters in
shapes: B maps, H×W cells.
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
# What columns hold.
_NOTES = (
    "stuck: true mean λ ≤ λ_stuck. soft ground: classes with soft spots, which no "
    "colour shows. soft spots: of all.",
    "time s: fastest path around stuck cells (solvable splits). straight free: maps "
    "with no stuck cell on the line.",
)


def of_split(dataset: TerrainDataset, split: str) -> Maps:
    """Measures all maps of a split, some at a time; see `measure`.

    Raises:
        DatasetError: there is no such split, or its data are damaged.
    """
    fields = (
        "class_id",
        "slope_deg",
        "start_m",
        "goal_m",
        "reference_time_s",
        *dataset.truth_names,
    )
    return join_maps(
        [measure(maps, dataset.recipe) for _, maps in dataset.chunks(split, fields)]
    )


def measure(maps: Maps, recipe: Recipe) -> Maps:
    """Measures what stands in a robot's way on some maps.

    Args:
        maps: `class_id`, `slope_deg`, `start_m`, `goal_m` and `reference_time_s`, as
            stored, and the fields of `schema.TRUTH` where the dataset has them.
        recipe: class table, resolution and λ_stuck.

    Returns:
        Of each map, arrays of shape [B]; shares are of the cells whose class is known:
            stuck: share of the cells whose true E[λ] is at most λ_stuck.
            soft_ground: share of the cells whose class has soft spots.
            soft_spots: share of the ground that is a soft spot, in the mean over all
                draws of λ.
            straight: whether all cells of the straight line from start to goal have a
                true E[λ] above λ_stuck.
            reference_times_s: grid reference time, not finite where there is none.
    """
    truth = latent.stored_truth(maps, recipe.classes)
    stuck = latent.expected_of(truth) <= recipe.stuck_threshold  # not where it is NaN
    spots = truth[0][:, 1:].sum(axis=1)  # weight of the soft spots
    labelled = maps["class_id"] != UNLABELLED
    on_line = crossed_cells(recipe.grid, maps["start_m"], maps["goal_m"])
    counts = np.maximum(1, labelled.sum(axis=(1, 2)))
    shares = {"stuck": stuck, "soft_ground": spots > 0, "soft_spots": spots}
    return {
        **{
            name: (values * labelled).sum(axis=(1, 2)) / counts
            for name, values in shares.items()
        },
        "straight": ~(stuck & on_line).any(axis=(1, 2)),
        "reference_times_s": maps["reference_time_s"].astype(np.float64),
    }


def crossed_cells(grid: Grid, start_m: ndarray, goal_m: ndarray) -> ndarray:
    """The cells that the straight line between two positions runs through.

    A line along a border between cells lies in those beyond it, as positions do; a
    corner that is only touched is not run through.

    Args:
        grid: size and resolution.
        start_m: (x, y), shape [B, 2].
        goal_m: (x, y), shape [B, 2].

    Returns:
        bool, shape [B, H, W].
    """
    start = start_m.astype(np.float64) / grid.resolution_m
    along = goal_m.astype(np.float64) / grid.resolution_m - start
    # Where the line comes into each row and column of cells and leaves it, as shares of
    # its length; one along a border lies beyond it.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        cuts = (np.arange(max(grid.shape) + 1) - start[..., None]) / along[..., None]
    cuts = np.nan_to_num(cuts, nan=-np.inf)
    ends = (
        np.minimum(cuts[..., 1:], cuts[..., :-1]),
        np.maximum(cuts[..., 1:], cuts[..., :-1]),
    )
    (x_in, y_in), (x_out, y_out) = (
        np.moveaxis(values.clip(0, 1), 1, 0) for values in ends
    )
    enter = np.maximum(x_in[:, None, : grid.width], y_in[:, : grid.height, None])
    leave = np.minimum(x_out[:, None, : grid.width], y_out[:, : grid.height, None])
    # Cuts of both kinds at a corner may differ in their last bits.
    return leave - enter > 1e-12


def table(dataset: TerrainDataset) -> Table:
    """Formats how hard every split of a dataset is."""
    stuck = dataset.recipe.stuck_threshold
    rows = []
    for split in dataset.splits:
        measured = of_split(dataset, split)
        percent = (
            f"{100 * measured[name].mean():.1f}"
            for name in ("stuck", "soft_ground", "soft_spots")
        )
        times, typical, spread = measured["reference_times_s"], NOTHING, NOTHING
        times = times[np.isfinite(times)]
        if len(times):
            typical, spread = (
                f"{np.median(times):.1f}",
                f"{times.min():.1f}–{times.max():.1f}",
            )
        straight = measured["straight"]
        rows.append(
            (split, *percent, typical, spread, f"{straight.sum()}/{len(straight)}")
        )
    return Table(
        title=f"how hard the maps are (λ_stuck {stuck:g})",
        headings=_HEADINGS,
        numbers=True,
        rows=tuple(rows),
        notes=_NOTES,
    )
