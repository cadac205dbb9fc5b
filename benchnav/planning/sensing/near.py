"""The sensor `near`: a mast camera whose noise grows with distance.

A cell is in line of sight unless terrain in between rises above the line from the mast
to it. The horizon is carried outwards from ring to ring of cells around the robot's,
linear between cells (XDraw), so that planes and long walls along the grid are exact.
Line of sight is that of a mast in the middle of the robot's cell. Terrain that is out
of range, out of the field of view or hidden below the horizon raises no horizon. Hence
the mask of observed cells depends only on observed terrain, as long as hidden terrain
stays below its horizon.
Letters in shapes: B episodes, S state dimensions, H×W cells, N cells of the rings,
observed or in total.

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

    The robot's own cell and its eight neighbours are always observed; other cells if
    their centre is in range, in the field of view and in line of sight. Noise is normal
    and independent for each cell and step; its standard deviation is proportional to
    the distance of the cell's centre. The defaults give ±4 of 255 and ±16 mm at 8 m, as
    a good stereo camera does; slopes of cells of 0.5 m are then known to about 1°.
    Layers other than colour and elevation have no noise, and slope is computed from
    observed elevation.

    Args:
        range_m: range in metres.
        fov_deg: field of view, centred on the robot's heading, in (0, 360].
        height_m: height of the mast above the terrain under the robot, in metres.
        colour_noise: standard deviation of each channel of a colour, 0–255, for each
            metre of distance.
        elevation_noise: standard deviation of elevation in metres, for each metre of
            distance.
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
                f"`{name}` of the sensor near > 0 and finite, got {value}.",
            )
        expect(
            0 < self.fov_deg <= 360,
            f"`fov_deg` of the sensor near in (0, 360], got {self.fov_deg}.",
        )
        for name in ("colour_noise", "elevation_noise"):
            value = getattr(self, name)
            expect(
                0 <= value < math.inf,
                f"`{name}` of the sensor near ≥ 0 and finite, got {value}.",
            )

    def sense(
        self, terrain: Terrain, field: Tensor, robot_state: Tensor, noise_key: NoiseKey
    ) -> Measurement:
        """Return the appearance of cells in sight; robots off the map see nothing."""
        distance = self._distances(terrain, robot_state.double())
        seen = distance.isfinite()
        noise = noise_key.normal("look", seen, (4,)) * distance[seen][:, None]
        colour = terrain.rgb.movedim(1, -1)[seen] + self.colour_noise * noise[:, :3]
        rgb = torch.zeros_like(terrain.rgb)
        rgb.movedim(1, -1)[seen] = colour.round().clamp(0, 255).to(rgb.dtype)
        heights = terrain.elevation_m[seen]
        noisy_heights = heights + self.elevation_noise * noise[:, 3]
        elevation_m = torch.full_like(terrain.elevation_m, math.nan)
        elevation_m[seen] = noisy_heights.to(heights.dtype)
        observation = Observation(
            rgb=rgb,
            elevation_m=elevation_m,
            slope_deg=torch.full_like(terrain.slope_deg, math.nan),
            grid=terrain.grid,
            layers={
                name: torch.where(seen, layer, math.nan)
                for name, layer in terrain.layers.items()
            },
        )
        return Measurement.of_appearance(
            Appearance(
                seen=seen, observation=observation, noise_level=distance.to(field.dtype)
            )
        )

    def _distances(self, terrain: Terrain, robot_state: Tensor) -> Tensor:
        """Return distances to the centres of observed cells, in metres, [B, H, W].

        The distance is infinite for all other cells.
        """
        grid = terrain.grid
        x, y, heading = robot_state[:, :3].T[..., None]
        range_cells = max(1, math.ceil(self.range_m / grid.resolution_m))
        rings = _rings(min(range_cells, max(grid.shape) - 1), robot_state.device)
        row, column = grid.cell_of(x, y)
        rows, columns = row + rings.row, column + rings.column
        on_map = (
            (rows >= 0) & (rows < grid.height) & (columns >= 0) & (columns < grid.width)
        )
        on_map &= grid.contains(x, y)
        centre_x, centre_y = grid.centre_of(rows, columns)
        dx = centre_x - x
        dy = centre_y - y
        distance = torch.hypot(dx, dy)
        in_view = distance <= self.range_m
        if self.fov_deg < 360:
            turn = torch.atan2(dy, dx) - heading + math.pi
            off_heading = turn.remainder(math.tau) - math.pi
            in_view &= off_heading.abs() <= math.radians(self.fov_deg) / 2
        in_view = on_map & (in_view | (rings.number <= 1))

        row_on_map = rows.clamp(0, grid.height - 1)
        cell = row_on_map * grid.width + columns.clamp(0, grid.width - 1)
        height_m = terrain.elevation_m.flatten(1).gather(1, cell).double()
        rise = height_m - height_m[:, :1] - self.height_m
        gradient = rise / rings.number.clamp(min=1)
        visible = in_view & rings.in_sight(gradient.where(in_view, -math.inf))
        distances = torch.full_like(terrain.elevation_m, math.inf, dtype=distance.dtype)
        member, ray = visible.nonzero(as_tuple=True)
        cells = member, rows[member, ray], columns[member, ray]
        distances[cells] = distance[member, ray]
        return distances


@dataclass(frozen=True, kw_only=True)
class _Rings(Batch):
    """Cells around a central one, ring by ring from the centre, and their rays.

    Args:
        row: row of each cell relative to the centre, int64, shape [N].
        column: column, likewise.
        number: number of the ring, shape [N]: the larger of the distances to the
            centre in rows and in columns.
        inner: for each cell, the two cells of the next inner ring between which its ray
            passes, as indices within that ring, shape [N, 2].
        fraction: weight of the second of them, float64, shape [N].
    """

    row: Tensor
    column: Tensor
    number: Tensor
    inner: Tensor
    fraction: Tensor

    def in_sight(self, rise: Tensor) -> Tensor:
        """Return a mask of cells that are not below the horizon, bool, shape [B, N].

        Args:
            rise: height of each cell above the mast's top, divided by the number of its
                ring, which orders cells along a ray as the tangent does. −∞ for cells
                that raise no horizon, shape [B, N].
        """
        visible = [torch.ones_like(rise[:, :9], dtype=torch.bool)]
        horizon = rise[:, 1:9]
        for number in range(2, int(self.number[-1]) + 1):
            ring = slice((2 * number - 1) ** 2, (2 * number + 1) ** 2)
            first, second = self.inner[ring].T
            inner_horizon = torch.lerp(
                horizon[:, first], horizon[:, second], self.fraction[ring]
            )
            visible.append(rise[:, ring] >= inner_horizon)
            horizon = torch.maximum(rise[:, ring], inner_horizon)
        return torch.cat(visible, 1)


@lru_cache(maxsize=8)
def _rings(cells: int, device: torch.device) -> _Rings:
    """Return the rings up to the number `cells`."""
    steps = torch.arange(-cells, cells + 1)
    row, column = (
        values.flatten() for values in torch.meshgrid(steps, steps, indexing="ij")
    )
    number = torch.maximum(row.abs(), column.abs())
    # By ring and, within it, by row and column: `order` is stable.
    order = number.argsort(stable=True)
    row, column, number = row[order], column[order], number[order]
    ring_start = (2 * number - 1).clamp(min=0) ** 2
    indices = torch.empty(len(steps), len(steps), dtype=torch.int64)
    indices[row + cells, column + cells] = torch.arange(len(order)) - ring_start
    # The ray crosses the next inner ring at the fraction (number − 1) / number, where
    # one of its two coordinates is an integer.
    scaled = torch.stack((row, column)) * (number - 1)
    divisor = number.clamp(min=1)
    lower = scaled.div(divisor, rounding_mode="floor")
    remainder = scaled % divisor
    upper = lower + (remainder > 0)
    inner = torch.stack([indices[tuple(ends + cells)] for ends in (lower, upper)], 1)
    rings = _Rings(
        row=row,
        column=column,
        number=number,
        inner=inner,
        fraction=remainder.sum(0) / divisor.double(),
    )
    return rings.to(device)
