"""Overhead of a unit of a suite: its time without planning and simulation.

    benchnav-datagen create full-v1
    python -m benchmarks.units [DATASET]

36 cells of 200 episodes run in units of 50: the straight line and A*+DWA, on three
scenarios, under six seeds, with the oracle and the risk setting `mean`. One process
runs them in sequence, as a worker of `benchnav-eval run` does. There is one row per
planner. It has the median time of a unit, that of its overhead (reading and predicting
maps, risk maps, noise, tables and files), and the peak memory of the process. It takes
about five minutes.
"""

import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import pandas as pd

from benchmarks.timing import peak_gib, show
from benchnav.eval import Suite
from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.unit import Extent, units
from benchnav.eval.run import unit as units_of_run

SCENARIOS, PLANNERS, SEEDS, MAPS = (
    ("std", "hg", "hs"),
    ("straight", "astar_dwa"),
    6,
    200,
)


def main(data: str = "full-v1") -> None:
    """Print the table."""
    suite = Suite(
        data=data,
        model="oracle",
        planners=PLANNERS,
        risks=("mean",),
        scenarios=SCENARIOS,
    )
    extent = Extent.product(range(SEEDS), 1, MAPS)
    conditions = {
        condition.id: (condition, extent)
        for condition in conditions_of(suite, lambda data: list(SCENARIOS))
    }
    driving: list[float] = []
    settings, simulate = units_of_run.Settings(), units_of_run.simulate

    def timed(*arguments: Any, **options: Any) -> Any:
        start = time.perf_counter()
        result = simulate(*arguments, **options)
        driving.append(time.perf_counter() - start)
        return result

    rows = []
    with TemporaryDirectory() as folder, patch.object(units_of_run, "simulate", timed):
        for unit in units(conditions):
            start = time.perf_counter()
            units_of_run.run_unit(
                unit, Path(folder), settings.origins().of(unit), settings
            )
            elapsed_s = time.perf_counter() - start
            planner = unit.condition.labels["planner"]
            rows.append(
                {
                    "planner": planner,
                    "a unit, s": elapsed_s,
                    "its overhead, s": elapsed_s - driving[-1],
                }
            )
    medians = pd.DataFrame(rows).groupby("planner", sort=False).median().reset_index()
    show(medians.assign(**{"most memory, GiB": peak_gib()}).to_dict("records"))


if __name__ == "__main__":
    main(*sys.argv[1:])
