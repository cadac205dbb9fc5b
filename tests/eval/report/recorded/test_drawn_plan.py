import numpy as np
import pytest
import torch

from benchnav.eval.report.recorded.drawn_plan import STYLES, drawing_interval, drawn_plan
from benchnav.planning.planners.planner import Plan


def test_points_that_are_not_used_and_lines_without_two_are_left_out() -> None:
    nan = torch.nan
    samples = torch.tensor(
        [[[0.0, 1.0], [2.0, 3.0], [nan, nan]], [[4.0, 5.0], [nan, nan], [nan, nan]], [[nan, nan]] * 3]
    )
    plan = drawn_plan(7, {"samples": samples, "tree": torch.empty(0, 0, 2)})
    assert plan.step == 7
    assert plan.lines["tree"] == []
    (line,) = plan.lines["samples"]
    np.testing.assert_array_equal(line, [[0, 1], [2, 3]])


def test_every_layer_of_a_plan_has_a_style_and_the_members_own_lines() -> None:
    path = torch.arange(24.0).reshape(3, 4, 2)
    lines = drawn_plan(0, Plan.empty(3, path=path).lines(1)).lines
    assert set(lines) == set(STYLES)
    np.testing.assert_array_equal(lines["path"][0], path[1])
    assert [name for name, layer in lines.items() if layer] == ["path"]


@pytest.mark.parametrize(("dt_s", "steps"), [(0.1, 5), (0.05, 10), (0.3, 2), (2.0, 1)])
def test_plans_are_drawn_twice_a_second(dt_s: float, steps: int) -> None:
    assert drawing_interval(dt_s) == steps
