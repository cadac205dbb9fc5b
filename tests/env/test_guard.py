"""What environments reject and warn of, and that they step in worker processes."""

import os
import pickle
import signal
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import benchnav  # noqa: F401 - registers the environments
from benchnav.core.errors import ConfigError
from benchnav.env import guard
from benchnav.planning.world.world import World

V0, V1 = "benchnav/OffRoad-v0", "benchnav/OffRoad-v1"
EACH = pytest.mark.parametrize("name", [V0, V1])
AHEAD = np.array([1.0, 0.0], np.float32)
CHOSEN: dict[str, Any] = {
    "split": "train",
    "world": {"preset": "stakes", "time_budget_s": 0.3},
}


def settings_of(name: str, path: Path) -> dict[str, Any]:
    return {**CHOSEN, "data": path, **({"model": "oracle"} if name == V1 else {})}


def make(name: str, path: Path, **changes: Any) -> Any:
    return gymnasium.make(name, **{**settings_of(name, path), **changes}).unwrapped


def make_vector(name: str, path: Path, **changes: Any) -> Any:
    return gymnasium.make_vec(
        name, num_envs=3, **{**settings_of(name, path), **changes}
    )


# --- worker processes ---

WORKERS = """
import multiprocessing, os, sys
import gymnasium, numpy as np, torch
import benchnav

chosen = dict(data="stakes-v1", split="test/std", world="stakes", model="oracle")
for threads, contexts in ((1, ("fork",)), (4, ("fork", "spawn", "forkserver"))):
    torch.set_num_threads(threads)
    torch.ones(2**22).exp().sum()
    for context in contexts:
        envs = gymnasium.make_vec(
            "benchnav/OffRoad-v1", 1, "async", vector_kwargs={"context": context}, **chosen
        )
        envs.reset(seed=0)
        seen, *_ = envs.step(np.ones((1, 2), np.float32))
        assert np.isfinite(seen["crop"]).all()
        envs.close()
        print(context, threads, flush=True)

env = gymnasium.make("benchnav/OffRoad-v1", **chosen)
env.reset(seed=0)
for call in (env.reset, lambda: env.step(np.ones(2, np.float32))):
    worker = multiprocessing.get_context("fork").Process(target=lambda: (call(), os._exit(torch.get_num_threads())))
    worker.start()
    worker.join()
    print(worker.exitcode, flush=True)
print(torch.get_num_threads())
"""


def output_of(code: str, limit_s: float = 120, **variables: str) -> tuple[str, str]:
    """Output and errors of a Python process, which is killed with its workers at the
    limit.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        env={**os.environ, "OMP_NUM_THREADS": "4", **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        return process.communicate(timeout=limit_s)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        out, errors = process.communicate()
        pytest.fail(f"no end within {limit_s} s, after: {out} {errors}")


def test_asynchronous_vectors_step_whatever_threads_ran_before_their_workers_started() -> (
    None
):
    out, errors = output_of(WORKERS)
    matrix = ["fork 1", "fork 4", "spawn 4", "forkserver 4"]
    # One thread in a worker, also for an environment that its parent made; the parent
    # keeps its own.
    assert out.splitlines() == [*matrix, "1", "1", "4"], errors


@pytest.mark.filterwarnings(
    "ignore::UserWarning"
)  # the model was trained on other classes
def test_an_environment_with_a_checkpoint_is_pickled_in_the_midst_of_an_episode(
    dataset_path: Path,
) -> None:
    env = gymnasium.make(
        V1, **{**settings_of(V1, dataset_path), "model": "stakes-v1", "sensor": "near"}
    )
    env.reset(seed=0)
    env.step(AHEAD)
    other = pickle.loads(pickle.dumps(env))
    for _ in range(2):
        (expected, *numbers), (seen, *others) = env.step(AHEAD), other.step(AHEAD)
        assert numbers == others
        np.testing.assert_array_equal(seen["crop"], expected["crop"])
    np.testing.assert_array_equal(other.reset()[0]["crop"], env.reset()[0]["crop"])


# --- actions ---


@pytest.mark.parametrize(
    ("action", "why"),
    [
        (np.zeros(3), r"an action of shape \[2\], got \[3\]"),
        (np.zeros((1, 2)), r"an action of shape \[2\], got \[1, 2\]"),
        (np.ones(2) + 1j, "real numbers, got array"),
        ("ahead", "real numbers, got 'ahead'"),
        (["1", "0"], "real numbers"),
        ([1.0, [2.0]], "real numbers"),
        (None, "an action of shape|real numbers"),
    ],
)
@EACH
def test_an_action_of_another_type_or_shape_raises(
    dataset_path: Path, name: str, action: Any, why: str
) -> None:
    env, vector = make(name, dataset_path), make_vector(name, dataset_path)
    env.reset(seed=0)
    with pytest.raises(ConfigError, match=why) as caught:
        env.step(action)
    assert "\n" not in str(caught.value)
    vector.reset(seed=0)
    with pytest.raises(ConfigError, match=r"real numbers|of shape \[3, 2\]"):
        vector.step(action)
    env.step([1, 0])


@EACH
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_action_that_is_not_finite_raises_and_changes_nothing(
    dataset_path: Path, name: str, value: float
) -> None:
    env, vector = make(name, dataset_path), make_vector(name, dataset_path)
    env.reset(seed=0)
    with pytest.raises(
        ConfigError, match=r"finite actions, got \[1\.0, (nan|inf|-inf)\]\."
    ):
        env.step(np.array([1.0, value], np.float32))
    fresh = make(name, dataset_path)
    fresh.reset(seed=0)
    assert env.step(AHEAD)[1:] == fresh.step(AHEAD)[1:]
    vector.reset(seed=0)
    actions = np.tile(AHEAD, (3, 1))
    actions[2, 0] = value
    with pytest.raises(ConfigError, match="for sub-environment 2"):
        vector.step(actions)
    # The action of a sub-environment that starts again is not used.
    for _ in range(3):
        *_, truncated, _ = vector.step(np.tile(AHEAD, (3, 1)))
    assert truncated.all()
    vector.step(np.full((3, 2), value, np.float32))


@EACH
def test_invalid_actions_leave_ended_sub_environments_as_they_are(
    dataset_path: Path, name: str
) -> None:
    ahead, still = np.tile(AHEAD, (3, 1)), np.zeros((3, 2), np.float32)
    faulty = ahead.copy()
    faulty[1, 0] = np.nan
    seen = []
    for actions in ((), (faulty, ahead[:2])):
        vector = make_vector(name, dataset_path)
        vector.reset(seed=0)
        vector.step(ahead)
        vector.reset(options={"reset_mask": np.array([False, True, True])})
        for _ in range(2):
            *_, truncated, _ = vector.step(still)
        assert truncated.tolist() == [True, False, False]
        for invalid in actions:
            with pytest.raises(ConfigError):
                vector.step(invalid)
        seen += [vector.step(ahead), vector.step(ahead)]
    for expected, step in zip(seen[:2], seen[2:], strict=True):
        assert step[4]["map"].tolist() == expected[4]["map"].tolist()
        for values, others in zip(step[1:4], expected[1:4], strict=True):
            np.testing.assert_array_equal(values, others)
        for key in expected[0]:
            np.testing.assert_array_equal(step[0][key], expected[0][key])


@EACH
def test_a_step_after_the_end_raises_until_a_reset(
    dataset_path: Path, name: str
) -> None:
    for changes in (
        {},
        {"goal_radius_m": 500.0},
    ):  # a time-out after 3 steps, and the goal after one
        env = make(name, dataset_path, **changes)
        env.reset(seed=0)
        ended = False
        while not ended:
            _, _, terminated, truncated, _ = env.step(AHEAD)
            ended = terminated or truncated
        for _ in range(2):
            with pytest.raises(gymnasium.error.ResetNeeded, match="ended"):
                env.step(AHEAD)
        env.reset()
        env.step(AHEAD)


# --- options of a reset ---


@EACH
@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"map": 1.5}, "`map` to be an integer from 0 to 7, got 1.5"),
        ({"map": 1.0}, "got 1.0"),
        ({"map": "3"}, "got '3'"),
        ({"map": True}, "got True"),
        ({"map": [0, 1, 2]}, r"got \[0, 1, 2\]"),
        ({"map": -1}, "got -1"),
        ({"map": 8}, "got 8"),
        ({"maps": 1}, "Did you mean 'map'"),
        ({"map": 1, "mask": None}, "got 'mask'"),
        ([("map", 1)], "`options` as a mapping"),
    ],
)
def test_options_that_mean_nothing_are_rejected_and_change_nothing(
    dataset_path: Path, name: str, options: Any, expected: str
) -> None:
    for env in (make(name, dataset_path), make_vector(name, dataset_path)):
        first = env.reset(seed=3)[1]["map"]
        second = env.reset()[1]["map"]
        env.reset(seed=3)
        with pytest.raises(ConfigError, match=expected):
            env.reset(seed=9, options=options)
        np.testing.assert_array_equal(env.reset()[1]["map"], second)
        np.testing.assert_array_equal(env.reset(seed=3)[1]["map"], first)


@EACH
def test_names_of_options_are_those_of_the_environment(
    dataset_path: Path, name: str
) -> None:
    single, vector = make(name, dataset_path), make_vector(name, dataset_path)
    for index in (5, np.int64(5), np.uint8(5)):
        assert single.reset(options={"map": index})[1]["map"] == 5
        assert (vector.reset(options={"map": index})[1]["map"] == 5).all()
    with pytest.raises(ConfigError, match="'reset_mask'"):
        single.reset(options={"reset_mask": np.array([True])})
    with pytest.raises(ConfigError, match="Did you mean 'reset_mask'"):
        vector.reset(options={"reset_maks": np.ones(3, bool)})


# --- rendering ---


@pytest.mark.filterwarnings(
    "ignore::UserWarning"
)  # Gymnasium's, of a render mode that it does not know
@pytest.mark.parametrize("mode", ["rgb_array", "human"])
def test_version_0_says_which_version_draws(dataset_path: Path, mode: str) -> None:
    for build in (make, make_vector):
        with pytest.raises(
            ConfigError, match=f"got '{mode}'.* Use benchnav/OffRoad-v1"
        ):
            build(V0, dataset_path, render_mode=mode)


@EACH
def test_the_checker_of_gymnasium_passes_without_a_display(
    dataset_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in ("DISPLAY", "WAYLAND_DISPLAY", "MPLBACKEND"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(make(name, dataset_path))
    monkeypatch.setenv("DISPLAY", ":0")
    assert ("human" in make(name, dataset_path).metadata["render_modes"]) == (
        name == V1
    )


# --- choices that were not made ---


@pytest.mark.parametrize(
    ("world", "is_chosen"),
    [
        ("", False),
        ({}, False),
        ({"noise": "stored", "time_budget_s": 9.0}, False),
        ("paper", True),
        ({"preset": "paper", "noise": "stored"}, True),
        ({"immobile": None}, True),
        ({"preset": "stakes", "immobile": None, "time_budget_s": 9.0}, True),
        (World(), True),
    ],
)
def test_a_world_without_stakes_warns_unless_it_is_chosen(
    dataset_path: Path, world: Any, is_chosen: bool
) -> None:
    for name, build in ((V0, make), (V1, make), (V1, make_vector)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            build(name, dataset_path, world=world)
        said = [str(item.message) for item in caught if "`world`" in str(item.message)]
        assert len(said) == (not is_chosen)


def test_a_privileged_model_warns_unless_it_is_chosen(dataset_path: Path) -> None:
    for build in (make, make_vector):
        with pytest.warns(
            UserWarning,
            match="`model` is 'oracle' by default.*model='oracle' to choose it",
        ):
            build(V1, dataset_path, model="")
        for model in ("oracle", "clairvoyant"):
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                build(V1, dataset_path, model=model)


DEFAULTS = """
import gymnasium, benchnav, torch
torch.set_num_threads(3)
for _ in range(3):
    gymnasium.make("benchnav/OffRoad-v1", data={path!r}, split="train").reset()
gymnasium.make_vec("benchnav/OffRoad-v1", 2, "sync", data={path!r}, split="train").reset()
print(torch.get_num_threads())
"""


def test_defaults_warn_once_in_a_process_which_keeps_its_threads(
    dataset_path: Path,
) -> None:
    out, errors = output_of(DEFAULTS.format(path=str(dataset_path)))
    assert out == "3\n"
    assert (
        errors.count("WARN"),
        errors.count("`world` is"),
        errors.count("`model` is"),
    ) == (2, 1, 1), errors


def test_a_warning_keeps_percent_signs() -> None:
    with pytest.warns(UserWarning, match="maps%d/50%"):
        guard.warn("maps%d/50%")
