"""Realised λ: a value for each episode, step and position.

The stream of the noise depends only on the root key, the map and the step, and not on
the step if λ is constant during an episode. Hence all planners and settings are
evaluated on common random numbers. Neither the batch nor the order of episodes matters.

Frozen λ is drawn once per episode as a correlated field. Each cell's quantile function
transforms a correlated normal score to λ (`benchnav.core.copula`). If terrain can
immobilise a robot, fields without a feasible path from start to goal are rejected,
since an episode without a path cannot compare planners.

Letters in shapes: B episodes, N steps, H×W cells, K mixture components, S state
dimensions.
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
from benchnav.planning.footprint import minimum_over_footprint
from benchnav.planning.world.world import Endpoints, World

MAX_ATTEMPTS = 100
"""Maximum number of λ fields that are drawn for an episode."""

# A map has a stream of its own, whose only element has index 0.
_ELEMENT = np.zeros(1, dtype=np.int64)


class Realisation:
    """Realised λ of B episodes.

    Args:
        terrain: terrain of the B maps.
        world: model of λ.
        places: start and goal of each episode.
        steps: number of steps N of the longest time budget.
        key: root key of the noise; see `rng.stream_key`.
        maps: indices of B maps; an episode draws its noise from the root key and the
            index of its map.

    Attributes:
        field: λ of all cells, shape [B, H, W]; None if λ is resampled at each step.
        attempts: number of fields that were drawn for each episode, int64, shape [B].
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
        check_traversability(terrain, world)
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
            # Each map has its own stream, so that a longer time budget does not change
            # the noise of the first steps.
            streams = [rng.stream_key(key, int(index)) for index in maps]
            noise = [rng.normal(stream, _ELEMENT, (steps,)) for stream in streams]
            self._noise = torch.from_numpy(np.concatenate(noise)).to(layers)
        # Padded for lookups, shape [B, 1 or 3·K, (H + 2)·(W + 2)].
        self._padded_layers = self._grid.pad(layers, outside=0.0)

    @property
    def truth(self) -> TraversabilityMixture:
        """True distribution of λ; parameters have shape [B, K, H, W]."""
        return self._truth

    def at(self, state: Tensor, step: Tensor) -> Tensor:
        """Return λ under robots during their next step, 0 off the map.

        Args:
            state: robot states, shape [B, S].
            step: index of the next step, counted from 0, int64, shape [B].

        Returns:
            λ in [0, 1], shape [B].
        """
        return self.at_positions(state[:, :1], state[:, 1:2], step)[:, 0]

    def at_positions(self, x: Tensor, y: Tensor, step: Tensor) -> Tensor:
        """Return λ at positions in the next step; 0 off the map.

        Args:
            x: positions in metres, shape [B, P].
            y: positions in metres, shape [B, P].
            step: number of steps taken, int64, shape [B].

        Returns:
            λ in [0, 1], shape [B, P].
        """
        if self.field is not None:
            return self._grid.lookup(self._padded_layers[:, 0], x, y)
        last = self._noise.shape[1] - 1
        index = step.clamp(max=last)[:, None]
        noise = self._noise.gather(1, index)[:, :, None]
        count = self._padded_layers.shape[1]
        layers = self._padded_layers.flatten(0, 1)
        layer_x = x.repeat_interleave(count, dim=0)
        layer_y = y.repeat_interleave(count, dim=0)
        values = self._grid.lookup(layers, layer_x, layer_y)
        shape = len(x), 3, count // 3, 1, x.shape[1]
        weights, means, stds = values.view(shape).unbind(1)
        mixture = TraversabilityMixture(weights, means, stds)
        traversability = mixture.from_normal(noise)[:, 0]
        return torch.where(self._grid.contains(x, y), traversability, 0.0)

    def field_at(self, step: int) -> Tensor:
        """Return resampled λ of all cells at a step, shape [B, H, W].

        All cells of a map have the same normal score in a step. Each cell's
        distribution transforms it to λ.

        Args:
            step: index of the step, counted from 0; an index after the last step means
                the last step.
        """
        index = min(step, self._noise.shape[1] - 1)
        noise = self._noise[:, index, None, None]
        return self._truth.from_normal(noise.expand(-1, *self._grid.shape))

    def exchange_(self, indices: Tensor, replacements: "Realisation") -> None:
        """Replace M episodes by those of another realisation, in place.

        Args:
            indices: indices of the replaced episodes, int64, shape [M].
            replacements: realisation of M episodes with the same world and grid.
        """
        self._padded_layers.index_copy_(0, indices, replacements._padded_layers)
        self._truth = map_tensors(
            self._truth,
            lambda old, new: old.index_copy(0, indices, new),
            replacements._truth,
        )
        self.attempts.index_copy_(0, indices, replacements.attempts)
        if self.field is not None and replacements.field is not None:
            self.field.index_copy_(0, indices, replacements.field)
            return
        # The longest time budgets may differ, so the shorter noise is padded. An
        # episode never reads noise beyond its own time budget.
        old_noise = self._noise
        new_noise = replacements._noise
        difference = old_noise.shape[1] - new_noise.shape[1]
        old_noise = pad(old_noise, (0, max(-difference, 0)))
        new_noise = pad(new_noise, (0, max(difference, 0)))
        self._noise = old_noise.index_copy(0, indices, new_noise)


def check_traversability(terrain: Terrain, world: World) -> None:
    """Check that a world can realise λ in all cells.

    Raises:
        ConfigError: If some cells have no class, or no stored λ for noise `stored`.
    """
    if bool(terrain.truth.means.isnan().any()):
        raise ConfigError(
            "Expected maps with a class in each cell, got maps with unlabelled cells. "
            "Episodes need λ in each cell. Use maps with unlabelled cells only to "
            "train and evaluate models."
        )
    if world.noise == "stored" and bool(terrain.traversability.isnan().any()):
        raise ConfigError(
            "Expected maps with λ in each cell for `noise` 'stored', got maps with "
            "cells without λ. Set `noise` to 'resampled'."
        )


def draw_frozen(
    terrain: Terrain, world: World, places: Endpoints, key: int, maps: Sequence[int]
) -> tuple[Tensor, Tensor]:
    """Draw a correlated field of λ for each of B episodes.

    Args:
        terrain: terrain of the B maps.
        world: world with the correlation length, the kernel and the rule of
            immobilisation.
        places: start and goal of each episode.
        key: root key of the noise; see `rng.stream_key`.
        maps: indices of B maps; an episode draws its field from the root key and the
            index of its map.

    Returns:
        λ in [0, 1], shape [B, H, W], and the number of fields that were drawn for each
        episode, int64, shape [B].

    Raises:
        ConfigError: If the correlation length is more than a quarter of the maps'
            shorter side, or no drawn field of an episode has a feasible path.
    """
    grid = terrain.grid
    correlation_cells = world.correlation_m / grid.resolution_m
    max_m = LONGEST_CORRELATION * min(grid.extent_m)
    expect(
        world.correlation_m <= max_m,
        f"`world.correlation_m` of at most {max_m:g} m (a quarter of the maps' shorter "
        f"side), got {world.correlation_m:g} m. Use larger maps or a shorter "
        "correlation length.",
    )
    field = torch.zeros_like(terrain.traversability)
    attempts = torch.zeros(len(terrain), dtype=torch.int64, device=field.device)
    pending = torch.arange(len(terrain), device=field.device)
    for attempt in range(MAX_ATTEMPTS):
        normals = []
        for episode in pending.tolist():
            stream = rng.stream_key(key, int(maps[episode]), "field", attempt)
            normal = correlated_normal(
                stream, _ELEMENT, grid.shape, correlation_cells, world.kernel
            )
            normals.append(normal)
        scores = torch.from_numpy(np.concatenate(normals)).to(field)
        drawn = terrain.truth.select(pending).from_normal(scores)
        field[pending] = drawn
        attempts[pending] += 1
        if world.immobile is None:
            return field, attempts
        is_firm = drawn >= world.immobile.below
        if world.clearance_m is not None:
            is_firm = minimum_over_footprint(is_firm, grid, world.clearance_m)
        is_feasible = are_connected(is_firm, grid, places.select(pending))
        pending = pending[~is_feasible]
        if len(pending) == 0:
            return field, attempts
    clearance = ""
    if world.clearance_m is not None:
        clearance = f", with a clearance of {world.clearance_m:.2g} m,"
    raise ConfigError(
        f"Expected a feasible path from start to goal{clearance} in one of "
        f"{MAX_ATTEMPTS} drawn fields of λ, got none for map {maps[int(pending[0])]}. "
        "Lower `immobile.below`, or use easier maps."
    )


def are_connected(is_traversable: Tensor, grid: Grid, places: Endpoints) -> Tensor:
    """Return a mask of episodes with a path from start to goal over traversable cells.

    A path crosses from cell to cell over an edge, never over a corner.

    Args:
        is_traversable: mask of traversable cells, bool, shape [B, H, W].
        grid: grid of the maps.
        places: start and goal of each episode.

    Returns:
        Mask, bool, shape [B].
    """
    # Cells of different maps are not connected.
    connectivity = np.zeros((3, 3, 3))
    connectivity[1] = generate_binary_structure(2, 1)
    labels, _ = label(is_traversable.cpu().numpy(), connectivity)
    regions = torch.from_numpy(labels)
    episode = torch.arange(len(regions))
    start_region = regions[episode, *grid.cell_of(*places.start_m.cpu().T)]
    goal_region = regions[episode, *grid.cell_of(*places.goal_m.cpu().T)]
    is_connected = (start_region > 0) & (start_region == goal_region)
    return is_connected.to(is_traversable.device)
