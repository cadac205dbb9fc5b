"""How hard the maps of a dataset are to cross, a split at a time.

Hard ground is told before anything is trained or driven on it: where a straight line to the goal is free
on nearly every map, no planner has anything to plan. Letters in shapes: B maps, H×W cells.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from benchnav.core.grid import Grid
from benchnav.core.tables import NOTHING, Table
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.recipe import latent
from benchnav.datagen.recipe.recipe import Recipe
from benchnav.datagen.schema import UNLABELLED, Maps

_FIELDS = ("class_id", "slope_deg", "start_m", "goal_m", "reference_time_s")
_HEADINGS = (
    "split", "stuck\n%", "soft\nground %", "soft\nspots %", "time s,\nmedian", "time s,\nrange", "straight\nfree",
)  # fmt: skip
# What columns hold: heading and sentence.
_EXPLAINED = (
    ("stuck %", "share of the cells that count as stuck: their true mean λ is at most λ_stuck, {stuck:g}."),
    ("soft ground %", "share of the cells whose class has soft spots, which no colour shows; 0 where no class has."),
    ("soft spots %", "share of all ground that is itself a soft spot, on average over draws of λ."),
    ("time s", "of the fastest path over cells that are not stuck, at 1 m/s times their mean λ: median, least and most "
     "of the maps. A dash where the recipe does not ask for it with `solvable: true`."),
    ("straight free", "maps on which the straight line from start to goal meets no stuck cell. Where these are nearly "
     "all, there is little to plan."),
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Difficulty:
    """What stands in a robot's way on the maps of a split; shares are of the cells whose class is known.

    Args:
        maps: number of maps.
        stuck: share of the cells whose true E[λ] is at most λ_stuck.
        soft_ground: share of the cells whose class has soft spots.
        soft_spots: share of the ground that is a soft spot, in the mean over all draws of λ.
        straight: number of maps on which all cells of the straight line from start to goal have a true
            E[λ] above λ_stuck.
        reference_times_s: grid reference times of the maps that have one.
    """

    maps: int
    stuck: float
    soft_ground: float
    soft_spots: float
    straight: int
    reference_times_s: ndarray


def of_split(dataset: TerrainDataset, split: str) -> Difficulty:
    """Measures all maps of a split, some at a time.

    Raises:
        DatasetError: there is no such split, or its data are damaged.
    """
    return summarise(measure(maps, dataset.recipe) for _, maps in dataset.chunks(split, _FIELDS))


def measure(maps: Maps, recipe: Recipe) -> Maps:
    """Measures some maps.

    Args:
        maps: `class_id`, `slope_deg`, `start_m`, `goal_m` and `reference_time_s`, as stored.
        recipe: class table, resolution and λ_stuck.

    Returns:
        The figures of each map, as `Difficulty` has them of all, each of shape [B].
    """
    slope = maps["slope_deg"].astype(np.float64)
    expected = latent.expected_of(latent.truth(maps["class_id"], slope, recipe.classes))
    stuck = expected <= recipe.stuck_threshold  # not where it is NaN
    labelled = maps["class_id"] != UNLABELLED
    weight = np.array([item.soft.weight if item.soft else 0.0 for item in recipe.classes])
    spots = weight[np.where(labelled, maps["class_id"], 0)]
    on_line = crossed_cells(recipe.grid, maps["start_m"], maps["goal_m"])
    counts = np.maximum(1, labelled.sum(axis=(1, 2)))
    shares = {"stuck": stuck, "soft_ground": spots > 0, "soft_spots": spots}
    return {
        **{name: (values * labelled).sum(axis=(1, 2)) / counts for name, values in shares.items()},
        "straight": ~(stuck & on_line).any(axis=(1, 2)),
        "reference_times_s": maps["reference_time_s"].astype(np.float64),
    }


def summarise(pieces: Iterable[Maps]) -> Difficulty:
    """Puts what `measure` gave of some maps after others together."""
    parts = list(pieces)
    maps = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    times = maps["reference_times_s"]
    return Difficulty(
        maps=len(times),
        straight=int(maps["straight"].sum()),
        reference_times_s=times[np.isfinite(times)],
        **{name: float(maps[name].mean()) for name in ("stuck", "soft_ground", "soft_spots")},
    )


def crossed_cells(grid: Grid, start_m: ndarray, goal_m: ndarray) -> ndarray:
    """The cells that the straight line between two positions runs through.

    A line along a border between cells lies in those beyond it, as positions do; a corner that is only
    touched is not run through.

    Args:
        grid: size and resolution.
        start_m: (x, y), shape [B, 2].
        goal_m: (x, y), shape [B, 2].

    Returns:
        bool, shape [B, H, W].
    """
    start = start_m.astype(np.float64) / grid.resolution_m
    along = goal_m.astype(np.float64) / grid.resolution_m - start
    # Where the line is cut by the grid's lines: as shares of its length, sorted, its ends among them.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        cuts = (np.arange(1, max(grid.shape)) - start[..., None]) / along[..., None]
    inside = np.where((cuts > 0) & (cuts < 1), cuts, 0).reshape(len(start), -1)
    shares = np.sort(np.concatenate([inside, np.tile([0.0, 1.0], (len(start), 1))], axis=1), axis=1)
    middle = start[:, None] + (0.5 * (shares[:, 1:] + shares[:, :-1]))[..., None] * along[:, None]
    # Cuts of both kinds at a corner may differ in their last bits.
    member, piece = np.nonzero(np.diff(shares, axis=1) > 1e-12)
    column, row = np.floor(middle[member, piece]).astype(np.int64).T
    crossed = np.zeros((len(start), *grid.shape), dtype=bool)
    crossed[member, row.clip(0, grid.height - 1), column.clip(0, grid.width - 1)] = True
    return crossed


def table(dataset: TerrainDataset) -> Table:
    """Formats how hard every split of a dataset is."""
    stuck = dataset.recipe.stuck_threshold
    rows = []
    for split in dataset.splits:
        measured = of_split(dataset, split)
        shares = (measured.stuck, measured.soft_ground, measured.soft_spots)
        times, typical, spread = measured.reference_times_s, NOTHING, NOTHING
        if len(times):
            typical, spread = f"{np.median(times):.1f}", f"{times.min():.1f}–{times.max():.1f}"
        percent = (f"{100 * share:.1f}" for share in shares)
        rows.append((split, *percent, typical, spread, f"{measured.straight}/{measured.maps}"))
    return Table(
        title=f"how hard the maps are: what stands in a robot's way (λ_stuck {stuck:g})",
        headings=_HEADINGS,
        numbers=True,
        rows=tuple(rows),
        notes=tuple(f"  {heading}: {sentence.format(stuck=stuck)}" for heading, sentence in _EXPLAINED),
    )
