"""Edges, against the controller and F run step by step, and against what geometry says."""

import math

import pytest
import torch
from torch import Tensor

from benchnav.planning.planners.cl_rrt.edges import (
    ClosedLoop,
    Edges,
    LoopState,
    draw_references,
    drive,
)
from benchnav.planning.planners.cl_rrt.pursuit import Tracking
from tests.planning.planners.cl_rrt.maps import known, make_loop, open_map, walled_map


def edge(
    loop: ClosedLoop, pose: tuple[float, ...], *targets: tuple[float, float]
) -> Edges:
    """Drives from one pose to some targets."""
    state = torch.tensor([[pose]]).expand(1, len(targets), -1)
    free = loop.problem.free_at(state)
    begin = LoopState(state=state, tracking=Tracking.standing(state), free=free)
    reference, length_m = draw_references(loop, state, torch.tensor([targets]))
    return drive(loop, begin, reference, length_m)


def slow_map(value: float) -> Tensor:
    """The wall of `walled_map`, of other ground."""
    maps = open_map()
    maps[:, :, 16:18] = value
    return maps


def test_reference_turns_with_the_radius_and_then_runs_straight_on() -> None:
    for radius_m in (0.5, 1.0, 2.0):
        loop = make_loop(open_map(), radius_m=radius_m)
        reference, length_m = draw_references(
            loop, torch.tensor([[[8.0, 8.0, 0.0]]]), torch.tensor([[[8.0, 13.0]]])
        )
        centre = torch.tensor([8.0, 8.0 + radius_m])
        # of the tangent through the target
        angle = math.pi / 2 + math.asin(radius_m / (5 - radius_m))
        on_arc = torch.arange(len(reference.rows)) * 0.1 < radius_m * angle
        from_centre = torch.linalg.vector_norm(reference.rows[:, :2] - centre, dim=1)
        torch.testing.assert_close(
            from_centre[on_arc], torch.full((int(on_arc.sum()),), radius_m)
        )
        assert length_m.item() == pytest.approx(
            radius_m * angle + math.sqrt((5 - radius_m) ** 2 - radius_m**2), rel=1e-4
        )
        heading = torch.atan2(reference.rows[~on_arc, 3], reference.rows[~on_arc, 2])
        torch.testing.assert_close(
            heading, torch.full_like(heading, angle), rtol=0, atol=1e-4
        )


def test_each_radius_is_its_own_episodes() -> None:
    loop = make_loop(open_map(2))
    radii = torch.tensor([0.5, 1.5])
    several = ClosedLoop(**{**vars(loop), "radius_m": radii})
    pose, target = (
        torch.tensor([[[8.0, 8.0, 0.0]]] * 2),
        torch.tensor([[[8.0, 13.0]]] * 2),
    )
    _, length_m = draw_references(several, pose, target)
    for member, radius_m in enumerate(radii.tolist()):
        _, alone = draw_references(
            make_loop(open_map(), radius_m=radius_m), pose[:1], target[:1]
        )
        assert length_m[member].item() == pytest.approx(alone.item())


def test_edge_is_what_controller_and_robot_do_step_by_step() -> None:
    loop = make_loop(slow_map(0.4))
    edges = edge(loop, (5.0, 7.0, 0.5), (9.0, 9.5))
    reference, length_m = draw_references(
        loop, torch.tensor([[[5.0, 7.0, 0.5]]]), torch.tensor([[[9.0, 9.5]]])
    )
    state = torch.tensor([[[5.0, 7.0, 0.5]]])
    tracking, progress, steps = Tracking.standing(state), torch.zeros(1, 1), 0
    while True:
        progress = loop.follower.advance(reference, state, progress)
        if progress >= length_m:
            break
        before = state
        action, tracking = loop.follower.act(reference, state, tracking, progress)
        state = loop.problem.robot(state, action, loop.problem.traversability_at(state))
        steps += 1
    assert edges.exists.all()
    assert edges.time_s.item() == pytest.approx(steps * 0.1)
    torch.testing.assert_close(edges.at.state, state)
    torch.testing.assert_close(edges.at.tracking.position_m, before[..., :2])
    torch.testing.assert_close(edges.at.tracking.integral, tracking.integral)
    torch.testing.assert_close(edges.at.tracking.error_mps, tracking.error_mps)
    torch.testing.assert_close(edges.end_m, progress)
    torch.testing.assert_close(
        known(edges.drawn[0, 0])[[0, -1]],
        torch.stack((torch.tensor([5.0, 7.0]), state[0, 0, :2])),
    )
    assert edges.blocked_m.item() == 0
    assert edges.at.free.item()


@pytest.mark.parametrize("step_m", [2.0, 4.0])
def test_edge_ends_after_its_greatest_length(step_m: float) -> None:
    edges = edge(
        make_loop(open_map(), step_m=step_m), (2.0, 4.0, 0.0), (12.0, 4.0), (3.0, 4.0)
    )
    torch.testing.assert_close(
        edges.end_m, torch.tensor([[step_m, 1.0]]), rtol=0, atol=0.1
    )


@pytest.mark.parametrize("edge_time_s", [3.0, 6.0])
def test_edge_ends_after_its_greatest_duration(edge_time_s: float) -> None:
    edges = edge(
        make_loop(torch.full_like(open_map(), 0.32), edge_time_s=edge_time_s),
        (2.0, 4.0, 0.0),
        (12.0, 4.0),
    )
    assert edges.time_s.item() == pytest.approx(edge_time_s)
    assert edges.end_m.item() == pytest.approx(0.32 * edge_time_s, abs=0.05)


def test_edge_ends_at_the_goal() -> None:
    edges = edge(make_loop(open_map()), (10.5, 8.0, 0.0), (15.0, 8.0), (10.5, 12.0))
    assert edges.arrived.tolist() == [[True, False]]
    assert edges.at.state[0, 0, 0] == pytest.approx(12.0, abs=0.1)


def test_nearer_half_of_an_edge_that_would_enter_a_wall_stays() -> None:
    edges = edge(make_loop(walled_map()), (5.0, 4.0, 0.0), (9.9, 4.0))
    assert edges.exists.all()
    assert edges.at.free.all()
    assert edges.blocked_m.item() == 0
    # free from 5 m to 8 m
    assert edges.at.state[0, 0, 0] == pytest.approx(6.5, abs=0.1)


def test_edge_that_begins_at_a_wall_is_rejected() -> None:
    edges = edge(make_loop(walled_map()), (7.95, 4.0, 0.0), (9.0, 4.0))
    assert not edges.exists.any()


def test_edge_that_may_cross_goes_on_and_counts_the_metres() -> None:
    edges = edge(make_loop(walled_map(), crossing=True), (7.0, 4.0, 0.0), (11.0, 4.0))
    assert edges.at.state[0, 0, 0] == pytest.approx(11.0, abs=0.1)
    assert edges.blocked_m.item() == pytest.approx(1.0, abs=0.1)
    assert edges.at.free.item()
    # Ground that is not free moves a robot at least as `min_traversability` does.
    assert edges.time_s.item() == pytest.approx(3 / 0.8 + 1 / 0.3, abs=0.3)


def test_edge_that_ends_in_a_wall_is_not_on_free_ground() -> None:
    edges = edge(make_loop(walled_map(), crossing=True), (7.0, 4.0, 0.0), (8.5, 4.0))
    assert not edges.at.free.item()
    assert edges.blocked_m.item() == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("crossing", [False, True])
def test_edge_collides_with_the_border_of_the_map(crossing: bool) -> None:
    edges = edge(
        make_loop(open_map(), crossing=crossing), (13.0, 4.0, 0.0), (17.5, 4.0)
    )
    assert edges.at.state[0, 0, 0] == pytest.approx(14.5, abs=0.1)


def test_each_episode_crosses_or_not_by_itself() -> None:
    loop = make_loop(walled_map().repeat(2, 1, 1))
    loop = ClosedLoop(**{**vars(loop), "crossing": torch.tensor([True, False])})
    state = torch.tensor([[[7.0, 4.0, 0.0]]] * 2)
    begin = LoopState(
        state=state,
        tracking=Tracking.standing(state),
        free=torch.ones(2, 1, dtype=torch.bool),
    )
    reference, length_m = draw_references(
        loop, state, torch.tensor([[[11.0, 4.0]]] * 2)
    )
    end = drive(loop, begin, reference, length_m).at.state[:, 0, 0]
    assert end[0] > 10.5
    assert end[1] < 8


def test_robot_on_ground_that_is_not_free_may_leave_it_but_not_enter_more() -> None:
    maps = walled_map()
    maps[:, :, 22:24] = 0.1  # the next wall, at x = 11 m
    edges = edge(make_loop(maps), (8.5, 4.0, 0.0), (10.0, 4.0), (13.0, 4.0))
    assert edges.exists.all()
    assert edges.at.free.tolist() == [[True, True]]
    assert edges.at.state[0, 0, 0] == pytest.approx(10.0, abs=0.1)
    assert edges.at.state[0, 1, 0] < 11
    torch.testing.assert_close(
        edges.blocked_m, torch.full((1, 2), 0.5), rtol=0, atol=0.1
    )


@pytest.mark.parametrize("crossing", [False, True])
def test_edge_between_two_cells_that_touch_at_a_corner_is_one_through_a_wall(
    crossing: bool,
) -> None:
    maps = open_map()
    rows = torch.arange(32)
    maps[0, rows, 31 - rows] = 0.1
    loop = make_loop(maps, crossing=crossing)
    # Along the diagonal each time step leads from corner to corner, and none ends in
    # the wall.
    edges = edge(loop, (7.0, 7.0, math.pi / 4), (9.0, 9.0), (7.5, 7.5))
    assert edges.exists.all()
    beyond = edges.at.state[0, :, 0] > 8
    assert beyond.tolist() == [crossing, False]
    assert edges.at.free.all()
    expected = [0.08, 0.0] if crossing else [0.0, 0.0]  # one step of 0.8 m/s
    torch.testing.assert_close(
        edges.blocked_m, torch.tensor([expected]), rtol=0, atol=1e-3
    )


def test_edge_round_one_cell_that_is_not_free_passes_its_corner() -> None:
    maps = open_map()
    maps[0, 15, 16] = 0.1
    edges = edge(make_loop(maps), (7.0, 7.0, math.pi / 4), (9.0, 9.0))
    assert edges.at.state[0, 0, 0] == pytest.approx(9.0, abs=0.1)
    assert edges.blocked_m.item() == 0
