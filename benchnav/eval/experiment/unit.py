"""Units of work: blocks of maps of a condition, each run as one batch."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchnav.core.registry import Part
from benchnav.core.store import Shard
from benchnav.eval.experiment.condition import Condition, condition_names
from benchnav.eval.experiment.suite import Record

BLOCK_MAPS = 50  # maximum number of maps of a block
# Columns that identify an episode of a condition.
DRAW = ["seed", "realisation", "map"]


@dataclass(frozen=True, kw_only=True)
class Extent:
    """Seeds, realisations and maps on which a condition is run.

    Args:
        draws: (seed, realisation, maps) of each draw of λ; `maps` is the number of maps
            from the start of the split.
    """

    draws: tuple[tuple[int, int, int], ...]

    @classmethod
    def product(cls, seeds: Iterable[int], realisations: int, maps: int) -> "Extent":
        """Return the extent with the same maps for each seed and realisation."""
        draws = [(seed, r, maps) for seed in seeds for r in range(realisations)]
        return cls(draws=tuple(draws))

    @property
    def seeds(self) -> tuple[int, ...]:
        """Root seeds."""
        return tuple(dict.fromkeys(seed for seed, _, _ in self.draws))

    @property
    def maps(self) -> int:
        """Maximum number of maps of a draw."""
        return max(maps for _, _, maps in self.draws)

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return sum(maps for _, _, maps in self.draws)

    def union(self, other: "Extent") -> "Extent":
        """Return the union of two extents."""
        n_maps: dict[tuple[int, int], int] = {}
        for seed, realisation, maps in (*self.draws, *other.draws):
            draw = (seed, realisation)
            n_maps[draw] = max(maps, n_maps.get(draw, 0))
        draws = [(*draw, maps) for draw, maps in n_maps.items()]
        return Extent(draws=tuple(draws))


Conditions = Mapping[str, tuple[Condition, Extent]]  # by id, each with its extent


@dataclass(frozen=True, kw_only=True)
class Unit:
    """One batch of episodes.

    Args:
        condition: condition of all episodes.
        seed: root seed.
        realisation: index of the draw of λ.
        maps: indices of maps of the condition's split, all of one block.
        record: data that are stored in addition to rows; see `Suite`.
        is_first_unit: whether this is the first unit of its condition.
        metrics: metrics in addition to the built-in ones.
    """

    condition: Condition
    seed: int
    realisation: int
    maps: tuple[int, ...]
    record: Record = "none"
    is_first_unit: bool = False
    metrics: tuple[Part, ...] = ()

    @property
    def block(self) -> int:
        """Index of the block."""
        return self.maps[0] // BLOCK_MAPS

    def shard(self, of: int) -> Shard:
        """Return the shard that contains the unit if a run has `of` shards.

        The shard depends only on the unit and `of`. Extending a run therefore moves no
        unit to another shard. Consecutive blocks, realisations and seeds of a condition
        are assigned to consecutive shards. The id of the condition selects the first
        shard.
        """
        first = int(self.condition.id, 16)
        turn = first + self.seed + self.realisation + self.block
        return Shard(index=turn % of + 1, of=of)

    @property
    def name(self) -> str:
        """Name, unique among the units of its condition."""
        return f"{self.seed}-{self.realisation}-{self.block:05d}"

    @property
    def steps_path(self) -> Path:
        """Path of the unit's steps in a run folder; each condition is a partition."""
        return steps_path(self.condition.id, self.name)

    def recording_path(self, index: int, suffix: str = ".npz") -> Path:
        """Return the path of an episode's recording in a run folder.

        The Rerun viewer (suffix `.rrd`) shows the file's name, and warns of characters
        other than letters, digits, `_` and `-`. They are replaced by `-`.

        Args:
            index: index of the episode in the unit.
            suffix: suffix of the file.
        """
        labels = self.condition.labels
        words = [
            labels["planner"],
            labels["risk"],
            labels["scenario"],
            self.condition.id[:8],
            f"{self.seed}",
            f"{self.realisation}",
            f"{self.maps[index]:05d}",
        ]
        cleaned = [re.sub(r"[^A-Za-z0-9_-]+", "-", word) for word in words]
        stem = "-".join(cleaned)
        return Path("playback", f"{stem}{suffix}")

    def possibly_recorded(self) -> list[int]:
        """Return the indices of the episodes that are recorded if all of them fail."""
        return self.recorded([False] * len(self.maps))

    def recorded(self, succeeded: Sequence[bool]) -> list[int]:
        """Return the indices of the episodes that are recorded.

        Args:
            succeeded: whether each episode succeeded.
        """
        indices = range(len(self.maps))
        if self.record == "all":
            return list(indices)
        first = {0} if self.is_first_unit else set()
        if self.record == "first":
            return list(first)
        if self.record == "failures":
            failed = {index for index in indices if not succeeded[index]}
            return sorted(first | failed)
        return []


def steps_path(condition_id: str, name: str) -> Path:
    """Return the path of a unit's steps in a run folder."""
    return Path("steps", f"condition={condition_id}", f"{name}.parquet")


def units(
    conditions: Conditions, record: Record = "none", metrics: Sequence[Part] = ()
) -> list[Unit]:
    """Split conditions into units of work, ordered so that predictions are reused.

    Units of blind planners come last in their block. They are the shortest and need no
    prediction, so that they use the least memory. A worker's memory is measured after
    its first unit; a worker whose memory grows much thereafter is replaced, which takes
    long.

    Args:
        conditions: conditions by id, each with its extent.
        record: data that are stored in addition to rows.
        metrics: metrics in addition to the built-in ones.
    """
    units_: list[Unit] = []
    for condition, extent in conditions.values():
        units_ += _blocks(condition, extent, record, tuple(metrics))
    order = {condition_id: index for index, condition_id in enumerate(conditions)}

    def run_order(unit: Unit) -> tuple[Any, ...]:
        condition = unit.condition
        block = (condition.data, condition.scenario, unit.block)
        prediction = (condition.blind, condition.model.part)
        draw = (unit.seed, unit.realisation)
        return (*block, *prediction, *draw, order[condition.id])

    return sorted(units_, key=run_order)


def in_table_order(units_: Iterable[Unit], conditions: Conditions) -> list[Unit]:
    """Return units in the order of tables, which differs from the order of running."""
    order = {condition_id: index for index, condition_id in enumerate(conditions)}

    def table_order(unit: Unit) -> tuple[int, ...]:
        index = order[unit.condition.id]
        return (index, unit.seed, unit.realisation, unit.block)

    return sorted(units_, key=table_order)


def unit_names(units_: Sequence[Unit]) -> Callable[[Unit], str]:
    """Return a function that names a unit by its maps and the labels that differ.

    Args:
        units_: all units that the names must distinguish.
    """
    conditions = {unit.condition.id: unit.condition for unit in units_}
    labels = condition_names(list(conditions.values()))
    names = dict(zip(conditions, labels, strict=True))
    draws = [name for name in ("seed", "realisation") if _n_values(units_, name) > 1]

    def name(unit: Unit) -> str:
        words = [names[unit.condition.id]]
        words += [f"{draw} {getattr(unit, draw)}" for draw in draws]
        first = unit.maps[0]
        last = unit.maps[-1]
        if first == last:
            words.append(f"map {first}")
        else:
            words.append(f"maps {first} to {last}")
        return ", ".join(words)

    return name


def _n_values(units_: Sequence[Unit], name: str) -> int:
    return len({getattr(unit, name) for unit in units_})


def _blocks(
    condition: Condition, extent: Extent, record: Record, metrics: tuple[Part, ...]
) -> Iterator[Unit]:
    """Yield the units of a condition: one for each draw of λ and block of maps."""
    is_first_unit = True
    for seed, realisation, maps in extent.draws:
        for start in range(0, maps, BLOCK_MAPS):
            end = min(start + BLOCK_MAPS, maps)
            yield Unit(
                condition=condition,
                seed=seed,
                realisation=realisation,
                maps=tuple(range(start, end)),
                record=record,
                is_first_unit=is_first_unit,
                metrics=metrics,
            )
            is_first_unit = False
