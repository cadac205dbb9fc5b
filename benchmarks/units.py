"""What a unit of a suite costs beside planning and driving: 36 cells of 200 episodes, in units of 50.

    benchnav-datagen create full-v1
    python benchmarks/units.py [DATASET]

The cells are the straight line and A*+DWA, on three scenarios, under six seeds; the oracle predicts, and the risk
setting is the mean. One process runs them one after another, as a worker of `benchnav-eval run` does. Told of each
planner: the median time of a unit, that of its overhead (reading and predicting maps, risk maps, drawing noise, tables
and files), and the most memory that the process has held. About five minutes. First it times the checks before a run,
of 204 conditions, in a process of which they are the first work: they are to take 5 s at most.
"""

import resource
import sys
import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from rich.console import Console
from rich.table import Table

from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Extent, units
from benchnav.eval.run import unit as units_of_run
from benchnav.eval.run.check import check_suite

SCENARIOS, PLANNERS, SEEDS, MAPS = ("std", "hg", "hs"), ("straight", "astar_dwa"), 6, 200
CHECKED = "astar_dwa", "astar_mppi", "cl_rrt", "mppi"
RISKS = ("mean", *(f"cvar:{level / 20}" for level in range(1, 17)))


def time_checks(data: str) -> str:
    """A line on how long the checks of a suite take before its first episode."""
    suite = Suite(data=data, model="paper-v1", planners=CHECKED, risks=RISKS, scenarios=SCENARIOS)
    start = time.perf_counter()
    checked = check_suite(suite, elsewhere=True)
    return f"checks of {len(checked.conditions)} conditions: {time.perf_counter() - start:.1f} s"


def main() -> None:
    data = sys.argv[1] if len(sys.argv) > 1 else "full-v1"
    Console().print(time_checks(data))
    suite = Suite(data=data, model="oracle", planners=PLANNERS, risks=("mean",), scenarios=SCENARIOS)
    extent = Extent.product(range(SEEDS), 1, MAPS)
    conditions = {
        condition.id: (condition, extent) for condition in conditions_of(suite, lambda data: list(SCENARIOS))
    }
    driving: list[float] = []
    settings, simulate = units_of_run.Settings(), units_of_run.simulate

    def timed(*given: Any, **options: Any) -> Any:
        start = time.perf_counter()
        answer = simulate(*given, **options)
        driving.append(time.perf_counter() - start)
        return answer

    units_of_run.simulate = timed
    whole: dict[str, list[float]] = {}
    overhead: dict[str, list[float]] = {}
    with TemporaryDirectory() as folder:
        for unit in units(conditions):
            start = time.perf_counter()
            units_of_run.run_unit(unit, Path(folder), settings.origins().of(unit), settings)
            took, label = time.perf_counter() - start, unit.condition.labels["planner"]
            whole.setdefault(label, []).append(took)
            overhead.setdefault(label, []).append(took - driving[-1])
    table = Table("planner", "units", "a unit, s", "its overhead, ms", "most memory, GiB")
    held = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    for label, times in whole.items():
        row = f"{median(times):.2f}", f"{1e3 * median(overhead[label]):.0f}", f"{held:.2f}"
        table.add_row(label, str(len(times)), *row)
    Console().print(table)


if __name__ == "__main__":
    main()
