"""The sensor `near`: a mast camera whose noise grows with distance.

A cell is visible unless terrain in between rises above the line from the top of the
mast to the cell. The horizon is computed ring by ring, outwards from the robot's cell,
and is interpolated linearly between the cells of a ring (XDraw). Visibility on planes
and behind long walls along the grid is therefore exact. The mast is in the middle of
the robot's cell. Terrain that is out of range, out of the field of view or below the
horizon does not raise the horizon. Hence the mask of observed cells depends only on
observed terrain, as long as hidden terrain stays below the horizon.
Letters in shapes: B episodes, S state dimensions, H×W cells, N cells of the rings.

Source: Franklin, Ray and Mehta (1994), "Geometric algorithms for siting of air defense
missile batteries", for XDraw.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.errors import expect
from benchnav.core.terrain import Observation, Terrain
from benchnav.planning.sensing.sensor import Appearance, Measurement, NoiseKey, Sensor


@dataclass(frozen=True)
class Near(Sensor):
    """Appearance of terrain near the robot, from a mast, with noise.

    The robot's own cell and its eight neighbours are always observed. Any other cell is
    observed if its centre is in range, in the field of view and in line of sight. Noise
    is normal and independent between cells and steps. Its standard deviation is
    proportional to the distance of the cell's centre. At 8 m, the defaults are 4 of 255
    for colour and 16 mm for elevation, as for a good stereo camera. Slopes of cells of
    0.5 m then have an error of about 1°. Layers other than colour and elevation have no
    noise, and slope is computed from observed elevation.

    Args:
        range_m: maximum distance from the robot to the centre of an observed cell, in
            metres.
        fov_deg: field of view in degrees, centred on the robot's heading, in (0, 360].
        height_m: height of the mast above the terrain under the robot, in metres.
        colour_noise: standard deviation of the noise of each colour channel, on the
            scale 0–255, per metre of distance.
        elevation_noise: standard deviation of the noise of elevation in metres, per
            metre of distance to the cell.
    """

    range_m: float = 8.0
    fov_deg: float = 360.0
    height_m: float = 1.0
    colour_noise: float = 0.5
    elevation_noise: float = 0.002

    def __post_init__(self) -> None:
        """Validate range, field of view, height and noise."""
        for name in ("range_m", "height_m"):
            value = getattr(self, name)
            expect(
                0 < value < math.inf,
                f"`{name}` of sensor 'near' > 0 and finite, got {value}.",
            )
        expect(
            0 < self.fov_deg <= 360,
            f"`fov_deg` of sensor 'near' in (0, 360], got {self.fov_deg}.",
        )
        for name in ("colour_noise", "elevation_noise"):
            value = getattr(self, name)
            expect(
                0 <= value < math.inf,
                f"`{name}` of sensor 'near' ≥ 0 and finite, got {value}.",
            )

    def sense(
        self, terrain: Terrain, field: Tensor, robot_state: Tensor, noise_key: NoiseKey
    ) -> Measurement:
        """Return the appearance of visible cells; robots off the map observe no cell."""
        distance = self._distances(terrain, robot_state.double())
        seen = distance.isfinite()
        # Independent normals for red, green, blue and elevation.
        normals = noise_key.normal("look", seen, (4,))
        noise = normals * distance[seen][:, None]
        colour = terrain.rgb.movedim(1, -1)[seen]
        noisy_colour = colour + self.colour_noise * noise[:, :3]
        rounded = noisy_colour.round().clamp(0, 255)
        rgb = torch.zeros_like(terrain.rgb)
        rgb.movedim(1, -1)[seen] = rounded.to(rgb.dtype)
        heights = terrain.elevation_m[seen]
        noisy_heights = heights + self.elevation_noise * noise[:, 3]
        elevation_m = torch.full_like(terrain.elevation_m, math.nan)
        elevation_m[seen] = noisy_heights.to(heights.dtype)
        layers = {}
        for name, layer in terrain.layers.items():
            layers[name] = torch.where(seen, layer, math.nan)
        observation = Observation(
            rgb=rgb,
            elevation_m=elevation_m,
            slope_deg=torch.full_like(terrain.slope_deg, math.nan),
            grid=terrain.grid,
            layers=layers,
        )
        noise_level = distance.to(field.dtype)
        appearance = Appearance(
            seen=seen, observation=observation, noise_level=noise_level
        )
        return Measurement.of_appearance(appearance)

    def _distances(self, terrain: Terrain, robot_state: Tensor) -> Tensor:
        """Return distances to the centres of observed cells in metres.

        The distance is infinite for unobserved cells. Shape [B, H, W].
        """
        grid = terrain.grid
        x, y, heading = robot_state[:, :3].T[..., None]
        range_cells = max(1, math.ceil(self.range_m / grid.resolution_m))
        n_rings = min(range_cells, max(grid.shape) - 1)
        rings = _rings(n_rings, robot_state.device)
        row, column = grid.cell_of(x, y)
        rows = row + rings.row
        columns = column + rings.column
        in_rows = (rows >= 0) & (rows < grid.height)
        in_columns = (columns >= 0) & (columns < grid.width)
        on_map = in_rows & in_columns & grid.contains(x, y)
        centre_x, centre_y = grid.centre_of(rows, columns)
        dx = centre_x - x
        dy = centre_y - y
        distance = torch.hypot(dx, dy)
        in_view = distance <= self.range_m
        if self.fov_deg < 360:
            turn = torch.atan2(dy, dx) - heading + math.pi
            off_heading = turn.remainder(math.tau) - math.pi
            half_fov = math.radians(self.fov_deg) / 2
            in_view &= off_heading.abs() <= half_fov
        in_view = on_map & (in_view | (rings.ring_number <= 1))

        row_on_map = rows.clamp(0, grid.height - 1)
        column_on_map = columns.clamp(0, grid.width - 1)
        cell = row_on_map * grid.width + column_on_map
        height_m = terrain.elevation_m.flatten(1).gather(1, cell).double()
        rise = height_m - height_m[:, :1] - self.height_m
        gradient = rise / rings.ring_number.clamp(min=1)
        # Only cells in view raise the horizon.
        gradient = gradient.where(in_view, -math.inf)
        visible = in_view & rings.in_sight(gradient)
        distances = torch.full_like(terrain.elevation_m, math.inf, dtype=distance.dtype)
        episode, ray = visible.nonzero(as_tuple=True)
        cells = episode, rows[episode, ray], columns[episode, ray]
        distances[cells] = distance[episode, ray]
        return distances


@dataclass(frozen=True, kw_only=True)
class _Rings(Batch):
    """Cells around a central cell, ring by ring outwards, and their rays to the centre.

    Args:
        row: row of each cell relative to the centre, int64, shape [N].
        column: column of each cell relative to the centre, int64, shape [N].
        ring_number: number of each cell's ring: the larger of its distances to the
            centre in rows and in columns, int64, shape [N].
        inner_cells: the two cells of the next inner ring between which each cell's ray
            passes, as indices within that ring, int64, shape [N, 2].
        fraction: interpolation weight of the second of these two cells, float64, shape
            [N].
    """

    row: Tensor
    column: Tensor
    ring_number: Tensor
    inner_cells: Tensor
    fraction: Tensor

    def in_sight(self, gradient: Tensor) -> Tensor:
        """Return a mask of cells that are not below the horizon, bool, shape [B, N].

        Args:
            gradient: height of each cell above the mast's top, divided by the number of
                the cell's ring, shape [B, N]. Along a ray, cells have the same order by
                gradient as by elevation angle. It is −∞ for cells that do not raise the
                horizon.
        """
        visible = [torch.ones_like(gradient[:, :9], dtype=torch.bool)]
        horizon = gradient[:, 1:9]
        n_rings = int(self.ring_number[-1])
        for ring_number in range(2, n_rings + 1):
            start = (2 * ring_number - 1) ** 2
            stop = (2 * ring_number + 1) ** 2
            ring = slice(start, stop)
            ring_gradient = gradient[:, ring]
            first, second = self.inner_cells[ring].T
            inner_horizon = torch.lerp(
                horizon[:, first], horizon[:, second], self.fraction[ring]
            )
            visible.append(ring_gradient >= inner_horizon)
            horizon = torch.maximum(ring_gradient, inner_horizon)
        return torch.cat(visible, 1)


@lru_cache(maxsize=8)
def _rings(n_rings: int, device: torch.device) -> _Rings:
    """Return the central cell and the rings around it."""
    steps = torch.arange(-n_rings, n_rings + 1)
    offsets = torch.meshgrid(steps, steps, indexing="ij")
    row, column = (values.flatten() for values in offsets)
    ring_number = torch.maximum(row.abs(), column.abs())
    # A stable sort by ring keeps the order of rows and columns within each ring.
    order = ring_number.argsort(stable=True)
    row = row[order]
    column = column[order]
    ring_number = ring_number[order]
    ring_start = (2 * ring_number - 1).clamp(min=0) ** 2
    index_in_ring = torch.empty(len(steps), len(steps), dtype=torch.int64)
    index = torch.arange(len(order)) - ring_start
    index_in_ring[row + n_rings, column + n_rings] = index
    # The ray crosses ring n − 1 at the fraction (n − 1) / n of the way to a cell of
    # ring n. One of the two coordinates of that point is an integer.
    scaled = torch.stack((row, column)) * (ring_number - 1)
    divisor = ring_number.clamp(min=1)
    lower = scaled.div(divisor, rounding_mode="floor")
    remainder = scaled % divisor
    upper = lower + (remainder > 0)
    inner_cells = [index_in_ring[tuple(ends + n_rings)] for ends in (lower, upper)]
    rings = _Rings(
        row=row,
        column=column,
        ring_number=ring_number,
        inner_cells=torch.stack(inner_cells, 1),
        fraction=remainder.sum(0) / divisor.double(),
    )
    return rings.to(device)
