"""What the scripts on planners compute from problems and rows."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import pytest
import torch
from torch import Tensor

from benchnav.planning import TravelTime, Unicycle
from studies.matched.figure import matched_figure
from studies.planners import optimal, optimism
from tests import factories


@dataclass(frozen=True)
class Told:
    """Fields of one λ for the planner, and of another where as many are asked for as
    fresh ones.
    """

    own: float
    fresh: float

    def sample(self, count: int, key: int, cells: Tensor | None = None) -> Tensor:
        return torch.full(
            (2, count, 16, 24), self.fresh if count == optimism.AT_ONCE else self.own
        )

    def select(self, members: Tensor) -> "Told":
        return self


@pytest.mark.parametrize(("fresh", "sign"), [(0.9, 0), (0.5, 1), (1.0, -1)])
def test_optimism_is_what_fresh_fields_cost_more(
    fresh: float, sign: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(optimism, "MOMENTS", (0, 2))
    monkeypatch.setattr(optimism, "FRESH", 12)
    monkeypatch.setattr(optimism, "AT_ONCE", 6)
    maps = torch.full((2, 16, 24), 0.9)
    problem = factories.problem(
        maps, (2.25, 4.25), (9.25, 4.25), objective=TravelTime(Unicycle(), 1.0)
    )
    known = factories.normal(maps, torch.zeros_like(maps))
    problem = replace(problem, distribution=known, fields=Told(0.9, fresh))
    gaps, took = optimism.optimism(problem, level=0.0, count=2, samples=16)
    assert gaps.shape == (2, 2, 2)
    assert took > 0
    found = gaps[:, :, 0].mean()
    assert found == pytest.approx(0, abs=1e-4) if sign == 0 else sign * found > 0.1


def test_the_grid_is_told_by_times_at_two_resolutions_and_by_whether_there_is_a_way() -> (
    None
):
    ground = torch.full((2, 16, 24), 0.8)
    ground[1, :, 11:14] = 0.02
    problem = factories.problem(ground, (2.25, 4.25), (9.25, 4.25), time_budget_s=60.0)
    problem = replace(problem, distribution=factories.certain(ground))
    table, ((coarse, fine), (bound, bound_fine), (entry, _)) = optimal.grid_table(
        problem
    )
    assert coarse[0] == pytest.approx(6 / 0.8, rel=0.03)
    assert fine[0] == pytest.approx(coarse[0], rel=0.03)
    assert coarse[0] != fine[0]
    for found in (bound, bound_fine, entry):
        assert np.isfinite(found).tolist() == [True, False]
    assert [row["planner"] for row in table] == [
        "optimal",
        "near_optimal",
        "near_optimal, levels 0",
    ]
    (row,) = optimal.loss_table(bound, np.array([1.1 * bound[0], math.inf]))
    assert row["more time: median"] == "10.0%"
    (lost,) = optimal.loss_table(np.array([10.0, 10.0]), np.array([10.0, math.inf]))
    assert lost["paths lost"] == 1


def test_a_planner_is_quicker_by_more_than_the_grid_where_it_takes_less_by_more() -> (
    None
):
    best = [20.0, 20.0, 20.0, math.inf]
    seconds = pd.DataFrame(
        dict.fromkeys(optimal.PLANNERS, best) | {"mppi": [19.0, 19.9, 22.0, 30.0]}
    )
    rows = optimal.planner_table(seconds, np.full(4, 0.5))
    assert list(rows[0].values()) == ["optimal", "3 of 4", "1.000", "0%", "0%"]
    assert list(rows[-1].values()) == ["mppi", "4 of 4", "0.995", "75%", "50%"]


def test_matched_computing_has_a_line_a_family_over_its_time_a_step() -> None:
    rows = pd.DataFrame({
        "family": ["MPPI", "MPPI", "CL-RRT"], "ms": [8.0, 2.0, 1.0], "success_rate": [0.8, 0.7, 0.6],
        "success_low": [0.7, 0.6, 0.5], "success_high": [0.9, 0.8, 0.7], "total_time_mean_s": [40.0, 50.0, 60.0],
        "total_time_low_s": [38.0, 48.0, 58.0], "total_time_high_s": [42.0, 52.0, 62.0],
    })  # fmt: skip
    success, time_s = matched_figure(rows).axes
    for panel, expected in ((success, [70.0, 80.0]), (time_s, [50.0, 40.0])):
        line = next(line for line in panel.lines if line.get_label() == "MPPI")
        assert list(line.get_xdata()) == [2.0, 8.0]
        assert list(line.get_ydata()) == pytest.approx(expected)
