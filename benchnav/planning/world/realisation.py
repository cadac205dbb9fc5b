"""The λ that robots meet: a value for each episode, step and place.

Noise is keyed by (root key, instance, step), so every planner and setting meets the same luck, whatever
the batch or the order. Letters in shapes: B episodes, N steps.
"""

import copy
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from benchnav import rng
from benchnav.errors import ConfigError
from benchnav.planning.world.world import World
from benchnav.terrain import Terrain


class Realisation:
    """The λ of B episodes, as the world's noise has it.

    Args:
        terrain: the true maps.
        world: what λ does.
        steps: steps N of the time budget.
        key: root of the noise; see `rng.stream_key`.
        instances: names each episode's stream under that root, B of them.
    """

    def __init__(
        self, terrain: Terrain, world: World, steps: int, key: int, instances: Sequence[int]
    ) -> None:
        """Draws the luck of all steps."""
        self._grid = terrain.grid
        if world.noise == "stored":
            if bool(terrain.traversability.isnan().any()):
                raise ConfigError(
                    "Expected maps with λ in every cell for `noise` 'stored', got some that were not observed. "
                    "Take `noise` 'resampled'."
                )
            self._mean = terrain.grid.pad(terrain.traversability, outside=0.0)
            self._std = torch.zeros_like(self._mean)
        else:
            self._mean = terrain.grid.pad(terrain.truth.means[:, 0], outside=0.0)
            self._std = terrain.grid.pad(terrain.truth.stds[:, 0], outside=0.0)
        # A stream each, so that another time budget leaves the luck of the first steps as it is.
        first = np.zeros(1, dtype=np.int64)
        luck = [rng.normal(rng.stream_key(key, int(i)), first, (steps,)) for i in instances]
        self._noise = torch.from_numpy(np.concatenate(luck)).to(self._mean)

    def at(self, state: Tensor, step: Tensor) -> Tensor:
        """λ that robots meet at their next step.

        Args:
            state: shape [B, S].
            step: steps taken so far, int64, shape [B].

        Returns:
            λ in [0, 1], shape [B].
        """
        x, y = state[:, 0], state[:, 1]
        noise = self._noise.gather(1, step.clamp(max=self._noise.shape[1] - 1)[:, None])[:, 0]
        return (self._grid.lookup(self._mean, x, y) + self._grid.lookup(self._std, x, y) * noise).clamp(0, 1)

    def exchange(self, members: Tensor, others: "Realisation") -> "Realisation":
        """Gives some episodes what they meet in another realisation of the same world.

        Args:
            members: indices of the episodes, int64, shape [M].
            others: of M episodes on maps of the same grid.
        """
        made = copy.copy(self)
        for name in ("_mean", "_std", "_noise"):
            setattr(made, name, getattr(self, name).index_copy(0, members, getattr(others, name)))
        return made
