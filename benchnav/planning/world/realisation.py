"""Realised λ: a value for each episode, step and position.

Noise is keyed by (root key, map, step), or by (root key, map) if λ is constant during
an episode. Hence all planners and settings meet common random numbers, whatever the
batch or the order.

Frozen λ is drawn once per episode as a correlated field: a field of correlated standard
normals passes through each cell's quantile function (`benchnav.core.copula`). If
terrain can immobilise a robot, draws without a feasible path from start to goal are
rejected: the benchmark asks which path to take, so one must exist. Letters in shapes: B
episodes, N steps, H×W cells, K components.
cells, K components.
"""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.ndimage import generate_binary_structure, label
from torch import Tensor

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
        self._grid, self._truth = terrain.grid, terrain.truth
        truth = self._truth
        self.attempts = torch.ones(
            len(terrain), dtype=torch.int64, device=terrain.traversability.device
        )
        self.field: Tensor | None = None
        if world.noise == "stored":
            self.field = terrain.traversability.clone()
        elif world.noise == "frozen":
            self.field, self.attempts = draw_frozen(terrain, world, places, key, maps)
        if self.field is not None:
            layers = self.field[:, None]
        else:
            layers = torch.cat((truth.weights, truth.means, truth.stds), dim=1)
            # A stream each, so that another time budget leaves the noise of the first
            # steps as it is.
            noise = [
                rng.normal(rng.stream_key(key, int(i)), _FIRST, (steps,)) for i in maps
            ]
            self._noise = torch.from_numpy(np.concatenate(noise)).to(layers)
        # Framed for lookups, shape [B, 1 or 3·K, N].
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
        noise = self._noise.gather(1, step.clamp(max=last)[:, None])[:, :, None]
        count = self._ground.shape[1]
        values = self._grid.lookup(
            self._ground.flatten(0, 1),
            x.repeat_interleave(count),
            y.repeat_interleave(count),
        )
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
        noise = self._noise[:, min(step, self._noise.shape[1] - 1), None, None]
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
        n_steps = max(self._noise.shape[1], others._noise.shape[1])
        old, new = (
            torch.nn.functional.pad(noise, (0, n_steps - noise.shape[1]))
            for noise in (self._noise, others._noise)
        )
        self._noise = old.index_copy(0, members, new)


def check_known(terrain: Terrain, world: World) -> None:
    """Check that λ of all cells is available in a world.

    Raises:
        ConfigError: If it is missing in some cells.
    """
    if bool(terrain.truth.means.isnan().any()):
        raise ConfigError(
            "Expected maps with a class in every cell to drive on, got some without: "
            "their λ is not known. "
            "Maps with unlabelled cells are there to train and measure models on."
        )
    if world.noise == "stored" and bool(terrain.traversability.isnan().any()):
        raise ConfigError(
            "Expected maps with λ in every cell for `noise` 'stored', got some that "
            "were not observed. "
            "Take `noise` 'resampled'."
        )


def draw_frozen(
    terrain: Terrain, world: World, places: Endpoints, key: int, maps: Sequence[int]
) -> tuple[Tensor, Tensor]:
    """Draw the λ of B episodes.

    Args:
        terrain: the true maps.
        world: correlation length, kernel, and what immobilises a robot.
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
    longest = LONGEST_CORRELATION * min(grid.extent_m)
    expect(
        world.correlation_m <= longest,
        f"`world.correlation_m` of at most {longest:g} m, a quarter of the maps' "
        "shorter side, got "
        f"{world.correlation_m:g} m.",
    )
    field = torch.zeros_like(terrain.traversability)
    attempts = torch.zeros(len(terrain), dtype=torch.int64, device=field.device)
    pending = torch.arange(len(terrain), device=field.device)
    for attempt in range(MOST_ATTEMPTS):
        normals = [
            correlated_normal(
                rng.stream_key(key, int(maps[i]), "field", attempt),
                _FIRST,
                grid.shape,
                correlation_cells,
                world.kernel,
            )
            for i in pending.tolist()
        ]
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
        f"Expected a feasible path from start to goal, but {MOST_ATTEMPTS} draws of λ "
        "gave none for map "
        f"{maps[int(pending[0])]}. Lower `immobile.below`, or take easier maps."
    )


def joined(ground: Tensor, grid: Grid, places: Endpoints) -> Tensor:
    """Return in which episodes a mask connects start and goal over shared edges.

    Cells that only touch at a corner are not connected.

    Args:
        ground: mask of traversable cells, bool, shape [B, H, W].
        grid: size and resolution.
        places: starts and goals.

    Returns:
        Mask of the episodes, bool, shape [B].
        grid: size and resolution.
        places: starts and goals.

    Returns:
        bool, shape [B].
    """
    connectivity = np.zeros((3, 3, 3))  # none between maps
    connectivity[1] = generate_binary_structure(2, 1)
    parts = torch.from_numpy(label(ground.cpu().numpy(), connectivity)[0])
    member = torch.arange(len(parts))
    start, goal = (
        parts[member, *grid.cell_of(*position.cpu().T)]
        for position in (places.start_m, places.goal_m)
    )
    return ((start > 0) & (start == goal)).to(ground.device)
