from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchnav.eval.figures.same_episode import (
    SameEpisode,
    draw_same_episode,
    same_episodes,
)
from benchnav.eval.recording import Recording
from benchnav.viz.style import TWO_COLUMNS_IN
from tests.eval.report import made

WORLDS = ("stakes", "stakes backend=tracks", "stakes backend=physics")
OUTCOMES = ("success", "immobilised", "stuck")


def recorded(
    world: str, outcome: str, map_index: int = 0, risk: str = "mean", **body: Any
) -> Recording:
    about = made.condition("mppi", risk, world=world) | {"data": "stakes-v1"}
    about |= {"condition": f"{world} {risk}", "seed": "0", "realisation": "0"}
    about |= {"map": str(map_index), "outcome": outcome}
    return made.body_recording(60, about=about, plans=(), **body)


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    in_worlds = [
        recorded(world, outcome, 4, ruts="physics" in world)
        for world, outcome in zip(WORLDS, OUTCOMES, strict=True)
    ]
    alike = [recorded(world, "success", 1) for world in WORLDS]
    another = [recorded(WORLDS[0], "stuck", 4, "cvar:0.8")]
    return [*alike, *another, *in_worlds[::-1]]


CONDITIONS = [f"{world} mean" for world in WORLDS] + ["stakes cvar:0.8"]


def test_the_episode_is_the_one_whose_outcomes_differ_most(
    recordings: list[Recording],
) -> None:
    shown = same_episodes(recordings, CONDITIONS)
    assert [item.about["world"] for item in shown] == list(WORLDS)
    assert [item.about["outcome"] for item in shown] == list(OUTCOMES)
    assert {item.about["map"] for item in shown} == {"4"}
    assert same_episodes(recordings[:4], CONDITIONS)[0].about["map"] == "1"
    assert same_episodes(recordings[3:5], CONDITIONS) == []  # two settings
    assert same_episodes(recordings, CONDITIONS[:1]) == []
    points = [made.held_recording(9, about=item.about) for item in recordings]
    assert same_episodes(points, CONDITIONS) == []


def test_each_world_has_its_path_a_close_up_and_lambda_over_time(
    recordings: list[Recording],
) -> None:
    shown = same_episodes(recordings, CONDITIONS)
    figure = draw_same_episode(shown)
    assert figure.get_figwidth() == TWO_COLUMNS_IN
    above, middle, below = np.array(figure.axes[:9]).reshape(3, 3)
    titles = [panel.get_title().splitlines()[0] for panel in above]
    assert titles == ["stakes", "backend=tracks", "backend=physics"]
    least = int(np.argmin(shown[0].traversability))
    for index, (recording, step) in enumerate(zip(shown, (least, 60, 60), strict=True)):
        close_up = middle[index]
        centre = [np.mean(close_up.get_xlim()), np.mean(close_up.get_ylim())]
        np.testing.assert_allclose(centre, recording.track[step], rtol=1e-6)
        assert np.ptp(close_up.get_xlim()) == pytest.approx(5)
        tracks = [line for line in close_up.lines if len(line.get_xdata()) == step + 1]
        drawn = np.stack([np.stack(line.get_data(), axis=1) for line in tracks[:4]], 1)
        np.testing.assert_array_equal(drawn, recording.body["contacts_m"][: step + 1])
        line = below[index].lines[0]
        np.testing.assert_array_equal(line.get_ydata(), recording.traversability)
    # Only the last world has ruts.
    depths = [axes for axes in figure.axes if "rut" in axes.get_ylabel()]
    assert len(depths) == 1
    ruts_m = shown[2].body["ruts_m"]
    np.testing.assert_allclose(depths[0].lines[0].get_ydata(), 100 * ruts_m.max(1))


def test_the_figure_needs_an_episode_in_several_worlds(
    recordings: list[Recording], tmp_path: Path
) -> None:
    summary = pd.DataFrame({"condition": CONDITIONS})
    data = made.run_data(summary, folder=tmp_path)
    assert not SameEpisode().is_available(data)
    for index, recording in enumerate(recordings):
        recording.save(tmp_path / "playback" / f"{index}.npz")
    data = made.run_data(summary, folder=tmp_path)
    figure = SameEpisode()
    assert figure.is_available(data)
    assert "std, map 4" in figure.caption(data)
    assert "in 3 worlds" in figure.caption(data)
    assert len(figure.draw(data).axes) > 9
    assert not figure.is_available(made.run_data(folder=tmp_path))
