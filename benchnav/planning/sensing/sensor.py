"""What a robot senses: the λ of the ground under it and near it, and what its planner is told at each time step.

A sensor of the ground is given the truth and says which cells' λ a robot learns in a step, and how well. Its noise is
keyed by episode, cell and step, so that every planner and belief meets the same. `contact` is what every robot has:
the λ of the cell under it. Letters in shapes: B episodes, S state dimensions, H×W cells, N sensed cells.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.batch import Batch
from benchnav.core.errors import expect
from benchnav.core.terrain import Terrain

LEAST_STD = 1e-3  # of noise, in normal scores: keeps the equations of a belief solvable
_MOST_SCORE = 8.0  # standard deviations; beyond it a rank within an atom is not told from its end


@dataclass(frozen=True, kw_only=True)
class Step(Batch):
    """What a planner is told at each step.

    Args:
        state: where the robots are, shape [B, S].
        traversability: the λ that each met in the last step, NaN at first, shape [B].
        time_s: time since the episodes began.
        draw: what is planned will be drawn; a planner may leave the layers of its `Plan` out otherwise.
    """

    state: Tensor
    traversability: Tensor
    time_s: float
    draw: bool = False


@dataclass(frozen=True, kw_only=True)
class Sensed(Batch):
    """What is learnt of the ground in a step.

    Args:
        traversability: λ of the cells that are sensed, NaN in all others, shape [B, H, W].
        std: standard deviation of the noise in normal scores, at least `LEAST_STD`, shape [B, H, W]; of cells that
            are not sensed it means nothing.
    """

    traversability: Tensor
    std: Tensor

    @property
    def mask(self) -> Tensor:
        """Which cells are sensed, bool, shape [B, H, W]."""
        return ~self.traversability.isnan()


@dataclass(frozen=True)
class Moment:
    """Which noise a sensor meets.

    Args:
        keys: a stream key of each episode, B of them.
        step: how many steps were taken.
    """

    keys: Sequence[int]
    step: int

    def normal(self, name: str, wanted: Tensor) -> Tensor:
        """Standard normals, one for each wanted cell of each episode in this step, whatever else is wanted.

        Args:
            name: of the stream, for a sensor that draws more than one number a cell.
            wanted: bool, shape [B, H, W].

        Returns:
            Float64, in the order of `wanted.nonzero()`, shape [N].
        """
        count, flat = wanted[0].numel(), wanted.flatten(1).cpu()
        drawn = [
            rng.normal(rng.stream_key(key, name), self.step * count + row.nonzero()[:, 0].numpy())
            for key, row in zip(self.keys, flat, strict=True)
            if bool(row.any())
        ]
        found = np.concatenate(drawn) if drawn else np.empty(0)
        return torch.from_numpy(found).to(wanted.device)


class Sensor(ABC):
    """What a robot learns of the λ of the ground: the base class of the parts of kind `ground`."""

    @abstractmethod
    def sense(self, terrain: Terrain, field: Tensor, robot_state: Tensor, moment: Moment) -> Sensed:
        """Senses once.

        Args:
            terrain: the truth, B maps.
            field: λ of every cell as it is now, shape [B, H, W].
            robot_state: beginning with (x, y, θ), shape [B, S].
            moment: gives the noise.

        Returns:
            What is learnt. A sensor may look at the truth of the cells that it reports, and at no other: `check_sensor`
            replaces all others.
        """


@dataclass(frozen=True)
class Contact(Sensor):
    """The λ of the cell under the robot, without noise: what every robot has."""

    def sense(self, terrain: Terrain, field: Tensor, robot_state: Tensor, moment: Moment) -> Sensed:
        """Senses the robot's own cell."""
        x, y = robot_state[:, 0], robot_state[:, 1]
        row, column = terrain.grid.cell_of(x, y)
        found = torch.full_like(field, torch.nan)
        member = torch.arange(len(field), device=field.device)[terrain.grid.contains(x, y)]
        row, column = row[member], column[member]
        found[member, row, column] = field[member, row, column]
        return Sensed(traversability=found, std=torch.full_like(field, LEAST_STD))


@dataclass(frozen=True)
class Probe(Sensor):
    """The λ of all cells whose centres are near the robot, with noise in normal scores.

    A cell's rank among the values that its distribution allows is a standard normal number; the noise is added to that,
    so that what is sensed is in [0, 1] and an atom at 0 or 1 can be mistaken for ground beside it.

    Args:
        radius_m: how near.
        noise_std: standard deviation of the noise, in normal scores.
    """

    radius_m: float = 1.0
    noise_std: float = 0.1

    def __post_init__(self) -> None:
        """Refuses what senses nothing, or too well to be conditioned on."""
        expect(0 < self.radius_m < float("inf"), f"`radius_m` > 0 and finite, got {self.radius_m}.")
        expect(
            LEAST_STD <= self.noise_std < float("inf"),
            f"`noise_std` of at least {LEAST_STD:g} and finite, got {self.noise_std}.",
        )

    def sense(self, terrain: Terrain, field: Tensor, robot_state: Tensor, moment: Moment) -> Sensed:
        """Senses the cells near the robot."""
        near = self._near(terrain, robot_state)
        wanted = near.nonzero(as_tuple=True)
        truth, value = terrain.truth.at(near), field[wanted]
        lower, upper = (ends[0].double() for ends in truth.to_normal(value[None]))
        # In an atom all ranks are alike: one of them, at random.
        low, high = (torch.special.ndtr(end.clamp(-_MOST_SCORE, _MOST_SCORE)) for end in (lower, upper))
        rank = torch.special.ndtr(moment.normal("rank", near))
        score = torch.where(upper > lower, torch.special.ndtri(low + (high - low) * rank), lower)
        score = score + self.noise_std * moment.normal("noise", near)
        found = torch.full_like(field, torch.nan)
        found[wanted] = truth.from_normal(score[None].to(value.dtype))[0].to(field.dtype)
        return Sensed(traversability=found, std=torch.full_like(field, self.noise_std))

    def _near(self, terrain: Terrain, robot_state: Tensor) -> Tensor:
        """Cells whose centres are within the radius, bool, shape [B, H, W]."""
        grid = terrain.grid
        row, column = (torch.arange(size, device=robot_state.device) for size in grid.shape)
        x, y = grid.centre_of(row[:, None], column[None, :])
        away = torch.hypot(x - robot_state[:, 0, None, None], y - robot_state[:, 1, None, None])
        return away <= self.radius_m
