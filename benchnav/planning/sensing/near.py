"""The sensor `near`: a camera on a mast sees the ground around the robot, the better
the nearer.

A cell is in line of sight unless ground between stands over the line from the mast to
it. The horizon is carried outwards from ring to ring of cells around the robot's,
between which it is linear (XDraw), so that planes and long walls along the grid are
exact. Line of sight is that of a mast in the middle of the robot's cell. Ground that is
out of range, out of the field of view or hidden under the horizon raises no horizon:
which cells are seen depends on nothing but the ground that is seen, as long as what is
hidden stays lower than its horizon.
Letters in shapes: B episodes, S state dimensions, H×W cells, N cells of the rings, seen
or in them all.

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
from benchnav.planning.sensing.sensor import Appearance, Moment, Sensed, Sensor


@dataclass(frozen=True)
class Near(Sensor):
    """What the ground near the robot looks like, from a mast, with noise that grows
    with distance.

    The robot's own cell and its eight neighbours are always seen; other cells where
    their centre is in range, in the field of view and in line of sight. Noise is drawn
    for each cell and step alone, normal, with a standard deviation that is proportional
    to the distance of the cell's centre. The defaults give ±4 of 255 and ±16 mm at 8 m,
    as a good stereo camera does; slopes of cells of 0.5 m are then known to about 1°.
    Layers other than colour and elevation have no noise, and slope is computed from
    observed elevation.

    Args:
        range_m: how far it sees.
        fov_deg: field of view, centred on the robot's heading, in (0, 360].
        height_m: of the mast over the ground under the robot.
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
        """Refuses cameras that are none."""
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
        self, terrain: Terrain, field: Tensor, robot_state: Tensor, moment: Moment
    ) -> Sensed:
        """Looks around once; robots off the map see nothing."""
        distance = self._distances(terrain, robot_state.double())
        seen = distance.isfinite()
        noise = moment.normal("look", seen, (4,)) * distance[seen][:, None]
        colour = terrain.rgb.movedim(1, -1)[seen] + self.colour_noise * noise[:, :3]
        rgb = torch.zeros_like(terrain.rgb)
        rgb.movedim(1, -1)[seen] = colour.round().clamp(0, 255).to(rgb.dtype)
        heights = terrain.elevation_m[seen]
        elevation = torch.full_like(terrain.elevation_m, math.nan)
        elevation[seen] = (heights + self.elevation_noise * noise[:, 3]).to(
            heights.dtype
        )
        observation = Observation(
            rgb=rgb,
            elevation_m=elevation,
            slope_deg=torch.full_like(terrain.slope_deg, math.nan),
            grid=terrain.grid,
            layers={
                name: torch.where(seen, layer, math.nan)
                for name, layer in terrain.layers.items()
            },
        )
        return Sensed.looks(
            Appearance(
                seen=seen, observation=observation, doubt=distance.to(field.dtype)
            )
        )

    def _distances(self, terrain: Terrain, robot_state: Tensor) -> Tensor:
        """Metres to the centres of the cells that are seen, infinite for all others,
        shape [B, H, W].
        """
        grid, (x, y, heading) = terrain.grid, robot_state[:, :3].T[..., None]
        cells = min(
            max(1, math.ceil(self.range_m / grid.resolution_m)), max(grid.shape) - 1
        )
        rings = _rings(cells, robot_state.device)
        row, column = grid.cell_of(x, y)
        rows, columns = row + rings.row, column + rings.column
        on_map = (
            (rows >= 0) & (rows < grid.height) & (columns >= 0) & (columns < grid.width)
        )
        on_map &= grid.contains(x, y)
        to_x, to_y = grid.centre_of(rows, columns)
        to_x, to_y = to_x - x, to_y - y
        distance = torch.hypot(to_x, to_y)
        in_view = distance <= self.range_m
        if self.fov_deg < 360:
            off_heading = (torch.atan2(to_y, to_x) - heading + math.pi).remainder(
                math.tau
            ) - math.pi
            in_view &= off_heading.abs() <= math.radians(self.fov_deg) / 2
        in_view = on_map & (in_view | (rings.number <= 1))

        place = rows.clamp(0, grid.height - 1) * grid.width + columns.clamp(
            0, grid.width - 1
        )
        ground = terrain.elevation_m.flatten(1).gather(1, place).double()
        rise = (ground - ground[:, :1] - self.height_m) / rings.number.clamp(min=1)
        visible = in_view & rings.in_sight(rise.where(in_view, -math.inf))
        found = torch.full_like(terrain.elevation_m, math.inf, dtype=distance.dtype)
        member, ray = visible.nonzero(as_tuple=True)
        found[member, rows[member, ray], columns[member, ray]] = distance[member, ray]
        return found


@dataclass(frozen=True, kw_only=True)
class _Rings(Batch):
    """Cells around one, ring by ring, the one itself first, and those that the rays to
    them pass between.

    Args:
        row: of each cell less that of the first, int64, shape [N].
        column: likewise.
        number: of the ring: rows or columns to the first cell, whichever are more,
            shape [N].
        inner: for each cell the two of the ring within that its ray passes between, by
            their places in that ring, shape [N, 2].
        share: of the second of them, float64, shape [N].
    """

    row: Tensor
    column: Tensor
    number: Tensor
    inner: Tensor
    share: Tensor

    def in_sight(self, rise: Tensor) -> Tensor:
        """Tells which cells are not under the horizon.

        Args:
            rise: height of each cell over the mast's top by the number of its ring,
                which along a ray is as good as the tangent; −∞ for cells that raise no
                horizon, shape [B, N].
        """
        found, horizon = [torch.ones_like(rise[:, :9], dtype=torch.bool)], rise[:, 1:9]
        for number in range(2, int(self.number[-1]) + 1):
            ring = slice((2 * number - 1) ** 2, (2 * number + 1) ** 2)
            one, other = (horizon[:, places] for places in self.inner[ring].T)
            before = torch.lerp(one, other, self.share[ring])
            found.append(rise[:, ring] >= before)
            horizon = torch.maximum(rise[:, ring], before)
        return torch.cat(found, 1)


@lru_cache(maxsize=8)
def _rings(cells: int, device: torch.device) -> _Rings:
    """The rings up to a number."""
    steps = torch.arange(-cells, cells + 1)
    row, column = (
        values.flatten() for values in torch.meshgrid(steps, steps, indexing="ij")
    )
    number = torch.maximum(row.abs(), column.abs())
    # By ring and, within it, by row and column: `order` is stable.
    order = number.argsort(stable=True)
    row, column, number = row[order], column[order], number[order]
    first = (2 * number - 1).clamp(min=0) ** 2
    places = torch.empty(len(steps), len(steps), dtype=torch.int64)
    places[row + cells, column + cells] = torch.arange(len(order)) - first
    # The ray crosses the ring within at (number − 1) / number of the way, where one of
    # the two is a whole number.
    before, whole = torch.stack((row, column)) * (number - 1), number.clamp(min=1)
    least, part = before.div(whole, rounding_mode="floor"), before % whole
    most = least + (part > 0)
    inner = torch.stack([places[tuple(ends + cells)] for ends in (least, most)], 1)
    made = _Rings(
        row=row,
        column=column,
        number=number,
        inner=inner,
        share=part.sum(0) / whole.double(),
    )
    return made.to(device)
