"""Sensors of appearance and of λ, and the input of a planner at each step.

A sensor receives the truth and returns a measurement of it: the appearance of cells
(kind `sensor`) or their λ (kind `ground`). Its noise is a function of episode, cell and
step, so that all planners and beliefs have common random numbers. By default, a robot
has the sensor `contact`, which measures λ of the cell or the contacts under it.
Letters in shapes: B episodes, S state dimensions, H×W cells, N sensed cells.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.batch import Batch
from benchnav.core.errors import expect
from benchnav.core.grid import Grid
from benchnav.core.specified import Specified
from benchnav.core.terrain import Observation, Terrain
from benchnav.planning.footprint import Footprint
from benchnav.planning.robots import Robot

MIN_STD = 1e-3
"""Minimum standard deviation of noise in normal scores, for which beliefs are solvable."""


@dataclass(frozen=True, kw_only=True)
class Step(Batch):
    """Input of a planner at each step.

    Args:
        state: robot states, shape [B, S].
        traversability: λ observed under the robot in the last step; NaN in the first
            step, shape [B].
        time_s: time since the start of the episodes, in seconds.
        draw: whether the plan will be shown in a figure. If False, a planner may omit
            the layers of its `Plan`.
    """

    state: Tensor
    traversability: Tensor
    time_s: float
    draw: bool = False


@dataclass(frozen=True, kw_only=True)
class Appearance(Batch):
    """Appearance of cells in a step.

    Args:
        seen: mask of observed cells, bool, shape [B, H, W].
        observation: colour, elevation and layers of the observed cells. Values of other
            cells are ignored. Slopes are ignored too, since they are computed from the
            observed elevation.
        noise_level: noise of each cell's observation, in any unit, shape [B, H, W]. The
            memory keeps the observation of lowest noise level.
    """

    seen: Tensor
    observation: Observation
    noise_level: Tensor


@dataclass(frozen=True, kw_only=True)
class Measurement(Batch):
    """Measurement of a sensor in a step.

    Args:
        traversability: measured λ; NaN in cells that are not measured, shape [B, H, W].
        std: standard deviation of the noise in normal scores, at least `MIN_STD`, shape
            [B, H, W]; ignored in cells that are not measured.
        appearance: appearance of cells; None if the sensor measures only λ.
    """

    traversability: Tensor
    std: Tensor
    appearance: Appearance | None = None

    @classmethod
    def of_appearance(cls, appearance: Appearance) -> "Measurement":
        """Return a measurement of appearance without λ."""
        unmeasured = torch.full_like(appearance.noise_level, torch.nan)
        return cls(
            traversability=unmeasured,
            std=torch.ones_like(unmeasured),
            appearance=appearance,
        )

    @property
    def mask(self) -> Tensor:
        """Mask of cells whose λ is measured, bool, shape [B, H, W]."""
        return ~self.traversability.isnan()


@dataclass(frozen=True)
class NoiseKey:
    """Key of a sensor's noise: common random numbers for all planners and beliefs.

    Args:
        keys: stream key of each episode, length B.
        step: number of steps taken so far: one integer for all episodes, or B integers.
    """

    keys: Sequence[int]
    step: int | Sequence[int]

    def normal(self, name: str, cells: Tensor, shape: tuple[int, ...] = ()) -> Tensor:
        """Draw standard normals for the cells of a mask in this step.

        The numbers of a cell do not depend on the other cells of the mask.

        Args:
            name: name of the stream. If a sensor draws more than once in a step, each
                draw needs its own name.
            cells: mask of N cells, bool, shape [B, H, W].
            shape: shape of the numbers of each cell; up to four numbers take about the
                time of one.

        Returns:
            Standard normals, float64, in the order of `cells.nonzero()`, shape
            [N, *shape].
        """
        indices = cells.flatten(1).nonzero().cpu().numpy()
        episode, cell = indices.T
        steps = np.broadcast_to(np.array(self.step), len(self.keys))
        keys = [rng.stream_key(key, name) for key in self.keys]
        n_cells = cells[0].numel()
        counters = steps[episode] * n_cells + cell
        per_cell = int(np.prod(shape, dtype=int))
        normals = rng.normal_of_each(keys, episode, counters, per_cell)
        draws = normals.reshape(-1, *shape)
        return torch.from_numpy(draws).to(cells.device)


class Sensor(Specified, ABC):
    """Base class of sensors: parts of kind `sensor` (appearance) and `ground` (λ).

    Attributes:
        sees_all: whether the sensor observes the whole map before the episode starts.
            If True, `sense` is not called during the episode.
    """

    sees_all: ClassVar[bool] = False

    def mounted(self, robot: Robot) -> "Sensor":
        """Return the sensor as mounted on a robot; by default, the sensor itself."""
        return self

    @abstractmethod
    def sense(
        self, terrain: Terrain, field: Tensor, robot_state: Tensor, noise_key: NoiseKey
    ) -> Measurement:
        """Return a measurement of the terrain.

        Args:
            terrain: the B true maps.
            field: current λ of all cells, shape [B, H, W].
            robot_state: robot states that begin with (x, y, θ), shape [B, S].
            noise_key: key of the noise of this step.

        Returns:
            The measurement. It may depend only on the truth of the cells that it
            contains; `check_sensor` tests this by changing the truth of other cells.
        """


@dataclass(frozen=True)
class Full(Sensor):
    """Appearance of the whole map, without noise, before the episode starts."""

    sees_all: ClassVar[bool] = True

    def sense(
        self, terrain: Terrain, field: Tensor, robot_state: Tensor, noise_key: NoiseKey
    ) -> Measurement:
        """Return the appearance of all cells."""
        seen = torch.ones_like(field, dtype=torch.bool)
        observation = terrain.observe()
        noise_level = torch.zeros_like(field)
        appearance = Appearance(
            seen=seen, observation=observation, noise_level=noise_level
        )
        return Measurement.of_appearance(appearance)


@dataclass(frozen=True)
class Contact(Sensor):
    """Sensor of λ under the robot, without noise; the default sensor of λ.

    It measures the robot's own cell. On a robot with a footprint, it measures the cells
    under the contacts instead.
    """

    def mounted(self, robot: Robot) -> Sensor:
        """Return the sensor of the robot's contacts, if it has any."""
        footprint = robot.footprint
        return self if footprint is None else _Contacts(footprint)

    def sense(
        self, terrain: Terrain, field: Tensor, robot_state: Tensor, noise_key: NoiseKey
    ) -> Measurement:
        """Return λ of the robot's own cell."""
        return _measure_at(terrain.grid, field, robot_state[:, :1], robot_state[:, 1:2])


@dataclass(frozen=True)
class _Contacts(Contact):
    """Contact sensor of a robot with a footprint."""

    footprint: Footprint

    def sense(
        self, terrain: Terrain, field: Tensor, robot_state: Tensor, noise_key: NoiseKey
    ) -> Measurement:
        """Return λ of the cells under the robot's contacts."""
        x, y = self.footprint.contacts(robot_state).flatten(1, 2).unbind(2)
        return _measure_at(terrain.grid, field, x, y)


def _measure_at(grid: Grid, field: Tensor, x: Tensor, y: Tensor) -> Measurement:
    """Return exact λ of the cells at positions (x, y) in metres, both [B, P]."""
    row, column = grid.cell_of(x, y)
    episode, position = grid.contains(x, y).nonzero(as_tuple=True)
    cells = episode, row[episode, position], column[episode, position]
    values = torch.full_like(field, torch.nan)
    values[cells] = field[cells]
    return Measurement(traversability=values, std=torch.full_like(field, MIN_STD))


@dataclass(frozen=True)
class Probe(Sensor):
    """Sensor of λ of all cells whose centre is near the robot, with noise.

    Noise is added to the normal score of a cell's λ. Hence a measurement lies in
    [0, 1], and λ near an atom at 0 or 1 can be measured as 0 or 1. λ at an atom is
    measured without noise, since the atom's score is an interval. A score drawn from
    that interval would mislead beliefs about neighbouring cells.

    Args:
        radius_m: maximum distance from the robot to a cell centre, in metres.
        noise_std: standard deviation of the noise, in normal scores.
    """

    radius_m: float = 1.0
    noise_std: float = 0.1

    def __post_init__(self) -> None:
        """Validate the radius and the noise."""
        expect(
            0 < self.radius_m < float("inf"),
            f"`radius_m` of sensor 'probe' > 0 and finite, got {self.radius_m}.",
        )
        expect(
            MIN_STD <= self.noise_std < float("inf"),
            f"`noise_std` of sensor 'probe' ≥ {MIN_STD:g} and finite, got "
            f"{self.noise_std}.",
        )

    def sense(
        self, terrain: Terrain, field: Tensor, robot_state: Tensor, noise_key: NoiseKey
    ) -> Measurement:
        """Return noisy λ of the cells near the robot."""
        in_range = self._in_range(terrain, robot_state)
        cells = in_range.nonzero(as_tuple=True)
        true_distribution = terrain.truth.at(in_range)
        value = field[cells]
        interval = true_distribution.to_normal(value[None])
        lower, upper = (ends[0].double() for ends in interval)
        # An atom has no single score to which noise could be added.
        is_atom = upper > lower
        noise = noise_key.normal("noise", in_range)
        score = lower.masked_fill(is_atom, 0.0) + self.noise_std * noise
        noisy_score = score[None].to(value.dtype)
        noisy = true_distribution.from_normal(noisy_score)[0].to(field.dtype)
        values = torch.full_like(field, torch.nan)
        values[cells] = torch.where(is_atom, value, noisy)
        std = torch.full_like(field, self.noise_std)
        return Measurement(traversability=values, std=std)

    def _in_range(self, terrain: Terrain, robot_state: Tensor) -> Tensor:
        """Return a mask of cells with centres within the radius, bool, [B, H, W]."""
        grid = terrain.grid
        device = robot_state.device
        row = torch.arange(grid.height, device=device)
        column = torch.arange(grid.width, device=device)
        x, y = grid.centre_of(row[:, None], column[None, :])
        dx = x - robot_state[:, 0, None, None]
        dy = y - robot_state[:, 1, None, None]
        in_columns = dx.abs() <= self.radius_m
        in_rows = dy.abs() <= self.radius_m
        in_square = in_columns & in_rows
        # Distances of all cells would take as long as the rest of a measurement.
        episode, row, column = in_square.nonzero(as_tuple=True)
        distance = torch.hypot(dx[episode, 0, column], dy[episode, row, 0])
        return in_square.index_put((episode, row, column), distance <= self.radius_m)
