from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import benchnav  # noqa: F401 - registers the environment
from benchnav.core.errors import ConfigError
from benchnav.planning.sensing.near import Near
from tests.env.test_egocentric import AHEAD, make, make_vector

MAP = slice(40, 464), slice(16, 440)  # pixels of the map's panel


def test_a_picture_shows_the_robot_where_it_is(dataset_path: Path) -> None:
    env = make(dataset_path, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.shape == (480, 640, 3)
    assert first.dtype == np.uint8
    np.testing.assert_array_equal(env.render(), first)
    places = []
    for _ in range(2):
        for _ in range(10):
            env.step(AHEAD)
        picture = env.render()
        assert (picture[MAP] != first[MAP]).any()
        # The robot's orange is nobody else's.
        orange = (np.abs(picture[MAP].astype(int) - (255, 120, 0)) < 12).all(-1)
        places.append(np.argwhere(orange).mean(0))
        x, y = env._batch._now.state[0, :2].tolist()
        width, _ = env._batch._maps.grid.extent_m
        np.testing.assert_allclose(
            places[-1][::-1], (424 * x / width, 424 * (1 - y / width)), atol=8
        )
    assert np.abs(places[1] - places[0]).max() > 10


def test_unseen_ground_is_darker(dataset_path: Path) -> None:
    seen, near = (
        make(dataset_path, render_mode="rgb_array", sensor=sensor)
        for sensor in ("full", Near(2.0))
    )
    bright, dark = (
        env.reset(seed=0) and env.render()[MAP].mean() for env in (seen, near)
    )
    assert dark < 0.6 * bright


def test_each_member_of_a_vector_has_a_picture(dataset_path: Path) -> None:
    vector = make_vector(dataset_path, 3, render_mode="rgb_array")
    vector.reset(seed=0)
    vector.step(np.tile(AHEAD, (3, 1)))
    pictures = vector.render()
    single = make(dataset_path, render_mode="rgb_array")
    single.reset(seed=1)
    single.step(AHEAD)
    np.testing.assert_array_equal(pictures[1], single.render())
    assert not np.array_equal(pictures[0], pictures[1])


def test_a_path_begins_anew_with_its_episode(dataset_path: Path) -> None:
    env = make(dataset_path, render_mode="rgb_array")
    env.reset(seed=0, options={"map": 1})
    for _ in range(10):
        env.step(AHEAD)
    env.reset(seed=0, options={"map": 1})
    fresh = make(dataset_path, render_mode="rgb_array")
    fresh.reset(seed=0, options={"map": 1})
    np.testing.assert_array_equal(env.render(), fresh.render())


def test_nothing_is_drawn_without_a_mode(dataset_path: Path) -> None:
    env = make(dataset_path)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="rgb_array"):
        assert env.render() is None
    vector = make_vector(dataset_path, 1)
    vector.reset(seed=0)
    assert vector.render() is None


def test_a_window_needs_a_display(
    dataset_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("matplotlib.pyplot.get_backend", lambda: "agg")
    monkeypatch.delenv("MPLBACKEND", raising=False)
    with pytest.raises(
        ConfigError, match='Expected a display for `render_mode` "human"'
    ):
        make(dataset_path, render_mode="human")


def test_a_window_shows_each_step(
    dataset_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    env = make(dataset_path, render_mode="human")
    shown: list[Any] = []
    monkeypatch.setattr(env._window._image, "set_data", shown.append)
    env.reset(seed=0)
    env.step(AHEAD)
    assert env.render() is None
    assert len(shown) == 2
    drawn = gymnasium.make(
        env.spec.id, **{**env.spec.kwargs, "render_mode": "rgb_array"}
    ).unwrapped
    drawn.reset(seed=0)
    drawn.step(AHEAD)
    np.testing.assert_array_equal(shown[1], drawn.render())
    env.close()
    env.close()
