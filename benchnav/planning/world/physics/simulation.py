"""Simulation of robots as rigid bodies on wheels, which soil pulls.

λ under a wheel is that of its cell at the begin of a step, as in other backends. All
that changes during an episode is in `PhysicsState`, so that `step` is a function: the
same state gives the same result in any batch and order, bit for bit on one machine.
Letters in shapes: B episodes, W wheels, H×W cells, S state and A action dimensions.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from benchnav.core.errors import expect
from benchnav.core.terrain import Terrain
from benchnav.planning.problem import Task
from benchnav.planning.world.backend import check_backend
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.physics.body import drive_of
from benchnav.planning.world.physics.maps import check_heights
from benchnav.planning.world.physics.settings import Physics, sub_steps
from benchnav.planning.world.physics.workspace import (
    BROKEN,
    CONTROLLER_SIZE,
    MEAN_SPEED,
    MEAN_TURN,
    ROLLED_OVER,
    Maps,
    Workspace,
    workspace,
)
from benchnav.planning.world.simulation import (
    MIN_WHEEL_SPEED_MPS,
    Simulation,
    SimulationState,
)
from benchnav.planning.world.world import Endpoints, World

SETTLE_S = 0.5
"""Time in which a body sinks onto the terrain before an episode, in seconds."""
LAW_STEP_DEG = 0.5
_LAW_SLOPES_DEG = torch.arange(0, 90 + LAW_STEP_DEG, LAW_STEP_DEG, dtype=torch.float64)


@dataclass(frozen=True)
class PhysicsState(SimulationState):
    """State of a batch of episodes with bodies.

    Args:
        body: state of MuJoCo, float64, shape [B, ·].
        memory: numbers of the controller, then rut depths in metres and loads in N of
            the wheels; see drive.c, float64, shape [B, 6 + 2 W].
        contacts_m: positions (x, y) of the contacts, float64, shape [B, 2 W].
        status: 0, or what went wrong; see `workspace.Moved`, int64, shape [B].
    """

    body: Tensor
    memory: Tensor
    contacts_m: Tensor
    status: Tensor

    @property
    def ruts_m(self) -> Tensor:
        """Depth of each wheel's rut in metres, shape [B, W]."""
        n_wheels = self.contacts_m.shape[1] // 2
        return self.memory[:, CONTROLLER_SIZE : CONTROLLER_SIZE + n_wheels]


class PhysicsSimulation(Simulation):
    """Simulation of bodies on soil; see `Simulation` for the arguments."""

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
            ConfigError: If MuJoCo or a compiler is missing, the robot or the body does
                not suit the backend, or heights are missing.
        """
        physics = world.physics
        assert physics is not None
        self._physics: Physics = physics
        check_backend(task, world, terrain.grid)
        self._drive = drive_of(task.robot)
        self._sub_steps = sub_steps(task.robot.dt_s, physics.substep_s)
        goal_radius_m = task.rules.goal_radius_m
        contact_radius_m = self._workspace.contact_radius_m
        expect(
            contact_radius_m <= goal_radius_m,
            f"a body within the goal's disc of {goal_radius_m:g} m, got wheels "
            f"{contact_radius_m:g} m from the robot's position. Increase "
            "`task.goal_radius_m`.",
        )
        footprint = task.robot.footprint
        assert footprint is not None
        expect(
            contact_radius_m <= 1.01 * footprint.radius_m,
            "a body whose wheels are within the robot's footprint of "
            f"{footprint.radius_m:.3g} m, which planners keep clear, got wheels "
            f"{contact_radius_m:.3g} m from its position. Increase the robot's `track_m` "
            "or `wheelbase_m`.",
        )
        check_heights(terrain, physics)
        super().__init__(terrain, task, world, places, noise_key, maps)
        self._noise_key = noise_key
        self._map_indices = torch.as_tensor([int(index) for index in maps])
        self._height_m = terrain.elevation_m.double().cpu().contiguous()
        self._slope_deg = terrain.slope_deg.double().cpu()
        self._class_id = terrain.class_id.cpu()
        self._law = None
        if terrain.slope_law is not None:
            self._law = terrain.slope_law(_LAW_SLOPES_DEG).double()

    def init(self, start: Tensor) -> PhysicsState:
        """Return the state of bodies that have settled at the start; see `Simulation`.

        Args:
            start: robot states, shape [B, S].
        """
        first = super().init(start)
        pose = start[:, :3].double().cpu()
        contacts_m = pose[:, None, :2].expand(-1, self._workspace.n_wheels, -1)
        cells, _ = self._cells(contacts_m, first.step)
        count = max(1, round(SETTLE_S / self._physics.substep_s))
        body, memory, moved = self._workspace.place(
            self._maps(), count, pose.numpy(), cells
        )
        return PhysicsState(
            **vars(first),
            body=torch.from_numpy(body),
            memory=torch.from_numpy(memory),
            contacts_m=torch.from_numpy(moved.contacts_m).flatten(1),
            status=torch.from_numpy(moved.status).long(),
        )

    def step(
        self, now: SimulationState, action: Tensor
    ) -> tuple[SimulationState, Tensor]:
        """Advance the running episodes by one step; see `Simulation`."""
        after, observed = super().step(now, action)
        assert isinstance(after, PhysicsState)
        status = after.status.to(after.outcome.device)
        outcome = after.outcome
        rolls = (status == ROLLED_OVER) & (outcome != Outcome.SUCCESS)
        outcome = torch.where(rolls, Outcome.ROLLOVER, outcome)
        outcome = torch.where(status == BROKEN, Outcome.MODEL_ERROR, outcome)
        outcome = torch.where(now.running, outcome, now.outcome)
        return replace(after, outcome=outcome), observed

    def drawn(self, now: SimulationState) -> dict[str, Tensor]:
        """Return poses of bodies and wheels, and ruts; see `Simulation`.

        Wheels have the order of the body's MJCF; in the shipped body: front left, front
        right, rear left, rear right.

        Returns:
            `contacts_m`: positions (x, y) of the contacts in metres, shape [B, W, 2].
            `position_m`: position (x, y, z) of the body's reference point, [B, 3].
            `rotation`: quaternion (w, x, y, z) of the body, shape [B, 4].
            `wheels_m`: centres (x, y, z) of the wheels in metres, shape [B, W, 3].
            `wheel_radius_m`: radii of the wheels in metres, shape [B, W].
            `ruts_m`: depth of each wheel's rut in metres, shape [B, W].
        """
        assert isinstance(now, PhysicsState)
        pose = now.body[:, 1:8]  # after the time: position and quaternion of the root
        wheels_m = torch.from_numpy(self._workspace.wheels(now.body.numpy()))
        radius_m = torch.as_tensor(self._workspace.wheel_radius_m)
        return {
            "contacts_m": now.contacts_m.unflatten(1, (-1, 2)),
            "position_m": pose[:, :3],
            "rotation": pose[:, 3:],
            "wheels_m": wheels_m,
            "wheel_radius_m": radius_m.expand(len(pose), -1),
            "ruts_m": now.ruts_m,
        }

    def faults(self, now: SimulationState) -> list[str]:
        """Return a message for each episode whose physics failed; otherwise empty."""
        assert isinstance(now, PhysicsState)
        messages = []
        for episode, status in enumerate(now.status.tolist()):
            message = ""
            if status == BROKEN:
                message = (
                    f"Expected a finite motion of the body on map "
                    f"{int(self._map_indices[episode])}, got one that diverged in step "
                    f"{int(now.step[episode])} with noise key {self._noise_key}. Lower "
                    "`physics.substep_s`."
                )
            messages.append(message)
        return messages

    def exchange_(self, indices: Tensor, replacements: Simulation) -> None:
        """Replace M episodes by those of another simulation, in place."""
        assert isinstance(replacements, PhysicsSimulation)
        super().exchange_(indices, replacements)
        members = indices.cpu()
        for name in ("_height_m", "_slope_deg", "_class_id", "_map_indices"):
            values = getattr(self, name)
            other_values = getattr(replacements, name)
            setattr(self, name, values.index_copy(0, members, other_values))

    def _move(
        self, now: SimulationState, action: Tensor, traversability: Tensor
    ) -> tuple[SimulationState, Tensor]:
        """Return the state after the motion of a step, and the observed λ."""
        assert isinstance(now, PhysicsState)
        running = now.running.cpu()
        contacts_m = now.contacts_m.unflatten(1, (-1, 2))
        cells, met = self._cells(contacts_m, now.step)
        command = torch.stack(self._command(now, action), dim=1).double().cpu()
        body = now.body.clone().contiguous()
        memory = now.memory.clone().contiguous()
        moved = self._workspace.advance(
            self._maps(),
            running.nonzero()[:, 0].int().numpy(),
            self._sub_steps,
            body.numpy(),
            memory.numpy(),
            command.contiguous().numpy(),
            cells,
        )
        pose = torch.from_numpy(moved.pose)
        before = now.state[:, :3].double().cpu()
        turns = ((before[:, 2] - pose[:, 2]) / (2 * math.pi)).round()
        pose[:, 2] += 2 * math.pi * turns
        setpoint = memory[:, [MEAN_SPEED, MEAN_TURN]]
        observed = self._observed(before, pose, setpoint, met.mean(1))
        beyond = self.unhindered(now, action)[:, 3:]
        state = torch.cat((pose.to(now.state), beyond), dim=1)
        contacts_after = torch.from_numpy(moved.contacts_m).flatten(1)
        status = torch.from_numpy(moved.status).long()
        after = replace(
            now,
            state=state,
            body=body,
            memory=memory,
            contacts_m=torch.where(running[:, None], contacts_after, now.contacts_m),
            status=torch.where(running, status, now.status),
        )
        return after, observed.to(now.state)

    @property
    def _workspace(self) -> Workspace:
        # It is not an attribute, so that the simulation can be pickled.
        return workspace(self._physics, self._drive)

    def _maps(self) -> Maps:
        law = None if self._law is None else self._law.numpy()
        resolution_m = self._grid.resolution_m
        return Maps(self._height_m.numpy(), resolution_m, law, LAW_STEP_DEG)

    def _cells(self, contacts_m: Tensor, step: Tensor) -> tuple[np.ndarray, Tensor]:
        """Return what the compiled code needs of the cells under wheels, and λ.

        Args:
            contacts_m: positions of the contacts, float64, shape [B, W, 2].
            step: number of steps taken, int64, shape [B].

        Returns:
            λ, slope in degrees and index of the slope law (−1 for none), float64, shape
            [B, W, 3]; and λ, shape [B, W].
        """
        x, y = contacts_m.unbind(2)
        device = step.device
        met = self._realisation.at_positions(x.to(device), y.to(device), step).cpu()
        episode = torch.arange(len(x))[:, None]
        row, column = self._grid.cell_of(x, y)
        slope_deg = self._slope_deg[episode, row, column]
        class_id = self._class_id[episode, row, column]
        if self._law is not None:
            is_known = class_id < len(self._law)
            is_firm = self._is_firm(met, episode, row, column)
            class_id = torch.where(is_known & is_firm, class_id, -1)
        else:
            class_id = torch.full_like(class_id, -1)
        cells = torch.stack((met.double(), slope_deg, class_id.double()), dim=2)
        return cells.contiguous().numpy(), met

    def _is_firm(
        self, met: Tensor, episode: Tensor, row: Tensor, column: Tensor
    ) -> Tensor:
        """Return a mask of cells whose λ is that of firm terrain, bool, shape of `met`.

        The first component of the true mixture is firm terrain, whose mean follows the
        slope law. Other components are soft spots.
        """
        truth = self._realisation.truth
        weights, means, stds = (
            values[episode, :, row, column].cpu()
            for values in (truth.weights, truth.means, truth.stds)
        )
        score = weights.log() - stds.log()
        score -= ((met[..., None] - means) / stds).square() / 2
        return score.argmax(2) == 0

    def _command(self, now: SimulationState, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return (v, ω) or, for a steered robot, (v, δ), each of shape [B]."""
        if self._drive.is_steered:
            return action[:, 0], action[:, 1]
        return self._velocity(now, action)

    def _observed(
        self, before: Tensor, after: Tensor, setpoint: Tensor, met: Tensor
    ) -> Tensor:
        """Return the achieved fraction of the wheels' motion in a step.

        The sides are weighted by their motion, as in the backend `tracks`. Wheels that
        hardly turned observe λ of their cells.

        Args:
            before: poses before the step, float64, shape [B, 3].
            after: poses after the step.
            setpoint: mean (v, ω) or (v, δ) of the wheels in the step, shape [B, 2].
            met: mean λ of the cells under the wheels, shape [B].
        """
        speed, turn = setpoint.unbind(1)
        if self._drive.is_steered:
            turn = speed * turn.tan() / self._drive.wheelbase_m
        dt_s = self.robot.dt_s
        moved = after - before
        heading = before[:, 2] + moved[:, 2] / 2
        along_m = moved[:, 0] * heading.cos() + moved[:, 1] * heading.sin()
        half_track_m = self._drive.track_m / 2
        sides = speed.new_tensor([-half_track_m, half_track_m])
        wheels = speed[:, None] + sides * turn[:, None]
        ground = (along_m[:, None] + sides * moved[:, 2:]) / dt_s
        total = wheels.abs().sum(1)
        achieved = (ground * wheels.sign()).sum(1) / total.clamp(min=1e-9)
        is_moving = wheels.abs().amax(1) >= MIN_WHEEL_SPEED_MPS
        return torch.where(is_moving, achieved.clamp(0, 1), met.double())
