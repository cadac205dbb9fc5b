"""Planning time over samples, horizon, episodes and size of the map.

    python -m benchmarks.scaling OUT.png

Times are medians on one thread. Each curve changes one of these settings: 5 000
samples, a horizon of 5 s (50 steps), 20 episodes, a map of 64 × 64 cells.
"""

import sys
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from benchmarks.timing import plan_ms, show
from benchnav import Grid
from benchnav.planning import (
    MPPI,
    AStarDWA,
    GoalDistance,
    MPPIConfig,
    Problem,
    Rules,
    Task,
    Unicycle,
)
from benchnav.viz import draw_estimates, legend_outside, line_looks, panel_grid, styled
from benchnav.viz.style import save
from studies.units import pose_on

SAMPLES = (2000, 5000, 10_000, 20_000, 50_000)
HORIZONS_S = (1, 2, 5, 10, 20)
EPISODES = (1, 2, 5, 10, 20, 50, 100)
SIZES = (64, 128, 256, 512, 1024)


def problem_of(episodes: int = 20, size: int = 64) -> Problem:
    """Return a problem with random λ, the same for all episodes."""
    generator = torch.Generator().manual_seed(0)
    uniform = torch.rand((1, size, size), generator=generator)
    ground = 0.35 + 0.6 * uniform.expand(episodes, -1, -1)
    start_m = torch.full((episodes, 2), 4.0)
    ends_m = start_m, torch.full((episodes, 2), size / 2 - 4.0)
    task = Task(robot=Unicycle(), objective=GoalDistance(), rules=Rules())
    return pose_on(ground, Grid(size, size, 0.5), ends_m, task, 100.0)[0]


@styled()
def main() -> None:
    """Print the times and draw them."""
    torch.set_num_threads(1)
    cases: list[tuple[str, str, int, Any, Problem]] = [
        *(
            ("samples", "MPPI", n, MPPI(MPPIConfig(samples=n)), problem_of())
            for n in SAMPLES
        ),
        *(
            ("horizon [s]", "MPPI", s, MPPI(MPPIConfig(horizon_s=s)), problem_of())
            for s in HORIZONS_S
        ),
        *(("episodes", "MPPI", n, MPPI(), problem_of(n)) for n in EPISODES),
        *(("episodes", "A*+DWA", n, AStarDWA(), problem_of(n)) for n in EPISODES),
        *(
            ("cells along a side of the map", "MPPI", n, MPPI(), problem_of(size=n))
            for n in SIZES
        ),
    ]
    rows = [
        {
            "setting": setting,
            "planner": name,
            "value": value,
            "ms": plan_ms(planner, problem, 11),
        }
        for setting, name, value, planner, problem in cases
    ]
    show(rows)
    table = pd.DataFrame(rows)
    looks = line_looks(["MPPI", "A*+DWA"])
    settings = list(dict.fromkeys(table["setting"]))
    figure, places = panel_grid([""] * len(settings), 4, 1.8, sharey=True)
    for (panel,), setting in zip(places, settings, strict=True):
        for name, curve in table[table["setting"] == setting].groupby(
            "planner", sort=False
        ):
            ms = curve["ms"]
            draw_estimates(
                panel, curve["value"], ms, ms, ms, looks[str(name)], str(name)
            )
        panel.set(xscale="log", yscale="log", xlabel=setting)
    places[0][0].set_ylabel("ms a step and episode")
    legend_outside(figure)
    save(figure, Path(sys.argv[1]), "png", dpi=200)


if __name__ == "__main__":
    main()
