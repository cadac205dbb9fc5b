"""Videos of episodes, side by side at one time base."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchnav.core.errors import ConfigError
from benchnav.core.store import replacing
from benchnav.eval.recording import Recording
from benchnav.eval.report.playback.frames import Frames

FRAMES_A_SECOND = 20
# Seconds of an episode in a second of video.
SPEED = 4.0
HOLD_S = 2.0  # of the last frame, which says how it ended
MOST_CONDITIONS = 6


def frame_times(end_s: float) -> np.ndarray:
    """Times in an episode that frames show, up to its end, which is shown a while.

    Args:
        end_s: when the last episode ends.
    """
    moving = np.arange(0.0, end_s, SPEED / FRAMES_A_SECOND)
    return np.append(moving, np.full(round(HOLD_S * FRAMES_A_SECOND), end_s))


def write_video(recordings: Sequence[Recording], path: Path) -> Iterator[tuple[int, int]]:
    """Writes a video, whole or not at all, yielding (frames done, frames in all); to be iterated to the end.

    Args:
        recordings: one, or several of one map.
        path: an `.mp4` file.

    Raises:
        ConfigError: there are too many to be seen.
    """
    import av

    if len(recordings) > MOST_CONDITIONS:
        raise ConfigError(
            f"Expected at most {MOST_CONDITIONS} conditions side by side, got {len(recordings)}."
        )
    frames, times = Frames(recordings), frame_times(max(recording.end_s for recording in recordings))
    faststart = {"movflags": "+faststart"}
    with replacing(path) as partial, av.open(str(partial), "w", format="mp4", options=faststart) as container:
        stream = container.add_stream("libx264", rate=FRAMES_A_SECOND, options={"crf": "20"})
        stream.width, stream.height = frames.size
        stream.pix_fmt = "yuv420p"
        for done, time_s in enumerate(times, start=1):
            frame = av.VideoFrame.from_ndarray(frames.draw(float(time_s)), format="rgb24")
            container.mux(stream.encode(frame))
            yield done, len(times)
        container.mux(stream.encode())
