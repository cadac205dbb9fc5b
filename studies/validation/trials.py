"""Experiment of Cai et al. with our planner and risk settings.

`docs/studies/validation.md` compares their experiment with ours.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from rich.progress import track

from benchnav.core import rng
from benchnav.core.settings import of, read
from benchnav.core.store import write_text
from benchnav.planning import MPPIConfig
from studies.study import Work
from studies.validation.drive import ManyTrialsMPPI, drive
from studies.validation.tables import tabulate, tabulate_runs
from studies.validation.task import Setup, planner_config, pose
from studies.validation.world import draw_traction, draw_vegetation

SETTINGS = ("mean", "cvar:0.4", "cvar:0.6", "cvar:0.8")
DENSITIES = (0.1, 0.4, 0.7, 1.0)


def run_trials(
    densities: Sequence[float],
    settings: Sequence[str],
    maps: int,
    realisations: int,
    seed: int,
    setup: Setup,
) -> Iterator[pd.DataFrame]:
    """Run maps × realisations episodes of each density and setting.

    The key of the planner's noise is (seed, map, realisation), like that of the world.
    So only episodes of the same map and realisation have the same noise.

    Args:
        densities: fractions of vegetation.
        settings: risk settings.
        maps: number of maps per density.
        realisations: number of draws of traction per map.
        seed: root of all draws.
        setup: settings of planning.

    Yields:
        Rows of one realisation of a map: `density`, `setting`, `map`, `realisation`,
            `success`, `time_s` (NaN for failures).
    """
    settings_by_config: dict[MPPIConfig, list[str]] = {}
    for setting in settings:
        settings_by_config.setdefault(planner_config(setting, setup), []).append(
            setting
        )
    planners = {config: ManyTrialsMPPI(config, setup) for config in settings_by_config}
    names = [round(1e6 * density) for density in densities]
    for map_number in range(maps):
        map_index = np.array([map_number])
        vegetation = np.concatenate(
            [draw_vegetation(seed, map_index, density) for density in densities]
        )
        problems = {
            config: pose(vegetation, group, setup, names)
            for config, group in settings_by_config.items()
        }
        for realisation in range(realisations):
            fields = draw_traction(
                seed, map_index.repeat(len(densities)), realisation, vegetation
            )
            key = rng.stream_key(seed, "cai", "planner", map_number, realisation)
            for config, group in settings_by_config.items():
                traction = torch.from_numpy(fields.repeat(len(group), axis=0)).float()
                arrival = drive(
                    planners[config], problems[config], traction, rng.generator(key)
                )
                arrival_s = arrival.double().numpy()
                has_arrived = np.isfinite(arrival_s)
                labels = pd.MultiIndex.from_product(
                    (densities, group), names=("density", "setting")
                )
                yield labels.to_frame(index=False).assign(
                    map=map_number,
                    realisation=realisation,
                    success=has_arrived,
                    time_s=np.where(has_arrived, arrival_s.round(1), np.nan),
                )


def trials(
    work: Work,
    folder: Path,
    risks: Sequence[str] = SETTINGS,
    densities: Sequence[float] = DENSITIES,
    maps: int = 40,
    realisations: int = 5,
    seed: int = 0,
    **setup: Any,
) -> dict[str, str]:
    """Run episodes, store their rows as `trials.csv`, and return their tables.

    The options are those of `run_trials` and `Setup`.
    """
    settings: Setup = read(Setup, setup, of("the options"))
    rows_by_map = pd.concat(
        track(
            run_trials(densities, risks, maps, realisations, seed, settings), "trials"
        )
    )
    for name, order in (("density", densities), ("setting", risks)):
        rows_by_map[name] = pd.Categorical(rows_by_map[name], order)
    rows = rows_by_map.sort_values(["density", "setting", "map", "realisation"])
    write_text(folder / "trials.csv", rows.to_csv(index=False))
    return together(work, folder, [folder.name.removeprefix("validation-")])


def together(work: Work, folder: Path, parts: Sequence[str]) -> dict[str, str]:
    """Return the tables of the episodes of several parts together."""
    return {"trials": tabulate(pd.concat(_read(work, part) for part in parts))}


def compared(work: Work, folder: Path, runs: dict[str, str]) -> dict[str, str]:
    """Return the table of several parts, and the differences of each to the first.

    Args:
        work: where the study is run.
        folder: folder of the run.
        runs: parts by the name that the table shows.
    """
    return {
        "runs": tabulate_runs({name: _read(work, part) for name, part in runs.items()})
    }


def _read(work: Work, part: str) -> pd.DataFrame:
    return pd.read_csv(work.out / f"validation-{part}" / "trials.csv")
