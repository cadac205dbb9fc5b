"""Recordings that are recreated from a run, and the map that its figures show."""

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
from benchnav.eval.recording import GROUND, MAP, RecordedMap, Recording
from benchnav.eval.run.recorder import Recorder
from benchnav.eval.run.unit import (
    Settings,
    UnitInputs,
    build,
    noise_key,
    one_thread,
    read_block,
    read_maps,
    simulate,
)
from benchnav.metrics.motion import path_length_m
from benchnav.planning.world.tracks import create_simulation


def find_recording(
    folder: Path, unit: Unit, episode_index: int, out: Path | None = None
) -> Recording:
    """Return the recording of an episode; run its unit again if necessary.

    Args:
        folder: a run in which the unit is finished.
        unit: unit of the episode.
        episode_index: index of the episode in the unit.
        out: folder to which a new recording is written; if None, the run folder.

    Raises:
        ConfigError: If the run has no row of the episode, or its device is missing.
        BenchnavError: If the repeated episode differs from its stored row.
    """
    out = out or folder
    for parent in (folder, out):
        stored = parent / unit.recording_path(episode_index)
        if stored.exists():
            return Recording.load(stored)
    row = _row(folder, unit, unit.maps[episode_index])
    device = device_of_run(open_run(folder).manifest)
    # Planners have no time limit here, since a limit changes no action.
    settings = Settings(device=device.type)
    with one_thread():
        recorder, inputs = _recorder(unit, settings, [episode_index])
        episodes, _ = simulate(unit, inputs, settings, observer=recorder.observer)
    recording = recorder.recording(episodes, episode_index)
    if not _repeats(row, recording):
        raise BenchnavError(
            f"The repeated episode differs from the stored one: {folder} was run with "
            "other versions or on another type of machine. Run the suite again on this "
            "machine to replay it."
        )
    recording.save(out / unit.recording_path(episode_index))
    return recording


def _recorder(
    unit: Unit, settings: Settings, episode_indices: Sequence[int]
) -> tuple[Recorder, UnitInputs]:
    """Return a recorder of some episodes of a unit, and the unit's inputs."""
    origin = settings.origins().of(unit)
    device = torch.device(settings.device)
    inputs = build(unit, origin, device)
    terrain = read_block(unit, origin, device).terrain
    recorder = Recorder(
        unit, inputs.problem, inputs.simulation, terrain, episode_indices
    )
    return recorder, inputs


def _row(folder: Path, unit: Unit, map_index: int) -> dict[str, Any]:
    """Return the row of an episode; the run need not be finished."""
    if (folder / EPISODES).exists():
        rows = read_table(folder, EPISODES)
    else:
        newest = find_units(folder, unit)[:1]
        no_rows = pd.DataFrame(columns=KEYS)
        rows = pd.concat([no_rows, *map(unit_rows, newest)])
    keys = {
        "condition": unit.condition.id,
        "seed": unit.seed,
        "realisation": unit.realisation,
        "map": map_index,
    }
    matches = _matching(rows, keys)
    if matches.empty:
        raise ConfigError(
            f"Expected a finished episode, got one that {folder} does not contain yet. "
            "To finish the episode, repeat the `benchnav-eval run` command of that "
            "folder, or select another condition."
        )
    return matches.to_dict("records")[0]


def _matching(rows: pd.DataFrame, values: Mapping[str, Any]) -> pd.DataFrame:
    """Return the rows with the given values, by column."""
    is_equal = rows[list(values)] == pd.Series(values)
    return rows[is_equal.all(axis=1)]


def _repeats(row: Mapping[str, Any], recording: Recording) -> bool:
    """Return whether a repeated episode agrees with its row."""
    is_same_end = np.isclose(row["end_time_s"], recording.end_s, atol=1e-6)
    if row["outcome"] != recording.about["outcome"] or not is_same_end:
        return False
    if not len(recording.traversability):
        return True
    track = recording.track.astype(np.float64)
    traversability = recording.traversability.astype(np.float64)
    is_same_length = row["path_length_m"] == path_length_m(track)
    is_same_mean = row["traversability"] == traversability.mean()
    return bool(is_same_length and is_same_mean)


def record_driven(folder: Path, rows: pd.DataFrame) -> list[Recording]:
    """Record episodes again from stored steps, without planning.

    Args:
        folder: a finished run that stored steps.
        rows: rows of the run's table, all of one condition.

    Returns:
        One recording per row.

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
    """Yield recordings of episodes with the same seed and realisation."""
    first = rows.iloc[0]
    condition, _ = run.conditions[first["condition"]]
    maps = tuple(rows["map"].tolist())
    seed = int(first["seed"])
    realisation = int(first["realisation"])
    unit = Unit(condition=condition, seed=seed, realisation=realisation, maps=maps)
    _check_unchanged(run, unit, first["code"])
    with one_thread():
        recorder, _ = _recorder(unit, Settings(), ())
    steps_table = read_steps(
        run.folder, condition=condition.id, seed=seed, realisation=realisation, map=maps
    )
    driven = steps_table.groupby("map")
    commands = list(recorder.problem.robot.action_names)
    outcomes = zip(maps, rows["outcome"], strict=True)
    for episode_index, (map_index, outcome) in enumerate(outcomes):
        steps = driven.get_group(map_index)
        states = steps[["x_m", "y_m", "heading_rad"]].to_numpy()
        actions = steps[commands].to_numpy()[:-1]
        traversability = steps[LAST_COLUMN].to_numpy()[:-1]
        yield recorder.recording_from_states(
            episode_index, outcome, states, actions, traversability
        )


def _check_unchanged(run: Run, unit: Unit, code_digest: str) -> None:
    """Reject maps or parts that differ from those of a run.

    Args:
        run: opened run folder.
        unit: unit whose maps and parts are checked.
        code_digest: digest of the code of the run's rows.

    Raises:
        BenchnavError: If maps or parts differ.
    """
    condition = unit.condition
    origin = Settings().origins().of(unit)
    digests = run.manifest["datasets"][condition.data]["maps"][condition.split]
    map_digests = tuple(digests[index] for index in unit.maps)
    if origin.maps[1:] != map_digests:
        raise BenchnavError(
            f"Expected {condition.data} with the maps of {run.folder}, got different "
            "maps. Restore the dataset, or run the suite again."
        )
    parts = code_of(run, code_digest)["parts"]
    for part, digest in origin.code["parts"].items():
        if parts.get(part) != digest:
            raise BenchnavError(
                f"Expected {part} to be unchanged since {run.folder} was run, got a "
                "changed one. Restore it, or run the suite again."
            )


def most_differing_map(episodes: pd.DataFrame) -> dict[str, Any]:
    """Choose the map and the draw of λ on which the success of conditions differs most.

    On this map, the smaller of the numbers of successes and failures is largest. Ties
    are decided by the number of conditions, then by the order of the rows.

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


def write_ground(folder: Path) -> None:
    """Write the map on which outcomes differ most, with its λ field.

    If the run has no steps, nothing is written.

    Args:
        folder: a run with a complete table.
    """
    if not has_steps(folder):
        return
    rows = read_table(folder, EPISODES)
    map_keys = most_differing_map(rows)
    first_id = _matching(rows, map_keys)["condition"].iloc[0]
    condition, _ = open_run(folder).conditions[first_id]
    maps = [map_keys["map"]]
    block = read_maps(condition.dataset, condition.split, maps)
    noise = noise_key(map_keys["seed"], condition.split, map_keys["realisation"])
    simulation = create_simulation(
        block.terrain, condition.task, condition.world, block.endpoints, noise, maps
    )
    field = None
    if simulation.field is not None:
        field = simulation.field[0].cpu().numpy()
    ground = RecordedMap(
        about=map_keys,
        resolution_m=block.terrain.grid.resolution_m,
        rgb=block.terrain.rgb[0].cpu().numpy(),
        field=field,
        immobilising=simulation.immobilising[0].cpu().numpy(),
        goal_m=block.endpoints.goal_m[0].cpu().numpy(),
    )
    path = folder / GROUND
    ground.save(path)
    note_checksums(folder, [path])
