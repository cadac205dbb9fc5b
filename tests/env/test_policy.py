from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchnav.core.errors import ConfigError
from benchnav.env import PolicyPlanner
from benchnav.env.egocentric_batch import EgocentricBatch
from benchnav.env.view import CHANNELS
from benchnav.eval.run.rollout import run_episodes
from benchnav.planning.problem import Prediction, Problem, pose_problem
from benchnav.planning.robots import Unicycle
from benchnav.planning.sensing.near import Near
from benchnav.planning.sensing.sensor import Step
from benchnav.testing import check_planner
from tests.env.test_egocentric import EACH, batch_of, make

GENERATOR = torch.Generator()
TURNING = np.array([1.0, 0.3], np.float32)


def toward(seen: dict[str, np.ndarray]) -> np.ndarray:
    """Full speed at the goal, slower on ground of low λ̂; normalised."""
    cosine, sine = seen["state"][:, 1], seen["state"][:, 2]
    ahead = seen["crop"][:, CHANNELS.index("risk"), 14:18, 12:16].mean((1, 2))
    return np.stack(
        (2 * ahead - 1, np.clip(2 * np.arctan2(sine, cosine), -1, 1)), axis=1
    )


def problem_of(batch: EgocentricBatch) -> Problem:
    """The problem that an evaluation would pose of what an environment's robots know
    now.
    """
    simulation, now = batch._current()
    knowledge, learner = batch._experience._current(), batch._experience._learner
    chosen = torch.from_numpy(batch._map)
    prediction = Prediction(
        knowledge.observation, learner.distribution(knowledge), knowledge.risk_map
    )
    start_m, goal_m = batch._places.start_m[chosen], batch._places.goal_m[chosen]
    posed = pose_problem(
        batch._task, prediction, start_m, goal_m, simulation.time_budget_s
    )
    return replace(posed, start=now.state)


def test_a_policy_keeps_the_contract_of_planners() -> None:
    check_planner(PolicyPlanner(toward, normalised_actions=True))
    check_planner(
        PolicyPlanner(lambda seen: toward(seen) * 9, crop_cells=20, crop_behind=0.5)
    )


@EACH
@pytest.mark.parametrize("robot", ["unicycle", "differential_drive"])
def test_it_is_given_the_observation_of_the_environment(
    dataset_path: Path, senses: dict[str, Any], robot: str
) -> None:
    crop = {"crop_cells": 14, "crop_behind": 0.2}
    env = make(dataset_path, robot=robot, risk="cvar:0.7", **crop, **senses)
    env.reset(seed=2)
    planner = PolicyPlanner(toward, **crop)
    before = planner.init(problem_of(batch_of(env)), GENERATOR)
    for steps in range(1, 11):
        seen, *_, info = env.step(TURNING)
        if steps in (1, 10):
            plan_state = planner.revise(before, problem_of(batch_of(env)))
            step = Step(
                state=batch_of(env)._current()[1].state,
                traversability=torch.tensor([info["traversability"]]),
                time_s=steps * 0.1,
            )
            found = planner.observe(step, plan_state)
            np.testing.assert_allclose(found["state"][0], seen["state"], atol=1e-6)
            # The spread of what is believed may be told in a quicker way, within 0.01.
            np.testing.assert_allclose(found["crop"][0], seen["crop"], atol=0.02)
    assert (seen["crop"] != 0).any()


def test_it_drives_in_an_evaluation_as_in_the_environment(dataset_path: Path) -> None:
    settings: dict[str, Any] = {"risk": "cvar:0.9", "normalised_actions": True}
    env, same = (make(dataset_path, **settings) for _ in range(2))
    seen, _ = env.reset(seed=1)
    same.reset(seed=1)
    problem, (simulation, _) = problem_of(batch_of(same)), batch_of(same)._current()
    found = run_episodes(
        PolicyPlanner(toward, normalised_actions=True), problem, simulation, GENERATOR
    )
    for count in range(int(found.steps[0])):
        action = toward({name: values[None] for name, values in seen.items()})[0]
        seen, _, terminated, truncated, info = env.step(action.astype(np.float32))
        state = batch_of(env)._current()[1].state
        torch.testing.assert_close(found.states[:, count + 1], state)
        assert info["traversability"] == found.traversability[0, count]
    assert terminated or truncated
    assert found.steps[0] > 9


def test_what_was_not_seen_is_unknown_to_it(dataset_path: Path) -> None:
    env = make(dataset_path, sensor=Near(range_m=1.5))
    env.reset(seed=0)
    problem = problem_of(batch_of(env))
    planner = PolicyPlanner(toward)
    step = Step(
        state=problem.start, traversability=torch.tensor([torch.nan]), time_s=0.0
    )
    known = planner.observe(step, planner.init(problem, GENERATOR))["crop"][
        0, CHANNELS.index("known")
    ]
    assert 9 <= known.sum() < 60


def test_actions_are_the_policys_within_the_bounds(dataset_path: Path) -> None:
    env = make(dataset_path, robot=Unicycle(speed_mps=(-0.5, 1.5)))
    env.reset(seed=0)
    problem = problem_of(batch_of(env))
    step = Step(state=problem.start, traversability=torch.tensor([0.5]), time_s=0.1)

    def action(given: list[float], **settings: Any) -> list[float]:
        planner = PolicyPlanner(lambda seen: np.array([given]), **settings)
        taken, _, plan = planner.plan(step, planner.init(problem, GENERATOR))
        assert plan.status.tolist() == [0]
        return [float(value) for value in taken[0]]

    assert action([1.0, -0.5]) == [1.0, -0.5]
    assert action([9.0, -9.0]) == [1.5, -1.0]
    assert action([0.5, -0.5], normalised_actions=True) == [1.0, -0.5]
    assert action([9.0, -9.0], normalised_actions=True) == [1.5, -1.0]
    with pytest.raises(
        ConfigError, match=r"actions of shape \[1, 2\] from the policy, got \[1, 3\]"
    ):
        action([1.0, 2.0, 3.0])


def test_a_policy_in_a_file_is_a_part(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(
        "import numpy as np\n"
        "from benchnav.env import PolicyPlanner\n"
        "class Mine(PolicyPlanner):\n"
        "    def __init__(self, speed: float = 1.0):\n"
        "        super().__init__(lambda seen: np.tile([speed, 0.0], (len(seen['state']), 1)))\n"
    )
    check_planner(
        {"part": f"{path}:Mine", "options": {"speed": 0.5}}, robots=["unicycle"]
    )
