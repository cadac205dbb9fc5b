"""Running the trials of all densities and risk settings, and their table of rows."""

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd
import torch

from benchnav.core import rng
from benchnav.core.errors import ConfigError
from benchnav.planning.planners.mppi import MPPIConfig
from studies.validation.drive import ManyTrialsMPPI, drive
from studies.validation.task import Setup, planner_config, pose
from studies.validation.world import draw_traction, draw_vegetation

SETTINGS = ("mean", "cvar:0.4", "cvar:0.6", "cvar:0.8")


def run_trials(
    densities: Sequence[float], settings: Sequence[str], maps: int, realisations: int, seed: int, setup: Setup
) -> Iterator[pd.DataFrame]:
    """Runs maps × realisations trials of each density and setting.

    The planner's noise is named by (seed, map, realisation), as the world is: trials of one map and
    realisation share it, and no others do.

    Args:
        densities: shares of vegetation.
        settings: risk settings.
        maps: maps a density.
        realisations: draws of traction a map.
        seed: root of all draws.
        setup: how it is planned.

    Yields:
        Rows of one map, realisation and planner, which settings of λ̂ share: `density`, `setting`, `map`, `realisation`,
        `success`, `time_s` (not a number where there was no arrival).

    Raises:
        ConfigError: there is nothing to run, or a density or setting that does not exist.
    """
    if not all(0 <= density <= 1 for density in densities):
        raise ConfigError(f"Expected densities in [0, 1], got {list(densities)}.")
    if maps < 1 or realisations < 1:
        raise ConfigError(f"Expected `maps` and `realisations` ≥ 1, got {maps} and {realisations}.")
    alike: dict[MPPIConfig, list[str]] = {}
    for setting in settings:
        alike.setdefault(planner_config(setting, setup), []).append(setting)
    planners = {config: ManyTrialsMPPI(config, setup) for config in alike}
    names = [round(1e6 * density) for density in densities]
    for member in range(maps):
        which = np.array([member])
        vegetation = np.concatenate([draw_vegetation(seed, which, density) for density in densities])
        problems = {config: pose(vegetation, own, setup, names) for config, own in alike.items()}
        for realisation in range(realisations):
            drawn = draw_traction(seed, which.repeat(len(densities)), realisation, vegetation)
            for config, own in alike.items():
                traction = torch.from_numpy(drawn.repeat(len(own), axis=0)).float()
                generator = rng.generator(rng.stream_key(seed, "cai", "planner", member, realisation))
                arrival_s = drive(planners[config], problems[config], traction, generator).double().numpy()
                labels = pd.MultiIndex.from_product((densities, own), names=("density", "setting"))
                yield labels.to_frame(index=False).assign(
                    map=member,
                    realisation=realisation,
                    success=np.isfinite(arrival_s),
                    time_s=np.where(np.isfinite(arrival_s), arrival_s.round(1), np.nan),
                )
