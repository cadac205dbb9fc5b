"""What a robot senses: what ground looks like, its λ, and what its planner is told at
each time step.

A sensor is given the truth and says what of it a robot learns in a step, and how well:
what cells look like (kind `sensor`), or their λ (kind `ground`). Its noise is keyed by
episode, cell and step, so that every planner and belief meets the same. `contact` is
what every robot has: the λ of the cell under it.
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
from benchnav.core.specified import Specified
from benchnav.core.terrain import Observation, Terrain

LEAST_STD = 1e-3  # of noise, in normal scores: keeps the equations of a belief solvable


@dataclass(frozen=True, kw_only=True)
class Step(Batch):
    """What a planner is told at each step.

    Args:
        state: where the robots are, shape [B, S].
        traversability: the λ that each met in the last step, NaN at first, shape [B].
        time_s: time since the episodes began.
        draw: what is planned will be drawn; a planner may leave the layers of its
            `Plan` out otherwise.
    """

    state: Tensor
    traversability: Tensor
    time_s: float
    draw: bool = False


@dataclass(frozen=True, kw_only=True)
class Appearance(Batch):
    """What cells look like in a step.

    Args:
        seen: which cells are seen, bool, shape [B, H, W].
        observation: colour, elevation and layers of the seen cells; what it holds of
            others is not used, nor are its slopes, which are those of the elevation
            that was seen.
        doubt: observation noise of each cell, in any unit, shape [B, H, W]; of several
            observations of a cell the least noisy one is kept.
    """

    seen: Tensor
    observation: Observation
    doubt: Tensor


@dataclass(frozen=True, kw_only=True)
class Sensed(Batch):
    """What is learnt in a step.

    Args:
        traversability: λ of the cells that are sensed, NaN in all others, shape [B, H,
            W].
        std: standard deviation of the noise in normal scores, at least `LEAST_STD`,
            shape [B, H, W]; of cells that are not sensed it means nothing.
        appearance: what cells look like; None from a sensor that does not look.
    """

    traversability: Tensor
    std: Tensor
    appearance: Appearance | None = None

    @classmethod
    def looks(cls, appearance: Appearance) -> "Sensed":
        """What a sensor learns that looks at the ground and senses no λ."""
        nothing = torch.full_like(appearance.doubt, torch.nan)
        return cls(
            traversability=nothing, std=torch.ones_like(nothing), appearance=appearance
        )

    @property
    def mask(self) -> Tensor:
        """Which cells are sensed, bool, shape [B, H, W]."""
        return ~self.traversability.isnan()


@dataclass(frozen=True)
class Moment:
    """Which noise a sensor meets.

    Args:
        keys: a stream key of each episode, B of them.
        step: how many steps were taken, in all episodes or in each, B of them.
    """

    keys: Sequence[int]
    step: int | Sequence[int]

    def normal(self, name: str, wanted: Tensor, shape: tuple[int, ...] = ()) -> Tensor:
        """Standard normals for each wanted cell of each episode in this step, whatever
        else is wanted.

        Args:
            name: of the stream, for a sensor that draws more than once.
            wanted: bool, shape [B, H, W].
            shape: of what is drawn for a cell; four numbers cost hardly more than one.

        Returns:
            Float64, in the order of `wanted.nonzero()`, shape [N, *shape].
        """
        member, cell = wanted.flatten(1).nonzero().cpu().numpy().T
        steps = np.broadcast_to(np.array(self.step), len(self.keys))
        keys = [rng.stream_key(key, name) for key in self.keys]
        drawn = rng.normal_of_each(
            keys,
            member,
            steps[member] * wanted[0].numel() + cell,
            int(np.prod(shape, dtype=int)),
        )
        return torch.from_numpy(drawn.reshape(-1, *shape)).to(wanted.device)


class Sensor(Specified, ABC):
    """What a robot learns in a step: the base class of the parts of kinds `sensor`
    (appearance) and `ground` (λ).

    Attributes:
        sees_all: it shows the whole map at the start and is never asked.
    """

    sees_all: ClassVar[bool] = False

    @abstractmethod
    def sense(
        self, terrain: Terrain, field: Tensor, robot_state: Tensor, moment: Moment
    ) -> Sensed:
        """Senses once.

        Args:
            terrain: the truth, B maps.
            field: λ of every cell as it is now, shape [B, H, W].
            robot_state: beginning with (x, y, θ), shape [B, S].
            moment: gives the noise.

        Returns:
            What is learnt. A sensor may look at the truth of the cells that it reports,
            and at no other: `check_sensor` replaces all others.
        """


@dataclass(frozen=True)
class Full(Sensor):
    """What the whole map looks like, without noise, before the robot sets out."""

    sees_all: ClassVar[bool] = True

    def sense(
        self, terrain: Terrain, field: Tensor, robot_state: Tensor, moment: Moment
    ) -> Sensed:
        """Sees all."""
        seen = torch.ones_like(field, dtype=torch.bool)
        return Sensed.looks(
            Appearance(
                seen=seen, observation=terrain.observe(), doubt=torch.zeros_like(field)
            )
        )


@dataclass(frozen=True)
class Contact(Sensor):
    """The λ of the cell under the robot, without noise: what every robot has."""

    def sense(
        self, terrain: Terrain, field: Tensor, robot_state: Tensor, moment: Moment
    ) -> Sensed:
        """Senses the robot's own cell."""
        x, y = robot_state[:, 0], robot_state[:, 1]
        row, column = terrain.grid.cell_of(x, y)
        found = torch.full_like(field, torch.nan)
        member = torch.arange(len(field), device=field.device)[
            terrain.grid.contains(x, y)
        ]
        row, column = row[member], column[member]
        found[member, row, column] = field[member, row, column]
        return Sensed(traversability=found, std=torch.full_like(field, LEAST_STD))


@dataclass(frozen=True)
class Probe(Sensor):
    """The λ of all cells whose centres are near the robot, with noise in normal scores.

    A cell's rank among the values that its distribution allows is a standard normal
    number; the noise is added to that, so that what is sensed is in [0, 1], and ground
    beside an atom at 0 or 1 can be mistaken for it. An atom is read as
    it is: its λ does not tell where in it the rank lies, and a rank drawn for it would
    tell neighbours what is not so.

    Args:
        radius_m: how near.
        noise_std: standard deviation of the noise, in normal scores.
    """

    radius_m: float = 1.0
    noise_std: float = 0.1

    def __post_init__(self) -> None:
        """Refuses what senses nothing, or too well to be conditioned on."""
        expect(
            0 < self.radius_m < float("inf"),
            f"`radius_m` of the ground probe > 0 and finite, got {self.radius_m}.",
        )
        expect(
            LEAST_STD <= self.noise_std < float("inf"),
            f"`noise_std` of the ground probe of at least {LEAST_STD:g} and finite, "
            f"got {self.noise_std}.",
        )

    def sense(
        self, terrain: Terrain, field: Tensor, robot_state: Tensor, moment: Moment
    ) -> Sensed:
        """Senses the cells near the robot."""
        near = self._near(terrain, robot_state)
        wanted = near.nonzero(as_tuple=True)
        truth, value = terrain.truth.at(near), field[wanted]
        lower, upper = (ends[0].double() for ends in truth.to_normal(value[None]))
        # An atom has no score that noise could move.
        atom = upper > lower
        score = lower.masked_fill(atom, 0.0) + self.noise_std * moment.normal(
            "noise", near
        )
        read = truth.from_normal(score[None].to(value.dtype))[0].to(field.dtype)
        found = torch.full_like(field, torch.nan)
        found[wanted] = torch.where(atom, value, read)
        return Sensed(traversability=found, std=torch.full_like(field, self.noise_std))

    def _near(self, terrain: Terrain, robot_state: Tensor) -> Tensor:
        """Cells whose centres are within the radius, bool, shape [B, H, W]."""
        grid = terrain.grid
        row, column = (
            torch.arange(size, device=robot_state.device) for size in grid.shape
        )
        x, y = grid.centre_of(row[:, None], column[None, :])
        right, up = x - robot_state[:, 0, None, None], y - robot_state[:, 1, None, None]
        near = (right.abs() <= self.radius_m) & (up.abs() <= self.radius_m)
        # Roots of the few cells alone that may be near: those of all take as long as
        # the rest of a look.
        member, row, column = near.nonzero(as_tuple=True)
        away = torch.hypot(right[member, 0, column], up[member, row, 0])
        return near.index_put((member, row, column), away <= self.radius_m)
