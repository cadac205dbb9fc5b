import math
from dataclasses import fields, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.quantiles import QuantileDistribution
from benchnav.core.terrain import Observation
from benchnav.planning.free_space import FreeSpace, Rules, cells_at_goal
from benchnav.planning.problem import Prediction, Problem, heading_to, pose_problem
from benchnav.planning.robots import DifferentialDrive, Unicycle
from benchnav.planning.sensing.belief import Belief, CovarianceModel, Fields, Static
from benchnav.planning.sensing.copula import Copula
from benchnav.planning.sensing.sensor import Measurement
from tests import factories
from tests.core.distributions import quantiles

BATCH, HEIGHT, WIDTH = 3, 12, 20


def varied() -> Problem:
    """Three problems of which no two tensors or episodes are alike, on a map that is
    not square.
    """
    grid = Grid(HEIGHT, WIDTH, 0.5)
    means = torch.rand(BATCH, 2, HEIGHT, WIDTH)
    mixture = TraversabilityMixture(
        torch.full_like(means, 0.5), means, 0.1 + 0.1 * means
    )
    rgb = torch.randint(255, (BATCH, 3, HEIGHT, WIDTH), dtype=torch.uint8)
    observation = Observation(
        rgb, torch.rand(BATCH, HEIGHT, WIDTH), torch.rand(BATCH, HEIGHT, WIDTH), grid
    )
    start_m, goal_m = (
        torch.tensor([[1.0, 2.0], [3.0, 1.5], [6.0, 5.0]]),
        torch.tensor([[9.0, 2.0], [3.0, 5.5], [1.0, 0.5]]),
    )
    task = factories.task(robot=DifferentialDrive())
    return pose_problem(
        task, Prediction(observation, mixture, mixture.cvar(0.5)), start_m, goal_m, 42.0
    )


def tensors(problem: Problem) -> dict[str, Tensor]:
    """Every tensor of a problem, those that are derived from it included."""
    derived = {
        name: getattr(problem, name)
        for name in ("traversability", "padded_ground", "elevation_m")
    }
    held = {
        f"{owner}{field.name}": getattr(value, field.name)
        for owner, value in (
            ("", problem),
            ("distribution.", problem.distribution),
            ("observation.", problem.observation),
        )
        for field in fields(value)  # type: ignore[arg-type]
    }
    return {
        name: value
        for name, value in {**held, **derived}.items()
        if torch.is_tensor(value)
    }


def test_a_problem_is_posed_from_what_is_predicted() -> None:
    problem = varied()
    assert len(problem) == BATCH
    assert problem.grid == Grid(HEIGHT, WIDTH, 0.5)
    assert problem.start[:, :2].tolist() == [[1.0, 2.0], [3.0, 1.5], [6.0, 5.0]]
    expected = [0.0, math.pi / 2, math.atan2(-4.5, -5.0)]
    assert problem.start[:, 2].tolist() == pytest.approx(expected)
    # The robot says what stands beside the pose.
    assert problem.start[:, 3:].tolist() == [[0.0, 0.0]] * 3
    assert problem.time_budget_s.tolist() == [42.0] * BATCH
    assert torch.equal(problem.risk_map, problem.distribution.cvar(0.5))
    assert problem.dt_s == 0.1
    assert torch.equal(problem.elevation_m, problem.observation.elevation_m)
    low, high = problem.action_bounds
    assert low.tolist() == [0, -1]
    assert high.tolist() == [1, 1]
    assert problem.action_bounds[0] is low


def test_headings_look_at_the_goal() -> None:
    here = torch.tensor([[1.0, 1.0]] * 4)
    there = torch.tensor([[2.0, 2.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
    expected = [math.pi / 4, math.pi, -math.pi / 2, 0.0]
    assert heading_to(here, there)[:, 2].tolist() == pytest.approx(expected)
    assert torch.equal(heading_to(here, there)[:, :2], here)


def test_no_truth_is_in_it() -> None:
    assert {field.name for field in fields(Problem)} == {
        "task", "observation", "distribution", "risk_map", "free", "start", "goal_m", "time_budget_s",
        "fields", "immobile",
    }  # fmt: skip
    assert not any("class_id" in name or "truth" in name for name in tensors(varied()))


def test_ground_is_looked_up_by_row_and_column_of_each_episodes_own_map() -> None:
    problem = varied()
    x = torch.rand(BATCH, 50) * 10
    y = torch.rand(BATCH, 50) * 6
    state = torch.stack((x, y, torch.zeros_like(x)), dim=-1)
    found, free = problem.traversability_at(state), problem.free_at(state)
    for member in range(BATCH):
        for point in range(50):
            cell = int(y[member, point] / 0.5), int(x[member, point] / 0.5)
            assert found[member, point] == problem.risk_map[member][cell].clamp(min=0.3)
            assert bool(free[member, point]) == bool(problem.free[member][cell])
    assert torch.equal(problem.traversability_at(state[:, 7]), found[:, 7])


def test_off_the_map_nothing_moves_and_nothing_is_free() -> None:
    problem = factories.problem(torch.ones(1, 16, 16))
    state = torch.tensor(
        [
            [
                [-0.1, 1.0],
                [8.0, 1.0],
                [1.0, 8.1],
                [1.0, -5.0],
                [math.nan, 1.0],
                [math.inf, 1.0],
            ]
        ]
    )
    assert problem.traversability_at(state).tolist() == [[0.0] * 6]
    assert not problem.free_at(state).any()
    assert (problem.terminal_cost(state[:, :4], problem.goal_m[:, None]) > 9999).all()


def test_select_keeps_episodes_with_everything_that_is_theirs() -> None:
    problem = varied()
    chosen = problem.select(torch.tensor([2, 0]))
    assert len(chosen) == 2
    assert chosen.task is problem.task
    for name, value in tensors(chosen).items():
        assert torch.equal(value, tensors(problem)[name][[2, 0]]), name


def test_a_clone_shares_no_tensor() -> None:
    problem = varied()
    before = {name: value.clone() for name, value in tensors(problem).items()}
    clone = problem.clone()
    assert all(
        torch.equal(value, before[name]) for name, value in tensors(clone).items()
    )
    for value in tensors(clone).values():
        value.zero_()
    for bound in clone.action_bounds:
        bound.zero_()
    for name, value in tensors(problem).items():
        assert torch.equal(value, before[name]), name
    assert problem.action_bounds[1].tolist() == [1, 1]


def test_to_a_device_moves_every_tensor() -> None:
    moved = varied().to("meta")
    assert {value.device.type for value in tensors(moved).values()} == {"meta"}
    assert {bound.device.type for bound in moved.action_bounds} == {"meta"}


@pytest.mark.parametrize("name", ["risk_map", "free", "goal_m"])
def test_a_batch_that_is_none_is_refused(name: str) -> None:
    problem = varied()
    with pytest.raises(ConfigError, match=f"`{name}` of shape"):
        replace(problem, **{name: getattr(problem, name)[:2]})


def test_doubles_stay_doubles() -> None:
    ground = torch.rand(1, 16, 16, dtype=torch.float64)
    problem = factories.problem(ground, robot=Unicycle())
    problem = replace(
        problem, start=problem.start.double(), goal_m=problem.goal_m.double()
    )
    cost = problem.stage_cost(
        problem.start,
        problem.start[:, :2],
        problem.ground_at(problem.start),
        problem.goal_m,
    )
    assert (
        cost.dtype
        == problem.action_bounds[0].dtype
        == problem.padded_ground.dtype
        == torch.float64
    )


def test_any_distribution_is_posed_and_taken_apart_with_the_batch() -> None:
    made, law = varied(), quantiles(maps=BATCH)
    law = QuantileDistribution(
        law.values[..., :1, :1].expand(-1, -1, HEIGHT, WIDTH).float().contiguous()
    )
    task = replace(made.task, rules=Rules(free_space=FreeSpace(by="mean", above=0.3)))
    prediction = Prediction(made.observation, law, law.cvar(0.9))
    problem = pose_problem(task, prediction, made.start[:, :2], made.goal_m, 42.0)
    away = ~cells_at_goal(problem.grid, problem.goal_m, problem.goal_radius_m)
    assert torch.equal(problem.free[away], (law.mean() > 0.3)[away])
    kept = problem.clone().select(torch.tensor([2]))
    assert torch.equal(kept.distribution.cdf(0.4), law.cdf(0.4)[2:])
    with pytest.raises(ConfigError, match="`distribution` of shape"):
        replace(problem, distribution=law.select(torch.tensor([0])))


def drawing(
    belief: Belief[Any], sensed: Tensor | None = None, correlation_m: float = 1.5
) -> Problem:
    """Three problems whose fields are drawn from a belief, which was told some λ, [B,
    H, W].
    """
    problem = varied()
    covariance = CovarianceModel(grid=problem.grid, correlation_m=correlation_m)
    state = belief.init(problem.distribution, covariance)
    if sensed is not None:
        state = belief.update(
            state, Measurement(traversability=sensed, std=torch.full_like(sensed, 0.01))
        )
    return replace(problem, fields=Fields(belief, state, (7, 3, 11)))


@pytest.mark.parametrize("correlated", [True, False])
def test_fields_have_the_prediction_and_hang_together_as_the_belief_says(
    correlated: bool,
) -> None:
    torch.manual_seed(0)
    problem = drawing(Static(correlated))
    drawn = problem.sample_fields(600, 5)
    assert drawn.shape == (BATCH, 600, HEIGHT, WIDTH)
    assert drawn.dtype == problem.risk_map.dtype
    assert float(drawn.min()) >= 0
    assert float(drawn.max()) <= 1
    # Neighbouring cells are of one episode and hang together; E[λ] is within 4 standard
    # errors in nearly all.
    off = (drawn.mean(1) - problem.distribution.mean()).abs() * 600**0.5 / drawn.std(1)
    assert float((off < 4).double().mean()) > 0.99
    ranks = drawn.argsort(1).argsort(1).double()
    ranks = (ranks - ranks.mean(1, keepdim=True)) / ranks.std(1, keepdim=True)
    beside = (ranks[..., 1:] * ranks[..., :-1]).mean()
    expected = 6 / math.pi * math.asin(math.exp(-1 / 18) / 2) if correlated else 0.0
    assert float(beside) == pytest.approx(expected, abs=0.03)
    again = problem.sample_fields(600, 5)
    assert torch.equal(drawn, again)
    assert not torch.equal(problem.sample_fields(600, 6), drawn)


@pytest.mark.parametrize("belief", [Static(), Copula()])
def test_an_episodes_fields_depend_on_no_other(belief: Belief[Any]) -> None:
    sensed = torch.full((BATCH, HEIGHT, WIDTH), torch.nan)
    sensed[:, 4, 5] = torch.tensor([0.3, 0.5, 0.7])
    problem = drawing(belief, sensed)
    whole = problem.sample_fields(3, 5)
    kept = problem.select(torch.tensor([2, 0])).sample_fields(3, 5)
    torch.testing.assert_close(kept, whole[[2, 0]])
    assert (whole[0] - whole[1]).abs().max() > 0.1


def test_fields_are_those_that_what_was_sensed_allows() -> None:
    torch.manual_seed(0)
    sensed = torch.full((BATCH, HEIGHT, WIDTH), torch.nan)
    value = varied().distribution.quantile(0.25)[:, 4, 5]
    torch.manual_seed(0)
    sensed[:, 4, 5] = value
    drawn = drawing(Copula(), sensed).sample_fields(200, 5)
    assert (drawn[:, :, 4, 5] - value[:, None]).abs().max() < 0.05
    torch.manual_seed(0)
    before = drawing(Copula()).sample_fields(200, 5)
    # A cell beside it is as much worse ground as the correlation has it; one far away
    # is what it was.
    torch.manual_seed(0)
    distribution = varied().distribution
    rank = torch.stack([distribution.cdf(own) for own in drawn.unbind(1)], 1)
    score = -0.6745 * math.exp(-1 / 18)
    spread = math.sqrt(1 - math.exp(-1 / 9))
    beside = torch.special.ndtri(rank[:, :, 4, 6].double().clamp(1e-6, 1 - 1e-6))
    assert beside.mean(1).tolist() == pytest.approx(
        [score] * BATCH, abs=4 * spread / 200**0.5 + 0.02
    )
    torch.testing.assert_close(drawn[..., 19], before[..., 19], atol=0.02, rtol=0)


def test_a_problem_that_nobody_gave_fields_has_none_to_draw() -> None:
    with pytest.raises(ConfigError, match="with `fields` to draw from, got None"):
        varied().sample_fields(1, 0)
    kept = varied().select(torch.tensor([1]))
    assert kept.fields is None
