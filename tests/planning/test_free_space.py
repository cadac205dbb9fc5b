from dataclasses import replace

import pytest
import torch
from torch import Tensor

from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.planning.free_space import PENALTY, FreeSpace, Rules, cells_at_goal
from benchnav.planning.objective import GoalDistance
from benchnav.planning.planners.astar.dwa import DWAConfig, score
from benchnav.planning.planners.planner import rollout_path
from benchnav.planning.problem import Prediction, Problem, pose_problem
from tests import factories
from tests.planning.planners.driving import held_paths, rollout_cost


def doubtful(mean: Tensor) -> TraversabilityMixture:
    """Two halves 0.1 above and below the mean, so that any tail is below it."""
    means = torch.stack((mean - 0.1, mean + 0.1), dim=1)
    return TraversabilityMixture(
        torch.full_like(means, 0.5), means, torch.full_like(means, 1e-3)
    )


def test_ground_is_free_where_the_risk_map_or_the_mean_exceeds_the_threshold() -> None:
    mean = torch.full((1, 3, 3), 0.5)
    mean[0, 0, 0], mean[0, 1, 1] = 0.25, 0.35
    mixture = doubtful(mean)
    risk = mixture.cvar(0.9)
    closed = torch.zeros(1, 3, 3, dtype=torch.bool)
    closed[0, 0, 0] = True
    assert torch.equal(~FreeSpace(by="mean").mask(risk, mixture), closed)
    closed[0, 1, 1] = True
    assert torch.equal(~FreeSpace(by="risk").mask(risk, mixture), closed)
    assert torch.equal(
        ~FreeSpace(by="risk", above=0.45).mask(risk, mixture), risk <= 0.45
    )
    assert (risk <= 0.45).all()
    assert FreeSpace(by="mean", above=0.2).mask(risk, mixture).all()
    assert FreeSpace(by="risk", above=0.0).mask(risk, mixture).all()


def test_a_cell_at_the_threshold_is_not_free() -> None:
    risk = torch.tensor([[[0.3, 0.5, 0.0]]], dtype=torch.float64).expand(1, 3, 3)
    assert FreeSpace(above=0.3).mask(risk, factories.certain(risk))[0, 0].tolist() == [
        False,
        True,
        False,
    ]
    nothing = torch.zeros(1, 3, 3)
    assert not FreeSpace(above=0.0).mask(nothing, factories.certain(nothing)).any()


def test_cells_at_goal_are_those_that_the_disc_touches() -> None:
    """Against points all over each cell."""
    grid = Grid(7, 11, 0.5)
    goals = torch.tensor([[2.3, 1.1], [0.05, 3.4], [5.0, 1.75]], dtype=torch.float64)
    share = torch.linspace(0, 1, 41, dtype=torch.float64)
    for radius in (0.1, 0.5, 1.3):
        touched = cells_at_goal(grid, goals, radius)
        for row in range(7):
            for column in range(11):
                x, y = torch.meshgrid(
                    (column + share) * 0.5, (row + share) * 0.5, indexing="xy"
                )
                nearest = torch.hypot(
                    x - goals[:, 0, None, None], y - goals[:, 1, None, None]
                ).amin(dim=(1, 2))
                for member in range(3):
                    # Points are as near as half their spacing to the nearest of all.
                    if abs(nearest[member] - radius) > 0.01:
                        assert bool(touched[member, row, column]) == bool(
                            nearest[member] < radius
                        )


def test_the_goals_disc_is_free_whatever_is_predicted() -> None:
    problem = factories.problem(torch.zeros(1, 16, 16), rules=Rules(goal_radius_m=0.7))
    assert torch.equal(problem.free, cells_at_goal(problem.grid, problem.goal_m, 0.7))
    assert problem.free.sum() > 4
    bigger = factories.problem(torch.zeros(1, 16, 16), rules=Rules(goal_radius_m=2.0))
    assert bigger.free.sum() > problem.free.sum()
    at_goal = torch.tensor([[6.75, 6.75, 0.0]])
    assert problem.free_at(at_goal).all()
    cost = problem.stage_cost(
        at_goal, torch.zeros(1, 2), problem.ground_at(at_goal), problem.goal_m
    )
    assert cost.tolist() == [0.0]


def test_min_traversability_clamps_motion_alone() -> None:
    ground = torch.full((1, 16, 16), 0.8)
    ground[0, 2, 2], ground[0, 2, 3], ground[0, 2, 4] = 0.0, 0.4, 0.05
    rules = Rules(free_space=FreeSpace(above=0.1), min_traversability=0.5)
    problem = factories.problem(ground, rules=rules)
    state = torch.tensor(
        [[[1.25, 1.25, 0.0], [1.75, 1.25, 0.0], [2.25, 1.25, 0.0], [4.0, 4.0, 0.0]]]
    )
    assert problem.traversability_at(state)[0].tolist() == pytest.approx(
        [0.5, 0.5, 0.5, 0.8]
    )
    assert problem.free_at(state)[0].tolist() == [False, True, False, True]
    assert torch.equal(problem.risk_map, ground)
    assert problem.traversability.min() == 0.5


def test_ground_that_is_not_free_costs_its_penalty_a_step_beside_j() -> None:
    ground = torch.full((2, 16, 16), 0.8)
    ground[:, 2] = 0.1
    problem = factories.problem(ground, goal=(1.25, 5.25))
    state = torch.tensor(
        [[[1.25, 1.25, 0.0], [1.25, 2.25, 0.0], [-1.0, 2.25, 0.0]]]
    ).expand(2, 3, 3)
    action, target = torch.zeros(2, 3, 2), problem.goal_m[:, None]
    distances = torch.tensor([4.0, 3.0, (2.25**2 + 9) ** 0.5])
    expected = distances + PENALTY * torch.tensor([1.0, 0.0, 1.0])
    cost = problem.stage_cost(state, action, problem.ground_at(state), target)
    torch.testing.assert_close(cost, expected.expand(2, 3))
    torch.testing.assert_close(
        problem.terminal_cost(state, target), expected.expand(2, 3)
    )


def test_a_users_objective_is_given_the_risk_map_and_the_penalty_is_added_to_it() -> (
    None
):
    class Ground(GoalDistance):
        def stage(self, state, action, traversability, target):  # type: ignore[no-untyped-def]
            return traversability

        def terminal(self, state, traversability, target):  # type: ignore[no-untyped-def]
            return 2 * traversability

    ground = torch.full((1, 16, 16), 0.8)
    ground[0, 2], ground[0, 3] = 0.1, 0.0
    problem = factories.problem(
        ground, objective=Ground(), rules=Rules(min_traversability=0.2)
    )
    # On bad ground, on ground of λ̂ = 0, on good ground, off the map.
    state = torch.tensor(
        [[[1.25, 1.25, 0.0], [1.25, 1.75, 0.0], [1.25, 2.25, 0.0], [-1.0, 2.25, 0.0]]]
    )
    stage = problem.stage_cost(
        state, torch.zeros(1, 4, 2), problem.ground_at(state), problem.goal_m[:, None]
    )
    low = float(torch.tensor(PENALTY) + 0.1)
    assert stage[0].tolist() == [low, PENALTY, pytest.approx(0.8), PENALTY]
    terminal = problem.terminal_cost(state, problem.goal_m[:, None])[0].tolist()
    assert terminal == [
        float(torch.tensor(PENALTY) + 0.2),
        PENALTY,
        pytest.approx(1.6),
        PENALTY,
    ]


class DreadsLowGround(GoalDistance):
    """Costs 50 a step where λ̂ < 0.2, which the least λ̂ of motion, 0.3, would hide."""

    def stage(self, state, action, traversability, target):  # type: ignore[no-untyped-def]
        return super().stage(state, action, traversability, target) + 50 * (
            traversability < 0.2
        )


def low_field(objective: GoalDistance) -> Problem:
    """A field of λ̂ = 0.1 that is free by the mean, so that no penalty adds to J; the
    robot stands in it.
    """
    ground = torch.full((1, 16, 16), 0.9)
    ground[0, 1:4, 1:4] = 0.1
    problem = factories.problem(ground, objective=objective)
    return replace(problem, free=torch.ones(1, 16, 16, dtype=torch.bool))


def steps_on_low_ground(problem: Problem, paths: Tensor, steps: int) -> Tensor:
    """Of positions [1, K, T + 1, 2], how many of the first T lie on low ground, shape
    [1, K].
    """
    ground = problem.grid.lookup(
        problem.grid.pad(problem.risk_map, 0.0), paths[..., 0], paths[..., 1]
    )
    return (ground[..., :steps] < 0.2).sum(-1)


def test_dwa_minimises_a_cost_of_ground_below_the_least_traversability_of_motion() -> (
    None
):
    config = DWAConfig(heading_weight=0.0)  # the heading's weight is a share of J
    plain, dread = low_field(GoalDistance()), low_field(DreadsLowGround())
    pairs = torch.tensor([[[0.0, 0.0], [0.5, 0.0], [1.0, 0.0], [1.0, 0.4]]])
    paths = held_paths(plain, plain.start, pairs, 50)
    extra = score(dread, dread.start, pairs, dread.goal_m, config) - score(
        plain, plain.start, pairs, plain.goal_m, config
    )
    low = steps_on_low_ground(plain, paths, 50)
    assert extra[0].tolist() == pytest.approx((50 * low[0]).tolist(), rel=1e-5)
    # one that stands pays at each step, one that drives until it is out
    assert low[0, 0] == 50 > low[0, 2] > 0


def test_mppi_minimises_a_cost_of_ground_below_the_least_traversability_of_motion() -> (
    None
):
    plain, dread = low_field(GoalDistance()), low_field(DreadsLowGround())
    mean = torch.tensor([0.8, 0.0]).expand(1, 80, 2)
    noise = 0.3 * torch.randn(80, 2, 20, generator=torch.Generator().manual_seed(0))
    costs = [rollout_cost(p, p.start, mean, noise, p.goal_m) for p in (plain, dread)]
    low, high = plain.action_bounds
    actions = (mean[..., None] + noise).clamp(low[:, None], high[:, None])
    steps = steps_on_low_ground(plain, rollout_path(plain, plain.start, actions), 80)
    assert (costs[1] - costs[0])[0].tolist() == pytest.approx(
        (50 * steps[0]).tolist(), rel=1e-4
    )
    assert 0 < steps.min() < steps.max()


def test_ground_that_is_free_by_the_mean_is_free_where_the_risk_map_is_0() -> None:
    problem = replace(
        factories.problem(torch.zeros(1, 16, 16)),
        free=torch.ones(1, 16, 16, dtype=torch.bool),
    )
    assert problem.free_at(problem.start).all()
    assert problem.traversability_at(problem.start).tolist() == pytest.approx([0.3])


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"by": "noise"}, "'risk' or 'mean', got 'noise'"),
        ({"above": 1.0}, "free_space.above"),
        ({"above": -0.1}, "free_space.above"),
        ({"above": float("nan")}, "free_space.above"),
    ],
)
def test_free_space_that_means_nothing_is_refused(
    settings: dict[str, object], expected: str
) -> None:
    with pytest.raises(ConfigError, match=expected):
        FreeSpace(**settings)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"min_traversability": 0.0}, "min_traversability"),
        ({"min_traversability": 1.1}, "min_traversability"),
        ({"goal_radius_m": 0.0}, "goal_radius_m"),
        ({"goal_radius_m": float("inf")}, "goal_radius_m"),
        (
            {"unseen": "hopeful"},
            "'prior', 'optimistic' or 'pessimistic', got 'hopeful'",
        ),
        ({"replan_every_s": 0.0}, "replan_every_s"),
        ({"replan_every_s": float("inf")}, "replan_every_s"),
        ({"replan_every_s": float("nan")}, "replan_every_s"),
    ],
)
def test_rules_under_which_nothing_moves_or_arrives_are_refused(
    settings: dict[str, object], expected: str
) -> None:
    with pytest.raises(ConfigError, match=expected):
        Rules(**settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("unseen", ["prior", "optimistic", "pessimistic"])
def test_ground_that_was_not_seen_is_closed_by_no_pessimism(unseen: str) -> None:
    ground = torch.full((1, 4, 4), 0.2)
    ground[0, 0] = 0.8
    seen = torch.zeros(1, 4, 4, dtype=torch.bool)
    seen[0, :, :2] = True
    rules = Rules(unseen=unseen)
    free, certain = ground > 0.3, factories.certain(ground)
    assert torch.equal(rules.free(ground, certain), free)
    wanted = free | ~seen if unseen == "pessimistic" else free
    assert torch.equal(rules.free(ground, certain, seen), wanted)
    task = replace(factories.task(rules=rules))
    posed = factories.problem(ground)
    places = posed.start[:, :2], torch.tensor([[50.0, 50.0]])
    problem = pose_problem(
        task, Prediction(posed.observation, certain, ground, wanted), *places, 9.0
    )
    assert torch.equal(problem.free, wanted)


def test_rules_say_what_came_with_later_versions_where_it_is_no_default() -> None:
    paper = {
        "free_space": {"by": "risk", "above": 0.3},
        "min_traversability": 0.3,
        "goal_radius_m": 1.0,
    }
    assert Rules().to_dict() == paper
    assert Rules(unseen="optimistic").to_dict() == paper | {"unseen": "optimistic"}
    assert Rules(replan_every_s=2.0).to_dict() == paper | {"replan_every_s": 2.0}
    assert Rules(goal_radius_m=2.0).to_dict() == paper | {"goal_radius_m": 2.0}
