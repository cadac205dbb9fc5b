"""A lower bound of the time to the goal, for all planners, if λ is constant.

**Claim.** Let robots move as the shipped ones do: a time step leads from p to a point
at most v·dt·λ(p) away, where v is the top speed. Let λ⁺(x) be the maximum λ(p) over the
points p from which a step can lead to x or past it, |x − p| ≤ v·dt·λ(p). Let W be
continuous, 0 on the goal's disc, with |∇W| ≤ 1 / (v·λ⁺) almost everywhere. Then no
trajectory from x reaches the goal in less than W(x).

**Proof.** Each point x of the segment from p to its successor q has |x − p| ≤
v·dt·λ(p), so that λ⁺(x) ≥ λ(p). Along the segment W decreases by at most its length
times the maximum slope, v·dt·λ(p) / (v·λ(p)) = dt. A trajectory of K steps to the goal
ends where W is 0, hence W(start) ≤ K·dt. On a triangulation W is linear on each closed
triangle, and a segment along an edge lies in two of them. Hence the slope is bounded by
the maximum λ⁺ on the closed triangle.

**Immobilising terrain.** A robot is lost after m consecutive steps that start on λ
under `below`, unless it has reached the goal. A trajectory to the goal is a polygonal
line. Take a point x of it on immobilising terrain, and the longest part around x that
stays on such terrain. This part enters by a fraction of one step, at most v·dt long, or
begins at the start. It has at most m steps from inside, each up to v·dt·`below` long. It
ends where it leaves such terrain or reaches the goal's disc. So it is at most
v·dt·(1 + m·`below`) long, and x is at most half of that away from other terrain, the
disc or the start. Deeper points are removed, since no trajectory to the goal contains
one. W need not be continuous across them. If they separate start and goal, no trajectory
reaches the goal.

**The largest W.** The augmented Lagrangian method finds the W with the maximum sum over
the nodes, by one Poisson equation and one projection on discs per iteration (Ennaji,
Igbida and Nguyen, 2021, "Augmented Lagrangian methods for degenerate Hamilton–Jacobi
equations"). Its convergence affects only the size of the bound, and not its validity:
the slope of each triangle is measured in float64, and W is divided by the maximum
excess.

λ and positions are in single precision. Rounding may make a step longer, or read λ at a
point farther away, by some units in the last place; these are added to steps and
distances. Letters in shapes: H×W cells, N nodes, T triangles.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import product

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

_MAX_SQUARES = 300_000  # of a map, so that the factors take less than 1 GB
_MIN_TRAVERSABILITY = 1e-3
_ULPS = 4 * 2.0**-24  # error of a position, as a fraction of the map's extent
_RELAXATION = 1.6
# Weight of the augmented Lagrangian, in units of the flux at the goal over the slowness.
_WEIGHT = 5.0
_EXCESS = 1.004  # maximum relative slope at convergence
_CHECK_EVERY = 25  # iterations between checks for convergence
_MAX_STEPS = 300  # maximum number of iterations


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Bounds of the motion of robots in an episode.

    Args:
        robot: one of the shipped robots, whose λ scales its speed.
        goal_radius_m: distance in metres below which a robot has reached the goal.
        immobile: conditions of immobilisation; None if nothing immobilises a robot.
    """

    robot: Robot
    goal_radius_m: float
    immobile: Immobile | None = None

    @property
    def step_m(self) -> float:
        """Length of a step at λ = 1 in metres."""
        return self.robot.top_speed_mps * self.robot.dt_s


def lower_bound_s(
    field: ndarray, grid: Grid, motion: Motion, start_m: ndarray, goal_m: ndarray
) -> float:
    """Return a lower bound of the time to the goal, for all trajectories.

    Args:
        field: λ of each cell during the whole episode, in [0, 1], shape [H, W].
        grid: grid of the map.
        motion: bounds of the robot's motion.
        start_m: start (x, y) in metres, shape [2].
        goal_m: goal (x, y) in metres, shape [2].

    Returns:
        Time in seconds; 0 at the goal, infinite if no trajectory reaches it.
    """
    start_m = np.asarray(start_m, np.float64)
    goal_m = np.asarray(goal_m, np.float64)
    step_m = motion.step_m
    error_m = _ULPS * max(grid.extent_m)
    squares = _refined(grid, step_m)
    times = squares.height // grid.height
    fine = np.asarray(field, np.float64).repeat(times, 0).repeat(times, 1)
    ends = _squares_within(squares, goal_m, motion.goal_radius_m + error_m)
    begin = _square_at(squares, start_m)
    is_reachable = np.ones_like(ends)
    if motion.immobile is not None:
        # In single precision, as the world compares.
        below = np.float32(motion.immobile.below)
        exits = (fine >= below) | ends
        exits[begin] = True
        max_depth_m = _max_depth_m(motion, motion.immobile)
        is_reachable = _near(exits, squares, max_depth_m + 2 * error_m)
    regions, _ = label(is_reachable, generate_binary_structure(2, 2))
    is_reachable = regions == regions[begin]
    reached_ends = ends & is_reachable
    if not reached_ends.any():
        return math.inf
    reach = _reached(fine, squares, step_m, 2 * error_m) + error_m / step_m
    slowness = 1 / (motion.robot.top_speed_mps * reach.clip(_MIN_TRAVERSABILITY))
    mesh = Mesh(squares, slowness, is_reachable, reached_ends)
    value = largest(mesh, motion.goal_radius_m)
    return mesh.value_at(value, start_m)


def _refined(grid: Grid, step_m: float) -> Grid:
    """Return a grid of squares about as wide as a step.

    A whole number of squares covers each side of a cell.
    """
    times = math.ceil(grid.resolution_m / step_m - 1e-6)
    max_times = math.isqrt(_MAX_SQUARES // (grid.height * grid.width))
    times = max(1, min(times, max_times))
    return Grid(grid.height * times, grid.width * times, grid.resolution_m / times)


def _max_depth_m(motion: Motion, immobile: Immobile) -> float:
    """Return the maximum distance from other terrain on a trajectory to the goal."""
    steps = steps_in(immobile.for_s, motion.robot.dt_s)
    return motion.step_m * (1 + steps * immobile.below) / 2


def _square_at(squares: Grid, point_m: ndarray) -> tuple[int, int]:
    """Return row and column of the square at a point, the nearest if it is outside."""
    index = np.floor(point_m[::-1] / squares.resolution_m).astype(int)
    last = np.array(squares.shape) - 1
    row, column = index.clip(0, last)
    return row, column


def _squares_within(squares: Grid, point_m: ndarray, radius_m: float) -> ndarray:
    """Return a mask of closed squares within a radius of a point, bool."""
    gaps_m = []
    for size, position_m in zip(squares.shape, point_m[::-1], strict=True):
        low_m = np.arange(size) * squares.resolution_m
        before_m = low_m - position_m
        after_m = position_m - low_m - squares.resolution_m
        gap_m = np.maximum(np.maximum(before_m, after_m), 0)
        gaps_m.append(gap_m)
    row_gap_m, column_gap_m = gaps_m
    return np.hypot(row_gap_m[:, None], column_gap_m) <= radius_m


def _around(squares: Grid, reach_m: float) -> list[tuple[int, int, float]]:
    """Return offsets of squares within a distance, and the minimum distance of each."""
    max_offset = math.floor(reach_m / squares.resolution_m) + 1
    offsets = range(-max_offset, max_offset + 1)
    squares_around = []
    for row, column in product(offsets, offsets):
        row_gap = max(abs(row) - 1, 0)
        column_gap = max(abs(column) - 1, 0)
        distance_m = squares.resolution_m * math.hypot(row_gap, column_gap)
        if distance_m <= reach_m:
            squares_around.append((row, column, distance_m))
    return squares_around


def _shifted(values: ndarray, row: int, column: int) -> ndarray:
    """Return values shifted by some rows and columns, 0 beyond the edge."""
    height, width = values.shape
    margin = max(abs(row), abs(column))
    first_row = margin + row
    first_column = margin + column
    padded = np.pad(values, margin)
    return padded[first_row : first_row + height, first_column : first_column + width]


def _near(exits: ndarray, squares: Grid, reach_m: float) -> ndarray:
    """Return a mask of squares with a point within a distance of an exit, bool."""
    is_near = exits.copy()
    for row, column, _ in _around(squares, reach_m):
        is_near |= _shifted(exits, row, column)
    return is_near


def _reached(fine: ndarray, squares: Grid, step_m: float, error_m: float) -> ndarray:
    """Return λ⁺, the maximum λ from which one step leads into each square."""
    fastest = fine.copy()
    for row, column, distance_m in _around(squares, step_m + error_m):
        shifted = _shifted(fine, row, column)
        is_in_reach = shifted * step_m + error_m >= distance_m
        is_faster = shifted > fastest
        fastest = np.where(is_in_reach & is_faster, shifted, fastest)
    return fastest


class Mesh:
    """A triangulation of squares, two right triangles each, whose diagonals alternate.

    Args:
        squares: grid of squares of the whole map.
        slowness: maximum slope of W in each square in seconds per metre, of the shape
            of the squares.
        is_kept: mask of squares that are not removed, bool, of the same shape.
        ends: mask of squares where W is 0, bool, of the same shape.

    Attributes:
        right: node at the right angle of each triangle, int64, shape [T].
        along: nodes at the ends of both legs of each triangle, int64, shape [2, T].
        rise: maximum rise of W along a leg in seconds, shape [T].
        free: mask of nodes where W is not fixed to 0, bool, shape [N].
    """

    def __init__(
        self, squares: Grid, slowness: ndarray, is_kept: ndarray, ends: ndarray
    ) -> None:
        """Create the triangles."""
        self.squares = squares
        shape = squares.height + 1, squares.width + 1
        node = np.arange(shape[0] * shape[1]).reshape(shape)
        corners = node[:-1, :-1], node[:-1, 1:], node[1:, :-1], node[1:, 1:]
        low, right, up, far = (corner[is_kept] for corner in corners)
        row, column = np.nonzero(is_kept)
        even = (row + column) % 2 == 0
        # Right angles at the lower left and the upper right corner, or at the other
        # two.
        first = np.where(even, low, right)
        second = np.where(even, far, up)
        first_end = np.where(even, right, low)
        second_end = np.where(even, up, far)
        self.right = np.concatenate((first, second))
        across = np.concatenate((first_end, second_end))
        upward = np.concatenate((second_end, first_end))
        self.along = np.stack((across, upward))
        self.rise = np.tile(slowness[is_kept] * squares.resolution_m, 2)
        self.free = np.zeros(node.size, dtype=bool)
        self.free[self.right] = True
        self.free[self.along] = True
        for corner in corners:
            self.free[corner[ends]] = False

    @cached_property
    def rises(self) -> csr_array:
        """Matrix from W at the free nodes to its rise along both legs of all triangles.

        Its shape is [2·T, free nodes].
        """
        count = len(self.right)
        values = np.repeat([1.0, -1.0], count)
        rows = np.tile(np.arange(count), 2)
        shape = count, len(self.free)
        legs = []
        for end in self.along:
            columns = np.concatenate((end, self.right))
            legs.append(csr_array((values, (rows, columns)), shape))
        all_nodes = vstack(legs).tocsc()
        return csr_array(all_nodes[:, self.free])

    def excess(self, value: ndarray) -> float:
        """Return the maximum slope of W relative to its bound, from W at all N nodes."""
        at_right = value[self.right]
        across, upward = self.along
        rise = np.hypot(value[across] - at_right, value[upward] - at_right)
        return float((rise / self.rise).max())

    def value_at(self, value: ndarray, point_m: ndarray) -> float:
        """Return W at a point, from W at all nodes, shape [N].

        It is undefined in a removed square.
        """
        position = point_m / self.squares.resolution_m
        row, column = _square_at(self.squares, point_m)
        x, y = position - (column, row)
        nodes = value.reshape(self.squares.height + 1, -1)
        corners = nodes[row : row + 2, column : column + 2]
        if (row + column) % 2:  # mirror to the layout of even squares
            corners = corners[:, ::-1]
            x = 1 - x
        if x + y > 1:  # rotate the second triangle onto the first
            corners = corners[::-1, ::-1]
            x = 1 - x
            y = 1 - y
        low = corners[0, 0]
        right = corners[0, 1]
        up = corners[1, 0]
        return float(low + x * (right - low) + y * (up - low))


def largest(mesh: Mesh, goal_radius_m: float) -> ndarray:
    """Return nearly the largest W of bounded slope, at all nodes, shape [N].

    Args:
        mesh: triangles.
        goal_radius_m: radius in metres of the disc on which W is 0, which scales the
            step sizes of the iteration.
    """
    rises = mesh.rises
    max_rise = mesh.rise
    size = mesh.squares.resolution_m
    value = np.zeros(len(mesh.free))
    count = len(mesh.right)
    if not mesh.free.any():
        return value
    transposed = rises.T.tocsr()
    # Nodes without a path to the goal would make the matrix singular.
    regularisation = 1e-9 * identity(rises.shape[1])
    matrix = (transposed @ rises + regularisation).tocsc()
    factors = splu(matrix, "MMD_AT_PLUS_A", options={"SymmetricMode": True})
    # Flux through the rim of the disc from a unit source at each node, over the slowness.
    flux = count / 2 * size**2 / (2 * math.pi * goal_radius_m)
    weight = _WEIGHT * flux * size / np.median(max_rise)
    source = size**2 / weight
    allowed = np.zeros(2 * count)
    multiplier = allowed
    best = value
    for step in range(1, _MAX_STEPS + 1):
        free = factors.solve(source + transposed @ (allowed - multiplier))
        relaxed = _RELAXATION * (rises @ free) + (1 - _RELAXATION) * allowed
        target = relaxed + multiplier
        length = np.hypot(target[:count], target[count:])
        # The projection of each triangle's rises onto a disc.
        scale = max_rise / np.maximum(length, max_rise)
        allowed = target * np.tile(scale, 2)
        multiplier = multiplier + relaxed - allowed
        if step % _CHECK_EVERY == 0:
            value = np.zeros(len(mesh.free))
            value[mesh.free] = free
            excess = max(1.0, mesh.excess(value) * (1 + 1e-12))
            feasible = value / excess
            if feasible.sum() > best.sum():
                best = feasible
            if excess <= _EXCESS:
                break
    return best
