"""A lower bound of the time to the goal, for all planners, if λ is constant.

**Claim.** Let robots move as the shipped robots do: a time step leads from p to a point
at a distance of at most v·dt·λ(p), where v is the top speed. Let λ⁺(x) be the maximum
λ(p) over the points p from which a step can lead to x or beyond: |x − p| ≤ v·dt·λ(p).
Let W be continuous, 0 on the goal's disc, with |∇W| ≤ 1 / (v·λ⁺) almost everywhere.
Then no trajectory from x reaches the goal in less time than W(x).

**Proof.** A step from p to q is a segment. Each of its points x has |x − p| ≤
v·dt·λ(p), so that λ⁺(x) ≥ λ(p). Along the segment, W decreases by at most the length of
the segment times the maximum slope, v·dt·λ(p) / (v·λ(p)) = dt. A trajectory of K steps
to the goal ends where W is 0, hence W(start) ≤ K·dt. On a triangulation, W is linear on
each closed triangle. A segment along an edge lies in two triangles. Hence the slope on
a triangle must satisfy the bound for the maximum λ⁺ on the closed triangle.

**Immobilising terrain.** A robot is immobilised after m consecutive steps that start on
λ below `below`, unless it has reached the goal. A trajectory to the goal is a polygonal
line. Take a point x of the trajectory on immobilising terrain, and the longest part
around x that stays on such terrain. This part begins at the start, or within a step of
at most v·dt that enters such terrain. It contains at most m steps that start on such
terrain, each at most v·dt·`below` long. It ends where it leaves such terrain or reaches
the goal's disc. So its length is at most v·dt·(1 + m·`below`), and the distance of x
from other terrain, the disc or the start is at most half of this length. Points at a
larger distance are removed, since no trajectory to the goal contains one. W need not be
continuous across removed points. If they separate start and goal, no trajectory reaches
the goal.

**The largest W.** The augmented Lagrangian method finds the W with the maximum sum over
the nodes, by one Poisson equation and one projection on discs per iteration (Ennaji,
Igbida and Nguyen, 2021, "Augmented Lagrangian methods for degenerate Hamilton–Jacobi
equations"). Incomplete convergence makes the bound smaller, but not invalid: the slope
of each triangle is measured in float64, and W is divided by the maximum excess.

λ and positions are in single precision. By rounding, a step may be some units in the
last place longer, or λ may be read at a point that much farther away. These units are
added to steps and distances. Letters in shapes: H×W cells, N nodes, T triangles.
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

_MAX_SQUARES = 300_000  # maximum number of squares, so that factors take less than 1 GB
_MIN_TRAVERSABILITY = 1e-3  # A smaller λ⁺ is replaced by this value.
_RELATIVE_ERROR = 4 * 2.0**-24  # error of a position, as a fraction of the map's extent
_RELAXATION = 1.6  # over-relaxation of the iteration, in (1, 2)
# Weight of the augmented Lagrangian, relative to its natural unit; see `largest`.
_WEIGHT = 5.0
_EXCESS = 1.004  # maximum slope at convergence, relative to its bound
_CHECK_EVERY = 25  # iterations between checks for convergence
_MAX_STEPS = 300  # maximum number of iterations


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Bounds of the motion of robots in an episode.

    Args:
        robot: one of `BOUNDED_ROBOTS`, whose speed is scaled by λ.
        goal_radius_m: distance in metres below which a robot has reached the goal.
        immobile: rule of immobilisation; None if nothing immobilises a robot.
    """

    robot: Robot
    goal_radius_m: float
    immobile: Immobile | None = None

    @property
    def step_m(self) -> float:
        """Length of a step at top speed and λ = 1 in metres."""
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
        Time in seconds: 0 at the goal, and infinite if no trajectory reaches the goal.
    """
    start_m = np.asarray(start_m, np.float64)
    goal_m = np.asarray(goal_m, np.float64)
    step_m = motion.step_m
    error_m = _RELATIVE_ERROR * max(grid.extent_m)
    squares = _refined(grid, step_m)
    n_per_side = squares.height // grid.height
    fine_field = np.asarray(field, np.float64)
    fine_field = fine_field.repeat(n_per_side, 0).repeat(n_per_side, 1)
    at_goal = _squares_within(squares, goal_m, motion.goal_radius_m + error_m)
    start_square = _square_at(squares, start_m)
    is_reachable = np.ones_like(at_goal)
    if motion.immobile is not None:
        # The world compares λ with `below` in single precision.
        below = np.float32(motion.immobile.below)
        exits = (fine_field >= below) | at_goal
        exits[start_square] = True
        max_depth_m = _max_depth_m(motion, motion.immobile)
        is_reachable = _within(exits, squares, max_depth_m + 2 * error_m)
    regions, _ = label(is_reachable, generate_binary_structure(2, 2))
    is_reachable = regions == regions[start_square]
    reached_goal = at_goal & is_reachable
    if not reached_goal.any():
        return math.inf
    max_traversability = _max_reaching(fine_field, squares, step_m, 2 * error_m)
    max_traversability = max_traversability + error_m / step_m
    max_traversability = max_traversability.clip(_MIN_TRAVERSABILITY)
    slowness = 1 / (motion.robot.top_speed_mps * max_traversability)
    mesh = Mesh(squares, slowness, is_reachable, reached_goal)
    value = largest(mesh, motion.goal_radius_m)
    return mesh.value_at(value, start_m)


def _refined(grid: Grid, step_m: float) -> Grid:
    """Return a grid of squares that are about as wide as a step is long.

    Each side of a cell is divided into a whole number of squares.
    """
    times = math.ceil(grid.resolution_m / step_m - 1e-6)
    max_times = math.isqrt(_MAX_SQUARES // (grid.height * grid.width))
    times = max(1, min(times, max_times))
    return Grid(grid.height * times, grid.width * times, grid.resolution_m / times)


def _max_depth_m(motion: Motion, immobile: Immobile) -> float:
    """Return the maximum distance from other terrain on any trajectory to the goal."""
    steps = steps_in(immobile.for_s, motion.robot.dt_s)
    return motion.step_m * (1 + steps * immobile.below) / 2


def _square_at(squares: Grid, point_m: ndarray) -> tuple[int, int]:
    """Return row and column of the square nearest to a point."""
    index = np.floor(point_m[::-1] / squares.resolution_m).astype(int)
    last = np.array(squares.shape) - 1
    row, column = index.clip(0, last)
    return row, column


def _squares_within(squares: Grid, point_m: ndarray, radius_m: float) -> ndarray:
    """Return a mask of squares with a point within a radius of a given point, bool."""
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
    """Return offsets (row, column) of squares within a distance, and their distances.

    Distances are the minima between any points of two squares, in metres.
    """
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
    """Return values shifted by some rows and columns, with 0 beyond the edge."""
    height, width = values.shape
    margin = max(abs(row), abs(column))
    first_row = margin + row
    first_column = margin + column
    padded = np.pad(values, margin)
    return padded[first_row : first_row + height, first_column : first_column + width]


def _within(exits: ndarray, squares: Grid, reach_m: float) -> ndarray:
    """Return a mask of squares within a distance of a square of a mask, bool."""
    is_near = exits.copy()
    for row, column, _ in _around(squares, reach_m):
        is_near |= _shifted(exits, row, column)
    return is_near


def _max_reaching(
    field: ndarray, squares: Grid, step_m: float, error_m: float
) -> ndarray:
    """Return λ⁺ of each square: the maximum λ from which one step can reach it."""
    fastest = field.copy()
    for row, column, distance_m in _around(squares, step_m + error_m):
        shifted = _shifted(field, row, column)
        is_in_reach = shifted * step_m + error_m >= distance_m
        is_faster = shifted > fastest
        fastest = np.where(is_in_reach & is_faster, shifted, fastest)
    return fastest


class Mesh:
    """Triangulation of a map: each square is divided into two right triangles.

    The diagonals of neighbouring squares have different directions.

    Args:
        squares: grid of the squares of the whole map.
        slowness: maximum slope of W in each square in seconds per metre, shape
            [rows, columns] of the squares.
        is_kept: mask of squares that are not removed, bool, of the same shape.
        ends: mask of squares where W is 0, bool, of the same shape.

    Attributes:
        right: index of the node at the right angle of each triangle, int64, shape [T].
        along: indices of the nodes at the other ends of the two legs of each triangle,
            int64, shape [2, T].
        rise: maximum rise of W along a leg of each triangle in seconds, shape [T].
        free: mask of nodes where W is not fixed to 0, bool, shape [N].
    """

    def __init__(
        self, squares: Grid, slowness: ndarray, is_kept: ndarray, ends: ndarray
    ) -> None:
        """Create the triangles of the squares that are kept."""
        self.squares = squares
        shape = squares.height + 1, squares.width + 1
        node = np.arange(shape[0] * shape[1]).reshape(shape)
        corners = node[:-1, :-1], node[:-1, 1:], node[1:, :-1], node[1:, 1:]
        low, right, up, far = (corner[is_kept] for corner in corners)
        row, column = np.nonzero(is_kept)
        even = (row + column) % 2 == 0
        # In even squares, the right angles are at the lower left and the upper right
        # corner, and in odd squares at the other two corners.
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
        """Matrix that maps W at the free nodes to its rises along the triangles' legs.

        Its shape is [2·T, number of free nodes].
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
        """Return the maximum slope of W relative to its bound, from W at N nodes."""
        at_right = value[self.right]
        across, upward = self.along
        rise = np.hypot(value[across] - at_right, value[upward] - at_right)
        return float((rise / self.rise).max())

    def value_at(self, value: ndarray, point_m: ndarray) -> float:
        """Return W at a point, which must not be in a removed square.

        Args:
            value: W at all nodes, shape [N].
            point_m: point (x, y) in metres, shape [2].
        """
        position = point_m / self.squares.resolution_m
        row, column = _square_at(self.squares, point_m)
        x, y = position - (column, row)
        nodes = value.reshape(self.squares.height + 1, -1)
        corners = nodes[row : row + 2, column : column + 2]
        if (row + column) % 2:  # Mirror an odd square to the layout of even squares.
            corners = corners[:, ::-1]
            x = 1 - x
        if x + y > 1:  # Rotate the second triangle onto the first.
            corners = corners[::-1, ::-1]
            x = 1 - x
            y = 1 - y
        low = corners[0, 0]
        right = corners[0, 1]
        up = corners[1, 0]
        return float(low + x * (right - low) + y * (up - low))


def largest(mesh: Mesh, goal_radius_m: float) -> ndarray:
    """Return W at all nodes, shape [N]: nearly the largest W within the slope bounds.

    Args:
        mesh: triangulation with the bounds of the slope.
        goal_radius_m: radius of the goal's disc in metres; it affects only the speed of
            convergence.
    """
    rises = mesh.rises
    max_rise = mesh.rise
    size = mesh.squares.resolution_m
    value = np.zeros(len(mesh.free))
    count = len(mesh.right)
    if not mesh.free.any():
        return value
    transposed = rises.T.tocsr()
    # Without regularisation, nodes without a path to the goal would make the matrix
    # singular.
    regularisation = 1e-9 * identity(rises.shape[1])
    matrix = (transposed @ rises + regularisation).tocsc()
    factors = splu(matrix, "MMD_AT_PLUS_A", options={"SymmetricMode": True})
    # The natural unit of the weight is the flux through the border of the goal's disc
    # from a unit source, divided by the slowness.
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
        # The two rises of each triangle are projected onto a disc.
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
