"""A lower bound of the time to the goal, for all planners, where λ stays what it is
during an episode.

**Claim.** Let robots move as the shipped ones do: a time step leads from p to a point
at most v·dt·λ(p) away, where v is the top speed. Let λ⁺(x) be the greatest λ(p) of the
points p from which a step can lead to x or past it, |x − p| ≤ v·dt·λ(p). Let W be
continuous, 0 on the goal's disc, with |∇W| ≤ 1 / (v·λ⁺) almost everywhere. Then no
trajectory from x arrives in less than W(x).

**Proof.** Every point x of the segment from p to its successor q has |x − p| ≤
v·dt·λ(p), so that λ⁺(x) ≥ λ(p). Along the segment W falls by at most its length times
the greatest slope, v·dt·λ(p) / (v·λ(p)) = dt. An arriving trajectory of K steps ends
where W is 0, hence W(start) ≤ K·dt. On a triangulation W is linear on each closed
triangle, and a segment along an edge lies in two of them; the bound of the slope is
that of the greatest λ⁺ on the closed triangle.

**Immobilising ground.** A robot is lost after its m-th step in a row from λ under
`below`, if it has not arrived. A trajectory that arrives is a polygonal line. Take a
point x of it in immobilising ground, and the longest piece around x that stays there.
The piece comes in by a part of one step, at most v·dt long, or begins at the start; it
has at most m steps of v·dt·`below` from inside; and it ends where it leaves such ground
or reaches the goal's disc. So it is at most v·dt·(1 + m·`below`) long, and x is at most
half of that away from other ground, the disc or the start. Deeper points
are removed: no arriving trajectory has any. W need not be continuous across them, and
where they separate start and goal no trajectory arrives.

**The largest W.** Of all W the one with the greatest sum over the nodes is found by the
augmented Lagrangian method, one Poisson equation and one projection on discs a step
(Ennaji, Igbida and Nguyen, 2021, "Augmented Lagrangian methods for degenerate
Hamilton–Jacobi equations"). How well it has converged bears on how large the bound is,
and not on
whether it holds: the slope of each triangle is measured in float64, and W divided by
the greatest excess.

λ and positions are of single precision: a step may lead farther, and be read farther
off, by some units in the last place, which are added to steps and distances. Letters in
shapes: H×W cells, N nodes, T triangles.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy import ndarray
from scipy.ndimage import generate_binary_structure, label
from scipy.sparse import csr_array, identity, vstack
from scipy.sparse.linalg import splu

from benchnav.core.grid import Grid
from benchnav.planning.free_space import Immobile
from benchnav.planning.robots import (
    Bicycle,
    DifferentialDrive,
    Robot,
    Unicycle,
    steps_in,
)

BOUNDED_ROBOTS = (Unicycle, DifferentialDrive, Bicycle)

_MOST_SQUARES = 300_000  # of a map; the equations' factors stay under a gigabyte
_LEAST_TRAVERSABILITY = 1e-3
_ULPS = 4 * 2.0**-24  # of a position, as a share of the map's extent
_RELAXATION = 1.6
# of what the gradient misses, in units of the flux at the goal over the slowness
_WEIGHT = 5.0
_EXCESS = 1.004  # of slopes, at which to stop
_CHECK_EVERY = 25  # steps
_MOST_STEPS = 300


@dataclass(frozen=True, kw_only=True)
class Motion:
    """What bounds the motion of robots in an episode.

    Args:
        robot: one of the shipped robots, whose λ scales its speed.
        goal_radius_m: a robot this near to the goal has arrived.
        immobile: what immobilises a robot; None for nothing.
    """

    robot: Robot
    goal_radius_m: float
    immobile: Immobile | None = None

    @property
    def step_m(self) -> float:
        """Length of a step where λ is 1."""
        return self.robot.top_speed_mps * self.robot.dt_s


def lower_bound_s(
    field: ndarray, grid: Grid, motion: Motion, start_m: ndarray, goal_m: ndarray
) -> float:
    """Bound the time to the goal from below, for all trajectories.

    Args:
        field: λ of each cell during the whole episode, in [0, 1], shape [H, W].
        grid: of the map.
        motion: of the robot.
        start_m: (x, y), shape [2].
        goal_m: (x, y), shape [2].

    Returns:
        Seconds; 0 at the goal, infinite where no trajectory arrives.
    """
    start_m, goal_m = np.asarray(start_m, np.float64), np.asarray(goal_m, np.float64)
    error_m = _ULPS * max(grid.extent_m)
    squares = _refined(grid, motion.step_m)
    times = squares.height // grid.height
    fine = np.asarray(field, np.float64).repeat(times, 0).repeat(times, 1)
    ends = _squares_within(squares, goal_m, motion.goal_radius_m + error_m)
    begin = tuple(
        (start_m[::-1] / squares.resolution_m)
        .astype(int)
        .clip(0, np.array(squares.shape) - 1)
    )
    kept = np.ones_like(ends)
    if motion.immobile is not None:
        # In single precision, as the world compares.
        exits = (fine >= np.float32(motion.immobile.below)) | ends
        exits[begin] = True
        kept = _near(exits, squares, _deepest_m(motion, motion.immobile) + 2 * error_m)
    parts, _ = label(kept, generate_binary_structure(2, 2))
    kept = parts == parts[begin]
    if not (kept & ends).any():
        return math.inf
    reach = (
        _reached(fine, squares, motion.step_m, 2 * error_m) + error_m / motion.step_m
    )
    slowness = 1 / (motion.robot.top_speed_mps * reach.clip(_LEAST_TRAVERSABILITY))
    mesh = Mesh(squares, slowness, kept, ends & kept)
    return mesh.value_at(largest(mesh, motion.goal_radius_m), start_m)


def _refined(grid: Grid, step_m: float) -> Grid:
    """Squares about as wide as a step, a whole number of them along each side of a
    cell.
    """
    times = max(1, math.ceil(grid.resolution_m / step_m - 1e-6))
    times = max(1, min(times, math.isqrt(_MOST_SQUARES // (grid.height * grid.width))))
    return Grid(grid.height * times, grid.width * times, grid.resolution_m / times)


def _deepest_m(motion: Motion, immobile: Immobile) -> float:
    steps = steps_in(immobile.for_s, motion.robot.dt_s)
    return motion.step_m * (1 + steps * immobile.below) / 2


def _squares_within(squares: Grid, point_m: ndarray, radius_m: float) -> ndarray:
    """Tell which closed squares come as near to a point as a radius, bool, of the shape
    of the squares.
    """
    gaps_m = []
    for size, at_m in zip(squares.shape, point_m[::-1], strict=True):
        low_m = np.arange(size) * squares.resolution_m
        gaps_m.append(
            np.maximum(np.maximum(low_m - at_m, at_m - low_m - squares.resolution_m), 0)
        )
    return np.hypot(gaps_m[0][:, None], gaps_m[1]) <= radius_m


def _around(squares: Grid, reach_m: float) -> list[tuple[int, int, float]]:
    """Offsets of squares at most so far away, and how far: the least distance of the
    closed squares.
    """
    most = math.floor(reach_m / squares.resolution_m) + 1
    offsets = [
        (row, column)
        for row in range(-most, most + 1)
        for column in range(-most, most + 1)
    ]
    found = [
        (
            *offset,
            squares.resolution_m
            * math.hypot(*(max(abs(part) - 1, 0) for part in offset)),
        )
        for offset in offsets
    ]
    return [each for each in found if each[2] <= reach_m]


def _shifted(values: ndarray, row: int, column: int) -> ndarray:
    """Values some rows and columns on, 0 beyond the edge."""
    height, width = values.shape
    margin = max(abs(row), abs(column))
    framed = np.pad(values, margin)
    return framed[margin + row :, margin + column :][:height, :width]


def _near(exits: ndarray, squares: Grid, reach_m: float) -> ndarray:
    """Tell which squares have a point at most so far from an exit, bool."""
    found = exits.copy()
    for row, column, _ in _around(squares, reach_m):
        found |= _shifted(exits, row, column)
    return found


def _reached(fine: ndarray, squares: Grid, step_m: float, error_m: float) -> ndarray:
    """λ⁺: the greatest λ from which one step leads into each square, of the shape of
    the squares.
    """
    found = fine.copy()
    for row, column, away_m in _around(squares, step_m + error_m):
        there = _shifted(fine, row, column)
        found = np.where(
            (there * step_m + error_m >= away_m) & (there > found), there, found
        )
    return found


class Mesh:
    """A triangulation of squares, two right triangles each, whose diagonals alternate.

    Args:
        squares: of the whole map.
        slowness: greatest slope of W in each square, in seconds a metre, of the shape
            of the squares.
        kept: squares that are not removed, bool, of the same shape.
        ends: squares where W is 0, bool, of the same shape.

    Attributes:
        right: node at the right angle of each triangle, int64, shape [T].
        along: nodes at the ends of its two legs, int64, shape [2, T].
        rise: greatest rise of W over a leg, in seconds, shape [T].
    """

    def __init__(
        self, squares: Grid, slowness: ndarray, kept: ndarray, ends: ndarray
    ) -> None:
        """Lay triangles out."""
        self.squares = squares
        node = np.arange((squares.height + 1) * (squares.width + 1)).reshape(
            squares.height + 1, -1
        )
        corners = node[:-1, :-1], node[:-1, 1:], node[1:, :-1], node[1:, 1:]
        low, right, up, far = (corner[kept] for corner in corners)
        even = np.add.outer(*map(np.arange, squares.shape))[kept] % 2 == 0
        # Right angles at the lower left and the upper right corner, or at the other
        # two.
        self.right = np.concatenate(
            (np.where(even, low, right), np.where(even, far, up))
        )
        across = np.concatenate((np.where(even, right, low), np.where(even, up, far)))
        upward = np.concatenate((np.where(even, up, far), np.where(even, right, low)))
        self.along = np.stack((across, upward))
        self.rise = np.tile(slowness[kept] * squares.resolution_m, 2)
        self.free = np.zeros(node.size, dtype=bool)
        self.free[self.right] = self.free[self.along] = True
        for corner in corners:
            self.free[corner[ends]] = False

    @cached_property
    def rises(self) -> csr_array:
        """From W at the free nodes to its rise over both legs of all triangles, shape
        [2·T, free nodes].
        """
        count, each = len(self.right), np.arange(len(self.right))
        values, rows = np.repeat([1.0, -1.0], count), np.tile(each, 2)
        shape = count, len(self.free)
        legs = [
            csr_array((values, (rows, np.concatenate((end, self.right)))), shape)
            for end in self.along
        ]
        return csr_array(vstack(legs).tocsc()[:, self.free])

    def excess(self, value: ndarray) -> float:
        """Greatest slope of W over what is allowed, from W at all nodes, shape [N]."""
        over = np.hypot(*(value[end] - value[self.right] for end in self.along))
        return float((over / self.rise).max())

    def value_at(self, value: ndarray, point_m: ndarray) -> float:
        """W at a point, from W at all nodes, shape [N]; of a removed square it means
        nothing.
        """
        place = point_m / self.squares.resolution_m
        column, row = (
            np.floor(place).astype(int).clip(0, np.array(self.squares.shape)[::-1] - 1)
        )
        x, y = place - (column, row)
        nodes = value.reshape(self.squares.height + 1, -1)[
            row : row + 2, column : column + 2
        ]
        if (row + column) % 2:  # as seen in a mirror
            nodes, x = nodes[:, ::-1], 1 - x
        if x + y > 1:
            nodes, x, y = nodes[::-1, ::-1], 1 - x, 1 - y
        return float(
            nodes[0, 0]
            + x * (nodes[0, 1] - nodes[0, 0])
            + y * (nodes[1, 0] - nodes[0, 0])
        )


def largest(mesh: Mesh, goal_radius_m: float) -> ndarray:
    """Find nearly the largest W whose slopes are allowed, at all nodes, shape [N].

    Args:
        mesh: its triangles.
        goal_radius_m: a length of the disc in which W ends, by which steps are scaled.
    """
    rises, size = mesh.rises, mesh.squares.resolution_m
    value, count = np.zeros(len(mesh.free)), len(mesh.right)
    if not mesh.free.any():
        return value
    back = rises.T.tocsr()
    small = 1e-9 * identity(rises.shape[1])  # of nodes without a way to the goal
    solve = splu(
        (back @ rises + small).tocsc(), "MMD_AT_PLUS_A", options={"SymmetricMode": True}
    ).solve
    # Flux of a unit a node through the rim of the disc, over the slowness.
    flux = count / 2 * size**2 / (2 * math.pi * goal_radius_m)
    weight = _WEIGHT * flux * size / np.median(mesh.rise)
    source = size**2 / weight
    allowed = multiplier = np.zeros(2 * count)
    best = value
    for step in range(1, _MOST_STEPS + 1):
        free = solve(source + back @ (allowed - multiplier))
        over = _RELAXATION * (rises @ free) + (1 - _RELAXATION) * allowed
        wanted = over + multiplier
        length = np.hypot(wanted[:count], wanted[count:])
        allowed = wanted * np.tile(mesh.rise / np.maximum(length, mesh.rise), 2)
        multiplier = multiplier + over - allowed
        if step % _CHECK_EVERY == 0:
            value = np.zeros(len(mesh.free))
            value[mesh.free] = free
            excess = max(1.0, mesh.excess(value) * (1 + 1e-12))
            if (value / excess).sum() > best.sum():
                best = value / excess
            if excess <= _EXCESS:
                break
    return best
