"""Recordings that are created again from a finished run, and the map of its figures."""

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
    """Return the recording of an episode, running its unit again if necessary.

    Args:
        folder: a run in which the unit is finished.
        unit: unit of the episode.
        member: index of the episode in the unit.
        out: folder that a new recording is written to; by default the run's.

    Raises:
        ConfigError: If the run has no row of the episode, or its device is missing.
        BenchnavError: If the unit does not repeat its stored row.
    """
    out = out or folder
    for parent in (folder, out):
        stored = parent / unit.recording_path(member)
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
    """Create the problem and the simulation of a unit again."""
    origin = settings.origins().of(unit)
    device = torch.device(settings.device)
    built = build(unit, origin, device)
    terrain = read_block(unit, origin, device).terrain
    recorder = Recorder(unit, built.problem, built.simulation, terrain, members)
    return recorder, built


def _row(folder: Path, unit: Unit, map_index: int) -> dict[str, Any]:
    """Return the row of an episode, also if its run is not finished."""
    if (folder / EPISODES).exists():
        rows = read_table(folder, EPISODES)
    else:
        finished = [unit_rows(making) for making in find_units(folder, unit)[:1]]
        rows = pd.concat([pd.DataFrame(columns=KEYS), *finished])
    keys = {
        "condition": unit.condition.id,
        "seed": unit.seed,
        "realisation": unit.realisation,
        "map": map_index,
    }
    matches = (rows[list(keys)] == pd.Series(keys)).all(axis=1)
    if not matches.any():
        raise ConfigError(
            f"Expected an episode that is finished, got one that {folder} does not "
            "have yet. Give its `benchnav-eval "
            "run` command again to finish it, or name another condition."
        )
    return rows[matches].to_dict("records")[0]


def _repeats(row: Mapping[str, Any], recording: Recording) -> bool:
    """Return whether a repeated episode agrees with its row."""
    ended = np.isclose(row["end_time_s"], recording.end_s, atol=1e-6)
    if row["outcome"] != recording.about["outcome"] or not ended:
        return False
    if not len(recording.traversability):
        return True
    length_m = path_length_m(recording.track.astype(np.float64))
    traversability = recording.traversability.astype(np.float64).mean()
    return bool(
        row["path_length_m"] == length_m and row["traversability"] == traversability
    )


def record_driven(folder: Path, rows: pd.DataFrame) -> list[Recording]:
    """Record episodes again from stored steps, without planning.

    Args:
        folder: a finished run that stored steps.
        rows: episodes of one condition, rows of the run's table.

    Returns:
        A recording a row.

    Raises:
        BenchnavError: If maps or parts differ from those of the run, or are missing.
    """
    run = open_run(folder)
    recordings: dict[int, Recording] = {}
    for _, group in rows.groupby(["seed", "realisation"], sort=False):
        recorded = _record_block(run, group)
        recordings |= dict(zip(group.index, recorded, strict=True))
    return [recordings[index] for index in rows.index]


def _record_block(run: Run, rows: pd.DataFrame) -> Iterator[Recording]:
    """Yield recordings of episodes under one seed and realisation."""
    first = rows.iloc[0]
    condition, _ = run.conditions[first["condition"]]
    maps = tuple(rows["map"].tolist())
    seed = int(first["seed"])
    realisation = int(first["realisation"])
    unit = Unit(condition=condition, seed=seed, realisation=realisation, maps=maps)
    origin = Settings().origins().of(unit)
    code = code_of(run, first["code"])
    digests = run.about["datasets"][condition.data]["maps"][condition.split]
    if origin.maps[1:] != tuple(digests[i] for i in maps):
        raise BenchnavError(
            f"Expected {condition.data} with the maps of {run.folder}, got other maps."
        )
    for part, digest in origin.code["parts"].items():
        if code["parts"].get(part) != digest:
            raise BenchnavError(
                f"Expected {part} as it was when {run.folder} was run, got a changed "
                "one."
            )
    with one_thread():
        recorder, _ = _recorder(unit, Settings(), ())
    steps_table = read_steps(
        run.folder, condition=condition.id, seed=seed, realisation=realisation, map=maps
    )
    driven = steps_table.groupby("map")
    commands = list(recorder.problem.robot.action_names)
    outcomes = zip(maps, rows["outcome"], strict=True)
    for member, (map_index, outcome) in enumerate(outcomes):
        steps = driven.get_group(map_index)
        states = steps[["x_m", "y_m", "heading_rad"]].to_numpy()
        actions = steps[commands].to_numpy()[:-1]
        traversability = steps[LAST_COLUMN].to_numpy()[:-1]
        yield recorder.driven(member, outcome, states, actions, traversability)


def telling_map(episodes: pd.DataFrame) -> dict[str, Any]:
    """Choose the map and draw of λ on which conditions differ most in success.

    Successes and failures are about equally frequent there. Ties go to the map that
    most conditions were run on, then to the first.

    Args:
        episodes: rows of a run.

    Returns:
        Values of the columns `MAP`, which identify the map.
    """
    groups = episodes.groupby(MAP, sort=False)["success"]
    counts = groups.agg(conditions="size", successes="sum").reset_index()
    failures = counts["conditions"] - counts["successes"]
    counts["differing"] = np.minimum(counts["successes"], failures)
    best = counts.sort_values(
        ["differing", "conditions"], ascending=False, kind="stable"
    )
    return best[MAP].head(1).to_dict("records")[0]


def keep_ground(folder: Path) -> None:
    """Write the map on which outcomes differ most, with its λ field, if steps exist.

    Args:
        folder: a run with a complete table.
    """
    if not has_steps(folder):
        return
    rows = read_table(folder, EPISODES)
    map_keys = telling_map(rows)
    matches = (rows[list(map_keys)] == pd.Series(map_keys)).all(axis=1)
    map_rows = rows[matches]
    condition, _ = open_run(folder).conditions[map_rows["condition"].iloc[0]]
    block = read_maps(condition.dataset, condition.split, [map_keys["map"]])
    noise = noise_key(map_keys["seed"], condition.split, map_keys["realisation"])
    simulation = Simulation(
        block.terrain,
        condition.task,
        condition.world,
        block.places,
        noise,
        [map_keys["map"]],
    )
    field = simulation.field
    Ground(
        about=map_keys,
        resolution_m=block.terrain.grid.resolution_m,
        rgb=block.terrain.rgb[0].cpu().numpy(),
        field=None if field is None else field[0].cpu().numpy(),
        immobilising=simulation.immobilising[0].cpu().numpy(),
        goal_m=block.places.goal_m[0].cpu().numpy(),
    ).save(folder / GROUND)
    note_checksums(folder, [folder / GROUND])
