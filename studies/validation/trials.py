"""The experiment of Cai et al. with our planner and risk settings: trials of all
densities and risk settings.

What is theirs, what is ours and what differs stands in `docs/studies/validation.md`.
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
    """Run maps × realisations trials of each density and setting.

    The planner's noise is named by (seed, map, realisation), as the world is: trials of
    one map and realisation share it, and no others do.

    Args:
        densities: fractions of vegetation.
        settings: risk settings.
        maps: maps a density.
        realisations: draws of traction a map.
        seed: root of all draws.
        setup: how it is planned.

    Yields:
        Rows of one map: `density`, `setting`, `map`, `realisation`, `success`, `time_s`
            (NaN without arrival).
    """
    alike: dict[MPPIConfig, list[str]] = {}
    for setting in settings:
        alike.setdefault(planner_config(setting, setup), []).append(setting)
    planners = {config: ManyTrialsMPPI(config, setup) for config in alike}
    names = [round(1e6 * density) for density in densities]
    for member in range(maps):
        which = np.array([member])
        vegetation = np.concatenate(
            [draw_vegetation(seed, which, density) for density in densities]
        )
        problems = {
            config: pose(vegetation, own, setup, names) for config, own in alike.items()
        }
        for realisation in range(realisations):
            drawn = draw_traction(
                seed, which.repeat(len(densities)), realisation, vegetation
            )
            for config, own in alike.items():
                traction = torch.from_numpy(drawn.repeat(len(own), axis=0)).float()
                generator = rng.generator(
                    rng.stream_key(seed, "cai", "planner", member, realisation)
                )
                arrival_s = (
                    drive(planners[config], problems[config], traction, generator)
                    .double()
                    .numpy()
                )
                labels = pd.MultiIndex.from_product(
                    (densities, own), names=("density", "setting")
                )
                yield labels.to_frame(index=False).assign(
                    map=member,
                    realisation=realisation,
                    success=np.isfinite(arrival_s),
                    time_s=np.where(np.isfinite(arrival_s), arrival_s.round(1), np.nan),
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
    """Run trials, store them as trials.csv, and return their tables; options as in
    `run_trials` and `Setup`.
    """
    settings: Setup = read(Setup, setup, of("the options"))
    made = pd.concat(
        track(
            run_trials(densities, risks, maps, realisations, seed, settings), "trials"
        )
    )
    for name, order in (("density", densities), ("setting", risks)):
        made[name] = pd.Categorical(made[name], order)
    rows = made.sort_values(["density", "setting", "map", "realisation"])
    write_text(folder / "trials.csv", rows.to_csv(index=False))
    return together(work, folder, [folder.name.removeprefix("validation-")])


def together(work: Work, folder: Path, parts: Sequence[str]) -> dict[str, str]:
    """Return the tables of the trials of several parts."""
    return {"trials": tabulate(pd.concat(_read(work, part) for part in parts))}


def compared(work: Work, folder: Path, runs: dict[str, str]) -> dict[str, str]:
    """Return the table of several parts by a name each, and what each changes on the
    first.
    """
    return {
        "runs": tabulate_runs({name: _read(work, part) for name, part in runs.items()})
    }


def _read(work: Work, part: str) -> pd.DataFrame:
    return pd.read_csv(work.out / f"validation-{part}" / "trials.csv")
