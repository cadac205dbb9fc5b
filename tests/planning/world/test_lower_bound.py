"""The lower bound, against closed forms, its own claim at random points, and robots
that jump wherever λ lets them.
"""

import math

import numpy as np
import pytest
from numpy import ndarray
from scipy.optimize import minimize_scalar

from benchnav.core.grid import Grid
from benchnav.planning.free_space import Immobile
from benchnav.planning.robots import Robot, Unicycle
from benchnav.planning.world import lower_bound
from benchnav.planning.world.lower_bound import Mesh, Motion, lower_bound_s

GRID = Grid(12, 16, 0.5)
START, GOAL = np.array([1.25, 3.25]), np.array([6.75, 3.25])


def bound(
    field: ndarray,
    immobile: Immobile | None = None,
    robot: Robot | None = None,
    **changes: ndarray,
) -> float:
    motion = Motion(robot=robot or Unicycle(), goal_radius_m=0.5, immobile=immobile)
    ends = {"start_m": START, "goal_m": GOAL} | changes
    return lower_bound_s(field, Grid(*field.shape, 0.5), motion, **ends)


@pytest.mark.parametrize(
    ("traversability", "speed"), [(1.0, 1.0), (0.4, 1.0), (0.7, 2.0)]
)
def test_on_even_ground_it_is_the_straight_line_at_top_speed(
    traversability: float, speed: float
) -> None:
    least = 5.0 / (traversability * speed)
    found = bound(
        np.full(GRID.shape, traversability), robot=Unicycle(speed_mps=(0, speed))
    )
    assert 0.97 * least < found <= least
    # Where the goal is, no time is needed.
    assert bound(np.full(GRID.shape, traversability), goal_m=START + 0.2) == 0


def test_across_the_edge_of_slow_ground_it_is_what_the_law_of_refraction_says() -> None:
    field = np.full((24, 24), 0.9)
    field[:, 12:] = 0.3
    start, goal = np.array([2.25, 3.25]), np.array([9.75, 9.25])

    def seconds(y: float) -> float:
        beyond = math.hypot(goal[0] - 6, goal[1] - y) - 0.5
        return math.hypot(6 - start[0], y - start[1]) / 0.9 + beyond / 0.3

    least = minimize_scalar(seconds, bounds=(3, 10), method="bounded").fun
    found = bound(field, start_m=start, goal_m=goal)
    # What a step and a square reach into the slow ground, 0.2 m of it, may be driven at
    # the speed of the other.
    assert least - 0.2 * (1 / 0.3 - 1 / 0.9) - 0.02 * least < found <= least


@pytest.mark.parametrize("seed", range(3))
def test_no_step_gains_more_than_its_time(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The claim itself, at points near the edges of cells above all, on ground of sharp
    contrasts.
    """
    generator, kept = np.random.default_rng(seed), {}
    largest = lower_bound.largest

    def keep(mesh: Mesh, radius_m: float) -> ndarray:
        kept.update(mesh=mesh, value=largest(mesh, radius_m))
        return kept["value"]

    monkeypatch.setattr(lower_bound, "largest", keep)
    robot, field = Unicycle(), generator.choice([0.05, 0.4, 0.999], GRID.shape)
    assert bound(field, robot=robot) > 5
    mesh, value = kept["mesh"], kept["value"]
    point = generator.uniform(0, 1, (2500, 2)) * [8, 6]
    point = np.where(
        generator.random(point.shape) < 0.7, np.round(2 * point) / 2 - 1e-7, point
    ).clip(0.0)
    here = field[(2 * point[:, 1]).astype(int), (2 * point[:, 0]).astype(int)]
    angle = generator.uniform(0, 2 * math.pi, len(point))
    length = (
        0.1
        * here
        * np.where(generator.random(len(point)) < 0.7, 1, generator.random(len(point)))
    )
    after = point + length[:, None] * np.stack((np.cos(angle), np.sin(angle)), 1)
    inside = ((after >= 0) & (after < [8, 6])).all(1)
    gained = [
        mesh.value_at(value, p) - mesh.value_at(value, q)
        for p, q in zip(point[inside], after[inside], strict=True)
    ]
    assert max(gained) <= 0.1 * (1 + 1e-9)
    # And some come near to it: the slopes are used.
    assert max(gained) > 0.08


def quickest_jumps(field: ndarray, immobile: Immobile | None, most: int) -> float:
    """Time of the quickest trajectory found for a robot that may jump in any direction:
    no robot is quicker than all.

    A beam of positions, one for each bin of 4 cm and time on immobilising ground, the
    first to be there.
    """
    step, steps = 0.1, round(immobile.for_s / 0.1) if immobile else 1
    angle = np.arange(24) * (2 * math.pi / 24)
    ways = np.concatenate(
        [share * np.stack((np.cos(angle), np.sin(angle)), 1) for share in (1.0, 0.6)]
    )
    place, held, seen = (
        START[None],
        np.zeros(1, int),
        np.zeros((200, 150, steps + 1), bool),
    )
    for count in range(1, most + 1):
        here = field[(2 * place[:, 1]).astype(int), (2 * place[:, 0]).astype(int)]
        held = np.where(here < immobile.below, held + 1, 0) if immobile else held
        place = (place[:, None] + step * here[:, None, None] * ways).reshape(-1, 2)
        if (np.hypot(*(place - GOAL).T) < 0.5).any():
            return count * step
        held = held.repeat(len(ways))
        inside = ((place >= 0) & (place < [8, 6])).all(1) & (
            (held < steps) if immobile else True
        )
        place, held = place[inside], held[inside]
        bins = *(place.T / 0.04).astype(int), held
        _, first = np.unique(np.ravel_multi_index(bins, seen.shape), return_index=True)
        fresh = first[~seen[tuple(part[first] for part in bins)]]
        seen[tuple(part[fresh] for part in bins)] = True
        place, held = place[fresh], held[fresh]
    return math.inf


def wall(thickness: int, traversability: float) -> ndarray:
    field = np.full(GRID.shape, 0.9)
    field[:, 7 : 7 + thickness] = traversability
    return field


@pytest.mark.parametrize(
    ("field", "immobile"),
    [
        (wall(1, 0.3), None),
        # crossed in 2.2 s less what jumps gain
        (wall(2, 0.45), Immobile(below=0.5, for_s=2.0)),
        (wall(3, 0.45), Immobile(below=0.5, for_s=3.5)),
        (wall(1, 0.09), Immobile(below=0.1, for_s=2.0)),
        (wall(1, 0.45), Immobile(below=0.5, for_s=0.9)),
        (np.random.default_rng(1).choice([0.05, 0.09, 0.6, 0.9], GRID.shape), Immobile()),
        (np.random.default_rng(2).choice([0.3, 0.45, 0.9], GRID.shape), Immobile(below=0.5, for_s=1.2)),
    ],
)  # fmt: skip
def test_no_jumping_robot_arrives_earlier_or_where_it_is_infinite(
    field: ndarray, immobile: Immobile | None
) -> None:
    field = field.copy()
    field[6, 2] = 0.9
    quickest, least = quickest_jumps(field, immobile, 160), bound(field, immobile)
    assert least <= quickest
    if math.isfinite(quickest):  # but not far from it
        assert least > 0.6 * quickest


@pytest.mark.parametrize("thickness", [1, 2])
def test_a_wall_thicker_than_a_robot_can_cross_ends_all(thickness: int) -> None:
    assert math.isinf(bound(wall(thickness, 0.09), Immobile(below=0.1, for_s=2.0)))
    assert math.isfinite(bound(wall(thickness, 0.09), Immobile(below=0.1, for_s=12.0)))
    assert math.isfinite(bound(wall(thickness, 0.09)))
    # A goal or a start in such ground is left and reached.
    inside = bound(
        wall(4, 0.09), Immobile(below=0.1, for_s=2.0), goal_m=np.array([4.1, 3.25])
    )
    assert math.isfinite(inside)
    assert math.isfinite(
        bound(
            wall(4, 0.09), Immobile(below=0.1, for_s=2.0), start_m=np.array([5.4, 3.25])
        )
    )


@pytest.mark.parametrize("traversability", [0.1, 0.3, 0.7])
def test_ground_of_just_the_limit_immobilises_no_robot(traversability: float) -> None:
    """In single precision, in which 0.7 is less than 0.7, as in `Simulation`."""
    field = np.full(GRID.shape, traversability, np.float32)
    assert math.isfinite(bound(field, Immobile(below=traversability, for_s=0.1)))
    assert math.isinf(
        bound(field * np.float32(0.99), Immobile(below=traversability, for_s=0.1))
    )


def test_removed_squares_lie_deeper_than_a_robot_gets_and_reach_is_the_greatest_within_a_step() -> (
    None
):
    generator = np.random.default_rng(5)
    squares, step_m, deepest_m = Grid(40, 30, 0.05), 0.11, 0.13
    field = generator.choice([0.05, 0.5, 1.0], (40, 30))
    field = field.repeat(3, 0).repeat(3, 1)[:40, :30]
    exits = field > 0.05
    kept = lower_bound._within(exits, squares, deepest_m)
    reach = lower_bound._max_reaching(field, squares, step_m, 0.0)
    rows, columns = np.indices(squares.shape)
    for row, column in generator.integers(0, squares.shape, (150, 2)):
        apart = 0.05 * np.hypot(
            *(
                np.maximum(abs(one - at) - 1, 0)
                for one, at in ((rows, row), (columns, column))
            )
        )
        assert kept[row, column] == (apart[exits] <= deepest_m).any()
        assert reach[row, column] == field[field * step_m >= apart].max()


def test_triangles_tile_what_is_kept_and_slopes_are_theirs() -> None:
    generator = np.random.default_rng(3)
    squares, kept = Grid(5, 6, 0.2), generator.random((5, 6)) < 0.8
    mesh = Mesh(squares, np.full((5, 6), 2.0), kept, np.zeros((5, 6), bool))
    assert len(mesh.right) == 2 * kept.sum()
    x, y = (0.2 * part.ravel().astype(float) for part in np.indices((6, 7))[::-1])
    corners = np.stack((mesh.right, *mesh.along))
    areas = (
        np.linalg.det(
            np.stack((x[corners], y[corners], np.ones(corners.shape))).transpose(
                2, 0, 1
            )
        )
        / 2
    )
    np.testing.assert_allclose(abs(areas), 0.02)
    # A plane has one slope, and is met between nodes.
    plane = 3 * x - 4 * y + 1
    assert mesh.excess(plane) == pytest.approx(5 / 2)
    for point in generator.uniform(0, 1, (30, 2)) * [1.2, 1.0]:
        assert mesh.value_at(plane, point) == pytest.approx(
            3 * point[0] - 4 * point[1] + 1
        )
    one = generator.normal(size=len(x))
    slopes = [
        np.linalg.norm(
            np.linalg.solve(
                np.stack((x[c] - x[c[0]], y[c] - y[c[0]]), 1)[1:],
                one[c[1:]] - one[c[0]],
            )
        )
        for c in corners.T
    ]
    assert mesh.excess(one) == pytest.approx(max(slopes) / 2)
