"""What a unit of a suite costs besides planning and driving: 36 cells of 200 episodes,
in units of 50.

    benchnav-datagen create full-v1
    python -m benchmarks.units [DATASET]

The cells are the straight line and A*+DWA, on three scenarios, under six seeds; the
oracle predicts, and the risk setting is the mean. One process runs them one after
another, as a worker of `benchnav-eval run` does. A row a planner: the median time of a
unit, that of its overhead (reading and predicting maps, risk maps, drawing noise,
tables and files), and the most memory that the process has held. About five minutes.
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
        own.id: (own, extent)
        for own in conditions_of(suite, lambda data: list(SCENARIOS))
    }
    driving: list[float] = []
    settings, simulate = units_of_run.Settings(), units_of_run.simulate

    def timed(*given: Any, **options: Any) -> Any:
        start = time.perf_counter()
        answer = simulate(*given, **options)
        driving.append(time.perf_counter() - start)
        return answer

    rows = []
    with TemporaryDirectory() as folder, patch.object(units_of_run, "simulate", timed):
        for unit in units(conditions):
            start = time.perf_counter()
            units_of_run.run_unit(
                unit, Path(folder), settings.origins().of(unit), settings
            )
            took = time.perf_counter() - start
            planner = unit.condition.labels["planner"]
            rows.append(
                {
                    "planner": planner,
                    "a unit, s": took,
                    "its overhead, s": took - driving[-1],
                }
            )
    medians = pd.DataFrame(rows).groupby("planner", sort=False).median().reset_index()
    show(medians.assign(**{"most memory, GiB": peak_gib()}).to_dict("records"))


if __name__ == "__main__":
    main(*sys.argv[1:])
