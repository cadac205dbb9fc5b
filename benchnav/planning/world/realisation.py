"""Realised λ: a value for each episode, step and position.

Noise is keyed by (root key, map, step), or by (root key, map) if λ is constant during
an episode. Hence all planners and settings are evaluated on common random numbers,
whatever the batch or the order.

Frozen λ is drawn once per episode as a correlated field: a field of correlated standard
normals passes through each cell's quantile function (`benchnav.core.copula`). If
terrain can immobilise a robot, draws without a feasible path from start to goal are
rejected, since an episode without a path cannot compare planners. Letters in shapes: B
episodes, N steps, H×W cells, K components.
"""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.ndimage import generate_binary_structure, label
from torch import Tensor
from torch.nn.functional import pad

from benchnav.core import rng
from benchnav.core.batch import map_tensors
from benchnav.core.copula import LONGEST_CORRELATION, correlated_normal
from benchnav.core.errors import ConfigError, expect
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.planning.world.world import Endpoints, World

MOST_ATTEMPTS = 100

# Index of the only element of each map's stream.
_FIRST = np.zeros(1, dtype=np.int64)


class Realisation:
    """Realised λ of B episodes.

    Args:
        terrain: the true maps.
        world: the model of λ.
        places: starts and goals.
        steps: maximum number of steps N of the time budgets.
        key: root key of the noise; see `rng.stream_key`.
        maps: index of each episode's stream under that root, B of them.

    Attributes:
        field: λ of all cells if it is constant, shape [B, H, W]; None if it is
            resampled.
        attempts: number of fields drawn for each episode, int64, shape [B].
    """

    def __init__(
        self,
        terrain: Terrain,
        world: World,
        places: Endpoints,
        steps: int,
        key: int,
        maps: Sequence[int],
    ) -> None:
        """Draw all noise.

        Raises:
            ConfigError: If λ of some cells is missing.
        """
        check_known(terrain, world)
        truth = terrain.truth
        self._grid = terrain.grid
        self._truth = truth
        device = terrain.traversability.device
        self.attempts = torch.ones(len(terrain), dtype=torch.int64, device=device)
        self.field: Tensor | None = None
        if world.noise == "stored":
            self.field = terrain.traversability.clone()
        elif world.noise == "frozen":
            self.field, self.attempts = draw_frozen(terrain, world, places, key, maps)
        if self.field is not None:
            layers = self.field[:, None]
        else:
            layers = torch.cat((truth.weights, truth.means, truth.stds), dim=1)
            # One stream per map, so that the time budget does not change the noise of
            # the first steps.
            streams = [rng.stream_key(key, int(index)) for index in maps]
            noise = [rng.normal(stream, _FIRST, (steps,)) for stream in streams]
            self._noise = torch.from_numpy(np.concatenate(noise)).to(layers)
        # Padded for lookups, shape [B, 1 or 3·K, (H + 2)·(W + 2)].
        self._ground = self._grid.pad(layers, outside=0.0)

    def at(self, state: Tensor, step: Tensor) -> Tensor:
        """Return λ at the next step of robots.

        Args:
            state: robot states, shape [B, S].
            step: number of steps taken, int64, shape [B].

        Returns:
            λ in [0, 1], shape [B].
        """
        x, y = state[:, 0], state[:, 1]
        if self.field is not None:
            return self._grid.lookup(self._ground[:, 0], x, y)
        last = self._noise.shape[1] - 1
        index = step.clamp(max=last)[:, None]
        noise = self._noise.gather(1, index)[:, :, None]
        count = self._ground.shape[1]
        layers = self._ground.flatten(0, 1)
        layer_x = x.repeat_interleave(count)
        layer_y = y.repeat_interleave(count)
        values = self._grid.lookup(layers, layer_x, layer_y)
        weights, means, stds = values.view(len(x), 3, count // 3, 1, 1).unbind(1)
        mixture = TraversabilityMixture(weights, means, stds)
        traversability = mixture.from_normal(noise)[:, 0, 0]
        return torch.where(self._grid.contains(x, y), traversability, 0.0)

    def field_at(self, step: int) -> Tensor:
        """Return resampled λ of all cells at a step, shape [B, H, W].

        One noise value per step scales all cells, each by its own distribution.

        Args:
            step: number of steps taken; steps beyond the last repeat it.
        """
        index = min(step, self._noise.shape[1] - 1)
        noise = self._noise[:, index, None, None]
        return self._truth.from_normal(noise.expand(-1, *self._grid.shape))

    def exchange_(self, members: Tensor, others: "Realisation") -> None:
        """Replace episodes by those of another realisation of the same world, in place.

        Args:
            members: indices of the episodes, int64, shape [M].
            others: realisation of M episodes on maps of the same grid.
        """
        self._ground.index_copy_(0, members, others._ground)
        self._truth = map_tensors(
            self._truth, lambda old, new: old.index_copy(0, members, new), others._truth
        )
        self.attempts.index_copy_(0, members, others.attempts)
        if self.field is not None and others.field is not None:
            self.field.index_copy_(0, members, others.field)
            return
        # Time budgets may differ; noise beyond an episode's own budget is never used.
        old_noise = self._noise
        new_noise = others._noise
        difference = old_noise.shape[1] - new_noise.shape[1]
        old_noise = pad(old_noise, (0, max(-difference, 0)))
        new_noise = pad(new_noise, (0, max(difference, 0)))
        self._noise = old_noise.index_copy(0, members, new_noise)


def check_known(terrain: Terrain, world: World) -> None:
    """Check that λ of all cells is available in a world.

    Raises:
        ConfigError: If it is missing in some cells.
    """
    if bool(terrain.truth.means.isnan().any()):
        raise ConfigError(
            "Expected maps with a class in each cell for episodes, got some cells "
            "without a class, whose λ is missing. "
            "Use maps with unlabelled cells only to train and evaluate models."
        )
    if world.noise == "stored" and bool(terrain.traversability.isnan().any()):
        raise ConfigError(
            "Expected maps with λ in each cell for `noise` 'stored', got some cells "
            "that were not observed. Use `noise` 'resampled'."
        )


def draw_frozen(
    terrain: Terrain, world: World, places: Endpoints, key: int, maps: Sequence[int]
) -> tuple[Tensor, Tensor]:
    """Draw the λ of B episodes.

    Args:
        terrain: the true maps.
        world: world with the correlation length, the kernel and the conditions of
            immobilisation.
        places: starts and goals.
        key: root key of the noise.
        maps: index of each episode's stream under that root, B of them.

    Returns:
        λ in [0, 1], shape [B, H, W], and the number of fields drawn for each episode,
        int64, shape [B].

    Raises:
        ConfigError: If the correlation is too long for the maps, or all draws of some
            episode were rejected.
    """
    grid = terrain.grid
    correlation_cells = world.correlation_m / grid.resolution_m
    max_m = LONGEST_CORRELATION * min(grid.extent_m)
    expect(
        world.correlation_m <= max_m,
        f"`world.correlation_m` of at most {max_m:g} m, a quarter of the maps' "
        f"shorter side, got {world.correlation_m:g} m.",
    )
    field = torch.zeros_like(terrain.traversability)
    attempts = torch.zeros(len(terrain), dtype=torch.int64, device=field.device)
    pending = torch.arange(len(terrain), device=field.device)
    for attempt in range(MOST_ATTEMPTS):
        normals = []
        for episode in pending.tolist():
            stream = rng.stream_key(key, int(maps[episode]), "field", attempt)
            normal = correlated_normal(
                stream, _FIRST, grid.shape, correlation_cells, world.kernel
            )
            normals.append(normal)
        scores = torch.from_numpy(np.concatenate(normals)).to(field)
        drawn = terrain.truth.select(pending).from_normal(scores)
        field[pending] = drawn
        attempts[pending] += 1
        if world.immobile is None:
            return field, attempts
        is_firm = drawn >= world.immobile.below
        is_feasible = joined(is_firm, grid, places.select(pending))
        pending = pending[~is_feasible]
        if len(pending) == 0:
            return field, attempts
    raise ConfigError(
        f"Expected a feasible path from start to goal within {MOST_ATTEMPTS} draws of "
        f"λ, got none for map {maps[int(pending[0])]}. "
        "Lower `immobile.below`, or use easier maps."
    )


def joined(ground: Tensor, grid: Grid, places: Endpoints) -> Tensor:
    """Return a mask of episodes whose start and goal are connected over shared edges.

    Cells that only touch at a corner are not connected.

    Args:
        ground: mask of traversable cells, bool, shape [B, H, W].
        grid: grid of the maps.
        places: starts and goals.

    Returns:
        Mask, bool, shape [B].
    """
    connectivity = np.zeros((3, 3, 3))  # maps are not connected
    connectivity[1] = generate_binary_structure(2, 1)
    labels, _ = label(ground.cpu().numpy(), connectivity)
    regions = torch.from_numpy(labels)
    member = torch.arange(len(regions))
    start = regions[member, *grid.cell_of(*places.start_m.cpu().T)]
    goal = regions[member, *grid.cell_of(*places.goal_m.cpu().T)]
    is_connected = (start > 0) & (start == goal)
    return is_connected.to(ground.device)
