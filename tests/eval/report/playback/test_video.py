"""Videos, decoded again."""

from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from matplotlib.axes import Axes

from benchnav.core.errors import ConfigError
from benchnav.eval.figures.moment import known_colours, true_colours
from benchnav.eval.recorded_plans import KnownMap
from benchnav.eval.recording import Recording
from benchnav.eval.report.playback.video import (
    FRAMES_A_SECOND,
    HOLD_S,
    SIZE,
    SPEED,
    Frames,
    frame_times,
    write_video,
)
from benchnav.eval.words import condition_name
from benchnav.viz.maps import ROBOT, UNSEEN, hatching, shades
from benchnav.viz.style import bytes_of
from tests.eval.report import made


def flat(steps: int, **changes: object) -> Recording:
    """An episode on λ̂ of one colour, so that what is drawn stands out."""
    recording = made.recording(steps, plans=(), **changes)
    return replace(
        recording,
        predicted=np.full((40, 60), 0.5, np.float32),
        free=np.ones((40, 60), bool),
    )


def test_a_moment_lasts_a_frame_and_the_end_a_while() -> None:
    times = frame_times(12.0)
    held = round(HOLD_S * FRAMES_A_SECOND)
    assert len(times) == 12 / SPEED * FRAMES_A_SECOND + held
    np.testing.assert_allclose(
        times[:3], [0, SPEED / FRAMES_A_SECOND, 2 * SPEED / FRAMES_A_SECOND]
    )
    assert (times[-held:] == 12.0).all()
    assert times[-held - 1] < 12.0
    assert set(frame_times(0.0)) == {0.0}


def orange(frame: np.ndarray) -> np.ndarray:
    """Which pixels of a frame have the robot's colour."""
    return np.abs(frame.astype(int) - bytes_of(ROBOT)[:3]).sum(axis=-1) < 60


def robot_at(frame: np.ndarray, panel: Axes) -> np.ndarray:
    """Where the robot's mark is on a panel: x and y of its middle, in pixels from
    below.
    """
    box = panel.get_window_extent()
    rows, columns = np.nonzero(orange(frame))
    y = SIZE[1] - 1 - rows
    inside = (columns > box.x0) & (columns < box.x1) & (y > box.y0) & (y < box.y1)
    return np.array([columns[inside].mean(), y[inside].mean()])


def test_a_video_has_its_size_and_duration_and_the_robots_where_their_paths_say(
    tmp_path: Path,
) -> None:
    first, second = flat(40), flat(24, labels=made.condition(risk="mean"))
    second = replace(
        second, states=second.states * np.array([1, 0.5, 1, 1, 1], np.float32)
    )
    path = tmp_path / "there" / "a.mp4"
    steps = list(write_video([first, second], path))
    times = frame_times(4.0)
    assert steps[-1] == (len(times), len(times))
    assert [p.name for p in path.parent.iterdir()] == ["a.mp4"]
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height) == SIZE
        assert SIZE[0] * 9 == SIZE[1] * 16
        assert stream.average_rate == FRAMES_A_SECOND
        decoded = [
            frame.to_ndarray(format="rgb24") for frame in container.decode(stream)
        ]
        assert container.duration / 1e6 == pytest.approx(
            len(times) / FRAMES_A_SECOND, abs=0.06
        )
    assert len(decoded) == len(times)
    frames = Frames([first, second])
    for number in (0, 5, 11):
        for panel, recording in zip(frames.given, (first, second), strict=True):
            place = recording.states[round(times[number] / recording.dt_s), :2]
            found = robot_at(decoded[number], panel)
            np.testing.assert_allclose(found, panel.transData.transform(place), atol=6)


def test_the_robot_points_where_it_heads() -> None:
    turned = flat(3)
    size = {}
    for name, heading_rad in (("east", 0.0), ("north", np.pi / 2)):
        states = turned.states.copy()
        states[:, 2] = heading_rad
        frames = Frames([replace(turned, states=states)])
        box = frames.given[0].get_window_extent()
        rows, columns = np.nonzero(
            orange(frames.draw(0.1))[: -int(box.y0), : int(box.x1)]
        )
        size[name] = (np.ptp(columns), np.ptp(rows))
    assert size["east"][0] > size["east"][1]
    assert size["north"][1] > size["north"][0]


def labelled(panel: Axes) -> dict[str, Any]:
    return {str(artist.get_label()): artist for artist in panel.get_children()}


def test_a_frame_shows_what_was_planned_and_driven_by_then_and_at_the_end_how_it_ended() -> (
    None
):
    recording = made.held_recording(80)
    frames = Frames([recording])
    (given,), (truth,) = frames.given, frames.truths
    frames.draw(2.0)
    assert frames.time.get_text() == "t =   2.0 s"
    assert (
        given.texts[-1].get_text() == f"observed λ = {recording.traversability[20]:.2f}"
    )
    for panel in (given, truth):
        drawn = labelled(panel)
        np.testing.assert_array_equal(
            np.transpose(drawn["driven"].get_data()), recording.track[:21]
        )
        np.testing.assert_array_equal(
            np.ravel(drawn["robot"].get_data()), recording.track[20]
        )
        assert "immobilised" not in drawn
    plan = recording.plan_at(2.0).lines["path"][0]
    np.testing.assert_array_equal(labelled(given)["planned"].get_segments()[0], plan)
    frames.draw(99.0)
    assert given.texts[-1].get_text() == "immobilised, 8.0 s"
    for panel in (given, truth):
        drawn = labelled(panel)
        assert not {"planned", "robot"} & drawn.keys()
        np.testing.assert_array_equal(
            np.ravel(drawn["immobilised"].get_data()), recording.track[-1]
        )


def shown_in(panel: Axes) -> np.ndarray:
    return np.asarray(panel.images[0].get_array())


def test_λ_hat_stands_beside_λ_as_it_was_which_episodes_share() -> None:
    one, other = (
        made.held_recording(20),
        made.held_recording(20, predicted=np.full((40, 60), 0.5, np.float32)),
    )
    frames = Frames([one, other])
    frames.draw(0.5)
    for panel, own in zip(frames.given, (one, other), strict=True):
        np.testing.assert_array_equal(shown_in(panel), known_colours(own, 0)["risk"])
    (truth,) = frames.truths
    np.testing.assert_array_equal(shown_in(truth), true_colours(one))
    panels = [*frames.given, truth]
    widths = [panel.get_window_extent().width for panel in panels]
    assert np.ptp(widths) < 1e-6
    assert sum(widths) > 0.8 * SIZE[0]
    paths = [
        [line for line in panel.lines if "driven" in str(line.get_label())]
        for panel in panels
    ]
    assert list(map(len, paths)) == [1, 1, 2]
    assert one.field is not None
    turned = made.held_recording(20, field=one.field[::-1])
    apart = Frames([one, turned])
    assert len(apart.truths) == 2
    np.testing.assert_array_equal(shown_in(apart.truths[1]), true_colours(turned))


def test_where_λ_is_resampled_its_mean_stands_beside() -> None:
    recording = made.recording(20, plans=())
    frames = Frames([recording])
    np.testing.assert_array_equal(
        shown_in(frames.truths[0]), shades(recording.true_mean)
    )
    assert "resampled at each step" in words_of(frames.truths[0])


def words_of(panel: Axes) -> str:
    return panel.get_title().replace("\n", " ")


def test_each_episode_has_the_name_of_its_planner_and_risk_setting_and_of_what_else_differs() -> (
    None
):
    labels = [
        made.condition("astar_dwa", "mean"),
        made.condition("astar_dwa", "mean", robot="bicycle"),
    ]
    frames = Frames([made.recording(3, labels=own) for own in labels])
    for panel, own in zip(frames.given, labels, strict=True):
        assert (
            words_of(panel)
            == f"{condition_name(own)}, {own['robot']} λ̂ given to the planner"
        )
    (alone,) = Frames([made.recording(3, labels=labels[0])]).given
    assert words_of(alone).startswith(f"{condition_name(labels[0])} λ̂")
    (blind,) = Frames(
        [made.recording(3, labels=made.condition("straight", "–", model="–"))]
    ).given
    assert words_of(blind).startswith("straight true E[λ]")


def named(*recordings: Recording) -> set[str]:
    (legend,) = Frames(recordings)._figure.legends
    return {text.get_text() for text in legend.get_texts()}


def test_the_legend_names_what_is_there() -> None:
    taken = made.held_recording(80)
    places = {"start", "goal", "robot", "immobilised", "driven"}
    plan = {"samples", "reference path", "planned"}
    terrain = {"not free", "immobilises a robot"}
    assert named(taken) == places | plan | terrain
    everywhere = np.ones_like(taken.free)
    assert (
        named(replace(taken, free=everywhere, immobilising=~everywhere, plans=()))
        == places
    )
    other = replace(
        taken, about=taken.about | {"outcome": "success", "planner": "other"}
    )
    assert {"immobilised", "success", "driven, in the colour of its title"} < named(
        taken, other
    )


def inside(frame: np.ndarray, panel: Axes) -> np.ndarray:
    """The pixels of a panel."""
    box = panel.get_window_extent()
    return frame[
        SIZE[1] - int(box.y1) + 2 : SIZE[1] - int(box.y0) - 2,
        int(box.x0) + 2 : int(box.x1) - 2,
    ]


def test_the_map_changes_when_more_is_known_and_only_then() -> None:
    learning = made.learning_recording(80, plans=())
    still = replace(learning, states=np.repeat(learning.states[:1], 81, axis=0))
    frames = Frames([still])
    shown = [frames.draw(time_s) for time_s in (0.0, 0.4, 0.5, 4.0)]
    (panel,), (truth,) = frames.given, frames.truths
    assert np.array_equal(inside(shown[0], panel), inside(shown[1], panel))
    for before, after in ((shown[1], shown[2]), (shown[2], shown[3])):
        assert not np.array_equal(inside(before, panel), inside(after, panel))
        assert np.array_equal(inside(before, truth), inside(after, truth))
    known = still.known_at(40)
    assert known is not None
    np.testing.assert_array_equal(shown_in(panel), known_colours(still, 40)["risk"])
    np.testing.assert_array_equal(
        panel.collections[0].get_segments(), hatching(~known.seen, 0.5)
    )
    reach = labelled(panel)["footprint of the sensors"]
    np.testing.assert_array_equal(np.transpose(reach.get_data()), known.outline)
    assert "λ̂ of the belief at that time" in words_of(panel)
    # Back in time as well.
    assert np.array_equal(frames.draw(0.4), shown[1])


def test_ground_that_was_not_seen_lies_under_a_veil() -> None:
    recording = made.learning_recording(10)
    known = recording.known[-1]
    seen = replace(recording, known=(replace(known, seen=np.ones_like(known.seen)),))
    veiled, bare = known_colours(recording, 10), known_colours(seen, 10)
    for name, colours in veiled.items():
        assert (colours[known.seen] == bare[name][known.seen]).all(), name
        hidden = ~known.seen & ~known.sensed
        grey = bytes_of(UNSEEN)[0]
        assert (
            np.abs(colours[hidden] - 1.0 * grey)
            <= np.abs(bare[name][hidden] - 1.0 * grey)
        ).all()
    np.testing.assert_array_equal(bare["mean"], shades(known.mean))
    assert len(np.unique(veiled["seen"].reshape(-1, 3), axis=0)) == 3


def test_the_legend_names_what_learning_shows() -> None:
    learning, words = (
        made.learning_recording(20),
        {"not observed", "footprint of the sensors"},
    )
    assert words < named(learning)
    seen = replace(
        learning.known[0], seen=np.ones((40, 60), bool), outline=np.empty((0, 2))
    )
    known: tuple[KnownMap, ...]
    for known in ((seen,), ()):
        assert not words & named(replace(learning, known=known))


def test_names_have_room_however_long_they_are() -> None:
    labels = {
        "sensor": "near range_m=16",
        "ground": "probe radius_m=2.5",
        "belief": "copula correlation_m=1.5",
    }
    recordings = []
    for index in range(3):
        own = made.learning_recording(20)
        about = own.about | {name: f"{label} {index}" for name, label in labels.items()}
        recordings.append(replace(own, about=about))
    frames = Frames(recordings)
    boxes = [panel.title.get_window_extent() for panel in frames.given]
    assert all("copula" in panel.get_title() for panel in frames.given)
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    assert all(box.x0 >= 0 and box.y1 < SIZE[1] for box in boxes)


def test_an_episode_that_ended_at_once_is_shown(tmp_path: Path) -> None:
    list(write_video([made.recording(0, plans=())], tmp_path / "a.mp4"))
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert sum(1 for _ in container.decode(video=0)) == HOLD_S * FRAMES_A_SECOND


def test_more_than_can_be_seen_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="at most 6 conditions"):
        list(write_video([made.recording(3)] * 7, tmp_path / "a.mp4"))
    assert not list(tmp_path.iterdir())
