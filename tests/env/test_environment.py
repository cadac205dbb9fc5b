import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import benchnav  # noqa: F401 - registers the environment
from benchnav.core import registry
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.datagen.layers.vegetation import Growth
from benchnav.datagen.recipe.recipe import Split
from benchnav.planning.objective import GoalDistance, TravelTime
from benchnav.planning.robots import DifferentialDrive, Unicycle
from benchnav.planning.world.realisation import Realisation
from benchnav.planning.world.world import World
from tests import factories
from tests.datagen.small import grown, small_stakes

ID = "benchnav/OffRoad-v0"
AHEAD = np.array([1.0, 0.0], np.float32)


def dataset_of(path: Path, *names: str) -> Path:
    """A dataset of some splits, in this order."""
    recipe = factories.tiny_recipe()
    return factories.tiny_dataset(
        path, replace(recipe, splits={name: recipe.splits[name] for name in names})
    )


def make(path: Path, world: Any = "paper", **settings: Any) -> Any:
    return gymnasium.make(ID, data=path, world=chosen(world), **settings).unwrapped


def make_vector(path: Path, count: int, world: Any = "paper", **settings: Any) -> Any:
    settings = {"data": path, "vectorization_mode": "vector_entry_point", **settings}
    return gymnasium.make_vec(ID, num_envs=count, world=chosen(world), **settings)


def chosen(world: Any) -> Any:
    """A world that names its preset, as one without a warning does."""
    return {"preset": "paper", **world} if isinstance(world, dict) else world


def drive(env: Any, observation: dict[str, np.ndarray]) -> np.ndarray:
    """At the goal, as a unicycle."""
    offset = observation["goal"] - observation["state"][:2]
    turn = np.arctan2(offset[1], offset[0]) - observation["state"][2]
    return np.array([1.0, 3 * turn], np.float32)


@pytest.mark.parametrize("robot", registry.names("robot"))
def test_the_checkers_of_gymnasium_and_stable_baselines_pass(
    dataset_path: Path, robot: str
) -> None:
    env = make(
        dataset_path, world={"time_budget_s": 2.0}, robot=robot, objective="travel_time"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env)
        from stable_baselines3.common.env_checker import check_env as check_env_for_sb3

        check_env_for_sb3(env)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"robot": "differential_drive", "objective": "goal_distance"},
        {"world": {"noise": "stored", "time_budget_s": 1.0}, "goal_radius_m": 6.0},
        {"world": {"preset": "stakes", "time_budget_s": 1.0, "immobile": None}},
        {
            "world": {
                "noise": "stored",
                "time_budget_s": 1.0,
                "immobile": {"below": 1.0, "for_s": 0.5},
            }
        },
    ],
)
def test_each_vector_member_is_the_single_environment_with_its_seed(
    dataset_path: Path, settings: dict[str, Any]
) -> None:
    settings = {"split": "train", "world": {"time_budget_s": 1.0}, **settings}
    vector = make_vector(dataset_path, 3, **settings)
    singles = [make(dataset_path, **settings) for _ in range(3)]
    batch, _ = vector.reset(seed=7)
    alone = [env.reset(seed=7 + i)[0] for i, env in enumerate(singles)]
    # One is further on, so that they do not end together.
    for own, more in (
        (vector.unwrapped._batch, torch.tensor([0, 4, 0])),
        (singles[1]._batch, 4),
    ):
        own._now = replace(
            own._now,
            step=own._now.step + more,
            dwell_steps=own._now.dwell_steps + more // 2,
        )
    generator = np.random.default_rng(0)
    ended, episodes = [False] * 3, 0
    for _ in range(45):
        actions = generator.uniform([0, -1], [1, 1], (3, 2)).astype(np.float32)
        batch, reward, terminated, truncated, info = vector.step(actions)
        for i, env in enumerate(singles):
            if ended[i]:
                alone[i], _ = env.reset()
                assert reward[i] == 0
                ended[i] = False
                episodes += 1
            else:
                alone[i], gained, over, cut, one = env.step(actions[i])
                assert (over, cut) == (terminated[i], truncated[i])
                assert gained == pytest.approx(reward[i])
                assert one["traversability"] == info["traversability"][i]
                assert one["is_success"] == info["is_success"][i]
                assert one["map"] == info["map"][i]
                ended[i] = over or cut
            for name, value in alone[i].items():
                np.testing.assert_array_equal(value, batch[name][i])
    assert episodes > 3


def test_members_that_end_apart_begin_anew_alone(
    dataset_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    built: list[int] = []
    draw = Realisation.__init__

    def count(self: Realisation, terrain: Any, *given: Any) -> None:
        built.append(len(terrain))
        draw(self, terrain, *given)

    monkeypatch.setattr(Realisation, "__init__", count)
    vector = make_vector(dataset_path, 4, split="train", world={"time_budget_s": 1.0})
    vector.reset(seed=0)
    vector.unwrapped._ended = np.array([False, True, False, True])
    vector.step(np.tile(AHEAD, (4, 1)))
    assert built == [4, 2]


def test_reward_is_progress_less_time_and_arrival_ends(dataset_path: Path) -> None:
    env = make(dataset_path, world={"noise": "stored"})
    observation, info = env.reset(seed=0, options={"map": 1})
    assert info["map"] == 1
    assert info["is_success"] is False
    distance = info["distance_m"]
    for _ in range(1000):
        observation, reward, terminated, truncated, info = env.step(
            drive(env, observation)
        )
        expected = (
            distance - info["distance_m"] - 0.01 + 10 * (info["outcome"] == "success")
        )
        assert reward == pytest.approx(expected, abs=1e-4)
        distance = info["distance_m"]
        assert info["is_success"] is (distance < 1)
        if terminated or truncated:
            break
    assert info["outcome"] == "success"
    assert info["is_success"] is True
    assert terminated
    assert not truncated


def leave(env: Any) -> tuple[int, float, dict[str, Any], float]:
    """Drives off the map: steps taken, the last one's reward and info, the distance to
    the goal before it.
    """
    observation, _ = env.reset(seed=0)
    env._batch._now.state[:, 2] = -np.pi * 0.75
    for count in range(1, 500):
        distance = float(np.linalg.norm(observation["state"][:2] - observation["goal"]))
        observation, reward, terminated, _, info = env.step(AHEAD)
        if terminated:
            return count, reward, info, distance
    raise AssertionError("it did not leave the map")


def test_leaving_the_map_ends_an_episode_with_a_fine(dataset_path: Path) -> None:
    _, reward, info, _ = leave(make(dataset_path))
    assert info["outcome"] == "out_of_bounds"
    assert info["is_success"] is False
    assert -10.3 < reward < -9.7


def test_an_objectives_reward_is_minus_its_stage_cost(dataset_path: Path) -> None:
    class Spy(GoalDistance):
        def stage(self, state, action, traversability, target):  # type: ignore[no-untyped-def]
            told.append((state, action, traversability, target))
            return super().stage(state, action, traversability, target) + 3

    told: list[tuple[torch.Tensor, ...]] = []
    env = make(dataset_path, objective=Spy())
    observation, _ = env.reset(seed=0)
    for _ in range(5):
        before, goal = observation["state"], observation["goal"]
        observation, reward, _, _, info = env.step(np.array([9.0, 0.2], np.float32))
        assert reward == pytest.approx(-3 - np.linalg.norm(before[:2] - goal), rel=1e-5)
        state, action, met, target = told[-1]
        np.testing.assert_array_equal(state[0], before)
        np.testing.assert_array_equal(target[0], goal)
        assert action[0].tolist() == pytest.approx([1.0, 0.2])
        assert met[0] == info["traversability"]


def test_an_objective_is_taken_by_name_with_options_and_the_robot(
    dataset_path: Path,
) -> None:
    slow = {"part": "unicycle", "options": {"dt_s": 0.5}}
    near = make(dataset_path, objective="travel_time", robot=slow)
    near.reset(seed=0)
    assert near.step(AHEAD)[1] == pytest.approx(-0.5)
    arrived = make(
        dataset_path, objective="travel_time", robot=slow, goal_radius_m=500.0
    )
    arrived.reset(seed=0)
    assert arrived.step(AHEAD)[1] == 0
    made = make(dataset_path, objective=TravelTime(Unicycle(dt_s=0.25), 1.0))
    made.reset(seed=0)
    assert made.step(AHEAD)[1] == pytest.approx(-0.25)


def test_leaving_the_map_costs_what_standing_there_until_the_end_would(
    dataset_path: Path,
) -> None:
    env = make(dataset_path, objective="goal_distance", world={"time_budget_s": 60.0})
    steps, reward, info, distance = leave(env)
    assert info["outcome"] == "out_of_bounds"
    assert reward == pytest.approx(-distance * (1 + 600 - steps), rel=1e-5)


def test_a_robot_is_taken_by_name_and_its_state_and_actions_are_seen(
    dataset_path: Path,
) -> None:
    part = {
        "part": "differential_drive",
        "options": {"speed_mps": [-0.5, 2.0], "dt_s": 0.2},
    }
    for robot in (part, DifferentialDrive(speed_mps=(-0.5, 2.0), dt_s=0.2)):
        env = make(dataset_path, robot=robot, world={"noise": "stored"})
        assert env.observation_space["state"].shape == (5,)
        np.testing.assert_allclose(env.action_space.low, [-0.5, -1.0])
        np.testing.assert_allclose(env.action_space.high, [2.0, 1.0])
        observation, _ = env.reset(seed=0)
        assert observation["state"][3:].tolist() == [0, 0]
        observation = env.step(np.array([2.0, 1.0], np.float32))[0]
        assert observation["state"][3:].tolist() == pytest.approx([0.1, 0.2])


def shown(env: Any, map_index: int) -> np.ndarray:
    return env.reset(seed=0, options={"map": map_index})[0]["rgb"]


def test_the_split_is_train_wherever_there_is_one(tmp_path: Path) -> None:
    path = dataset_of(tmp_path / "both.h5", "test/std", "train")
    stored = TerrainDataset(path)
    assert next(iter(stored.splits)) == "test/std"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Gymnasium's, of every version that is not the last.
        warnings.filterwarnings(
            "ignore", message=".*is out of date", category=DeprecationWarning
        )
        np.testing.assert_array_equal(
            shown(make(path), 2), stored.read("train", [2], ["rgb"])["rgb"][0]
        )
        first = stored.read("test/std", [1], ["rgb"])["rgb"]
        np.testing.assert_array_equal(shown(make(path, split="test/std"), 1), first[0])
        np.testing.assert_array_equal(
            shown(make_vector(path, 1, split="test/std"), 1), first
        )


def test_a_dataset_without_train_gives_its_first_split_and_says_so(
    tmp_path: Path,
) -> None:
    path = dataset_of(tmp_path / "tests.h5", "test/hs", "test/std")
    with pytest.warns(
        UserWarning, match="no split 'train'; its split 'test/hs' is used"
    ):
        env = make(path)
    stored = TerrainDataset(path).read("test/hs", [1], ["rgb"])["rgb"][0]
    np.testing.assert_array_equal(shown(env, 1), stored)


def test_time_budget_and_goal_radius_end_episodes(dataset_path: Path) -> None:
    env = make(dataset_path, world={"time_budget_s": 0.3})
    env.reset(seed=0)
    assert [env.step(AHEAD)[3] for _ in range(3)] == [False, False, True]
    env = make(dataset_path, goal_radius_m=500.0)
    env.reset(seed=0)
    assert env.step(AHEAD)[4]["is_success"] is True


def test_each_episode_has_noise_of_its_own_and_stored_noise_has_none(
    dataset_path: Path,
) -> None:
    kinds = {}
    for noise in ("resampled", "stored", "frozen"):
        env = make(dataset_path, world={"noise": noise})
        env.reset(seed=0)
        met = []
        for _ in range(6):
            env.reset(options={"map": 0})
            met.append(env.step(np.zeros(2, np.float32))[4]["traversability"])
        kinds[noise] = len(set(met))
    assert min(kinds["resampled"], kinds["frozen"]) > 2
    assert kinds["stored"] == 1


def test_no_truth_is_observed(dataset_path: Path) -> None:
    env = make(dataset_path)
    assert set(env.observation_space.spaces) == {
        "state",
        "goal",
        "rgb",
        "elevation_m",
        "slope_deg",
    }


def test_an_observation_that_is_written_into_changes_nothing(
    dataset_path: Path,
) -> None:
    vector = make_vector(dataset_path, 2)
    first, _ = vector.reset(seed=0)
    kept = {name: value.copy() for name, value in first.items()}
    for value in first.values():
        value[:] = 0
    again, _ = vector.reset(seed=0)
    for name, value in kept.items():
        np.testing.assert_array_equal(again[name], value)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"world": {"noise": "loud"}}, "noise"),
        ({"world": "stake"}, "Did you mean 'stakes'"),
        ({"world": {"nose": "stored"}}, "Did you mean 'noise'"),
        ({"robot": "unicycel"}, "Did you mean 'unicycle'"),
        ({"robot": {"part": "unicycle", "options": {"speed": 3}}}, "speed_mps"),
        ({"objective": "fuel"}, "goal_distance"),
        ({"split": "night"}, "split"),
        ({"world": {"time_budget_s": 0.0}}, "time_budget_s"),
        ({"goal_radius_m": 0.0}, "goal_radius_m"),
    ],
)
def test_settings_that_mean_nothing_are_named(
    dataset_path: Path, settings: dict[str, Any], expected: str
) -> None:
    with pytest.raises(BenchnavError, match=expected):
        make(dataset_path, **settings).reset()


def test_misuse_is_named(dataset_path: Path) -> None:
    with pytest.raises(ConfigError, match="map"):
        make(dataset_path).reset(options={"map": 99})
    vector = make_vector(dataset_path, 3)
    with pytest.raises(gymnasium.error.ResetNeeded):
        vector.step(np.tile(AHEAD, (3, 1)))
    vector.reset(seed=0)
    with pytest.raises(ConfigError, match=r"shape \[3, 2\], got \[2\]"):
        vector.step(AHEAD)


def test_the_world_with_stakes_immobilises_a_robot(dataset_path: Path) -> None:
    # On ground of λ under 1, so everywhere; a frozen world would see to it that the
    # start is no such ground.
    held = {
        "noise": "stored",
        "time_budget_ratio": 3.0,
        "immobile": {"below": 1.0, "for_s": 0.4},
    }
    env = make(dataset_path, split="test/std", world=held, objective="goal_distance")
    env._batch._maps.traversability.clamp_(max=0.99)
    for seed in range(4):
        _, info = env.reset(seed=seed)
        steps, ended = 0, False
        while not ended:
            _, reward, ended, cut, info = env.step(np.zeros(2, np.float32))
            steps += 1
            assert not cut
        assert info["outcome"] == "immobilised"
        assert steps == 4
        reference = float(env._batch._places.reference_time_s[info["map"]])
        left = round(3 * reference / 0.1) - steps
        assert reward == pytest.approx(-info["distance_m"] * (1 + left), rel=1e-4)
        shaped = make(dataset_path, split="test/std", world=held)
        shaped._batch._maps.traversability.clamp_(max=0.99)
        shaped.reset(seed=seed)
        assert [shaped.step(np.zeros(2, np.float32))[1] for _ in range(4)][
            -1
        ] == pytest.approx(-10.01)


def test_a_world_may_be_given_as_itself(dataset_path: Path) -> None:
    world = World(noise="stored", time_budget_s=0.2)
    env = make(dataset_path, world=world)
    env.reset(seed=0)
    assert [env.step(AHEAD)[3] for _ in range(2)] == [False, True]


def test_maps_without_a_reference_time_have_no_budget_by_it(dataset_path: Path) -> None:
    with pytest.raises(ConfigError, match="solvable"):
        make(dataset_path, split="train", world="stakes")


def test_maps_without_the_reference_times_that_stakes_need_are_one_line_with_the_command(
    tmp_path: Path,
) -> None:
    recipe = factories.tiny_recipe()
    split = replace(recipe.splits["train"], solvable=False)
    path = factories.tiny_dataset(
        tmp_path / "d.h5", replace(recipe, splits={"train": split})
    )
    with pytest.raises(
        ConfigError,
        match=r"none on 8 of 8.*create RECIPE id=NAME splits\.SPLIT\.solvable=true",
    ) as told:
        make(path, world="stakes")
    assert "\n" not in str(told.value)
    # as the line says
    made = make(path, world={"preset": "stakes", "time_budget_s": 60})
    made.reset(seed=0)


def test_layers_are_seen_by_their_names(tmp_path: Path) -> None:
    grass = Growth(height_m=(0.1, 0.8), cover=0.5, colour=(60, 110, 30))
    recipe = small_stakes(splits={"train": Split(scenario="std", maps=4)})
    soft = [item.name for item in recipe.classes if item.soft]
    path = factories.tiny_dataset(
        tmp_path / "d.h5", grown(recipe, **dict.fromkeys(soft, grass))
    )
    stored = TerrainDataset(path).read("train")["vegetation_m"]
    env = make(path, world={"time_budget_s": 1.0})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env)
        from stable_baselines3.common.env_checker import check_env as check_env_for_sb3

        check_env_for_sb3(env)
    seen, _ = env.reset(options={"map": 2})
    assert set(env.observation_space) == {
        "state",
        "goal",
        "rgb",
        "elevation_m",
        "slope_deg",
        "vegetation_m",
    }
    np.testing.assert_array_equal(seen["vegetation_m"], stored[2])
    vector = make_vector(path, 3, world={"time_budget_s": 1.0})
    batch, info = vector.reset(seed=1)
    np.testing.assert_array_equal(batch["vegetation_m"], stored[info["map"]])


def test_what_a_layer_does_not_know_is_0(
    dataset_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = TerrainDataset.terrain

    def terrain(dataset: TerrainDataset, *given: Any) -> Terrain:
        found = read(dataset, *given)
        moss = torch.where(found.slope_deg > 5, torch.nan, found.slope_deg)
        return replace(found, layers={"moss": moss})

    monkeypatch.setattr(TerrainDataset, "terrain", terrain)
    env = make(dataset_path)
    seen, _ = env.reset(options={"map": 1})
    assert env.observation_space.contains(seen)
    slope = seen["slope_deg"]
    np.testing.assert_array_equal(seen["moss"], np.where(slope > 5, 0, slope))


def test_without_layers_nothing_more_is_seen(dataset_path: Path) -> None:
    assert set(make(dataset_path).observation_space) == {
        "state",
        "goal",
        "rgb",
        "elevation_m",
        "slope_deg",
    }


@pytest.mark.parametrize("name", ["state", "goal"])
def test_a_layer_may_not_take_the_name_of_what_is_seen(
    dataset_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    read = TerrainDataset.terrain

    def terrain(dataset: TerrainDataset, *given: Any) -> Terrain:
        found = read(dataset, *given)
        return replace(found, layers={name: found.elevation_m})

    monkeypatch.setattr(TerrainDataset, "terrain", terrain)
    with pytest.raises(
        ConfigError,
        match=f"layers with other names than the observations 'state' and 'goal', got \\['{name}'\\]",
    ):
        make(dataset_path)
