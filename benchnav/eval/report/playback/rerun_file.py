"""Files for the Rerun viewer: one episode, or several on one map.

A file holds the terrain as a mesh, its colours, λ in truth and as it was, the λ̂ that each planner was given,
each robot with its heading at every step, the path driven so far, what the planner was thinking, how it
ended, and time series; and a blueprint that arranges them.
"""

from collections.abc import Sequence
from pathlib import Path

from benchnav.core.store import replacing
from benchnav.eval.report.contenders import condition_colours, contender_names
from benchnav.eval.report.playback.blueprint import arrange
from benchnav.eval.report.playback.robot import (
    Driver,
    log_driven,
    log_outcome,
    log_plans,
    log_robot,
    log_series,
)
from benchnav.eval.report.playback.scene import log_maps, log_predicted, log_terrain
from benchnav.eval.report.playback.words import describe
from benchnav.eval.report.recorded.recording import Recording

APPLICATION = "benchnav"

_ALONE = (0, 170, 0)


def write_rerun(recordings: Sequence[Recording], path: Path) -> None:
    """Writes an `.rrd` file, whole or not at all.

    Args:
        recordings: one, or several of one map.
        path: file to write; its name is what the viewer calls it.
    """
    import rerun as rr

    drivers = drivers_of(recordings)
    first = recordings[0]
    # One chunk an entity, however slow the machine is: each has a header of more than a kilobyte.
    batches = rr.ChunkBatcherConfig.NEVER()
    stream = rr.RecordingStream(APPLICATION, recording_id=path.stem, batcher_config=batches)
    with replacing(path) as partial:
        stream.save(partial, default_blueprint=arrange(drivers))
        try:
            stream.send_recording_name(_title(drivers))
            stream.log("about", rr.TextDocument(describe(drivers), media_type="text/markdown"), static=True)
            log_terrain(stream, first)
            log_maps(stream, first)
            for driver in drivers:
                risk, closed = driver.entity("map/risk"), driver.entity("map/closed")
                log_predicted(stream, driver.recording, risk, closed)
                for log in (log_robot, log_series, log_driven, log_plans, log_outcome):
                    log(stream, driver)
            stream.flush()
        finally:
            stream.disconnect()


def drivers_of(recordings: Sequence[Recording]) -> list[Driver]:
    """Gives each robot a name and a colour; one that is alone needs no name."""
    if len(recordings) == 1:
        return [Driver(recording=recordings[0], name="", colour=_ALONE)]
    names = contender_names([recording.about for recording in recordings])
    colours = condition_colours(len(recordings))
    return [
        Driver(recording=recording, name=name, colour=colour)
        for recording, name, colour in zip(recordings, names, colours, strict=True)
    ]


def _title(drivers: Sequence[Driver]) -> str:
    if len(drivers) == 1:
        return drivers[0].recording.title
    about = drivers[0].recording.about
    return f"{about['scenario']} {about['map']}: {', '.join(driver.name for driver in drivers)}"
