"""A site of one's own, from a robot's drives to a suite of episodes: a dataset, a model, its measures, planners.

Real drives come from the robot's log; see `read_bag.py`. Here a robot drives in this package's own simulation, over
ground that is drawn and written as GeoTIFFs, as a survey would give them: elevation, photo, land cover. What it logs is
its position and two speeds. From there on everything is done by commands, as for real ground:

    python examples/own_site.py [FOLDER]

Real ground rarely has a map of classes. Without `--classes` the commands up to `evaluate` work as well; a suite simulates
drives by the class table, so it needs them.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import pandas as pd
import rasterio
import torch

from benchnav import Terrain
from benchnav.datagen import TerrainDataset, create_dataset, load_recipe
from benchnav.planning import GoalDistance, Rules, Step, Straight, Task, Unicycle, pose_problem
from benchnav.planning.world.simulation import Simulation
from benchnav.planning.world.world import Places, World

WEST, SOUTH, CELL = 500_000.0, 4_000_000.0, 0.5
HEIGHT, WIDTH = 96, 640  # cells: 48 m × 320 m
DRIVES, LEGS, LEG_S, REACH_M = 24, 4, 30.0, 25.0
GENERATOR = torch.Generator().manual_seed(0)
SIZE = (f"height={HEIGHT}", f"width={WIDTH}", "splits={site: {scenario: std, maps: 1}}")
MAPS = ("height=48", "width=48", "places={least_distance_m: 10, margin_m: 2}")


def command(line: str, folder: Path, *more: str) -> None:
    """Runs a command in the folder, as a user would."""
    name, *words = line.split()
    print(f"\n$ {line} {' '.join(more)}", flush=True)
    subprocess.run([Path(sys.executable).with_name(name), *words, *more], cwd=folder, check=True)


def survey(folder: Path) -> Terrain:
    """Draws the ground and writes what a survey knows of it; rows of rasters run southward."""
    recipe = load_recipe("stakes-v1", ["id=ground", *SIZE])
    for _ in create_dataset(recipe, folder / "ground.h5"):
        pass
    dataset = TerrainDataset(folder / "ground.h5")
    maps = dataset.read("site")
    corner = rasterio.Affine(CELL, 0, WEST, 0, -CELL, SOUTH + HEIGHT * CELL)
    for name, field in (("dem", "elevation_m"), ("photo", "rgb"), ("classes", "class_id")):
        bands = maps[field][0].reshape(-1, HEIGHT, WIDTH)[:, ::-1]
        about = {"count": len(bands), "dtype": bands.dtype, "crs": "EPSG:32654", "transform": corner}
        with rasterio.open(folder / f"{name}.tif", "w", "GTiff", WIDTH, HEIGHT, **about) as file:
            file.write(bands)
    return dataset.terrain("site", [0] * DRIVES)


def drive(terrain: Terrain) -> pd.DataFrame:
    """Lets a robot drive straight from place to place, several times, and logs what it knows of itself."""
    task = Task(robot=Unicycle(), objective=GoalDistance(), rules=Rules())
    extent = torch.tensor(terrain.grid.extent_m)
    position = 2 + torch.rand(DRIVES, 2, generator=GENERATOR) * (extent - 4)
    logs, steps = [], round(LEG_S / task.robot.dt_s)
    for leg in range(LEGS):
        way = REACH_M * (2 * torch.rand(DRIVES, 2, generator=GENERATOR) - 1)
        goal = torch.minimum((position + way).clamp(min=2), extent - 2)
        world = World(noise="stored", time_budget_s=LEG_S)  # the λ of the ground is the same on every drive
        places = Places(start_m=position, goal_m=goal, reference_time_s=torch.full((DRIVES,), torch.nan))
        simulation = Simulation(terrain, task, world, places, 0, range(DRIVES))
        risk_map = terrain.traversability
        problem = pose_problem(task, terrain.observe(), terrain.truth, risk_map, position, goal, LEG_S)
        planner = Straight()
        state, plan = simulation.init(problem.start), planner.init(problem, GENERATOR)
        met = torch.full((DRIVES,), torch.nan)
        for step in range(steps):
            now = step * task.robot.dt_s
            told = Step(state=state.state, traversability=met, time_s=now)
            action, plan, _ = planner.plan(told, plan)
            after, met = simulation.step(state, action)
            moved = (after.state - state.state)[:, :2].norm(dim=1) / task.robot.dt_s
            noise = 0.02 * torch.randn(DRIVES, generator=GENERATOR)
            columns = {
                "time_s": torch.full((DRIVES,), leg * LEG_S + now),
                "x_m": WEST + state.state[:, 0].double(),
                "y_m": SOUTH + state.state[:, 1].double(),
                "commanded_m_s": action[:, 0],
                "measured_m_s": moved + noise,
                "drive": torch.arange(DRIVES),
            }
            logs.append(pd.DataFrame(columns)[state.running.numpy()])
            state = after
        position = state.state[:, :2]
    return pd.concat(logs)


def main(folder: Path) -> None:
    log = drive(survey(folder))
    log.to_csv(folder / "drives.csv.gz", index=False)
    print(f"{DRIVES} drives of {len(log)} rows, {log['measured_m_s'].sum() * 0.1:.0f} m")
    rasters = "--dem dem.tif --photo photo.tif --classes classes.tif"
    command(
        f"benchnav-datagen import-drives drives.csv.gz {rasters} --recipe stakes-v1 --solvable --out site.h5",
        folder,
        *MAPS,
    )
    network = "--mdn.encoder_name tu-edgenext_xx_small" if False else ""
    command(
        f"benchnav-train mdn --data site.h5 --out mine --mdn.max_epochs 20 --mdn.batch_size 4 {network}",
        folder,
    )
    command("benchnav-train evaluate mine --data site.h5 --out quality", folder)
    parts = "--planners [straight,astar_dwa] --risks [mean,cvar:0.8] --objectives [travel_time]"
    command(
        f"benchnav-eval run --data site.h5 --model mine --world stakes --scenarios [site] --maps 0 {parts} --record none --jobs 2 --out run",
        folder,
    )


if __name__ == "__main__":
    if len(sys.argv) > 1:
        Path(sys.argv[1]).mkdir(parents=True, exist_ok=True)
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as name:
            main(Path(name))
