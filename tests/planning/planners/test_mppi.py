from dataclasses import replace

import pytest
import torch

from benchnav.planning import mppi
from benchnav.planning.mppi import MPPI, MPPIConfig
from tests import factories

SMALL = MPPIConfig(samples=256, horizon=20)


def test_rollout_cost_equals_a_loop_over_samples() -> None:
    generator = torch.Generator().manual_seed(0)
    problem = factories.problem(torch.rand(2, 16, 16, generator=generator))
    mean = torch.rand(2, 13, 2, generator=generator)
    noise = torch.randn(13, 2, 5, generator=generator)
    cost = mppi.rollout_cost(problem, problem.start, mean, noise)
    for b in range(2):
        for k in range(5):
            x, y, heading = problem.start[b].tolist()
            expected = 0.0
            for t in range(14):
                row, column = int(y // 0.5), int(x // 0.5)
                inside = 0 <= row < 16 and 0 <= column < 16 and x >= 0 and y >= 0
                lam = problem.traversability[b, row, column].item() if inside else 0.0
                gx, gy = problem.goal_m[b].tolist()
                expected += ((x - gx) ** 2 + (y - gy) ** 2) ** 0.5 + (1e4 if lam <= 0.3 else 0)
                if t < 13:
                    v = min(max(mean[b, t, 0].item() + noise[t, 0, k].item(), 0), 1)
                    w = min(max(mean[b, t, 1].item() + noise[t, 1, k].item(), -1), 1)
                    heading_now = torch.tensor(heading)
                    x += 0.1 * lam * v * heading_now.cos().item()
                    y += 0.1 * lam * v * heading_now.sin().item()
                    heading += 0.1 * lam * w
            assert cost[b, k].item() == pytest.approx(expected, rel=1e-4)


def test_the_mean_is_the_softmax_average_of_the_samples() -> None:
    problem = factories.problem(torch.full((1, 16, 16), 0.8))
    planner = MPPI(SMALL)
    first = planner.init(problem, torch.Generator().manual_seed(3))
    action, second, _ = planner.plan(problem.start, first)
    noise = planner._noise(first, problem.start) * 0.5
    cost = mppi.rollout_cost(problem, problem.start, first.mean, noise)[0].double()
    weights = torch.exp(-(cost - cost.min()) / SMALL.temperature)
    samples = noise.clamp(min=torch.tensor([0.0, -1.0])[:, None], max=torch.tensor([1.0, 1.0])[:, None])
    mean = (samples * (weights / weights.sum())).sum(-1)
    torch.testing.assert_close(action[0].double(), mean[0], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(second.mean[0, :-1].double(), mean[1:], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(second.mean[0, -1].double(), mean[-1], atol=1e-5, rtol=1e-4)


def test_compiled_and_eager_rollouts_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    problem = factories.problem(torch.rand(2, 16, 16, generator=generator))
    mean, noise = torch.rand(2, 10, 2, generator=generator), torch.randn(10, 2, 64, generator=generator)
    eager = mppi.rollout_cost(problem, problem.start, mean, noise)
    monkeypatch.setattr(mppi, "worth_compiling", lambda *_: True)
    fused = mppi.rollout_cost(problem, problem.start, mean, noise)
    # A sample that stands within rounding of a cell's edge may read the neighbour.
    close = torch.isclose(fused, eager, rtol=1e-4)
    assert close.float().mean() > 0.95


def test_drawing_changes_no_action() -> None:
    problem = factories.problem(torch.full((2, 16, 16), 0.8))
    actions = []
    for drawn in (0, 7):
        planner = MPPI(replace(SMALL, drawn_samples=drawn))
        action, _, plan = planner.plan(problem.start, planner.init(problem, torch.Generator().manual_seed(3)))
        actions.append(action)
        assert plan.samples.shape[1] == drawn
    torch.testing.assert_close(actions[0], actions[1], atol=0, rtol=0)
    assert plan.path.shape == (2, 21, 2)
