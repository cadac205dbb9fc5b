"""Robots whose sides slip apart, and immobilisation by the observed motion."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.errors import ConfigError
from benchnav.planning.free_space import Immobile
from benchnav.planning.robots import DifferentialDrive, SkidSteer, Unicycle
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.physics.settings import Physics
from benchnav.planning.world.simulation import Simulation
from benchnav.planning.world.tracks import TrackSimulation, create_simulation
from benchnav.planning.world.world import World
from tests import factories

KEY = rng.stream_key(0, "noise")
ROBOT = SkidSteer(track_m=0.6, wheelbase_m=0.4)
FAR = torch.tensor([[90.0, 90.0]])


def simulation(
    field: Tensor, robot: Any = ROBOT, world: World | None = None, **changes: Any
) -> Simulation:
    world = world or World(backend="tracks", noise="stored", **changes)
    return create_simulation(
        factories.terrain(field),
        factories.task(robot=robot),
        world,
        factories.places(FAR.expand(len(field), 2)),
        KEY,
        range(len(field)),
    )


def split_field(left: float, right: float) -> Tensor:
    """A map whose upper half, to the left of a robot that drives along x, differs."""
    field = torch.full((1, 16, 16), right)
    field[:, 8:] = left
    return field


def start_on_the_edge(sim: Simulation, heading: float = 0.0) -> Any:
    resolution_m = sim._grid.resolution_m
    pose = torch.tensor([[4 * resolution_m, 8 * resolution_m, heading]])
    return sim.init(sim.robot.initial_state(pose))


@pytest.mark.parametrize("robot", [ROBOT, SkidSteer(speed_mps=(-1.0, 1.0))])
@pytest.mark.parametrize("action", [(0.8, 0.3), (0.0, 1.0), (1.0, 0.0), (0.5, -1.0)])
def test_on_even_terrain_it_drives_as_the_point_does(
    robot: SkidSteer, action: tuple[float, float]
) -> None:
    field = torch.full((1, 16, 16), 0.4)
    tracks = simulation(field, robot)
    point = simulation(field, robot, World(noise="stored"))
    assert type(tracks) is TrackSimulation
    assert type(point) is Simulation
    pose = torch.tensor([[3.0, 3.0, 0.7]])
    now, then = tracks.init(pose), point.init(pose)
    for _ in range(20):
        now, observed = tracks.step(now, torch.tensor([action]))
        then, _ = point.step(then, torch.tensor([action]))
        torch.testing.assert_close(observed, torch.tensor([0.4]))
    torch.testing.assert_close(now.state, then.state, atol=1e-5, rtol=0)


def test_a_robot_turns_towards_the_side_that_slips() -> None:
    # The exact motion: v = (λ_l + λ_r) u / 2 and ω = (λ_r − λ_l) u / track.
    sim = simulation(split_field(left=0.2, right=0.8))
    now, observed = sim.step(start_on_the_edge(sim), torch.tensor([[1.0, 0.0]]))
    moved = now.state[0] - start_on_the_edge(sim).state[0]
    dt_s = ROBOT.dt_s
    expected = torch.tensor([0.5 * dt_s, 0.0, 0.6 * dt_s / ROBOT.track_m])
    torch.testing.assert_close(moved, expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(observed, torch.tensor([0.5]))


def test_a_turn_in_place_drags_the_robot_towards_the_firm_side() -> None:
    # Left wheels run backwards at λ 0.2, right wheels forwards at λ 0.8.
    sim = simulation(split_field(left=0.2, right=0.8))
    now, observed = sim.step(start_on_the_edge(sim), torch.tensor([[0.0, 1.0]]))
    moved = now.state[0] - start_on_the_edge(sim).state[0]
    wheel_mps = ROBOT.track_m / 2
    expected = torch.tensor([0.3 * wheel_mps * 0.1, 0.0, 0.5 * 0.1])
    torch.testing.assert_close(moved, expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(observed, torch.tensor([0.5]))


def test_wheels_weigh_by_their_motion() -> None:
    # An arc about the left contacts: only the right wheels move.
    sim = simulation(split_field(left=0.2, right=0.8))
    turn_rate = 2 * 0.3 / ROBOT.track_m
    action = torch.tensor([[0.3, turn_rate]])
    _, observed = sim.step(start_on_the_edge(sim), action)
    torch.testing.assert_close(observed, torch.tensor([0.8]))
    _, standing = sim.step(start_on_the_edge(sim), torch.zeros(1, 2))
    torch.testing.assert_close(standing, torch.tensor([0.5]))


def test_a_side_has_the_mean_of_its_contacts() -> None:
    field = torch.full((1, 16, 16), 1.0)
    field[..., 4:] = 0.0  # front contacts on soft terrain
    sim = simulation(field)
    now, observed = sim.step(start_on_the_edge(sim), torch.tensor([[1.0, 0.0]]))
    torch.testing.assert_close(observed, torch.tensor([0.5]))
    moved = now.state[0] - start_on_the_edge(sim).state[0]
    torch.testing.assert_close(moved, torch.tensor([0.05, 0.0, 0.0]), atol=1e-6, rtol=0)


@pytest.mark.parametrize("lag_s", [0.1, 0.3, 2.0])
def test_wheels_follow_with_a_first_order_lag(lag_s: float) -> None:
    sim = simulation(torch.ones(1, 16, 16), lag_s=lag_s)
    now = start_on_the_edge(sim)
    begin = now.state[0, 0].item()
    for step in range(1, 6):
        now, _ = sim.step(now, torch.tensor([[1.0, 0.0]]))
        speed = 1 - math.exp(-step * ROBOT.dt_s / lag_s)
        assert now.velocity[0].tolist() == pytest.approx([speed, 0.0], abs=1e-6)  # type: ignore[attr-defined]
    assert now.state[0, 0].item() - begin < 5 * ROBOT.dt_s


def test_a_batch_is_its_episodes() -> None:
    generator = torch.Generator().manual_seed(0)
    field = torch.rand(3, 16, 16, generator=generator)
    pose = torch.tensor([[2.0, 2.0, 0.1], [3.0, 2.5, 1.0], [4.0, 4.0, -2.0]])
    actions = torch.rand(10, 3, 2, generator=generator)
    sim = simulation(field, lag_s=0.3)
    now = sim.init(pose)
    singles = [simulation(field[[i]], lag_s=0.3) for i in range(3)]
    states = [single.init(pose[[i]]) for i, single in enumerate(singles)]
    for action in actions:
        now, observed = sim.step(now, action)
        for i, single in enumerate(singles):
            states[i], alone = single.step(states[i], action[[i]])
            assert torch.equal(alone, observed[[i]])
    assert torch.equal(now.state, torch.cat([state.state for state in states]))


def test_resampled_lambda_is_that_of_the_cell_under_each_contact() -> None:
    field = torch.rand(1, 16, 16, generator=torch.Generator().manual_seed(2))
    world = World(backend="tracks")
    sim = create_simulation(
        factories.terrain(field, 0.1),
        factories.task(robot=ROBOT),
        world,
        factories.places(FAR),
        KEY,
        [0],
    )
    now = start_on_the_edge(sim, heading=0.4)
    _, observed = sim.step(now, torch.tensor([[1.0, 0.0]]))
    contacts = ROBOT.footprint.contacts(now.state)[0].flatten(0, 1)
    row, column = sim._grid.cell_of(contacts[:, 0], contacts[:, 1])
    expected = sim.field_at(0)[0, row, column].mean()
    torch.testing.assert_close(observed[0], expected)


def drive(sim: Simulation, action: tuple[float, float], steps: int) -> Any:
    now = start_on_the_edge(sim)
    for _ in range(steps):
        now, _ = sim.step(now, torch.tensor([action]))
    return now


@pytest.mark.parametrize("backend", ["kinematic", "tracks"])
@pytest.mark.parametrize(
    ("by", "action", "ends"),
    [
        ("cell", (1.0, 0.0), True),
        ("observed", (1.0, 0.0), True),
        # Standing is no evidence of soft terrain, except for the rule of the cell.
        ("cell", (0.0, 0.0), True),
        ("observed", (0.0, 0.0), False),
        ("observed", (0.04, 0.0), False),
        ("observed", (0.06, 0.0), True),
        ("observed", (0.0, 1.0), True),
    ],
)
def test_who_is_immobilised(
    backend: str, by: str, action: tuple[float, float], ends: bool
) -> None:
    world = World(backend=backend, noise="stored", immobile=Immobile(by=by))
    sim = simulation(torch.full((1, 16, 16), 0.05), world=world)
    before, after = drive(sim, action, 19), drive(sim, action, 20)
    assert before.outcome.tolist() == [Outcome.RUNNING]
    assert (after.outcome.tolist() == [Outcome.IMMOBILISED]) is ends


def test_the_observed_rule_reads_the_contacts_and_the_rule_of_the_cell_the_middle() -> (
    None
):
    # Soft only under the middle: no contact is on it.
    field = torch.full((1, 16, 16), 0.8)
    field[:, 8, 4] = 0.0
    robot = SkidSteer(track_m=1.2, wheelbase_m=1.2)
    ends = {}
    for by in ("cell", "observed"):
        world = World(backend="tracks", noise="stored", immobile=Immobile(by=by))
        sim = simulation(field, robot, world)
        resolution_m = sim._grid.resolution_m
        centre = (4.5 * resolution_m, 8.5 * resolution_m, 0.0)
        now = sim.init(torch.tensor([centre]))
        for _ in range(20):
            now, _ = sim.step(now, torch.tensor([[0.1, 0.0]]))
        ends[by] = now.outcome.tolist() == [Outcome.IMMOBILISED]
    assert ends == {"cell": True, "observed": False}


def test_settings_without_effect_are_refused() -> None:
    with pytest.raises(ConfigError, match="`backend` 'physics' with `physics`, got"):
        World.stakes(backend="tracks", physics=Physics())
    with pytest.raises(ConfigError, match="`noise` 'frozen' and a rule `immobile`"):
        World.paper(clearance_m=0.5)
    with pytest.raises(ConfigError, match="`noise` 'frozen' and a rule `immobile`"):
        World.stakes(clearance_m=0.5, immobile=None)
    assert World.stakes(clearance_m=0.5).clearance_m == 0.5


@pytest.mark.parametrize(
    ("robot", "changes", "message"),
    [
        (Unicycle(), {}, "a robot with a footprint, such as skid_steer"),
        (DifferentialDrive(), {}, "got DifferentialDrive, which is a point"),
        (SkidSteer(track_m=2.5), {}, "a footprint within the goal's disc of 1 m"),
        (SkidSteer(track_m=0.1), {}, "cells of at most twice the track, 0.2 m"),
    ],
)
def test_what_does_not_fit_is_rejected(
    robot: Any, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        simulation(torch.ones(1, 16, 16), robot, **changes)


def test_the_defaults_leave_ids_as_they_are() -> None:
    assert World.stakes().to_dict() == {
        "noise": "frozen",
        "correlation_m": 1.5,
        "immobile": {"below": 0.1, "for_s": 2.0},
        "time_budget_ratio": 3.0,
    }
    changed = World.stakes(
        backend="tracks", lag_s=0.3, clearance_m=0.4, immobile=Immobile(by="observed")
    )
    assert changed.to_dict() == World.stakes().to_dict() | {
        "backend": "tracks",
        "lag_s": 0.3,
        "clearance_m": 0.4,
        "immobile": {"below": 0.1, "for_s": 2.0, "by": "observed"},
    }


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"backend": "magic"}, "`backend` 'kinematic', 'tracks' or 'physics', got"),
        ({"lag_s": 0.3}, "with `backend` 'tracks', got 0.3 with 'kinematic'"),
        ({"backend": "tracks", "lag_s": 0.0}, "`lag_s` > 0 and finite"),
        ({"clearance_m": -1.0}, "`clearance_m` > 0 and finite, got -1.0"),
    ],
)
def test_a_world_says_what_it_cannot_be(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        World(**settings)
