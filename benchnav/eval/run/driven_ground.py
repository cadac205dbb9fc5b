"""Keeps of a finished run the map that the figure of driven paths shows."""

from pathlib import Path

import numpy as np

from benchnav.datagen.files.reader import TerrainDataset, find_dataset
from benchnav.eval.folder.folder import EPISODES, open_run, read_table
from benchnav.eval.folder.steps import open_steps
from benchnav.eval.report.charts.driven import GROUND, MAP, DrivenGround, telling_map
from benchnav.eval.run.unit import noise_key, read_maps
from benchnav.planning.world.simulation import Simulation


def keep_ground(folder: Path) -> None:
    """Writes the map on which the outcomes of a run differ most, with λ as it was there; not where no steps were kept.

    Args:
        folder: a run whose rows are all there.
    """
    if open_steps(folder) is None:
        return
    rows = read_table(folder, EPISODES)
    about = telling_map(rows)
    on_map = np.logical_and.reduce([rows[name] == about[name] for name in MAP])
    condition, _ = open_run(folder).conditions[rows[on_map]["condition"].iloc[0]]
    block = read_maps(TerrainDataset(find_dataset(condition.data)), condition.split, [about["map"]])
    noise = noise_key(about["seed"], condition.split, about["realisation"])
    simulation = Simulation(
        block.terrain, condition.make_task(), condition.world, block.places, noise, [about["map"]]
    )
    field = None if simulation.field is None else simulation.field[0].cpu().numpy()
    DrivenGround(
        about=about,
        resolution_m=block.terrain.grid.resolution_m,
        rgb=block.terrain.rgb[0].cpu().numpy(),
        field=field,
        immobilising=simulation.immobilising[0].cpu().numpy(),
        goal_m=block.places.goal_m[0].cpu().numpy(),
    ).save(folder / GROUND)
