"""The ground on which episodes of a finished run failed: what was predicted of it, and what it was."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from benchnav.core.errors import BenchnavError
from benchnav.datagen.files.reader import TerrainDataset, find_dataset
from benchnav.eval.experiment.condition import Condition
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.folder import provenance
from benchnav.eval.folder.folder import Run, open_run
from benchnav.eval.report.charts.failure_sheet import FailedGround
from benchnav.eval.report.failure_choice import GroundOf
from benchnav.eval.run.unit import Settings, build, one_thread


def ground_of_run(folder: Path) -> GroundOf:
    """Gives a function that reads and predicts the ground of some failures of one condition again.

    Args:
        folder: a finished run.

    Returns:
        From rows of `failures.failures_table`, of one condition, the ground of each. It raises a `BenchnavError`
        that says why where the ground cannot be had.
    """
    run = open_run(folder)

    def ground_of(failures: pd.DataFrame) -> FailedGround:
        parts = [
            (rows.index.to_numpy(), _ground(run, rows))
            for _, rows in failures.reset_index(drop=True).groupby(["seed", "realisation"], sort=False)
        ]
        back = np.argsort(np.concatenate([index for index, _ in parts]))
        grounds = [ground for _, ground in parts]
        return FailedGround(
            predicted=np.concatenate([one.predicted for one in grounds])[back],
            immobilising=np.concatenate([one.immobilising for one in grounds])[back],
            resolution_m=grounds[0].resolution_m,
            goal_m=np.concatenate([one.goal_m for one in grounds])[back],
        )

    return ground_of


def _ground(run: Run, rows: pd.DataFrame) -> FailedGround:
    """The ground under one seed and realisation."""
    condition_id = rows["condition"].iloc[0]
    condition, _ = run.conditions[condition_id]
    maps = tuple(int(i) for i in rows["map"])
    _check_maps(run, condition, maps)
    made = run.about["codes"][rows["code"].iloc[0]]
    for part, digest in provenance.describe_parts(condition)["parts"].items():
        if made["parts"].get(part) != digest:
            raise BenchnavError(f"Expected {part} as it was when {run.folder} was run, got another.")
    unit = Unit(
        condition=condition,
        seed=int(rows["seed"].iloc[0]),
        realisation=int(rows["realisation"].iloc[0]),
        maps=maps,
    )
    with one_thread():
        problem, simulation = build(unit, Settings().origins().of(unit))
    return FailedGround(
        predicted=problem.risk_map.cpu().numpy(),
        immobilising=simulation.immobilising.cpu().numpy(),
        resolution_m=problem.grid.resolution_m,
        goal_m=problem.goal_m.cpu().numpy(),
    )


def _check_maps(run: Run, condition: Condition, maps: Sequence[int]) -> None:
    """Refuses other maps than those that the run was on."""
    dataset = TerrainDataset(find_dataset(condition.data))
    count = dataset.map_count(condition.split)
    if count <= max(maps):
        raise BenchnavError(
            f"Expected {condition.data} with the {max(maps) + 1} maps of {condition.split} or more that the run was "
            f"on, got {count}. Make them with `benchnav-datagen create`."
        )
    digests = run.about["datasets"][condition.data]["maps"][condition.split]
    now = provenance.map_digests(dataset, condition.split, max(maps) + 1)
    if any(now[i] != digests[i] for i in maps):
        raise BenchnavError(f"Expected {condition.data} with the maps that {run.folder} was on, got others.")
