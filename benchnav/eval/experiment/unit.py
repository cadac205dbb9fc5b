"""Units of work: a condition's block of maps under one seed and realisation, run as one batch."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from benchnav.core.store import Shard
from benchnav.eval.experiment.condition import Condition
from benchnav.eval.experiment.keep import Keep

BLOCK_MAPS = 50


@dataclass(frozen=True, kw_only=True)
class Extent:
    """How often a condition is run.

    Args:
        draws: (seed, realisation, maps): under each seed and draw of λ the first so
            many maps of the split.
    """

    draws: tuple[tuple[int, int, int], ...]

    @classmethod
    def product(cls, seeds: Iterable[int], realisations: int, maps: int) -> "Extent":
        """The same maps under every seed and realisation."""
        return cls(draws=tuple((seed, r, maps) for seed in seeds for r in range(realisations)))

    @property
    def seeds(self) -> tuple[int, ...]:
        """Root seeds."""
        return tuple(dict.fromkeys(seed for seed, _, _ in self.draws))

    @property
    def maps(self) -> int:
        """The most maps that any draw has."""
        return max(maps for _, _, maps in self.draws)

    def union(self, other: "Extent") -> "Extent":
        """What is in either, and no more."""
        most: dict[tuple[int, int], int] = {}
        for seed, realisation, maps in (*self.draws, *other.draws):
            most[seed, realisation] = max(maps, most.get((seed, realisation), 0))
        return Extent(draws=tuple((*key, maps) for key, maps in most.items()))

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {"seeds": list(self.seeds), "draws": [list(draw) for draw in self.draws]}

    @classmethod
    def from_dict(cls, about: Mapping[str, Any]) -> "Extent":
        """Reads what `to_dict` gave; other keys are left alone."""
        return cls(draws=tuple((seed, realisation, count) for seed, realisation, count in about["draws"]))


@dataclass(frozen=True, kw_only=True)
class Unit:
    """One batch of episodes.

    Args:
        condition: what is run.
        seed: root seed.
        realisation: which draw of λ.
        maps: which maps of the condition's split; of one block.
        keep: what is kept beside rows; a unit that does not begin its condition has no first map.
    """

    condition: Condition
    seed: int
    realisation: int
    maps: tuple[int, ...]
    keep: Keep = field(default_factory=Keep)

    @property
    def block(self) -> int:
        """Number of the block."""
        return self.maps[0] // BLOCK_MAPS

    def share(self, of: int) -> Shard:
        """The share that the unit is in, where so many machines make a run apart.

        It depends on the unit and that number alone, so that an extended run leaves every unit where it was.
        Blocks, realisations and seeds of a condition go to the shares in turn; the share that a condition begins with
        is drawn by its id, which is a digest.
        """
        turn = int(self.condition.id, 16) + self.seed + self.realisation + self.block
        return Shard(index=turn % of + 1, of=of)

    @property
    def path(self) -> Path:
        """The unit's file in a run folder."""
        return Path("units", self.condition.id, self._file)

    @property
    def steps_path(self) -> Path:
        """The file of the unit's steps in a run folder, one partition a condition."""
        return Path("steps", f"condition={self.condition.id}", self._file)

    @property
    def _file(self) -> str:
        return f"{self.seed}-{self.realisation}-{self.block:05d}.parquet"

    def stem(self, member: int) -> str:
        """A name for files of one of the unit's episodes."""
        labels = self.condition.labels
        words = [labels[name] for name in ("planner", "risk", "scenario")]
        words += [self.condition.id[:8], f"{self.seed}", f"{self.realisation}", f"{self.maps[member]:05d}"]
        return "+".join("".join(c if c.isalnum() or c in "._-" else "_" for c in word) for word in words)


def units(conditions: Mapping[str, tuple[Condition, Extent]], keep: Keep) -> list[Unit]:
    """Cuts conditions into units of work, those that share a prediction next to one another.

    Those that look at no prediction are the shortest and come last of their block: a worker's memory is measured
    after its first unit, and one whose memory grows much thereafter is replaced, which takes long.

    Args:
        conditions: by id, with how often each is run.
        keep: what is kept beside rows.
    """
    later = replace(keep, record="none") if keep.record == "first" else keep
    made = [
        replace(unit, keep=later if place else keep)
        for condition, extent in conditions.values()
        for place, unit in enumerate(_blocks(condition, extent))
    ]
    order = {condition_id: place for place, condition_id in enumerate(conditions)}
    return sorted(
        made,
        key=lambda u: (
            u.condition.data, u.condition.scenario, u.block, u.condition.blind, u.condition.model.part, u.seed,
            u.realisation, order[u.condition.id],
        ),
    )  # fmt: skip


def in_table_order(made: Iterable[Unit], conditions: Mapping[str, Any]) -> list[Unit]:
    """Units in the order in which tables list them, whatever the order they were run in."""
    order = {condition_id: place for place, condition_id in enumerate(conditions)}
    return sorted(made, key=lambda u: (order[u.condition.id], u.seed, u.realisation, u.block))


def _blocks(condition: Condition, extent: Extent) -> Iterator[Unit]:
    for seed, realisation, maps in extent.draws:
        for start in range(0, maps, BLOCK_MAPS):
            block = tuple(range(start, min(start + BLOCK_MAPS, maps)))
            yield Unit(condition=condition, seed=seed, realisation=realisation, maps=block)
