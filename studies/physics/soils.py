"""Tables of the soils: achieved motion, patches that hold a robot, and slopes.

    python -m studies.physics.soils drives|patches|slopes

- `drives`: per soil, the achieved fraction of v in four directions of a plane and the
  largest drift, and the achieved ω of a turn in place, for seven λ;
- `patches`: which n × n soft cells a robot crosses, by depth of the ruts;
- `slopes`: λ by slope along the heading: measured wheels, the same wheels under a body
  in physics, and the slope laws of classes.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from benchnav import Grid, Terrain, TraversabilityMixture
from benchnav.core import rng
from benchnav.core.tables import print_table
from benchnav.datagen import load_recipe
from benchnav.planning import SkidSteer, create_simulation
from benchnav.planning.free_space import Rules
from benchnav.planning.objective import GoalDistance
from benchnav.planning.problem import Task
from benchnav.planning.world.physics.settings import Entrapment, Physics
from benchnav.planning.world.physics.simulation import PhysicsSimulation
from benchnav.planning.world.physics.soil import Janosi, Soil, measured_wheels
from benchnav.planning.world.world import Endpoints, World
from studies.runs import table_of

SIZE = 64
RESOLUTION_M = 0.5
CENTRE_M = SIZE * RESOLUTION_M / 2
LAMBDAS = (0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9)
HEADINGS = {"up": 0.0, "oblique": 45.0, "across": 90.0, "down": 180.0}
SLOPES_DEG = (0.0, 8.0, 15.0)
SOILS = ("calibrated", "isotropic", "janosi")
CLASS = "gravel"  # class of stakes-v1 whose slope law the planes have
DEPTHS = {"none": None, "half": 0.5, "default": 1.0, "twice": 2.0}
SOFT_LAMBDA = 0.03
_STEPS = 60
_SKIPPED = 40


@dataclass(frozen=True, kw_only=True)
class Plane:
    """Terrain of the episodes: a plane that rises along x.

    Args:
        field: λ, shape [B, H, W].
        slope_deg: inclination of the plane.
        cell_slope_deg: inclination that the cells are said to have.
    """

    field: Tensor
    slope_deg: float = 0.0
    cell_slope_deg: float | None = None


def class_law(slope_deg: Tensor) -> Tensor:
    """Return the mean λ of `CLASS` by slope, shape [1, N]."""
    item = next(item for item in load_recipe("stakes-v1").classes if item.name == CLASS)
    loss = 1e-3 * item.scale * slope_deg**item.exponent + item.offset
    return (1 - loss).clamp(0, 1)[None]


def simulation_on(plane: Plane, physics: Physics) -> PhysicsSimulation:
    """Return episodes of the skid-steered robot on a plane."""
    batch = len(plane.field)
    x_m = (torch.arange(SIZE) + 0.5) * RESOLUTION_M
    height_m = math.tan(math.radians(plane.slope_deg)) * (x_m - CENTRE_M)
    cell_slope_deg = plane.slope_deg
    if plane.cell_slope_deg is not None:
        cell_slope_deg = plane.cell_slope_deg
    ones = torch.ones_like(plane.field)[:, None]
    terrain = Terrain(
        rgb=torch.zeros(batch, 3, SIZE, SIZE, dtype=torch.uint8),
        class_id=torch.zeros_like(plane.field).long(),
        elevation_m=height_m.expand_as(plane.field).contiguous(),
        slope_deg=torch.full_like(plane.field, cell_slope_deg),
        truth=TraversabilityMixture(ones, plane.field[:, None], 0.1 * ones, (0,)),
        traversability=plane.field,
        grid=Grid(SIZE, SIZE, RESOLUTION_M),
        slope_law=class_law,
    )
    far_m = torch.full((batch, 2), 1e3)
    simulation = create_simulation(
        terrain,
        Task(robot=SkidSteer(), objective=GoalDistance(), rules=Rules()),
        World(backend="physics", physics=physics, noise="stored"),
        Endpoints(
            start_m=torch.full((batch, 2), CENTRE_M),
            goal_m=far_m,
            reference_time_s=torch.full((batch,), torch.nan),
        ),
        rng.stream_key(0, "noise"),
        range(batch),
    )
    assert isinstance(simulation, PhysicsSimulation)
    return simulation


def uniform(traversability: Sequence[float]) -> Tensor:
    """Return fields of one λ each, shape [B, H, W]."""
    values = torch.tensor(traversability)[:, None, None]
    return values.expand(-1, SIZE, SIZE).contiguous()


def mean_motion(
    simulation: PhysicsSimulation,
    headings_deg: Sequence[float],
    action: tuple[float, float],
) -> Tensor:
    """Return mean (v along, v across, ω) of steady drives, shape [B, 3]."""
    poses = [
        (CENTRE_M, CENTRE_M, math.radians(heading_deg)) for heading_deg in headings_deg
    ]
    now: Any = simulation.init(torch.tensor(poses))
    actions = torch.tensor([action]).expand(len(poses), 2)
    motions = []
    for _ in range(_STEPS):
        before = now.state
        now, _ = simulation.step(now, actions)
        moved = now.state - before
        heading = before[:, 2] + moved[:, 2] / 2
        along = moved[:, 0] * heading.cos() + moved[:, 1] * heading.sin()
        across = moved[:, 1] * heading.cos() - moved[:, 0] * heading.sin()
        motions.append(torch.stack((along, across, moved[:, 2]), dim=1))
    return torch.stack(motions[_SKIPPED:]).mean(0) / simulation.robot.dt_s


def drives() -> pd.DataFrame:
    """Return the achieved motion on planes, with a row per soil, slope and λ."""
    rows = []
    for soil in SOILS:
        physics = Physics(soil=soil, entrapment=None)
        for slope_deg in SLOPES_DEG:
            traversability = np.repeat(LAMBDAS, len(HEADINGS)).tolist()
            headings = list(HEADINGS.values()) * len(LAMBDAS)
            plane = Plane(field=uniform(traversability), slope_deg=slope_deg)
            simulation = simulation_on(plane, physics)
            straight = mean_motion(simulation, headings, (1.0, 0.0))
            turn = mean_motion(simulation, headings, (0.0, 1.0))
            straight = straight.view(len(LAMBDAS), len(HEADINGS), 3)
            turn = turn.view(len(LAMBDAS), len(HEADINGS), 3)
            for index, value in enumerate(LAMBDAS):
                row: dict[str, Any] = {"soil": soil, "slope": slope_deg, "λ": value}
                for column, name in enumerate(HEADINGS):
                    row[name] = float(straight[index, column, 0])
                row["drift"] = float(straight[index, :, 1].abs().max())
                row["turn"] = float(turn[index, :, 2].mean())
                row["turn drift"] = float(turn[index, :, :2].norm(dim=1).max())
                rows.append(row)
    return pd.DataFrame(rows)


def patches(seconds: float = 20.0) -> pd.DataFrame:
    """Return the time in which a robot crosses soft cells; NaN if they hold it."""
    cases = [(n, is_centred) for n in (1, 2, 3, 4) for is_centred in (True, False)]
    field = uniform([0.8] * len(cases))
    poses = []
    middle = SIZE // 2
    for index, (n, is_centred) in enumerate(cases):
        row = middle - n // 2 if is_centred else middle
        field[index, row : row + n, 36 : 36 + n] = SOFT_LAMBDA
        y_m = (row + n / 2) * RESOLUTION_M if is_centred else CENTRE_M
        poses.append((CENTRE_M, y_m, 0.0))
    ends_m = torch.tensor([(36 + n) * RESOLUTION_M + 0.5 for n, _ in cases])
    rows = []
    for name, factor in DEPTHS.items():
        entrapment = None
        if factor is not None:
            default = Entrapment()
            entrapment = replace(default, sinkage=factor * default.sinkage)
        simulation = simulation_on(Plane(field=field), Physics(entrapment=entrapment))
        now: Any = simulation.init(torch.tensor(poses))
        crossed_s = torch.full((len(cases),), torch.nan)
        action = torch.tensor([[1.0, 0.0]]).expand(len(cases), 2)
        dt_s = simulation.robot.dt_s
        for step in range(round(seconds / dt_s)):
            now, _ = simulation.step(now, action)
            is_new = (now.state[:, 0] > ends_m) & crossed_s.isnan()
            crossed_s[is_new] = (step + 1) * dt_s
        row_of: dict[str, Any] = {"ruts": name}
        for (n, is_centred), time_s in zip(cases, crossed_s.tolist(), strict=True):
            row_of[f"{n}×{n}{'' if is_centred else ' off'}"] = time_s
        rows.append(row_of)
    return pd.DataFrame(rows)


def measured_curve(name: str, slope_deg: float) -> float:
    """Return λ = 1 − s at which a measured wheel pulls tan ψ; 0 if it cannot."""
    numbers = measured_wheels()[name]
    needed = numbers["resistance"] + math.tan(math.radians(slope_deg))
    if needed >= numbers["traction"]:
        return 0.0
    slip = -numbers["shear_slip"] * math.log(1 - needed / numbers["traction"])
    return max(0.0, 1 - slip)


def slopes(slopes_deg: Sequence[float] = (0, 1, 2, 3, 4, 6, 8, 10)) -> pd.DataFrame:
    """Return λ by slope along the heading.

    The cells have the λ of the measured wheel on level soil, and claim to be level, so
    that only gravity acts on the body.
    """
    rows = []
    for slope_deg in slopes_deg:
        row: dict[str, Any] = {"slope": slope_deg}
        for name in measured_wheels():
            soil: Soil = Janosi(wheel=name)
            field = uniform([measured_curve(name, 0)])
            plane = Plane(field=field, slope_deg=slope_deg, cell_slope_deg=0.0)
            simulation = simulation_on(plane, Physics(soil=soil, entrapment=None))
            speed = float(mean_motion(simulation, [0.0], (1.0, 0.0))[0, 0])
            row[f"{name}, measured"] = measured_curve(name, slope_deg)
            row[f"{name}, body"] = speed
        row[f"law of {CLASS}"] = float(class_law(torch.tensor([slope_deg * 1.0])))
        rows.append(row)
    return pd.DataFrame(rows)


TABLES = {"drives": drives, "patches": patches, "slopes": slopes}


def main(name: str) -> None:
    """Print a table."""
    table = TABLES[name]()
    print_table(table_of(table.round(3)))


if __name__ == "__main__":
    main(*sys.argv[1:])
