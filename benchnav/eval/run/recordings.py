"""What is made again of a finished run: recordings of episodes, the ground of failures,
and that of driven paths.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from benchnav.core.device import device_of_run
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.eval.experiment.unit import Unit
from benchnav.eval.folder.checksums import note_checksums
from benchnav.eval.folder.results import code_of
from benchnav.eval.folder.run_folder import (
    EPISODES,
    KEYS,
    Run,
    find_units,
    open_run,
    read_table,
    unit_rows,
)
from benchnav.eval.folder.steps import LAST_COLUMN, has_steps, read_steps
from benchnav.eval.recording import GROUND, MAP, Ground, Recording
from benchnav.eval.run.recorder import Recorder
from benchnav.eval.run.unit import (
    Built,
    Settings,
    build,
    noise_key,
    one_thread,
    read_block,
    read_maps,
    simulate,
)
from benchnav.metrics.motion import path_length_m
from benchnav.planning.world.simulation import Simulation


def find_recording(
    folder: Path, unit: Unit, member: int, out: Path | None = None
) -> Recording:
    """Gives the recording of an episode, running its unit again where it was not
    recorded.

    Args:
        folder: a run in which that unit is finished.
        unit: the episode's.
        member: which of the unit's episodes.
        out: folder that the recording of an episode that is run again is written to;
            the run's when not given.

    Raises:
        ConfigError: the run has no row of the episode, or the device that it was
            computed on is not there.
        BenchnavError: the unit did not repeat what the run holds.
    """
    out = out or folder
    for place in (folder, out):
        stored = place / unit.recording_path(member)
        if stored.exists():
            return Recording.load(stored)
    row = _row(folder, unit, unit.maps[member])
    with one_thread():
        # Without a time limit of planners, which changes no action.
        settings = Settings(device=device_of_run(open_run(folder).about).type)
        recorder, built = _recorder(unit, settings, [member])
        episodes, _ = simulate(unit, built, settings, observer=recorder.observer)
    recording = recorder.recording(episodes, member)
    if not _repeats(row, recording):
        raise BenchnavError(
            f"The repeated episode differs from the stored one: {folder} was made "
            "with other versions or on "
            "another machine type. Run the suite again here to replay it."
        )
    recording.save(out / unit.recording_path(member))
    return recording


def _recorder(
    unit: Unit, settings: Settings, members: Sequence[int]
) -> tuple[Recorder, Built]:
    """Makes the problem and the simulation of a unit again."""
    origin, device = settings.origins().of(unit), torch.device(settings.device)
    built, terrain = (
        build(unit, origin, device),
        read_block(unit, origin, device).terrain,
    )
    return Recorder(unit, built.problem, built.simulation, terrain, members), built


def _row(folder: Path, unit: Unit, map_index: int) -> dict[str, Any]:
    """What a run holds of an episode, which may be finished before the run is."""
    if (folder / EPISODES).exists():
        rows = read_table(folder, EPISODES)
    else:
        rows = pd.concat(
            [pd.DataFrame(columns=KEYS), *map(unit_rows, find_units(folder, unit)[:1])]
        )
    known = {
        "condition": unit.condition.id,
        "seed": unit.seed,
        "realisation": unit.realisation,
        "map": map_index,
    }
    own = (rows[list(known)] == pd.Series(known)).all(axis=1)
    if not own.any():
        raise ConfigError(
            f"Expected an episode that is finished, got one that {folder} does not "
            "have yet. Give its `benchnav-eval "
            "run` command again to finish it, or name another condition."
        )
    return rows[own].to_dict("records")[0]


def _repeats(row: Mapping[str, Any], recording: Recording) -> bool:
    """Whether an episode that was run again came out as its row says."""
    ended = np.isclose(row["end_time_s"], recording.end_s, atol=1e-6)
    if row["outcome"] != recording.about["outcome"] or not ended:
        return False
    if not len(recording.traversability):
        return True
    length_m = path_length_m(recording.track.astype(np.float64))
    met = recording.traversability.astype(np.float64).mean()
    return bool(row["path_length_m"] == length_m and row["traversability"] == met)


def record_driven(folder: Path, rows: pd.DataFrame) -> list[Recording]:
    """Records episodes again from the steps that were kept: their ground is read and
    predicted, nothing is planned.

    Args:
        folder: a finished run that kept steps.
        rows: episodes of one condition, rows of the run's table.

    Returns:
        A recording a row.

    Raises:
        BenchnavError: the maps or the parts are not those of the run, or cannot be had.
    """
    run, recordings = open_run(folder), dict[int, Recording]()
    for _, own in rows.groupby(["seed", "realisation"], sort=False):
        recordings |= dict(zip(own.index, _record_block(run, own), strict=True))
    return [recordings[index] for index in rows.index]


def _record_block(run: Run, rows: pd.DataFrame) -> Iterator[Recording]:
    """Records episodes under one seed and realisation."""
    first = rows.iloc[0]
    condition, _ = run.conditions[first["condition"]]
    maps = tuple(rows["map"].tolist())
    seed, realisation = int(first["seed"]), int(first["realisation"])
    unit = Unit(condition=condition, seed=seed, realisation=realisation, maps=maps)
    origin, made = Settings().origins().of(unit), code_of(run, first["code"])
    digests = run.about["datasets"][condition.data]["maps"][condition.split]
    if origin.maps[1:] != tuple(digests[i] for i in maps):
        raise BenchnavError(
            f"Expected {condition.data} with the maps of {run.folder}, got other maps."
        )
    for part, digest in origin.code["parts"].items():
        if made["parts"].get(part) != digest:
            raise BenchnavError(
                f"Expected {part} as it was when {run.folder} was run, got a changed "
                "one."
            )
    with one_thread():
        recorder, _ = _recorder(unit, Settings(), ())
    kept = read_steps(
        run.folder, condition=condition.id, seed=seed, realisation=realisation, map=maps
    )
    driven = kept.groupby("map")
    commands = list(recorder.problem.robot.action_names)
    for member, (map_index, outcome) in enumerate(
        zip(maps, rows["outcome"], strict=True)
    ):
        steps = driven.get_group(map_index)
        states = steps[["x_m", "y_m", "heading_rad"]].to_numpy()
        yield recorder.driven(
            member,
            outcome,
            states,
            steps[commands].to_numpy()[:-1],
            steps[LAST_COLUMN].to_numpy()[:-1],
        )


def telling_map(episodes: pd.DataFrame) -> dict[str, Any]:
    """Chooses the map and the draw of λ on which about as many conditions succeed as
    fail.

    Of several such the one that most conditions were run on, then the first.

    Args:
        episodes: rows of a run.

    Returns:
        What the map is known by, by the names of `MAP`.
    """
    groups = episodes.groupby(MAP, sort=False)["success"]
    counted = groups.agg(conditions="size", successes="sum").reset_index()
    counted["differing"] = np.minimum(
        counted["successes"], counted["conditions"] - counted["successes"]
    )
    best = counted.sort_values(
        ["differing", "conditions"], ascending=False, kind="stable"
    )
    return best[MAP].head(1).to_dict("records")[0]


def keep_ground(folder: Path) -> None:
    """Writes the map on which the outcomes of a run differ most, with the λ field; not
    where no steps were kept.

    Args:
        folder: a run whose rows are all there.
    """
    if not has_steps(folder):
        return
    rows = read_table(folder, EPISODES)
    about = telling_map(rows)
    on_map = rows[(rows[list(about)] == pd.Series(about)).all(axis=1)]
    condition, _ = open_run(folder).conditions[on_map["condition"].iloc[0]]
    block = read_maps(condition.dataset, condition.split, [about["map"]])
    noise = noise_key(about["seed"], condition.split, about["realisation"])
    simulation = Simulation(
        block.terrain,
        condition.task,
        condition.world,
        block.places,
        noise,
        [about["map"]],
    )
    Ground(
        about=about,
        resolution_m=block.terrain.grid.resolution_m,
        rgb=block.terrain.rgb[0].cpu().numpy(),
        field=None if simulation.field is None else simulation.field[0].cpu().numpy(),
        immobilising=simulation.immobilising[0].cpu().numpy(),
        goal_m=block.places.goal_m[0].cpu().numpy(),
    ).save(folder / GROUND)
    note_checksums(folder, [folder / GROUND])
