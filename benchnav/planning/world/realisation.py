"""The λ that robots meet: a value for each episode, step and place.

Noise is keyed by (root key, map, step), or by (root key, map) where λ stays what it is,
so every planner and setting meets the same, whatever the batch or the order.

Frozen λ is drawn once an episode as a correlated field, each cell with its own
distribution: a field of correlated standard normals goes through each cell's quantile
function (`benchnav.core.copula`). Where ground can immobilise a robot, a draw in which
no feasible path joins start and goal is rejected and drawn again: what is asked is
which way to take, and there has to be one. Letters in shapes: B episodes, N steps, H×W
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
from benchnav.planning.world.world import Places, World

MOST_ATTEMPTS = 100

# of each map's stream, the one element that is drawn
_FIRST = np.zeros(1, dtype=np.int64)


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
        field: the λ of every cell where it stays what it is, shape [B, H, W]; None
            where it is resampled.
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
        noise = self._noise.gather(
            1, step.clamp(max=self._noise.shape[1] - 1)[:, None]
        )[:, :, None]
        count = self._ground.shape[1]
        found = self._grid.lookup(
            self._ground.flatten(0, 1),
            x.repeat_interleave(count),
            y.repeat_interleave(count),
        )
        weights, means, stds = found.view(len(x), 3, count // 3, 1, 1).unbind(1)
        met = TraversabilityMixture(weights, means, stds).from_normal(noise)[:, 0, 0]
        return torch.where(self._grid.contains(x, y), met, 0.0)

    def field_at(self, step: int) -> Tensor:
        """λ of every cell at a step where it is resampled, shape [B, H, W]: one noise a
        step, in each cell's own scale.

        Args:
            step: steps taken so far; beyond the last the last.
        """
        noise = self._noise[:, min(step, self._noise.shape[1] - 1), None, None]
        return self._truth.from_normal(noise.expand(-1, *self._grid.shape))

    def exchange_(self, members: Tensor, others: "Realisation") -> None:
        """Gives some episodes what they meet in another realisation of the same world,
        in place.

        Args:
            members: indices of the episodes, int64, shape [M].
            others: of M episodes on maps of the same grid.
        """
        self._ground.index_copy_(0, members, others._ground)
        self._truth = map_tensors(
            self._truth, lambda own, new: own.index_copy(0, members, new), others._truth
        )
        self.attempts.index_copy_(0, members, others.attempts)
        if self.field is not None and others.field is not None:
            self.field.index_copy_(0, members, others.field)
            return
        # Time budgets may differ; what is beyond an episode's own is never met.
        most = max(self._noise.shape[1], others._noise.shape[1])
        own, new = (
            torch.nn.functional.pad(n, (0, most - n.shape[1]))
            for n in (self._noise, others._noise)
        )
        self._noise = own.index_copy(0, members, new)


def check_known(terrain: Terrain, world: World) -> None:
    """Refuses maps with cells whose λ a world cannot tell.

    Raises:
        ConfigError: they have such cells.
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
    terrain: Terrain, world: World, places: Places, key: int, maps: Sequence[int]
) -> tuple[Tensor, Tensor]:
    """Draws the λ of B episodes.

    Args:
        terrain: the true maps.
        world: correlation length and kernel, and what immobilises a robot.
        places: starts and goals.
        key: root key of the noise.
        maps: names each episode's stream under that root, B of them.

    Returns:
        λ in [0, 1], shape [B, H, W]; and how many fields of each episode were drawn,
        int64, shape [B].

    Raises:
        ConfigError: the correlation is too long for the maps, or all draws of some
            episode were rejected.
    """
    grid, cells = terrain.grid, world.correlation_m / terrain.grid.resolution_m
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
                cells,
                world.kernel,
            )
            for i in pending.tolist()
        ]
        drawn = terrain.truth.select(pending).from_normal(
            torch.from_numpy(np.concatenate(normals)).to(field)
        )
        field[pending] = drawn
        attempts[pending] += 1
        if world.immobile is None:
            return field, attempts
        pending = pending[
            ~joined(drawn >= world.immobile.below, grid, places.select(pending))
        ]
        if len(pending) == 0:
            return field, attempts
    raise ConfigError(
        f"Expected a feasible path from start to goal, but {MOST_ATTEMPTS} draws of λ "
        "gave none for map "
        f"{maps[int(pending[0])]}. Lower `immobile.below`, or take easier maps."
    )


def joined(ground: Tensor, grid: Grid, places: Places) -> Tensor:
    """Tells in which episodes ground joins start and goal, from cell to cell over
    shared edges.

    Cells that touch at a corner alone are no way for a robot.

    Args:
        ground: where a robot can go, bool, shape [B, H, W].
        grid: size and resolution.
        places: starts and goals.

    Returns:
        bool, shape [B].
    """
    within = np.zeros((3, 3, 3))  # a map's cells are joined to its own alone
    within[1] = generate_binary_structure(2, 1)
    parts = torch.from_numpy(label(ground.cpu().numpy(), within)[0])
    member = torch.arange(len(parts))
    start, goal = (
        parts[member, *grid.cell_of(*place.cpu().T)]
        for place in (places.start_m, places.goal_m)
    )
    return ((start > 0) & (start == goal)).to(ground.device)
