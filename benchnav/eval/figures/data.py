"""Data of the figures of a run, and the episodes that they show."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.errors import BenchnavError
from benchnav.eval.failures import RecordDriven, Sheets
from benchnav.eval.folder.steps import STEPS, read_steps
from benchnav.eval.recording import GROUND, RecordedMap, Recording, read_recordings
from benchnav.eval.stats.between import BetweenWorlds

MAX_PANELS = 4  # maximum number of recordings in a figure
_EPISODE = ("condition", "seed", "realisation", "map")
_SAME_MAP = ["data", "scenario", "map", "seed", "realisation"]


@dataclass(frozen=True, kw_only=True)
class Driven:
    """Driven paths of several conditions on one map.

    Args:
        ground: the map.
        rows: rows of the episodes, one per condition.
        tracks: positions (x, y) in metres of each episode with N steps, shape
            [N + 1, 2].
    """

    ground: RecordedMap
    rows: pd.DataFrame
    tracks: Sequence[np.ndarray]

    def chosen(self, max_count: int) -> list[int]:
        """Return up to `max_count` indices of rows: successes and failures in turn."""
        turn = self.rows.groupby("success", sort=False).cumcount().to_numpy()
        return sorted(np.argsort(turn, kind="stable")[:max_count].tolist())


@dataclass(frozen=True, kw_only=True)
class RunData:
    """Data of the figures of a run; files of the folder are read on first access.

    Args:
        about: contents of `run.json`; if the run is not finished, conditions without
            rows are left out.
        summary: one row per condition, from `summary.summarise`, joined with
            `best.against_best`.
        episodes: rows of episodes.
        tests: one row per hypothesis, from `hypotheses.test_hypotheses`; empty without
            hypotheses.
        regret: one row per step of a chain, from `regret.split_regret`; empty without a
            chain.
        between: comparison of the run's worlds, from `between.compare_worlds`; its
            tables are empty if the run has only one world.
        failures: one row per failed episode, from `failures.failures_table`.
        sheets: sheets of failures.
        folder: the run folder; None if the run was not saved, so that it has no steps
            or recordings.
        record_driven: function that records driven episodes again, such as
            `run.recordings.record_driven`.
    """

    about: Mapping[str, Any]
    summary: pd.DataFrame
    episodes: pd.DataFrame
    tests: pd.DataFrame = field(default_factory=pd.DataFrame)
    regret: pd.DataFrame = field(default_factory=pd.DataFrame)
    between: BetweenWorlds = field(default_factory=BetweenWorlds)
    failures: pd.DataFrame = field(default_factory=pd.DataFrame)
    sheets: Sheets = field(
        default_factory=lambda: Sheets(shown=(), predicted={}, left_out="")
    )
    folder: Path | None = None
    record_driven: RecordDriven | None = None

    @cached_property
    def recordings(self) -> list[Recording]:
        """All recorded episodes."""
        return read_recordings(self.folder) if self.folder else []

    @cached_property
    def driven(self) -> Driven | None:
        """Driven paths on the run's stored map; None if map or steps are missing."""
        return read_driven(self.folder, self.episodes) if self.folder else None

    @cached_property
    def on_one_map(self) -> list[Recording]:
        """Recordings of up to `MAX_PANELS` conditions on the run's stored map.

        A recording is read from the folder, or if missing, recreated from stored steps
        without plans. If one cannot be recreated, the list is empty.
        """
        if self.driven is None:
            return []
        chosen = self.driven.rows.iloc[self.driven.chosen(MAX_PANELS)]
        stored = {_episode_key(stored.about): stored for stored in self.recordings}
        recordings = []
        for index, row in chosen.iterrows():
            recording = stored.get(_episode_key(row))
            if recording is None and self.record_driven is not None:
                try:
                    (recording,) = self.record_driven(chosen.loc[[index]])
                except (BenchnavError, OSError):
                    return []
            if recording is None:
                return []
            recordings.append(recording)
        return recordings


def _episode_key(labels: Any) -> tuple[str, ...]:
    return tuple(str(labels[name]) for name in _EPISODE)


def read_driven(folder: Path, episodes: pd.DataFrame) -> Driven | None:
    """Read driven paths on a run's stored map; None if map or steps are missing.

    Args:
        folder: a finished run.
        episodes: rows of the run.
    """
    path = folder / GROUND
    if not path.exists() or not (folder / STEPS).is_dir():
        return None
    ground = RecordedMap.load(path)
    keys = pd.Series(ground.about)
    is_on_map = (episodes[list(ground.about)] == keys).all(axis=1)
    rows = episodes[is_on_map]
    draw = {name: ground.about[name] for name in ("seed", "realisation", "map")}
    all_steps = read_steps(folder, condition=list(rows["condition"]), **draw)
    steps = all_steps.groupby("condition")
    rows = rows[rows["condition"].isin(steps.groups)]
    tracks = []
    for condition in rows["condition"]:
        positions = steps.get_group(condition)[["x_m", "y_m"]]
        tracks.append(positions.to_numpy())
    return Driven(ground=ground, rows=rows, tracks=tracks) if tracks else None


def choose_recordings(
    recordings: Sequence[Recording], conditions: Sequence[str]
) -> list[Recording]:
    """Choose one recording per condition, up to `MAX_PANELS`, on one map if possible.

    The map is chosen among those on which the first condition was recorded: the first
    map on which outcomes differ, else the first on which an episode failed, else the
    first map.

    Args:
        recordings: all recordings.
        conditions: ids of conditions, in the order in which they are chosen.
    """
    labels = [recording.about for recording in recordings]
    table = pd.DataFrame(labels, columns=["condition", "outcome", *_SAME_MAP])
    table = table.astype({"condition": pd.CategoricalDtype(conditions), "map": int})
    table = table.dropna(subset="condition")
    table = table.sort_values(["condition", "map"], kind="stable")
    if table.empty:
        return []
    outcomes = table.groupby(_SAME_MAP)["outcome"]
    table["differing"] = outcomes.transform("nunique") > 1
    table["failed"] = outcomes.transform(lambda names: set(names) != {"success"})
    candidates = table[table["condition"] == table["condition"].iloc[0]]
    order = ["differing", "failed"]
    candidates = candidates.sort_values(order, ascending=False, kind="stable")
    shown = candidates.iloc[0]
    table["other"] = (table[_SAME_MAP] != shown[_SAME_MAP]).any(axis=1)
    table = table.sort_values(["condition", "other"], kind="stable")
    chosen = table.drop_duplicates("condition")
    return [recordings[index] for index in chosen.index[:MAX_PANELS]]
