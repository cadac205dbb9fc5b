from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from benchnav.core import registry
from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.run.rollout import Episodes
from benchnav.eval.run.rows import (
    References,
    episode_rows,
    episodes_without_steps,
    finished_episodes,
    step_table,
)
from benchnav.metrics.base import Episode, Metric, MetricError
from benchnav.metrics.shipped import SHIPPED
from benchnav.planning.problem import Problem
from benchnav.planning.world.outcome import Outcome
from tests import factories


def unit(**changes: object) -> Unit:
    suite = Suite(
        model="oracle",
        planners=("tests.eval.parts:Faulty",),
        risks=("cvar",),
        scenarios=("std",),
    )
    (condition,) = conditions_of(suite, lambda data: ["std"])
    given = {
        "condition": condition,
        "seed": 7,
        "realisation": 2,
        "maps": (4, 9),
    } | changes
    return Unit(**given)  # type: ignore[arg-type]


def made(**changes: object) -> tuple[Problem, Episodes]:
    problem = factories.problem(torch.full((2, 16, 16), 0.8), **changes)  # type: ignore[arg-type]
    states = torch.zeros(2, 5, 3)
    states[0, :, 0] = torch.tensor([0.0, 3.0, 3.0, 3.0, 3.0])
    states[0, 2:, 1] = 4.0
    episodes = Episodes(
        states=states,
        actions=torch.tensor(
            [[[1.0, 0.0], [1.0, 0.5], [9, 9], [9, 9]], [[0.0, 0.0]] * 4]
        ),
        traversability=torch.tensor([[0.2, 0.8, 9, 9], [0.3, 0.1, 0.31, 0.5]]),
        unhindered_speed_mps=torch.tensor([[1.0, 1.0, 9, 9], [0.0, 0.0, 0.0, 0.0]]),
        unhindered_turn_rate_radps=torch.tensor(
            [[0.0, 0.5, 9, 9], [0.0, 0.1, 0.0, 0.1]]
        ),
        outcome=torch.tensor([Outcome.SUCCESS, Outcome.STUCK]),
        steps=torch.tensor([2, 4]),
        begin_s=0.6,
        planning_s=torch.tensor([1.0, 0.2, 0.4, 0.1], dtype=torch.float64),
        planned=torch.tensor([2, 2, 1, 1]),
        revisions=torch.tensor([0, 3]),
        seen_cells=None,
        sensed_cells=None,
        ahead=None,
        learning_s=0.0,
        errors=("", "late"),
    )
    return problem, episodes


NAN = float("nan")
AHEAD = [
    [[0.2, -1.0], [NAN, NAN], [9, 9], [9, 9]],
    [[NAN, NAN], [0.1, 0.5], [0.3, -0.1], [NAN, NAN]],
]


def learnt() -> tuple[Problem, Episodes]:
    """The same episodes of robots that learnt, with what was measured in steps 0, or 1
    and 2.
    """
    problem, episodes = made()
    ahead = torch.tensor(AHEAD)
    seen, sensed = torch.tensor([40, 256]), torch.tensor([7, 0])
    return problem, replace(
        episodes, seen_cells=seen, sensed_cells=sensed, ahead=ahead, learning_s=0.6
    )


GROUPS = np.array([4, 4])


def rows(
    problem: Problem,
    episodes: Episodes,
    own: Unit | None = None,
    reference_time_s: tuple[float, float] = (0.1, 20.0),
) -> pd.DataFrame:
    draws = References(
        reference_time_s=np.array(reference_time_s), rejected_draws=[0, 3]
    )
    finished = finished_episodes(problem, episodes, draws)
    return episode_rows(own or unit(), GROUPS, finished, episodes.errors, compiled=True)


def test_metrics_are_those_of_the_episodes_own_steps() -> None:
    first, second = rows(*made(time_budget_s=torch.tensor([50.0, 70.0]))).to_dict(
        "records"
    )
    expected = {
        "map": 4, "group": 4, "outcome": "success", "success": True, "seed": 7, "realisation": 2,
        "condition": unit().condition.id, "risk": "cvar", "scenario": "std", "robot": "unicycle",
        "total_time_s": 0.2, "time_ratio": 2.0, "score": 0.25, "traversability": 0.5, "path_length_m": 7.0,
        "stuck_share": 0.5, "roughness_radps2": 5.0, "planning_ms": 100.0, "planning_ms_p95": 100.0,
        "planning_start_ms": 800.0, "compiled": True, "error": "", "rejected_draws": 0,
    }  # fmt: skip
    # A robot's share of those that were planned for, two and at last one; from the
    # second of its own steps on.
    other = {
        "map": 9, "group": 4, "outcome": "stuck", "success": False, "total_time_s": 70.0, "end_time_s": 0.4,
        "score": 0.0, "stuck_share": 0.5, "roughness_radps2": 1.0, "planning_ms": 100.0, "planning_ms_p95": 370.0,
        "planning_start_ms": 800.0, "rejected_draws": 3, "error": "late",
    }  # fmt: skip
    for row, values in ((first, expected), (second, other)):
        found = {name: row[name] for name in values}
        assert found == {
            n: pytest.approx(v) if isinstance(v, float) else v
            for n, v in values.items()
        }
    assert np.isnan(second["time_ratio"])


def test_columns_are_those_of_the_metrics_in_their_order() -> None:
    columns = [metric.column for metric in SHIPPED]
    assert list(rows(*made()).columns)[-len(columns) - 3 :] == [
        "outcome",
        *columns,
        "compiled",
        "error",
    ]
    assert len(set(columns)) == len(columns) == 21


def test_an_episode_that_ends_at_once_has_no_flattering_zeros() -> None:
    problem, episodes = made()
    at_once = rows(problem, replace(episodes, steps=torch.tensor([0, 1])))
    nothing = at_once.iloc[0][
        ["traversability", "path_length_m", "stuck_share", "roughness_radps2"]
    ]
    assert nothing.isna().all()
    assert np.isnan(at_once.iloc[1]["roughness_radps2"])
    assert at_once.iloc[1]["path_length_m"] == 0


def test_a_step_at_the_threshold_is_stuck_in_single_precision() -> None:
    # 0.3 in single precision is above 0.3 in double precision, and planners call it
    # stuck.
    problem, episodes = made()
    at_threshold = replace(episodes, traversability=torch.full((2, 4), 0.3))
    above = replace(episodes, traversability=torch.full((2, 4), 0.30000004))
    assert rows(problem, at_threshold)["stuck_share"].tolist() == [1.0, 1.0]
    assert rows(problem, above)["stuck_share"].tolist() == [0.0, 0.0]


def test_rows_of_a_failed_model_have_the_columns_of_all_rows() -> None:
    problem, episodes = made()
    table, places = rows(problem, episodes), factories.places(torch.full((2, 2), 5.0))
    task, budget_s = problem.task, torch.tensor([50.0, 60.0])
    unbegun = episodes_without_steps(task, places, budget_s, Outcome.MODEL_ERROR)
    failed = episode_rows(
        unit(), GROUPS, unbegun, ["ValueError: no idea"] * 2, compiled=False
    )
    assert list(failed.columns) == list(table.columns)
    assert [str(t) for t in failed.dtypes] == [str(t) for t in table.dtypes]
    assert set(failed["outcome"]) == {"model_error"}
    assert failed["total_time_s"].tolist() == [50.0, 60.0]
    assert not failed["success"].any()
    assert failed[["end_time_s", "score"]].to_numpy().tolist() == [[0.0, 0.0]] * 2
    assert failed["error"].tolist() == ["ValueError: no idea"] * 2
    known = ["success", "total_time_s", "end_time_s", "score", "rejected_draws"]
    assert (
        failed[[m.column for m in SHIPPED if m.column not in known]]
        .isna()
        .all(axis=None)
    )


class Broken(Metric):
    """Raises, or returns what it is given."""

    name = column = meaning = "broken"

    def __init__(self, value: float = 0.0) -> None:
        self.given = value

    def compute(self, episode: Episode) -> float:
        return 1 / 0 if self.given == 0 else self.given


@pytest.mark.parametrize(
    ("value", "got"), [(0.0, "ZeroDivisionError: division by zero"), (np.inf, "inf")]
)
def test_a_metric_that_fails_is_named_with_its_episode(value: float, got: str) -> None:
    part = registry.read_part(
        "metric",
        {"part": "tests.eval.run.test_rows:Broken", "options": {"value": value}},
    )
    with pytest.raises(MetricError) as raised:
        rows(*made(), unit(metrics=(part,)))
    assert str(raised.value).startswith(
        f"Expected a finite number or NaN from metric 'broken', got {got}. Return NaN"
    )
    assert "seed 7, realisation 2, map 4." in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_further_metric_is_the_last_column_and_may_be_undefined() -> None:
    part = registry.read_part(
        "metric", {"part": "tests.eval.run.test_rows:Broken", "options": {"value": NAN}}
    )
    table = rows(*made(), unit(metrics=(part,)))
    assert list(table.columns)[-2:] == ["error", "broken"]
    assert table["broken"].isna().all()
    assert table["broken"].dtype == float


LEARNT = [
    "revisions",
    "seen_cells",
    "sensed_cells",
    "ahead_rmse",
    "ahead_log_score",
    "learning_ms",
]


def test_rows_tell_what_was_learnt_in_the_steps_of_each_episode() -> None:
    table = rows(*learnt())
    # Six plans of an episode took 0.6 s of learning.
    wanted = [[0, 40, 7, 0.2, -1.0, 100.0], [3, 256, 0, 0.2, 0.2, 100.0]]
    assert table[LEARNT].to_numpy().tolist() == [pytest.approx(row) for row in wanted]
    problem, episodes = learnt()
    second = rows(problem, replace(episodes, steps=torch.tensor([2, 2]))).iloc[1]
    assert (second["ahead_rmse"], second["ahead_log_score"]) == (
        pytest.approx(0.1),
        pytest.approx(0.5),
    )
    at_once = rows(problem, replace(episodes, steps=torch.tensor([0, 1])))
    assert at_once[["ahead_rmse", "ahead_log_score"]].isna().all(axis=None)
    assert at_once["seen_cells"][0] == 40


def test_rows_of_robots_that_learn_nothing_say_nothing_of_it() -> None:
    table = rows(*made())
    assert table[LEARNT].isna().all(axis=None)
    # In any case the columns are of one type, so that tables of both kinds go together.
    other = rows(*learnt())
    assert list(other.columns) == list(table.columns)
    assert (other.dtypes == table.dtypes).all()


def test_steps_tell_what_was_measured_ahead_where_robots_learn() -> None:
    rows = step_table(unit(), *learnt()).to_pandas()
    assert list(rows.columns[-3:]) == [
        "ahead_rmse",
        "ahead_log_score",
        "traversability",
    ]
    first, second = (rows[rows["map"] == own] for own in unit().maps)
    nan = np.nan
    np.testing.assert_allclose(first["ahead_rmse"], [0.2, nan, nan])
    np.testing.assert_allclose(second["ahead_rmse"], [nan, 0.1, 0.3, nan, nan])
    np.testing.assert_allclose(second["ahead_log_score"], [nan, 0.5, -0.1, nan, nan])
    plain = step_table(unit(), *made()).to_pandas()
    assert not {"ahead_rmse", "ahead_log_score"} & set(plain.columns)
    pd.testing.assert_frame_equal(rows[plain.columns], plain)
