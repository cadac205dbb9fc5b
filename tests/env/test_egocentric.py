import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from torch import Tensor

import benchnav  # noqa: F401 - registers the environment
from benchnav.core.batch import map_tensors
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.env.egocentric_batch import EgocentricBatch
from benchnav.env.view import CHANNELS, View
from benchnav.eval.run.knowledge import KnowledgeTracker, Learning
from benchnav.models import TraversabilityModel
from benchnav.models.predictor import Oracle
from benchnav.planning.problem import Prediction, pose_problem
from benchnav.planning.sensing.copula import Copula
from benchnav.planning.sensing.knowledge import Truth
from benchnav.planning.sensing.near import Near
from benchnav.planning.sensing.sensor import Contact, Probe
from tests import factories

ID = "benchnav/OffRoad-v1"
RISK, SPREAD, RISE, KNOWN = (
    CHANNELS.index(name) for name in ("risk", "spread", "rise", "known")
)
AHEAD = np.array([1.0, 0.0], np.float32)
STAKES = {"preset": "stakes", "time_budget_s": 3.0, "immobile": None}
CHOSEN: dict[str, Any] = {"split": "train", "world": STAKES, "model": "oracle"}
SENSES = {
    "full, static": {},
    "full, probe, copula": {
        "ground": {"part": "probe", "options": {"radius_m": 1.5, "noise_std": 0.5}}, "belief": "copula",
    },
    "near, static": {"sensor": {"part": "near", "options": {"range_m": 2.0}}},
    "near, contact, copula": {
        "sensor": {"part": "near", "options": {"range_m": 2.0, "fov_deg": 120.0}}, "belief": "copula",
    },
}  # fmt: skip
EACH = pytest.mark.parametrize("senses", SENSES.values(), ids=SENSES)


def make(path: Path, **settings: Any) -> Any:
    return gymnasium.make(ID, data=path, **{**CHOSEN, **settings}).unwrapped


def make_vector(path: Path, count: int, **settings: Any) -> Any:
    settings = {"data": path, **CHOSEN, **settings}
    return gymnasium.make_vec(
        ID, num_envs=count, vectorization_mode="vector_entry_point", **settings
    )


def batch_of(env: Any) -> EgocentricBatch:
    batch = env.unwrapped._batch
    assert isinstance(batch, EgocentricBatch)
    return batch


def drive(
    env: Any, steps: int, action: np.ndarray = AHEAD, seed: int = 0
) -> list[dict[str, np.ndarray]]:
    """Observations from the start on."""
    return [env.reset(seed=seed)[0], *(env.step(action)[0] for _ in range(steps))]


@pytest.mark.parametrize(
    ("robot", "senses"),
    [
        ("unicycle", SENSES["full, static"]),
        ("differential_drive", SENSES["near, contact, copula"]),
    ],
)
def test_the_checkers_of_gymnasium_and_stable_baselines_pass(
    dataset_path: Path,
    robot: str,
    senses: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")  # there is no display
    env = make(dataset_path, robot=robot, **senses)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env)
        from stable_baselines3.common.env_checker import check_env as check_env_for_sb3

        check_env_for_sb3(env)


@EACH
def test_observations_lie_in_the_space_until_the_end(
    dataset_path: Path, senses: dict[str, Any]
) -> None:
    env = make(dataset_path, robot="differential_drive", **senses)
    for seen in drive(env, 30):
        assert env.observation_space.contains(seen)


@EACH
def test_each_vector_member_is_the_single_environment_with_its_seed(
    dataset_path: Path, senses: dict[str, Any]
) -> None:
    senses = {
        "world": {**STAKES, "time_budget_s": 1.0},
        "replan_every_s": 0.3,
        **senses,
    }
    vector = make_vector(dataset_path, 3, **senses)
    singles = [make(dataset_path, **senses) for _ in range(3)]
    batch, _ = vector.reset(seed=7)
    alone = [env.reset(seed=7 + i)[0] for i, env in enumerate(singles)]
    # One is further on, so that they do not end together.
    for own, more in (
        (batch_of(vector), torch.tensor([0, 4, 0])),
        (batch_of(singles[1]), 4),
    ):
        assert own._now is not None
        own._now = replace(own._now, step=own._now.step + more)
    generator, ended, episodes = np.random.default_rng(0), [False] * 3, 0
    for _ in range(24):
        # Mostly ahead, so that cells are sensed from some steps alone.
        actions = generator.uniform([0.8, -1], [1, 1], (3, 2)).astype(np.float32)
        batch, reward, terminated, truncated, info = vector.step(actions)
        for i, env in enumerate(singles):
            if ended[i]:
                alone[i], _ = env.reset()
                ended[i] = False
                episodes += 1
            else:
                alone[i], gained, over, cut, one = env.step(actions[i])
                assert (over, cut) == (terminated[i], truncated[i])
                assert gained == pytest.approx(reward[i])
                assert one["traversability"] == info["traversability"][i]
                ended[i] = over or cut
            np.testing.assert_allclose(alone[i]["crop"], batch["crop"][i], atol=2e-5)
            np.testing.assert_allclose(alone[i]["state"], batch["state"][i], atol=1e-6)
    assert episodes > 3


@EACH
def test_what_is_known_is_what_robots_of_an_evaluation_know(
    dataset_path: Path, senses: dict[str, Any]
) -> None:
    env = make(dataset_path, risk="cvar:0.8", replan_every_s=0.3, **senses)
    env.reset(seed=3)
    batch = batch_of(env)
    simulation, now = batch._current()
    learner, chosen = batch._experience._learner, torch.from_numpy(batch._map)
    assert simulation.field is not None
    terrain = batch._maps.select(chosen)
    keys = batch._experience._truth.keys if batch._experience._truth else (0,)
    truth = Truth(terrain=terrain, field=simulation.field.clone(), keys=keys)
    whole = (
        learner.predict(terrain, terrain.observe()) if learner.sensor.sees_all else None
    )
    start = learner.begin(truth, now.state, whole)
    prediction = Prediction(
        start.observation, learner.distribution(start), start.risk_map
    )
    places = batch._places
    problem = pose_problem(
        batch._task, prediction, places.start_m[chosen], places.goal_m[chosen], 3.0
    )
    knowing, running = (
        KnowledgeTracker(Learning(learner=learner, start=start, truth=truth), problem),
        now.running,
    )
    changed = 0
    for step in range(13):
        before = knowing.known.risk_map
        knowing.learn(step, batch._current()[1].state.clone(), running)
        changed += not torch.equal(before, knowing.known.risk_map)
        known = batch._experience.map_knowledge
        assert torch.equal(known.risk_map, knowing.known.risk_map)
        assert torch.equal(known.seen, knowing.known.seen)
        env.step(np.array([1.0, 0.4], np.float32))
    assert (changed > 2) == bool(senses)


@EACH
def test_the_crop_shows_what_is_believed(
    dataset_path: Path, senses: dict[str, Any]
) -> None:
    env = make(dataset_path, risk="cvar:0.8", crop_cells=12, crop_behind=0.5, **senses)
    seen = drive(env, 12)[-1]
    batch = batch_of(env)
    _, now = batch._current()
    knowledge, learner = batch._experience._current(), batch._experience._learner
    believed = learner.distribution(knowledge)
    known = replace(
        batch._experience.map_knowledge,
        risk_map=believed.cvar(0.8).float(),
        spread=(believed.quantile(0.84) - believed.quantile(0.16)).float() / 2,
    )
    wanted = View(cells=12, behind=0.5).crop(batch._maps.grid, known, now.state)[0]
    # A belief may tell some cells in a quicker way, within 0.01.
    np.testing.assert_allclose(seen["crop"], wanted.numpy(), atol=0.02)
    assert np.ptp(seen["crop"][RISK]) > 0.1


def test_models_measures_and_the_size_of_the_crop_are_those_that_were_asked_for(
    dataset_path: Path,
) -> None:
    class Flat(TraversabilityModel):
        def predict(self, observation: Any) -> Any:
            mean = torch.full_like(observation.elevation_m, 0.5)
            return factories.normal(mean, torch.full_like(mean, 0.1))

    seen, _ = make(dataset_path, model=Flat(), crop_cells=4).reset(seed=0)
    assert seen["crop"].shape == (4, 4, 4)
    on_map = seen["crop"][KNOWN] > 0
    np.testing.assert_allclose(seen["crop"][RISK][on_map], 0.5, atol=1e-5)
    np.testing.assert_allclose(seen["crop"][SPREAD][on_map], 0.199, atol=1e-3)
    cautious, _ = make(dataset_path, model=Flat(), crop_cells=4, risk="cvar:0.9").reset(
        seed=0
    )
    # φ(z) / 0.1 at the quantile z of 10 %.
    np.testing.assert_allclose(
        cautious["crop"][RISK][on_map], 0.5 - 0.1 * 1.755, atol=1e-3
    )
    behind, _ = make(dataset_path, crop_cells=10, crop_behind=0.0).reset(seed=0)
    middle, _ = make(dataset_path, crop_cells=10, crop_behind=0.5).reset(seed=0)
    np.testing.assert_array_equal(behind["crop"][:, :, :5], middle["crop"][:, :, 5:])


def test_a_robot_that_sees_what_is_near_gets_to_know_more_on_its_way(
    dataset_path: Path,
) -> None:
    def known(**settings: Any) -> list[int]:
        env = make(dataset_path, **settings)
        return [int(seen["crop"][KNOWN].sum()) for seen in drive(env, 15)]

    all_of_it = known()
    near, far = (known(sensor=Near(range_m=range_m)) for range_m in (1.5, 3.0))
    assert near[0] < far[0] < all_of_it[0]
    assert near[-1] > near[0] + 5
    narrow = known(
        sensor={"part": "near", "options": {"range_m": 3.0, "fov_deg": 60.0}}
    )
    assert narrow[0] < far[0]


def unseen_risk(path: Path, unseen: str, risk: str = "mean") -> float:
    seen, _ = make(path, sensor=Near(range_m=1.0), unseen=unseen, risk=risk).reset(
        seed=0
    )
    crop = seen["crop"]
    values = np.unique(crop[RISK][(crop[KNOWN] == 0) & (crop[RISK] > 0)])
    assert len(values) == 1
    return float(values[0])


def test_unseen_ground_is_believed_to_be_what_was_asked_for(dataset_path: Path) -> None:
    prior = unseen_risk(dataset_path, "prior")
    assert (
        unseen_risk(dataset_path, "pessimistic")
        < prior
        < unseen_risk(dataset_path, "optimistic")
        == 1
    )
    assert unseen_risk(dataset_path, "prior", "cvar:0.9") < prior


def changes_at(path: Path, **settings: Any) -> list[int]:
    """Steps after which λ̂ somewhere is another than before."""
    env = make(path, **settings)
    env.reset(seed=0)
    found, before = [], batch_of(env)._experience.map_knowledge.risk_map
    for step in range(1, 21):
        *_, truncated, _ = env.step(AHEAD)
        after = batch_of(env)._experience.map_knowledge.risk_map
        if not torch.equal(before, after):
            found.append(step)
        before = after
        if truncated:
            break
    return found


def test_what_is_known_changes_when_it_is_due_alone(dataset_path: Path) -> None:
    assert changes_at(dataset_path) == []
    assert changes_at(dataset_path, ground="probe") == []
    learning = {"ground": "probe", "belief": "copula"}
    assert changes_at(dataset_path, **learning) == [5, 10, 15, 20]
    assert changes_at(dataset_path, replan_every_s=0.7, **learning) == [7, 14]
    slow = {"part": "unicycle", "options": {"dt_s": 0.25}}  # twelve steps to the end
    assert changes_at(dataset_path, robot=slow, **learning) == [2, 4, 6, 8, 10, 12]


def test_the_time_left_is_a_share_of_the_budget(dataset_path: Path) -> None:
    env = make(dataset_path, robot={"part": "unicycle", "options": {"dt_s": 0.25}})
    left = [float(seen["state"][4]) for seen in drive(env, 3)]
    np.testing.assert_allclose(left, [1, 2.75 / 3, 2.5 / 3, 2.25 / 3], atol=1e-6)


def test_the_belief_is_told_how_the_λ_of_this_world_hangs_together(
    dataset_path: Path,
) -> None:
    def length(**world: Any) -> float:
        env = make(dataset_path, belief="copula", world={**STAKES, **world})
        return batch_of(env)._experience._learner.covariance.correlation_m

    assert length() == 1.5
    assert length(correlation_m=0.7) == 0.7
    assert length(noise="stored") == 0


def test_λ_is_learnt_from_the_start_and_the_more_the_farther_it_is_probed(
    dataset_path: Path,
) -> None:
    def spread(**settings: Any) -> float:
        return float(
            make(dataset_path, **settings).reset(seed=0)[0]["crop"][SPREAD].sum()
        )

    static = spread(ground="probe")
    contact, near, far = (
        spread(belief=Copula(), ground=ground)
        for ground in (Contact(), Probe(1.0), Probe(2.0))
    )
    assert far < near < contact < static
    noisy = spread(belief=Copula(), ground=Probe(2.0, noise_std=0.5))
    assert far < noisy < static


def test_each_episode_has_sensor_noise_of_its_own_and_the_same_seed_the_same(
    dataset_path: Path,
) -> None:
    env = make(
        dataset_path, sensor=Near(colour_noise=20.0), ground=Probe(2.0), belief="copula"
    )
    first, second = (
        env.reset(seed=seed, options={"map": 1})[0]["crop"] for seed in (0, 1)
    )
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(
        env.reset(seed=0, options={"map": 1})[0]["crop"], first
    )


def lie(values: Tensor, kept: Tensor, other: Tensor) -> Tensor:
    return torch.where(
        kept if values.ndim == kept.ndim else kept[:, None], values, other
    )


@pytest.mark.parametrize(
    "ground", ["contact", {"part": "probe", "options": {"radius_m": 1.2}}]
)
def test_what_was_not_sensed_changes_no_observation(
    dataset_path: Path, ground: Any
) -> None:
    settings: dict[str, Any] = {
        "sensor": Near(range_m=2.0),
        "ground": ground,
        "belief": "copula",
    }
    turning = np.array([1.0, 0.3], np.float32)
    env = make(dataset_path, **settings)
    wanted = drive(env, 16, turning)
    batch = batch_of(env)
    own, knowledge = batch._map[0], batch._experience._current()
    seen, sensed = knowledge.seen, knowledge.ever_sensed
    assert 0.05 < seen.float().mean() < 0.9
    # λ is given by the truth of its own cell, and the robot drove where it looked.
    other = make(dataset_path, **settings)
    maps = batch_of(other)._maps
    one = maps.select(torch.tensor([own]))
    truth = one.truth
    changed = replace(
        one,
        rgb=lie(one.rgb, seen, 255 - one.rgb),
        elevation_m=lie(one.elevation_m, seen, one.elevation_m - 50),
        slope_deg=lie(one.slope_deg, seen, 90 - one.slope_deg),
        truth=replace(truth, means=lie(truth.means, seen, 1 - truth.means)),
        traversability=lie(one.traversability, seen, 1 - one.traversability),
    )
    index = torch.tensor([own])
    batch_of(other)._maps = map_tensors(
        maps, lambda old, new: old.index_copy(0, index, new), changed
    )
    for before, after in zip(wanted, drive(other, 16, turning), strict=True):
        np.testing.assert_array_equal(before["crop"], after["crop"])
        np.testing.assert_array_equal(before["state"], after["state"])
    # Nor does λ of cells that were seen and never sensed.
    third = make(dataset_path, **settings)
    third.reset(seed=0)
    field = batch_of(third)._current()[0].field
    assert field is not None
    field.copy_(torch.where(sensed, field, 1 - field))
    for before in wanted[1:]:
        np.testing.assert_array_equal(before["crop"], third.step(turning)[0]["crop"])


def test_normalised_actions_stand_for_the_robots_bounds(dataset_path: Path) -> None:
    robot = {"part": "unicycle", "options": {"speed_mps": [-0.5, 1.5]}}
    plain, scaled = (
        make(dataset_path, robot=robot, normalised_actions=normalised)
        for normalised in (False, True)
    )
    assert plain.action_space.low.tolist() == [-0.5, -1.0]
    assert (scaled.action_space.low.tolist(), scaled.action_space.high.tolist()) == (
        [-1, -1],
        [1, 1],
    )
    for given, meant in (
        ((0.5, -0.2), (1.0, -0.2)),
        ((-1, 1), (-0.5, 1)),
        ((7, 0), (1.5, 0)),
    ):
        wanted = drive(plain, 3, np.array(meant, np.float32))[-1]
        found = drive(scaled, 3, np.array(given, np.float32))[-1]
        np.testing.assert_allclose(found["state"], wanted["state"], atol=1e-6)
        np.testing.assert_allclose(found["crop"], wanted["crop"], atol=1e-5)


@EACH
def test_some_members_start_anew_and_the_others_go_on(
    dataset_path: Path, senses: dict[str, Any]
) -> None:
    one, other = (make_vector(dataset_path, 4, **senses) for _ in range(2))
    actions = np.tile(np.array([0.8, 0.3], np.float32), (4, 1))
    mask = np.array([True, False, True, False])
    for vector in (one, other):
        vector.reset(seed=5)
        for _ in range(7):
            vector.step(actions)
    fresh, info = one.reset(options={"reset_mask": mask})
    assert fresh["state"][:, 4][mask].tolist() == [1, 1]
    assert (fresh["state"][:, 4][~mask] < 1).all()
    assert len(set(info["map"])) > 1
    for _ in range(8):
        found, wanted = one.step(actions)[0], other.step(actions)[0]
        np.testing.assert_allclose(
            found["crop"][~mask], wanted["crop"][~mask], atol=2e-5
        )
        np.testing.assert_array_equal(found["state"][~mask], wanted["state"][~mask])
        assert not np.array_equal(found["state"][mask], wanted["state"][mask])


def test_members_that_were_started_anew_do_not_start_anew_again(
    dataset_path: Path,
) -> None:
    vector = make_vector(dataset_path, 2, world={**STAKES, "time_budget_s": 0.3})
    with pytest.raises(gymnasium.error.ResetNeeded):
        vector.reset(options={"reset_mask": np.array([True, False])})
    vector.reset(seed=0)
    for _ in range(3):
        *_, truncated, _ = vector.step(np.tile(AHEAD, (2, 1)))
    assert truncated.all()
    vector.reset(options={"reset_mask": np.array([True, False])})
    seen, reward, *_ = vector.step(np.tile(AHEAD, (2, 1)))
    np.testing.assert_allclose(seen["state"][:, 4], [2 / 3, 1], atol=1e-6)
    assert reward[0] != 0
    assert reward[1] == 0
    for mask in (np.zeros(2, bool), np.ones(3, bool), np.array([1, 0])):
        with pytest.raises(ConfigError, match="reset_mask"):
            vector.reset(options={"reset_mask": mask})


def test_a_seed_is_for_the_members_that_start_anew(dataset_path: Path) -> None:
    vector = make_vector(dataset_path, 2)
    wanted, _ = vector.reset(seed=9)
    vector.reset(seed=2)
    found, _ = vector.reset(seed=9, options={"reset_mask": np.array([False, True])})
    np.testing.assert_array_equal(found["crop"][1], wanted["crop"][1])
    generators = vector.unwrapped._generators
    assert generators[0].bit_generator.seed_seq.entropy == 2
    assert generators[1].bit_generator.seed_seq.entropy == 10


def test_the_reward_and_the_world_are_those_of_v0(dataset_path: Path) -> None:
    given: dict[str, Any] = {"data": dataset_path, "split": "train", "world": STAKES}
    old = gymnasium.make("benchnav/OffRoad-v0", **given).unwrapped
    new = make(dataset_path, ground="probe", belief="copula")
    old.reset(seed=4)
    new.reset(seed=4)
    for _ in range(30):
        before, after = old.step(AHEAD), new.step(AHEAD)
        assert before[1:] == after[1:]


def test_the_world_may_resample_λ_where_nothing_is_learnt_of_it(
    dataset_path: Path,
) -> None:
    env = make(dataset_path, world="paper", sensor=Near(range_m=2.0))
    seen = drive(env, 6)
    assert seen[-1]["crop"][KNOWN].sum() > seen[0]["crop"][KNOWN].sum()


@pytest.mark.filterwarnings(
    "ignore"
)  # Gymnasium's, of a render mode that it does not know
@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"sensor": "nearr"}, "Did you mean 'near'"),
        ({"ground": "prob"}, "Did you mean 'probe'"),
        ({"belief": "copla"}, "Did you mean 'copula'"),
        ({"model": "oracel"}, "Did you mean 'oracle'"),
        ({"risk": "cvr"}, "Did you mean 'cvar'"),
        ({"belief": Contact()}, "to be an instance of benchnav.planning.Belief"),
        ({"unseen": "black"}, "unseen"),
        ({"replan_every_s": 0.0}, "replan_every_s"),
        ({"crop_cells": 1}, "crop_cells"),
        ({"crop_cells": 10.5}, "`crop_cells` to be an integer"),
        ({"crop_behind": 1.0}, "crop_behind"),
        ({"render_mode": "ansi"}, "render_mode"),
        ({"belief": "copula", "world": "paper"}, "world='stakes'"),
        ({"model": "clairvoyant", "world": "paper"}, "world='stakes'"),
        ({"goal_radius_m": 0.0}, "goal_radius_m"),
    ],
)
def test_settings_that_mean_nothing_are_named(
    dataset_path: Path, settings: dict[str, Any], expected: str
) -> None:
    with pytest.raises(BenchnavError, match=expected):
        make(dataset_path, **settings)


def test_the_clairvoyant_is_given_the_λ_of_the_episode(dataset_path: Path) -> None:
    env = make(dataset_path, model="clairvoyant", crop_cells=8)
    for _ in range(3):
        env.reset(options={"map": 2})
        batch = batch_of(env)
        field = batch._current()[0].field
        assert field is not None
        torch.testing.assert_close(batch._experience.map_knowledge.risk_map, field)


def test_predictions_of_maps_are_made_once(
    dataset_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Counts(Oracle):
        calls = 0

        def predict_terrain(self, terrain: Any) -> Any:
            Counts.calls += 1
            return terrain.truth

    env = make(dataset_path, model=Counts(), belief="copula")
    first, _ = env.reset(seed=0, options={"map": 1})
    for _ in range(20):
        env.step(AHEAD)
    again, _ = env.reset(seed=0, options={"map": 1})
    np.testing.assert_array_equal(first["crop"], again["crop"])
    assert Counts.calls == 1
    env.reset(options={"map": 2})
    assert Counts.calls == 2


def test_a_model_of_other_classes_is_said_to_be_one(dataset_path: Path) -> None:
    class Others(Oracle):
        class_names = ("sand", "lava")

    with pytest.warns(UserWarning, match="the model was trained on other classes"):
        make(dataset_path, model=Others())


def test_the_noise_of_sensors_is_each_episodes_own(dataset_path: Path) -> None:
    # On ground that stays what it is, nothing but the sensor's noise differs between
    # seeds.
    env = make(
        dataset_path,
        world={**STAKES, "noise": "stored"},
        **SENSES["full, probe, copula"],
    )
    first, other, again = (
        env.reset(seed=seed, options={"map": 1})[0]["crop"] for seed in (0, 1, 0)
    )
    np.testing.assert_array_equal(first, again)
    assert np.abs(first[RISK] - other[RISK]).max() > 0.02
