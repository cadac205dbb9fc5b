"""Simulation of robots whose left and right sides slip apart.

Each side has the mean λ of its contacts, which scales the speed of its wheels over the
terrain. Hence a robot with one side on soft terrain turns towards it. Letters in
shapes: B episodes, S state and A action dimensions.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchnav.core.terrain import Terrain
from benchnav.planning.problem import Task
from benchnav.planning.world.backend import check_backend as check_backend
from benchnav.planning.world.physics.simulation import PhysicsSimulation
from benchnav.planning.world.simulation import Simulation, SimulationState
from benchnav.planning.world.world import Endpoints, World


@dataclass(frozen=True)
class TrackState(SimulationState):
    """State of a batch of episodes with wheels that follow the command with a lag.

    Args:
        velocity: (v, ω) of the wheels, in m/s and rad/s, shape [B, 2].
    """

    velocity: Tensor


class TrackSimulation(Simulation):
    """Simulation of robots with a footprint; see `Simulation` for the arguments."""

    def __init__(
        self,
        terrain: Terrain,
        task: Task,
        world: World,
        places: Endpoints,
        noise_key: int,
        maps: Sequence[int],
    ) -> None:
        """Draw all noise.

        Raises:
            ConfigError: If the robot has no footprint, or one that does not fit the
                goal's disc or the cells.
        """
        check_backend(task, world, terrain.grid)
        footprint = task.robot.footprint
        assert footprint is not None
        super().__init__(terrain, task, world, places, noise_key, maps)
        self._footprint = footprint
        dt_s = task.robot.dt_s
        # Fraction of the difference to the command that wheels make up in a step.
        self._response = 1.0
        if world.lag_s is not None:
            self._response = 1 - math.exp(-dt_s / world.lag_s)

    def init(self, start: Tensor) -> TrackState:
        """Return the state at the start, with standing wheels; see `Simulation`."""
        first = super().init(start)
        return TrackState(**vars(first), velocity=torch.zeros_like(start[:, :2]))

    def _move(
        self, now: SimulationState, action: Tensor, traversability: Tensor
    ) -> tuple[SimulationState, Tensor]:
        """Return the state after the motion of a step, and the observed λ."""
        assert isinstance(now, TrackState)
        commanded = torch.stack(self._velocity(now, action), dim=1)
        velocity = torch.lerp(now.velocity, commanded, self._response)
        velocity = torch.where(now.running[:, None], velocity, now.velocity)
        half_track_m = self._footprint.track_m / 2
        side_signs = velocity.new_tensor([-1.0, 1.0])  # left, right
        wheel_speeds = velocity[:, :1] + side_signs * half_track_m * velocity[:, 1:]
        contacts = self._footprint.contacts(now.state).flatten(1, 2)
        met = self._realisation.at_positions(
            contacts[..., 0], contacts[..., 1], now.step
        )
        of_sides = met.unflatten(1, (2, 2)).mean(2)
        ground_speeds = of_sides * wheel_speeds
        speed = ground_speeds.mean(1)
        turn_rate = (ground_speeds[:, 1] - ground_speeds[:, 0]) / (2 * half_track_m)
        heading = now.state[:, 2]
        dt_s = self.robot.dt_s
        state = self.unhindered(now, action)
        pose = torch.stack(
            (
                now.state[:, 0] + speed * heading.cos() * dt_s,
                now.state[:, 1] + speed * heading.sin() * dt_s,
                heading + turn_rate * dt_s,
            ),
            dim=1,
        )
        state = torch.cat((pose, state[:, 3:]), dim=1)
        moved_m = wheel_speeds.abs()
        total = moved_m.sum(1)
        weighted = (of_sides * moved_m).sum(1) / total
        observed = torch.where(total > 0, weighted, of_sides.mean(1))
        return replace(now, state=state, velocity=velocity), observed


SIMULATIONS = {
    "kinematic": Simulation,
    "tracks": TrackSimulation,
    "physics": PhysicsSimulation,
}


def create_simulation(
    terrain: Terrain,
    task: Task,
    world: World,
    places: Endpoints,
    noise_key: int,
    maps: Sequence[int],
) -> Simulation:
    """Return the simulation of a world's backend; see `Simulation` for the arguments.

    Raises:
        ConfigError: If the robot does not suit the backend.
    """
    simulation = SIMULATIONS[world.backend]
    return simulation(terrain, task, world, places, noise_key, maps)
