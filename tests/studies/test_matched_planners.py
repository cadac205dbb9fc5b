"""Smooth MPPI and iCEM, which are compared with MPPI: they keep to the contract, and
sample as their sources say.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchnav.core import rng
from benchnav.planning import MPPI, MPPIConfig, Planner, Problem, Step
from benchnav.planning.free_space import PENALTY
from benchnav.testing import check_planner
from studies.matched.planners import (
    ICEM,
    ICEMConfig,
    SmoothConfig,
    SmoothMPPI,
    coloured_noise,
)
from tests import factories


def open_ground() -> Problem:
    return factories.problem(torch.full((2, 16, 16), 0.8))


def first_step(problem: Problem) -> Step:
    return Step(
        state=problem.start,
        traversability=torch.full((len(problem),), torch.nan),
        time_s=0.0,
    )


@pytest.mark.parametrize(
    "planner",
    [
        SmoothMPPI(SmoothConfig(samples=64, horizon_s=1.0)),
        ICEM(ICEMConfig(samples=64, horizon_s=1.0)),
        ICEM(ICEMConfig(samples=64, horizon_s=1.0, cost_to_go="map")),
    ],
    ids=["smooth", "icem", "icem to go"],
)
def test_they_keep_to_the_contract(planner: Planner) -> None:
    check_planner(planner, ["unicycle"])


def test_samples_of_smooth_mppi_are_sums_of_changes() -> None:
    problem, options = (
        open_ground(),
        {"samples": 200, "horizon_s": 1.0, "noise_share": 0.02},
    )
    plain, smooth = (
        planner.init(problem, rng.generator(0)).noise.at(3)
        for planner in (
            MPPI(MPPIConfig(**options)),
            SmoothMPPI(SmoothConfig(**options)),
        )
    )
    torch.testing.assert_close(smooth, plain.cumsum(0))


def test_changes_are_shares_of_an_actions_range() -> None:
    problem = open_ground()
    low, high = problem.action_bounds
    assert high[0] - low[0] != high[1] - low[1]
    costs = []
    for smoothness in (0.0, 3.0):
        planner = SmoothMPPI(
            SmoothConfig(samples=50, horizon_s=1.0, smoothness=smoothness)
        )
        state = planner.init(problem, rng.generator(0))
        weigh = planner._weigh
        planner._weigh = lambda states, cost, *rest, weigh=weigh: (
            costs.append(cost),
            weigh(states, cost, *rest),
        )[1]  # type: ignore[assignment]
        planner.plan_toward(first_step(problem), state, problem.goal_m)
    actions = (state.mean[..., None] + state.noise.at(0)).clamp(
        low[:, None], high[:, None]
    )
    shares = (actions - low[:, None]) / (high - low)[:, None]
    torch.testing.assert_close(
        costs[1] - costs[0],
        3 * (shares[:, 1:] - shares[:, :-1]).square().sum((1, 2)),
        rtol=1e-3,
        atol=1e-3,
    )


@pytest.mark.parametrize("colour", [0.0, 1.0, 2.0])
def test_the_spectrum_of_coloured_noise_falls_as_it_is_told(colour: float) -> None:
    noise = coloured_noise(64, (2, 4000), colour, torch.Generator().manual_seed(0))
    assert noise.shape == (64, 2, 4000)
    np.testing.assert_allclose(noise.square().mean((0, 2)), 1, atol=0.01)
    power = torch.fft.rfft(noise[:, 0], dim=0).abs().square().mean(1)[2:32]
    slope = np.polyfit(np.log(np.arange(2, 32)), np.log(power), 1)[0]
    assert slope == pytest.approx(-colour, abs=0.05)


def test_icem_fits_its_distribution_to_its_elites_as_its_algorithm_says() -> None:
    """Two iterations, written out: fewer samples in the second, which tries the elites
    and the mean again.
    """
    problem = open_ground()
    config = ICEMConfig(
        samples=40,
        horizon_s=0.5,
        iterations=2,
        elites=10,
        kept=0.2,
        decay=2.0,
        momentum=0.2,
    )
    planner = ICEM(config)
    state = planner.init(problem, rng.generator(0))
    state = replace(state, step=3, mean=state.mean + 0.1, elites=state.elites + 0.2)
    low, high = (bound[:, None] for bound in problem.action_bounds)
    mean, spread, tried = (
        state.mean,
        config.noise_share * (high - low)[:, 0].expand_as(state.mean),
        state.elites,
    )
    for iteration, count in enumerate((40, 20)):
        noise = state.coloured.take(rng.stream_key(state.key, 3, iteration), count)
        sampled = (mean[..., None] + spread[..., None] * noise).clamp(low, high)
        sequences = torch.cat(
            (sampled, tried, *([mean[..., None]] if iteration else [])), 3
        )
        order = planner._cost(
            problem, problem.start, sequences, problem.goal_m, None
        ).argsort(1)[:, :10]
        best = torch.stack(
            [sequences[episode][..., order[episode]] for episode in range(len(problem))]
        )
        mean, spread = 0.2 * mean + 0.8 * best.mean(3), 0.2 * spread + 0.8 * best.std(3)
        tried = best[..., :2]
    action, after, _ = planner.plan_toward(first_step(problem), state, problem.goal_m)
    torch.testing.assert_close(action, best[:, 0, :, 0])
    torch.testing.assert_close(after.mean[:, :-1], mean[:, 1:])
    torch.testing.assert_close(after.elites[:, :-1], tried[:, 1:])


def test_icem_pays_for_a_last_state_on_ground_that_is_not_free() -> None:
    ground = torch.full((1, 16, 16), 0.8)
    ground[:, :, 8:] = 0.0
    problem = factories.problem(ground)
    planner = ICEM(ICEMConfig(samples=8, horizon_s=0.2, cost_to_go="map"))
    to_go = planner.init(problem, rng.generator(0)).cost_to_go
    assert to_go is not None
    edge = 8 * problem.grid.resolution_m
    costs = [
        float(
            planner._cost(
                problem, torch.tensor([[edge - before, 4.0, 0.0]]), torch.tensor([[[[1.0], [0.0]]]]),
                problem.goal_m, torch.zeros_like(to_go),
            )
        )
        for before in (0.01, 0.3)
    ]  # fmt: skip
    assert costs[0] - costs[1] == pytest.approx(PENALTY, rel=0.01)
