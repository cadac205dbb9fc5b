import numpy as np
import pytest
import torch

from benchnav.eval.metrics import episode_table, step_table
from benchnav.eval.rollout import Episodes
from benchnav.eval.suite import Unit
from benchnav.planning.simulation import Outcome
from tests import factories

UNIT = Unit(planner="mppi", risk="cvar", scenario="std", instances=(4, 9))


def made() -> tuple:  # type: ignore[type-arg]
    problem = factories.problem(torch.full((2, 16, 16), 0.8))
    states = torch.zeros(2, 5, 3)
    states[0, :, 0] = torch.tensor([0.0, 3.0, 3.0, 3.0, 3.0])
    states[0, 2:, 1] = 4.0
    episodes = Episodes(
        states=states,
        actions=torch.tensor([[[1.0, 0.0], [1.0, 0.5], [9, 9], [9, 9]], [[0.0, 0.0]] * 4]),
        traversability=torch.tensor([[0.2, 0.8, 9, 9], [0.3, 0.1, 0.31, 0.5]]),
        outcome=torch.tensor([Outcome.SUCCESS, Outcome.STUCK]),
        steps=torch.tensor([2, 4]),
        planning_s=1.0,
    )
    return problem, episodes


def test_metrics_are_those_of_the_episodes_own_steps() -> None:
    problem, episodes = made()
    table = episode_table(UNIT, problem, episodes, np.array([0.1, 20.0]))
    first, second = table.to_dict("records")
    assert (first["instance"], first["outcome"], first["success"]) == (4, "success", True)
    assert first["total_time_s"] == pytest.approx(0.2)
    assert first["time_ratio"] == pytest.approx(2.0)
    assert first["traversability"] == pytest.approx(0.5)
    assert first["path_length_m"] == pytest.approx(7.0)
    assert first["stuck_share"] == pytest.approx(0.5)
    assert first["roughness"] == pytest.approx(0.5)
    assert (second["instance"], second["outcome"], second["success"]) == (9, "stuck", False)
    assert second["total_time_s"] == 100.0
    assert second["end_time_s"] == pytest.approx(0.4)
    assert np.isnan(second["time_ratio"])
    assert second["stuck_share"] == pytest.approx(0.5)


def test_step_table_holds_the_driven_path() -> None:
    problem, episodes = made()
    table = step_table(UNIT, problem, episodes)
    assert len(table) == 3 + 5
    first = table[table["instance"] == 4]
    assert first["x_m"].tolist() == [0, 3, 3]
    assert first["y_m"].tolist() == [0, 0, 4]
    assert first["speed_mps"].tolist()[:2] == [1, 1]
    assert np.isnan(first["traversability"].iloc[-1])
