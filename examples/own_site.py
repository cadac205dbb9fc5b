"""A site of one's own, from a robot's drives to a suite of episodes: a dataset, a
model, its measures, planners.

Real drives come from a robot's log; see `read_bag.py`. Here robots drive in this
package's own simulation, over ground that is drawn and written as GeoTIFFs, as a survey
gives them: elevation, photo, land cover. They log their position and two speeds. All
else is done by commands, as for real ground:

    python examples/own_site.py [FOLDER]

Real ground seldom has a map of classes. Without `--classes` and `--solvable` all works
up to `evaluate`; a suite simulates λ by the class table, and so needs them.
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
HEIGHT, WIDTH = 96, 640  # cells: 48 m × 320 m
DRIVES, LEGS, LEG_S, REACH_M = 24, 4, 30.0, 15.0
GENERATOR = torch.Generator().manual_seed(0)
SIZE = (f"height={HEIGHT}", f"width={WIDTH}", "splits={site: {scenario: std, maps: 1}}")
MAPS = ("height=48", "width=48", "places={least_distance_m: 10, margin_m: 2}")


def command(line: str, folder: Path, *more: str) -> None:
    """Runs a command in the folder, as a user would."""
    name, *words = line.split()
    print(f"\n$ {line} {' '.join(more)}", flush=True)
    # So small networks and suites are done before more threads, or compiling, would
    # pay.
    quick = os.environ | {"OMP_NUM_THREADS": "1", "TORCH_COMPILE_DISABLE": "1"}
    subprocess.run(
        [Path(sys.executable).with_name(name), *words, *more],
        cwd=folder,
        check=True,
        env=quick,
    )


def survey(folder: Path) -> Terrain:
    """Draws the ground and writes what a survey knows of it; rows of rasters run
    southward.
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
        about = {
            "count": len(bands),
            "dtype": bands.dtype,
            "crs": "EPSG:32654",
            "transform": corner,
        }
        with rasterio.open(
            folder / f"{name}.tif", "w", "GTiff", WIDTH, HEIGHT, **about
        ) as file:
            file.write(bands)
    return dataset.terrain("site", [0] * DRIVES)


def drive(terrain: Terrain) -> pd.DataFrame:
    """Lets robots drive straight from place to place, each several times, and logs what
    they know of themselves.
    """
    task = planning.Task(
        robot=planning.Unicycle(),
        objective=planning.GoalDistance(),
        rules=planning.Rules(),
    )
    extent = torch.tensor(terrain.grid.extent_m)
    share = torch.rand(DRIVES, 2, generator=GENERATOR)
    share[:, 0] = (torch.arange(DRIVES) + 0.5) / DRIVES  # all along the site
    position = 2 + share * (extent - 4)
    logs, steps = [], round(LEG_S / task.robot.dt_s)
    for leg in range(LEGS):
        way = REACH_M * (2 * torch.rand(DRIVES, 2, generator=GENERATOR) - 1)
        goal = torch.minimum((position + way).clamp(min=2), extent - 2)
        # The λ of the ground is the same on every drive.
        world = planning.World(noise="stored", time_budget_s=LEG_S)
        unknown = torch.full((DRIVES,), torch.nan)
        places = planning.Places(
            start_m=position, goal_m=goal, reference_time_s=unknown
        )
        simulation = planning.Simulation(terrain, task, world, places, 0, range(DRIVES))
        # Which `Straight` does not look at.
        predicted = planning.Prediction(
            terrain.observe(), terrain.truth, terrain.traversability
        )
        problem = planning.pose_problem(task, predicted, position, goal, LEG_S)
        planner, state = planning.Straight(), simulation.init(problem.start)
        plan, met = planner.init(problem, GENERATOR), unknown
        for step in range(steps):
            now = planning.Step(
                state=state.state, traversability=met, time_s=step * task.robot.dt_s
            )
            action, plan, _ = planner.plan(now, plan)
            after, met = simulation.step(state, action)
            moved = (after.state - state.state)[:, :2].norm(dim=1) / task.robot.dt_s
            columns = {
                "time_s": torch.full((DRIVES,), leg * LEG_S + now.time_s),
                "x_m": WEST + state.state[:, 0].double(),
                "y_m": SOUTH + state.state[:, 1].double(),
                "commanded_m_s": action[:, 0],
                "measured_m_s": moved + 0.02 * torch.randn(DRIVES, generator=GENERATOR),
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
        f"{DRIVES} drives of {len(log)} rows, {log['measured_m_s'].sum() * 0.1:.0f} m "
        "in all"
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
        own = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(temporary)
        own.mkdir(parents=True, exist_ok=True)
        main(own)
