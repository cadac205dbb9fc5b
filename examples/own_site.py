"""A custom site, from a robot's drives to a dataset, a trained model and a suite.

    python examples/own_site.py [FOLDER]

For a real site, the drives are in a robot's log; see `read_bag.py`. Here, robots drive
in the simulation of this package. The terrain is generated and written as the GeoTIFFs
of a survey: elevation, photo and land cover. Robots log their position, their commanded
speed and their measured speed. All further steps are commands, as for a real site.

Real sites seldom have a map of classes. Without `--classes` and `--solvable`, all steps
up to `evaluate` work. A suite needs both, since it simulates λ with the class table.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pandas as pd
import rasterio
import torch

from benchnav import Terrain, planning
from benchnav.datagen import TerrainDataset, create_dataset, load_recipe

WEST, SOUTH, CELL = 500_000.0, 4_000_000.0, 0.5
HEIGHT, WIDTH = 96, 640  # in cells; 48 m × 320 m
DRIVES, LEGS, LEG_S, REACH_M = 24, 4, 30.0, 15.0
GENERATOR = torch.Generator().manual_seed(0)
SIZE = (f"height={HEIGHT}", f"width={WIDTH}", "splits={site: {scenario: std, maps: 1}}")
MAPS = ("height=48", "width=48", "places={least_distance_m: 10, margin_m: 2}")


def command(line: str, folder: Path, *more: str) -> None:
    """Run a command in the folder."""
    name, *words = line.split()
    print(f"\n$ {line} {' '.join(more)}", flush=True)
    # For networks and suites this small, one thread without compiling is fastest.
    quick = os.environ | {"OMP_NUM_THREADS": "1", "TORCH_COMPILE_DISABLE": "1"}
    subprocess.run(
        [Path(sys.executable).with_name(name), *words, *more],
        cwd=folder,
        check=True,
        env=quick,
    )


def survey(folder: Path) -> Terrain:
    """Generate terrain and write it as the rasters of a survey.

    Rows of rasters run from north to south, and rows of maps from south to north.

    Returns:
        The terrain, once per drive.
    """
    recipe = load_recipe("stakes-v1", ["id=ground", *SIZE])
    for _ in create_dataset(recipe, folder / "ground.h5"):
        pass
    dataset = TerrainDataset(folder / "ground.h5")
    maps = dataset.read("site")
    corner = rasterio.Affine(CELL, 0, WEST, 0, -CELL, SOUTH + HEIGHT * CELL)
    for name, field in (
        ("dem", "elevation_m"),
        ("photo", "rgb"),
        ("classes", "class_id"),
    ):
        bands = maps[field][0].reshape(-1, HEIGHT, WIDTH)[:, ::-1]
        profile = {
            "count": len(bands),
            "dtype": bands.dtype,
            "crs": "EPSG:32654",
            "transform": corner,
        }
        with rasterio.open(
            folder / f"{name}.tif", "w", "GTiff", WIDTH, HEIGHT, **profile
        ) as file:
            file.write(bands)
    return dataset.terrain("site", [0] * DRIVES)


def drive(terrain: Terrain) -> pd.DataFrame:
    """Drive robots in straight legs to random goals; return their logs."""
    task = planning.Task(
        robot=planning.Unicycle(),
        objective=planning.GoalDistance(),
        rules=planning.Rules(),
    )
    extent = torch.tensor(terrain.grid.extent_m)
    fraction = torch.rand(DRIVES, 2, generator=GENERATOR)
    # Drives start at equal distances along the site.
    fraction[:, 0] = (torch.arange(DRIVES) + 0.5) / DRIVES
    position = 2 + fraction * (extent - 4)
    logs, steps = [], round(LEG_S / task.robot.dt_s)
    for leg in range(LEGS):
        offset = REACH_M * (2 * torch.rand(DRIVES, 2, generator=GENERATOR) - 1)
        goal = torch.minimum((position + offset).clamp(min=2), extent - 2)
        # λ is the same on every drive.
        world = planning.World(noise="stored", time_budget_s=LEG_S)
        missing = torch.full((DRIVES,), torch.nan)
        places = planning.Endpoints(
            start_m=position, goal_m=goal, reference_time_s=missing
        )
        simulation = planning.Simulation(terrain, task, world, places, 0, range(DRIVES))
        # A problem needs a prediction, but `Straight` does not use it.
        predicted = planning.Prediction(
            terrain.observe(), terrain.truth, terrain.traversability
        )
        problem = planning.pose_problem(task, predicted, position, goal, LEG_S)
        planner, state = planning.Straight(), simulation.init(problem.start)
        plan, observed = planner.init(problem, GENERATOR), missing
        for step in range(steps):
            step_input = planning.Step(
                state=state.state,
                traversability=observed,
                time_s=step * task.robot.dt_s,
            )
            action, plan, _ = planner.plan(step_input, plan)
            after, observed = simulation.step(state, action)
            speed = (after.state - state.state)[:, :2].norm(dim=1) / task.robot.dt_s
            columns = {
                "time_s": torch.full((DRIVES,), leg * LEG_S + step_input.time_s),
                "x_m": WEST + state.state[:, 0].double(),
                "y_m": SOUTH + state.state[:, 1].double(),
                "commanded_m_s": action[:, 0],
                "measured_m_s": speed + 0.02 * torch.randn(DRIVES, generator=GENERATOR),
                "drive": torch.arange(DRIVES),
            }
            logs.append(pd.DataFrame(columns)[state.running.numpy()])
            state = after
        position = state.state[:, :2]
    return pd.concat(logs)


def main(folder: Path) -> None:
    log = drive(survey(folder))
    log.to_csv(folder / "drives.csv.gz", index=False)
    print(
        f"{DRIVES} drives, {len(log)} rows, {log['measured_m_s'].sum() * 0.1:.0f} m in "
        "total"
    )
    rasters = (
        "--dem dem.tif --photo photo.tif --classes classes.tif --solvable "
        "--recipe stakes-v1"
    )
    command(
        f"benchnav-datagen import-drives drives.csv.gz {rasters} --out site.h5",
        folder,
        *MAPS,
    )
    network = (
        "--settings.max_epochs 12 --settings.batch_size 4 --settings.learning_rate 1e-3"
    )
    command(f"benchnav-train fit mdn --data site.h5 --out mine {network}", folder)
    command("benchnav-train evaluate mine --data site.h5 --out quality", folder)
    suite = (
        "--world stakes --objectives [travel_time] --scenarios [site] --maps 0 "
        "--record none --jobs 2 --out run"
    )
    parts = "--planners [straight,astar_dwa] --risks [mean,cvar:0.8]"
    command(f"benchnav-eval run --data site.h5 --model mine {parts} {suite}", folder)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        main(folder)
