import math

import numpy as np
import pytest
import torch

from studies.validation.ground import DIRT, VEGETATION
from studies.validation.task import Setup, pose
from studies.validation.world import draw_vegetation
from tests.planning.planners.driving import rollout_cost

VEGETATED = draw_vegetation(0, np.arange(2), 0.4)


@pytest.mark.parametrize(
    ("setting", "tail"), [("mean", 1.0), ("cvar:0.4", 0.6), ("cvar:0.8", 0.2)]
)
def test_risk_maps_are_the_tail_means_of_the_ground(setting: str, tail: float) -> None:
    cells = round(100 * tail)
    expected = np.where(
        VEGETATED, VEGETATION.slices()[:cells].mean(), DIRT.slices()[:cells].mean()
    )
    np.testing.assert_allclose(
        pose(VEGETATED, [setting], Setup()).risk_map, expected, atol=1e-5
    )


def cost_of(actions: np.ndarray, risk_map: np.ndarray, power: int) -> float:
    """Their cost of a rollout, written down from its description: steps are counted
    after the move.
    """
    x, y, heading = 0.5, 0.5, math.pi / 4
    cost = 0.0
    for speed, turn_rate in actions:
        traversability = risk_map[math.floor(y), math.floor(x)]
        x, y = (
            x + 0.1 * traversability * speed * math.cos(heading),
            y + 0.1 * traversability * speed * math.sin(heading),
        )
        heading += 0.1 * traversability * turn_rate
        away = math.hypot(8.5 - x, 8.5 - y)
        cost += 0.1 + away**power
        if away <= 0.5:
            return cost
    return cost + away / (0.01 + 1e-6)


@pytest.mark.parametrize("power", [1, 2])
def test_costs_of_rollouts_are_theirs(power: int) -> None:
    problem = pose(VEGETATED[:1], ["mean"], Setup(distance_power=power))
    noise = np.random.default_rng(0)
    actions = np.stack(
        (noise.uniform(1.5, 3, (100, 6)), noise.normal(0, 0.02, (100, 6))), axis=1
    )
    actions[:, 0, 3:] /= 5  # these never arrive
    costs = rollout_cost(
        problem,
        problem.start,
        torch.zeros(1, 100, 2),
        torch.from_numpy(actions).float(),
        problem.goal_m,
    )[0]
    expected = [
        cost_of(actions[..., k], problem.risk_map[0].numpy(), power) for k in range(6)
    ]
    assert 2 * max(expected[:3]) < min(expected[3:])
    start = 0.1 + math.hypot(8, 8) ** power  # counted by us alone, of every rollout
    np.testing.assert_allclose(costs.numpy() - start, expected, rtol=2e-4)


def test_histograms_give_their_fields() -> None:
    fields = pose(
        VEGETATED, ["cost", "mean"], Setup(risk_map="histogram")
    ).sample_fields(2000, 0)
    assert fields.shape == (4, 2000, 9, 9)
    expected = np.where(
        VEGETATED, VEGETATION.histogram_atoms().mean(), DIRT.histogram_atoms().mean()
    )
    np.testing.assert_allclose(fields[::2].mean(1), expected, atol=0.04)
    np.testing.assert_allclose(fields[1::2].mean(1), expected, atol=0.04)
    np.testing.assert_array_equal(np.unique((100 * fields[0]).round() % 5), [0, 2])


def test_fields_have_the_distribution_of_each_cell_and_cells_are_independent() -> None:
    problem = pose(VEGETATED[:1], ["cost", "cost-cvar:0.6"], Setup(), [7])
    drawn = problem.sample_fields(4000, 3)
    assert torch.equal(drawn[0], drawn[1])
    mean = problem.distribution.mean()[0]
    assert float((drawn[0].mean(0) - mean).abs().max()) < 0.03
    cells = drawn[0].flatten(1)[:, :6]
    assert float((torch.corrcoef(cells.T) - torch.eye(6)).abs().max()) < 0.06
    assert torch.equal(
        drawn, pose(VEGETATED, ["cost"], Setup(), [7, 8]).sample_fields(4000, 3)[[0, 0]]
    )
    assert not torch.equal(
        drawn,
        pose(VEGETATED[:1], ["cost"], Setup(), [8]).sample_fields(4000, 3)[[0, 0]],
    )
