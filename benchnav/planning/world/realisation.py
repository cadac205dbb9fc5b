"""The λ that robots meet: a value for each episode, step and place.

Noise is keyed by (root key, map, step), or by (root key, map) where λ stays what it is, so every
planner and setting meets the same, whatever the batch or the order. Letters in shapes: B episodes, N steps,
H×W cells, K components.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.planning.world.frozen_field import draw_frozen
from benchnav.planning.world.places import Places
from benchnav.planning.world.world import World


class Realisation:
    """The λ of B episodes, as the world's noise has it.

    Args:
        terrain: the true maps.
        world: what λ does.
        places: starts and goals.
        steps: most steps N of the time budgets.
        key: root key of the noise; see `rng.stream_key`.
        maps: names each episode's stream under that root, B of them.

    Attributes:
        field: the λ of every cell where it stays what it is, shape [B, H, W]; None where it is resampled.
        attempts: how many fields were drawn for each episode, int64, shape [B].
    """

    def __init__(
        self,
        terrain: Terrain,
        world: World,
        places: Places,
        steps: int,
        key: int,
        maps: Sequence[int],
    ) -> None:
        """Draws all noise.

        Raises:
            ConfigError: λ of some cells is not known.
        """
        check_known(terrain, world)
        self._grid = terrain.grid
        self.attempts = torch.ones(len(terrain), dtype=torch.int64, device=terrain.traversability.device)
        self.field: Tensor | None = None
        if world.noise == "stored":
            self.field = terrain.traversability.clone()
        elif world.noise == "frozen":
            self.field, self.attempts = draw_frozen(terrain, world, places, key, maps)
        if self.field is not None:
            self._ground = terrain.grid.pad(self.field, outside=0.0)[:, None]
            return
        truth, grid = terrain.truth, terrain.grid
        parameters = torch.cat((truth.weights, truth.means, truth.stds), dim=1)
        # Framed for lookups, shape [B, 3·K, N].
        self._ground = torch.stack([grid.pad(layer, outside=0.0) for layer in parameters.unbind(1)], dim=1)
        # A stream each, so that another time budget leaves the noise of the first steps as it is.
        first = np.zeros(1, dtype=np.int64)
        noise = [rng.normal(rng.stream_key(key, int(i)), first, (steps,)) for i in maps]
        self._noise = torch.from_numpy(np.concatenate(noise)).to(self._ground)

    def at(self, state: Tensor, step: Tensor) -> Tensor:
        """λ that robots meet at their next step.

        Args:
            state: shape [B, S].
            step: steps taken so far, int64, shape [B].

        Returns:
            λ in [0, 1], shape [B].
        """
        x, y = state[:, 0], state[:, 1]
        if self.field is not None:
            return self._grid.lookup(self._ground[:, 0], x, y)
        noise = self._noise.gather(1, step.clamp(max=self._noise.shape[1] - 1)[:, None])[:, :, None]
        count = self._ground.shape[1]
        found = self._grid.lookup(
            self._ground.flatten(0, 1), x.repeat_interleave(count), y.repeat_interleave(count)
        )
        weights, means, stds = found.view(len(x), 3, count // 3, 1, 1).unbind(1)
        met = TraversabilityMixture(weights, means, stds).from_normal(noise)[:, 0, 0]
        return torch.where(self._grid.contains(x, y), met, 0.0)

    def exchange_(self, members: Tensor, others: "Realisation") -> None:
        """Gives some episodes what they meet in another realisation of the same world, in place.

        Args:
            members: indices of the episodes, int64, shape [M].
            others: of M episodes on maps of the same grid.
        """
        self._ground.index_copy_(0, members, others._ground)
        self.attempts.index_copy_(0, members, others.attempts)
        if self.field is not None and others.field is not None:
            self.field.index_copy_(0, members, others.field)
            return
        # Time budgets may differ; what is beyond an episode's own is never met.
        most = max(self._noise.shape[1], others._noise.shape[1])
        own, new = (torch.nn.functional.pad(n, (0, most - n.shape[1])) for n in (self._noise, others._noise))
        self._noise = own.index_copy(0, members, new)


def check_known(terrain: Terrain, world: World) -> None:
    """Refuses maps with cells whose λ a world cannot tell.

    Raises:
        ConfigError: they have such cells.
    """
    if bool(terrain.truth.means.isnan().any()):
        raise ConfigError(
            "Expected maps with a class in every cell to drive on, got some without: their λ is not known. "
            "Maps with unlabelled cells are there to train and measure models on."
        )
    if world.noise == "stored" and bool(terrain.traversability.isnan().any()):
        raise ConfigError(
            "Expected maps with λ in every cell for `noise` 'stored', got some that were not observed. "
            "Take `noise` 'resampled'."
        )
