"""Videos, decoded again."""

from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from matplotlib.axes import Axes

from benchnav.core.errors import ConfigError
from benchnav.eval.figures.knowledge import known_colours
from benchnav.eval.recording import KnownMap, Recording
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
from benchnav.viz.maps import ROBOT, field_colours, hatching, predicted_colours, shades
from benchnav.viz.style import bytes_of
from tests.eval.report import made


def flat(steps: int, **changes: object) -> Recording:
    """An episode on λ̂ of one colour, so that what is drawn stands out."""
    recording = made.recording(steps, plans=(), **changes)
    return replace(recording, predicted=np.full((40, 60), 0.5, np.float32), free=np.ones((40, 60), bool))


def test_a_moment_lasts_a_frame_and_the_end_a_while() -> None:
    times = frame_times(12.0)
    held = round(HOLD_S * FRAMES_A_SECOND)
    assert len(times) == 12 / SPEED * FRAMES_A_SECOND + held
    np.testing.assert_allclose(times[:3], [0, SPEED / FRAMES_A_SECOND, 2 * SPEED / FRAMES_A_SECOND])
    assert (times[-held:] == 12.0).all()
    assert times[-held - 1] < 12.0
    assert set(frame_times(0.0)) == {0.0}


def orange(frame: np.ndarray) -> np.ndarray:
    """Which pixels of a frame have the robot's colour."""
    return np.abs(frame.astype(int) - bytes_of(ROBOT)[:3]).sum(axis=-1) < 60


def robot_at(frame: np.ndarray, panel: Axes) -> np.ndarray:
    """Where the robot's mark is on a panel: x and y of its middle, in pixels from below."""
    box = panel.get_window_extent()
    rows, columns = np.nonzero(orange(frame))
    y = SIZE[1] - 1 - rows
    inside = (columns > box.x0) & (columns < box.x1) & (y > box.y0) & (y < box.y1)
    return np.array([columns[inside].mean(), y[inside].mean()])


def test_a_video_has_its_size_and_duration_and_the_robots_where_their_paths_say(tmp_path: Path) -> None:
    first, second = flat(40), flat(24, labels=made.condition(risk="mean"))
    second = replace(second, states=second.states * np.array([1, 0.5, 1, 1, 1], np.float32))
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
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert container.duration / 1e6 == pytest.approx(len(times) / FRAMES_A_SECOND, abs=0.06)
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
        rows, columns = np.nonzero(orange(frames.draw(0.1))[: -int(box.y0), : int(box.x1)])
        size[name] = (np.ptp(columns), np.ptp(rows))
    assert size["east"][0] > size["east"][1]
    assert size["north"][1] > size["north"][0]


def test_what_moves_is_told_in_words() -> None:
    recording = made.held_recording(80)
    frames = Frames([recording])
    driver, _ = frames.drivers
    frames.draw(2.0)
    assert frames._time.get_text() == "t =   2.0 s"
    assert driver.state is not None
    assert driver.state.get_text() == f"observed λ = {recording.traversability[20]:.2f}"
    np.testing.assert_array_equal(np.transpose(driver.path[0].get_data()), recording.track[:21])
    plan = recording.plan_at(2.0).lines["path"][0]
    np.testing.assert_array_equal(driver.layers["path"].get_segments()[0], plan)
    assert not driver.end.get_visible()
    assert driver.robot.get_visible()
    frames.draw(99.0)
    assert driver.state.get_text() == "immobilised, 8.0 s"
    assert not driver.layers["path"].get_segments()
    # It gives way to what says how it ended.
    assert driver.end.get_visible()
    assert not driver.robot.get_visible()


def test_λ_hat_stands_beside_λ_as_it_was_which_episodes_share() -> None:
    one, other = (
        made.held_recording(20),
        made.held_recording(20, predicted=np.full((40, 60), 0.5, np.float32)),
    )
    frames = Frames([one, other])
    for panel, own in zip(frames.given, (one, other), strict=True):
        np.testing.assert_array_equal(panel.images[0].get_array(), predicted_colours(own.predicted, own.free))
    (truth,) = frames.truths
    assert one.field is not None
    np.testing.assert_array_equal(truth.images[0].get_array(), field_colours(one.field, one.immobilising))
    widths = [panel.get_window_extent().width for panel in (*frames.given, truth)]
    assert np.ptp(widths) < 1e-6
    assert sum(widths) > 0.9 * SIZE[0]
    assert [driver.path[0].axes for driver in frames.drivers] == [*frames.given, truth, truth]
    apart = Frames([one, made.held_recording(20, field=one.field[::-1])])
    assert len(apart.truths) == 2
    np.testing.assert_array_equal(
        apart.truths[1].images[0].get_array(), field_colours(one.field[::-1], one.immobilising)
    )


def test_where_λ_is_resampled_its_mean_stands_beside() -> None:
    recording = made.recording(20, plans=())
    frames = Frames([recording])
    np.testing.assert_array_equal(frames.truths[0].images[0].get_array(), shades(recording.true_mean))
    assert "resampled at each step" in words_of(frames.truths[0])


def words_of(panel: Axes) -> str:
    return "; ".join(text.get_text() for text in panel.texts)


def test_each_episode_has_the_name_of_its_planner_and_risk_setting_and_of_what_else_differs() -> None:
    labels = [made.condition("astar_dwa", "mean"), made.condition("astar_dwa", "mean", robot="bicycle")]
    frames = Frames([made.recording(3, labels=own) for own in labels])
    for panel, own in zip(frames.given, labels, strict=True):
        assert words_of(panel).startswith(f"{condition_name(own)}, {own['robot']}; λ̂ given to the planner")
    (alone,) = Frames([made.recording(3, labels=labels[0])]).given
    assert words_of(alone).startswith(f"{condition_name(labels[0])}; ")
    (blind,) = Frames([made.recording(3, labels=made.condition("straight", "–", model="–"))]).given
    assert words_of(blind).startswith("straight; true mean of λ")


@pytest.mark.parametrize(("cell_m", "length_m"), [(0.5, 10.0), (0.1, 2.0), (0.01, 0.5), (20.0, 200.0)])
def test_the_scale_bar_is_as_long_as_it_says(cell_m: float, length_m: float) -> None:
    recording = made.recording(3, resolution_m=cell_m)
    frames = Frames([recording])
    (bar,) = [panel for panel in frames._figure.axes if panel.get_label() == "scale"]
    metre = frames.given[0].get_window_extent().width / (60 * cell_m)
    assert bar.get_window_extent().width == pytest.approx(length_m * metre)
    assert f"{length_m:g} m" in [text.get_text() for text in frames._figure.texts]


def test_how_an_episode_ended_stands_where_it_ended() -> None:
    recording = made.held_recording(80)
    frames = Frames([recording])
    frames.draw(99.0)
    for driver in frames.drivers:
        np.testing.assert_array_equal(np.ravel(driver.end.get_data()), recording.track[-1])


def test_the_legend_names_what_is_there() -> None:
    taken = made.held_recording(80)

    def named(*recordings: Recording) -> list[str]:
        (legend,) = Frames(recordings)._figure.legends
        return [text.get_text() for text in legend.get_texts()]

    ground = ["not free", "immobilises a robot"]
    assert named(taken)[:4] == ["start", "goal", "robot", "immobilised"]
    assert named(taken)[-3:] == ["driven", *ground]
    everywhere = np.ones_like(taken.free)
    assert named(replace(taken, free=everywhere, immobilising=~everywhere))[-1] == "driven"
    assert "planned" not in named(replace(taken, plans=()))
    other = replace(taken, about=taken.about | {"outcome": "success", "planner": "other"})
    assert named(taken, other)[3:5] == ["immobilised", "success"]
    assert "driven, in the colour of its title" in named(taken, other)


def inside(frame: np.ndarray, panel: Axes) -> np.ndarray:
    """The pixels of a panel."""
    box = panel.get_window_extent()
    return frame[SIZE[1] - int(box.y1) + 2 : SIZE[1] - int(box.y0) - 2, int(box.x0) + 2 : int(box.x1) - 2]


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
    np.testing.assert_array_equal(panel.images[0].get_array(), known_colours(known)["risk"])
    (hatched,) = [layer for layer in panel.collections if len(layer.get_segments())]
    np.testing.assert_array_equal(hatched.get_segments(), hatching(~known.seen, 0.5))
    (reach,) = [line for line in panel.lines if line.get_label() == "_reach"]
    np.testing.assert_array_equal(np.transpose(reach.get_data()), known.outline)
    assert "λ̂ known by then" in words_of(panel)
    # Back in time as well.
    assert np.array_equal(frames.draw(0.4), shown[1])


def test_ground_that_was_not_seen_lies_under_a_veil() -> None:
    known = made.learning_recording(10).known[-1]
    bare = known_colours(replace(known, seen=np.ones_like(known.seen)))
    for name, colours in known_colours(known).items():
        assert (colours[known.seen] == bare[name][known.seen]).all(), name
        hidden = colours[~known.seen & ~known.sensed].astype(int)
        assert (
            np.abs(hidden - 153) <= np.abs(bare[name][~known.seen & ~known.sensed].astype(int) - 153)
        ).all()
    np.testing.assert_array_equal(bare["risk"], predicted_colours(known.predicted, known.free))
    np.testing.assert_array_equal(bare["mean"], shades(known.mean))
    assert len(np.unique(known_colours(known)["seen"].reshape(-1, 3), axis=0)) == 3


def test_the_legend_names_what_learning_shows() -> None:
    learning = made.learning_recording(20)

    def named(*known: KnownMap) -> list[str]:
        (legend,) = Frames([replace(learning, known=known)])._figure.legends
        return [text.get_text() for text in legend.get_texts()]

    assert named(*learning.known)[-2:] == ["not seen", "reach of the sensors"]
    seen = replace(learning.known[0], seen=np.ones((40, 60), bool), outline=np.empty((0, 2)))
    for given in ((seen,), ()):
        assert not {"not seen", "reach of the sensors"} & set(named(*given))


def test_names_and_legend_have_room_however_long_they_are() -> None:
    labels = {
        "sensor": "near range_m=16",
        "ground": "probe radius_m=2.5",
        "belief": "copula correlation_m=1.5",
    }
    recordings = []
    for place in range(3):
        own = made.learning_recording(20)
        about = own.about | {name: f"{label} {place}" for name, label in labels.items()}
        recordings.append(replace(own, about=about))
    frames = Frames(recordings)
    for panel in frames.given:
        heading = max(panel.texts, key=lambda text: len(text.get_text()))
        assert "copula" in heading.get_text()
        assert heading.get_window_extent().width <= panel.get_window_extent().width
    (legend,) = frames._figure.legends
    bar, colours = (axes.get_window_extent() for axes in frames._figure.axes[-2:])
    assert bar.x1 < legend.get_window_extent().x0
    assert legend.get_window_extent().x1 < colours.x0


def test_an_episode_that_ended_at_once_is_shown(tmp_path: Path) -> None:
    list(write_video([made.recording(0, plans=())], tmp_path / "a.mp4"))
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert sum(1 for _ in container.decode(video=0)) == HOLD_S * FRAMES_A_SECOND


def test_more_than_can_be_seen_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="at most 6 conditions"):
        list(write_video([made.recording(3)] * 7, tmp_path / "a.mp4"))
    assert not list(tmp_path.iterdir())
