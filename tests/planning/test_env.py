import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_for_sb3

import benchnav  # noqa: F401 - registers the environment
from benchnav.errors import ConfigError

ID = "benchnav/OffRoad-v0"


def test_the_checkers_of_gymnasium_and_stable_baselines_pass(dataset_path: Path) -> None:
    env = gymnasium.make(ID, data=dataset_path, time_budget_s=2.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env.unwrapped)
        check_env_for_sb3(env.unwrapped)


def test_each_vector_member_is_the_single_environment_with_its_seed(dataset_path: Path) -> None:
    settings = {"data": dataset_path, "split": "train", "time_budget_s": 1.0}
    vector = gymnasium.make_vec(ID, num_envs=3, vectorization_mode="vector_entry_point", **settings)
    singles = [gymnasium.make(ID, **settings) for _ in range(3)]
    batch, _ = vector.reset(seed=7)
    alone = [env.reset(seed=7 + i)[0] for i, env in enumerate(singles)]
    generator = np.random.default_rng(0)
    ended = [False] * 3
    for _ in range(25):
        actions = generator.uniform([0, -1], [1, 1], (3, 2)).astype(np.float32)
        batch, reward, terminated, truncated, info = vector.step(actions)
        for i, env in enumerate(singles):
            if ended[i]:
                alone[i], _ = env.reset()
                assert reward[i] == 0
                ended[i] = False
            else:
                alone[i], gained, over, cut, one = env.step(actions[i])
                assert (over, cut) == (terminated[i], truncated[i])
                assert gained == pytest.approx(reward[i])
                assert one["traversability"] == info["traversability"][i]
                ended[i] = over or cut
            for name, value in alone[i].items():
                np.testing.assert_array_equal(value, batch[name][i])


def test_reward_is_progress_less_time_and_arrival_ends(dataset_path: Path) -> None:
    env = gymnasium.make(ID, data=dataset_path, noise="frozen").unwrapped
    observation, info = env.reset(seed=0, options={"instance": 1})
    assert info["instance"] == 1
    gained, distance = 0.0, info["distance_m"]
    for _ in range(1000):
        offset = observation["goal"] - observation["state"][:2]
        turn = np.arctan2(offset[1], offset[0]) - observation["state"][2]
        observation, reward, terminated, truncated, info = env.step(np.array([1.0, 3 * turn], np.float32))
        expected = distance - info["distance_m"] - 0.01 + 10 * (info["outcome"] == "success")
        assert reward == pytest.approx(expected, abs=1e-4)
        distance, gained = info["distance_m"], gained + reward
        if terminated or truncated:
            break
    assert info["outcome"] == "success"
    assert terminated
    assert not truncated
    assert distance < 1


def test_each_episode_has_luck_of_its_own(dataset_path: Path) -> None:
    env = gymnasium.make(ID, data=dataset_path).unwrapped
    env.reset(seed=0)
    met = []
    for _ in range(6):
        env.reset(options={"instance": 0})
        met.append(env.step(np.zeros(2, np.float32))[4]["traversability"])
    assert len(set(met)) > 2


def test_no_truth_is_observed(dataset_path: Path) -> None:
    env = gymnasium.make(ID, data=dataset_path)
    assert set(env.observation_space.spaces) == {"state", "goal", "rgb", "elevation_m", "slope_deg"}


def test_misuse_is_named(dataset_path: Path) -> None:
    with pytest.raises(ConfigError, match="instance"):
        gymnasium.make(ID, data=dataset_path).unwrapped.reset(options={"instance": 99})
    with pytest.raises(ConfigError, match="noise"):
        gymnasium.make(ID, data=dataset_path, noise="loud")
