"""Planes, patches and drives for the tests of physics."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.planning.robots import Robot, SkidSteer
from benchnav.planning.world.physics.settings import Entrapment, Physics
from benchnav.planning.world.physics.simulation import PhysicsSimulation
from benchnav.planning.world.tracks import create_simulation
from benchnav.planning.world.world import World
from tests import factories

KEY = rng.stream_key(0, "noise")
ROBOT = SkidSteer()
SIZE = 64
CENTRE = 16.0
FIRM = Physics(entrapment=None)


def slope_law(slope_deg: Tensor) -> Tensor:
    """Mean λ of the only class."""
    return (0.95 - 0.006 * slope_deg**1.6).clamp(0, 1)[None]


def simulation(
    field: Tensor,
    physics: Physics = FIRM,
    robot: Robot = ROBOT,
    slope_deg: float | Tensor = 0.0,
    world: dict[str, Any] | None = None,
    **terrain: Any,
) -> PhysicsSimulation:
    """Episodes on λ [B, H, W], on planes that rise along x, or on given maps."""
    x = (torch.arange(field.shape[2]) + 0.5) * 0.5
    slope_map = torch.as_tensor(slope_deg).expand(field.shape).float().contiguous()
    maps: dict[str, Any] = {
        "elevation_m": slope_map.deg2rad().tan() * (x - CENTRE),
        "slope_deg": slope_map,
        "slope_law": slope_law,
    }
    goals = torch.tensor([[300.0, 300.0]]).expand(len(field), 2)
    settings: dict[str, Any] = {"noise": "stored", "immobile": None} | (world or {})
    sim = create_simulation(
        replace(factories.terrain(field), **maps | terrain),
        factories.task(robot=robot),
        World(backend="physics", physics=physics, **settings),
        factories.places(goals),
        KEY,
        range(len(field)),
    )
    assert isinstance(sim, PhysicsSimulation)
    return sim


def uniform(traversability: Sequence[float]) -> Tensor:
    values = torch.tensor(traversability)[:, None, None]
    return values.expand(-1, SIZE, SIZE).contiguous()


@dataclass
class Driven:
    """Mean speeds of a drive, each of shape [B], and its last state."""

    along_mps: Tensor
    across_mps: Tensor
    turn_radps: Tensor
    observed: Tensor
    track: Tensor
    last: Any


def drive(
    sim: PhysicsSimulation,
    headings_deg: Sequence[float],
    action: tuple[float, float],
    steps: int = 40,
    skipped: int = 20,
    start: tuple[float, float] = (CENTRE, CENTRE),
) -> Driven:
    """Drive with one action; the first steps are not in the means."""
    poses = [(*start, math.radians(heading)) for heading in headings_deg]
    now: Any = sim.init(torch.tensor(poses))
    states = [now.state]
    seen = []
    for _ in range(steps):
        now, observed = sim.step(now, torch.tensor([action]).expand(len(poses), 2))
        states.append(now.state)
        seen.append(observed)
    track = torch.stack(states)
    moved = track[1:] - track[:-1]
    heading = (track[1:, :, 2] + track[:-1, :, 2]) / 2
    along = moved[..., 0] * heading.cos() + moved[..., 1] * heading.sin()
    across = moved[..., 1] * heading.cos() - moved[..., 0] * heading.sin()
    dt_s = sim.robot.dt_s
    return Driven(
        along_mps=along[skipped:].mean(0) / dt_s,
        across_mps=across[skipped:].mean(0) / dt_s,
        turn_radps=moved[skipped:, :, 2].mean(0) / dt_s,
        observed=torch.stack(seen)[skipped:].mean(0),
        track=track,
        last=now,
    )


ENTRAPMENT = Physics(entrapment=Entrapment())
