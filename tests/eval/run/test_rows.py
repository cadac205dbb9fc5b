from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from benchnav.eval.experiment.condition import conditions_of
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.run.rollout import Episodes
from benchnav.eval.run.rows import episode_rows, error_rows, score, step_table
from benchnav.planning.problem import Problem
from benchnav.planning.robots import Unicycle
from benchnav.planning.world.outcome import Outcome
from tests import factories


def unit(**changes: object) -> Unit:
    suite = Suite(model="oracle", planners=("tests.eval.parts:Faulty",), risks=("cvar",), scenarios=("std",))
    (condition,) = conditions_of(suite, lambda data: ["std"])
    given = {"condition": condition, "seed": 7, "realisation": 2, "maps": (4, 9)} | changes
    return Unit(**given)  # type: ignore[arg-type]


def made(**changes: object) -> tuple[Problem, Episodes]:
    problem = factories.problem(torch.full((2, 16, 16), 0.8), **changes)  # type: ignore[arg-type]
    states = torch.zeros(2, 5, 3)
    states[0, :, 0] = torch.tensor([0.0, 3.0, 3.0, 3.0, 3.0])
    states[0, 2:, 1] = 4.0
    episodes = Episodes(
        states=states,
        actions=torch.tensor([[[1.0, 0.0], [1.0, 0.5], [9, 9], [9, 9]], [[0.0, 0.0]] * 4]),
        traversability=torch.tensor([[0.2, 0.8, 9, 9], [0.3, 0.1, 0.31, 0.5]]),
        turn_rate_radps=torch.tensor([[0.0, 0.5, 9, 9], [0.0, 0.1, 0.0, 0.1]]),
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
    """The same episodes of robots that learnt, with what was measured in steps 0, or 1 and 2."""
    problem, episodes = made()
    ahead = torch.tensor(AHEAD)
    seen, sensed = torch.tensor([40, 256]), torch.tensor([7, 0])
    return problem, replace(episodes, seen_cells=seen, sensed_cells=sensed, ahead=ahead, learning_s=0.6)


GROUPS = np.array([4, 4])


def test_metrics_are_those_of_the_episodes_own_steps() -> None:
    problem, episodes = made(time_budget_s=torch.tensor([50.0, 70.0]))
    table = episode_rows(unit(), GROUPS, problem, episodes, np.array([0.1, 20.0]), [0, 3], True)
    first, second = table.to_dict("records")
    assert (first["map"], first["outcome"], first["success"]) == (4, "success", True)
    assert (first["group"], second["group"]) == (4, 4)
    assert (first["seed"], first["realisation"], first["condition"]) == (7, 2, unit().condition.id)
    assert (first["risk"], first["scenario"], first["robot"]) == ("cvar", "std", "unicycle")
    assert first["total_time_s"] == pytest.approx(0.2)
    assert first["time_ratio"] == pytest.approx(2.0)
    assert first["score"] == pytest.approx(0.25)
    assert first["traversability"] == pytest.approx(0.5)
    assert first["path_length_m"] == pytest.approx(7.0)
    assert first["stuck_share"] == pytest.approx(0.5)
    assert first["roughness_radps2"] == pytest.approx(5.0)
    # A robot's share of those that were planned for, two and at last one; from the second of its own steps on.
    assert (first["planning_ms"], first["planning_ms_p95"]) == (pytest.approx(100), pytest.approx(100))
    assert (second["planning_ms"], second["planning_ms_p95"]) == (pytest.approx(100), pytest.approx(370))
    assert first["planning_start_ms"] == second["planning_start_ms"] == pytest.approx(800)
    assert (first["compiled"], first["error"]) == (True, "")
    assert (second["map"], second["outcome"], second["success"]) == (9, "stuck", False)
    assert second["total_time_s"] == 70.0
    assert (first["rejected_draws"], second["rejected_draws"]) == (0, 3)
    assert second["end_time_s"] == pytest.approx(0.4)
    assert np.isnan(second["time_ratio"])
    assert second["score"] == 0
    assert second["stuck_share"] == pytest.approx(0.5)
    assert second["roughness_radps2"] == pytest.approx(1.0)
    assert second["error"] == "late"


def test_times_are_measured_by_the_robots_top_speed() -> None:
    problem, episodes = made(robot=Unicycle(speed_mps=(0.0, 2.0)))
    first = episode_rows(unit(), GROUPS, problem, episodes, np.array([0.4, 20.0]), [0, 0], False).iloc[0]
    assert first["reference_time_s"] == pytest.approx(0.4)
    assert first["time_ratio"] == pytest.approx(1.0)
    assert first["score"] == pytest.approx(0.5)


def test_an_episode_that_ends_at_once_has_no_flattering_zeros() -> None:
    problem, episodes = made()
    at_once = Episodes(**{**vars(episodes), "steps": torch.tensor([0, 1])})
    table = episode_rows(unit(), GROUPS, problem, at_once, np.array([0.1, 20.0]), [0, 0], False)
    nothing = table.iloc[0][["traversability", "path_length_m", "stuck_share", "roughness_radps2"]]
    assert nothing.isna().all()
    assert np.isnan(table.iloc[1]["roughness_radps2"])
    assert table.iloc[1]["path_length_m"] == 0


def test_rows_of_a_failed_model_have_the_columns_of_all_rows() -> None:
    problem, episodes = made()
    table = episode_rows(unit(), GROUPS, problem, episodes, np.array([0.1, 20.0]), [0, 3], True)
    failed = error_rows(
        unit(), GROUPS, torch.tensor([50.0, 60.0]), Outcome.MODEL_ERROR, "ValueError: no idea"
    )
    assert list(failed.columns) == list(table.columns)
    assert [str(t) for t in failed.dtypes] == [str(t) for t in table.dtypes]
    assert set(failed["outcome"]) == {"model_error"}
    assert failed["total_time_s"].tolist() == [50.0, 60.0]
    assert not failed["success"].any()
    assert failed["error"].tolist() == ["ValueError: no idea"] * 2


LEARNT = ["revisions", "seen_cells", "sensed_cells", "ahead_rmse", "ahead_log_score", "learning_ms"]


def test_rows_tell_what_was_learnt_in_the_steps_of_each_episode() -> None:
    table = episode_rows(unit(), GROUPS, *learnt(), np.array([0.1, 20.0]), [0, 3], True)
    # Six plans of an episode took 0.6 s of learning.
    wanted = [[0, 40, 7, 0.2, -1.0, 100.0], [3, 256, 0, 0.2, 0.2, 100.0]]
    assert table[LEARNT].to_numpy().tolist() == [pytest.approx(row) for row in wanted]
    problem, episodes = learnt()
    early = replace(episodes, steps=torch.tensor([2, 2]))
    second = episode_rows(unit(), GROUPS, problem, early, np.array([0.1, 20.0]), [0, 3], True).iloc[1]
    assert (second["ahead_rmse"], second["ahead_log_score"]) == (pytest.approx(0.1), pytest.approx(0.5))
    at_once = replace(episodes, steps=torch.tensor([0, 1]))
    first, second = (row for _, row in episode_rows(
        unit(), GROUPS, problem, at_once, np.array([0.1, 20.0]), [0, 3], True
    ).iterrows())  # fmt: skip
    assert np.isnan([first["ahead_rmse"], second["ahead_rmse"], second["ahead_log_score"]]).all()
    assert first["seen_cells"] == 40


def test_rows_of_robots_that_learn_nothing_say_nothing_of_it() -> None:
    table = episode_rows(unit(), GROUPS, *made(), np.array([0.1, 20.0]), [0, 3], True)
    assert table[LEARNT].isna().all(axis=None)
    # In any case the columns are of one type, so that tables of both kinds go together.
    other = episode_rows(unit(), GROUPS, *learnt(), np.array([0.1, 20.0]), [0, 3], True)
    assert list(other.columns) == list(table.columns)
    assert (other.dtypes == table.dtypes).all()


def test_steps_tell_what_was_measured_ahead_where_robots_learn() -> None:
    rows = step_table(unit(), *learnt()).to_pandas()
    assert list(rows.columns[-3:]) == ["ahead_rmse", "ahead_log_score", "traversability"]
    first, second = (rows[rows["map"] == own] for own in unit().maps)
    nan = np.nan
    np.testing.assert_allclose(first["ahead_rmse"], [0.2, nan, nan])
    np.testing.assert_allclose(second["ahead_rmse"], [nan, 0.1, 0.3, nan, nan])
    np.testing.assert_allclose(second["ahead_log_score"], [nan, 0.5, -0.1, nan, nan])
    plain = step_table(unit(), *made()).to_pandas()
    assert not {"ahead_rmse", "ahead_log_score"} & set(plain.columns)
    pd.testing.assert_frame_equal(rows[plain.columns], plain)


def test_score_is_barns() -> None:
    # OT = 5 s: nothing is better than arriving in 10 s, nothing worse than in 40 s.
    assert [score(t, 10.0) for t in (4.0, 10.0, 20.0, 40.0, 90.0)] == [0.5, 0.5, 0.25, 0.125, 0.125]
