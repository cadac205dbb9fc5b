"""Units of work: a condition's block of maps under one seed and realisation, run as one
batch.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from benchnav.core.registry import Part
from benchnav.core.store import Shard
from benchnav.eval.experiment.condition import Condition, condition_names
from benchnav.eval.experiment.suite import Record

BLOCK_MAPS = 50
# columns by which an episode of a condition is known
DRAW = [
    "seed",
    "realisation",
    "map",
]


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
        return cls(
            draws=tuple((seed, r, maps) for seed in seeds for r in range(realisations))
        )

    @property
    def seeds(self) -> tuple[int, ...]:
        """Root seeds."""
        return tuple(dict.fromkeys(seed for seed, _, _ in self.draws))

    @property
    def maps(self) -> int:
        """The most maps that any draw has."""
        return max(maps for _, _, maps in self.draws)

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return sum(maps for _, _, maps in self.draws)

    def union(self, other: "Extent") -> "Extent":
        """What is in either, and no more."""
        most: dict[tuple[int, int], int] = {}
        for seed, realisation, maps in (*self.draws, *other.draws):
            most[seed, realisation] = max(maps, most.get((seed, realisation), 0))
        return Extent(draws=tuple((*key, maps) for key, maps in most.items()))


Conditions = Mapping[str, tuple[Condition, Extent]]  # by id, with how often each is run


@dataclass(frozen=True, kw_only=True)
class Unit:
    """One batch of episodes.

    Args:
        condition: what is run.
        seed: root seed.
        realisation: which draw of λ.
        maps: which maps of the condition's split; of one block.
        record: what is kept beside rows: the `steps` of all episodes; recordings of the
            `first` map of the condition, of `failures`, or of `all`.
        leads: the unit begins its condition, so that its first map is the condition's.
        metrics: metrics that its rows have besides those that every run has.
    """

    condition: Condition
    seed: int
    realisation: int
    maps: tuple[int, ...]
    record: Record = "none"
    leads: bool = False
    metrics: tuple[Part, ...] = ()

    @property
    def block(self) -> int:
        """Number of the block."""
        return self.maps[0] // BLOCK_MAPS

    def shard(self, of: int) -> Shard:
        """The shard that the unit is in, where so many machines make a run apart.

        It depends on the unit and that number alone, so that an extended run leaves
        every unit where it was. Blocks, realisations and seeds of a condition go to the
        shards in turn; the one that a condition begins with is drawn by its id, which
        is a digest.
        """
        turn = int(self.condition.id, 16) + self.seed + self.realisation + self.block
        return Shard(index=turn % of + 1, of=of)

    @property
    def name(self) -> str:
        """Its name among the units of its condition."""
        return f"{self.seed}-{self.realisation}-{self.block:05d}"

    @property
    def steps_path(self) -> Path:
        """The file of the unit's steps in a run folder, one partition a condition."""
        return steps_path(self.condition.id, self.name)

    def recording_path(self, member: int, suffix: str = ".npz") -> Path:
        """The file of one episode's recording in a run folder; `.rrd` for the viewer's,
        which is made of it.

        The viewer names what it opens by the file, and takes letters, digits, `_` and
        `-` without a warning; all else becomes `-`.
        """
        labels = self.condition.labels
        words = [labels[name] for name in ("planner", "risk", "scenario")]
        words += [
            self.condition.id[:8],
            f"{self.seed}",
            f"{self.realisation}",
            f"{self.maps[member]:05d}",
        ]
        return Path(
            "playback",
            "-".join(re.sub(r"[^A-Za-z0-9_-]+", "-", word) for word in words) + suffix,
        )

    def watched(self) -> list[int]:
        """Which episodes may come to be recorded, known before they are run."""
        return self.recorded([False] * len(self.maps))

    def recorded(self, succeeded: Sequence[bool]) -> list[int]:
        """Which episodes are recorded, by how they ended."""
        first = [0] if self.leads else []
        failed = [member for member, success in enumerate(succeeded) if not success]
        chosen = {
            "first": first,
            "failures": sorted({*first, *failed}),
            "all": list(range(len(self.maps))),
        }
        return chosen.get(self.record, [])


def steps_path(condition_id: str, name: str) -> Path:
    """Return the file of a unit's steps in a run folder, from its condition and its
    name.
    """
    return Path("steps", f"condition={condition_id}", f"{name}.parquet")


def units(
    conditions: Conditions, record: Record = "none", metrics: Sequence[Part] = ()
) -> list[Unit]:
    """Cuts conditions into units of work, those that share a prediction next to one
    another.

    Those that look at no prediction are the shortest and come last of their block: a
    worker's memory is measured after its first unit, and one whose memory grows much
    thereafter is replaced, which takes long.

    Args:
        conditions: what is run.
        record: what is kept beside rows.
        metrics: metrics that rows have besides those that every run has.
    """
    made = [
        replace(unit, metrics=tuple(metrics))
        for condition, extent in conditions.values()
        for unit in _blocks(condition, extent, record)
    ]
    order = {condition_id: place for place, condition_id in enumerate(conditions)}
    return sorted(
        made,
        key=lambda u: (
            u.condition.data,
            u.condition.scenario,
            u.block,
            u.condition.blind,
            u.condition.model.part,
            u.seed,
            u.realisation,
            order[u.condition.id],
        ),
    )


def in_table_order(made: Iterable[Unit], conditions: Conditions) -> list[Unit]:
    """Units in the order in which tables list them, whatever the order they were run
    in.
    """
    order = {condition_id: place for place, condition_id in enumerate(conditions)}
    return sorted(
        made, key=lambda u: (order[u.condition.id], u.seed, u.realisation, u.block)
    )


def unit_names(known: Sequence[Unit]) -> Callable[[Unit], str]:
    """Names units among others by scenario, planner, risk setting and what else
    differs, and by their maps.

    Args:
        known: all that are to be distinguished.
    """
    conditions = {unit.condition.id: unit.condition for unit in known}
    labels = condition_names(list(conditions.values()))
    names = dict(zip(conditions, labels, strict=True))
    draws = [
        name
        for name in ("seed", "realisation")
        if len({getattr(unit, name) for unit in known}) > 1
    ]

    def name(unit: Unit) -> str:
        words = [names[unit.condition.id]]
        words += [f"{draw} {getattr(unit, draw)}" for draw in draws]
        first, last = unit.maps[0], unit.maps[-1]
        return ", ".join(
            [*words, f"map {first}" if first == last else f"maps {first} to {last}"]
        )

    return name


def _blocks(condition: Condition, extent: Extent, record: Record) -> Iterator[Unit]:
    leads = True
    for seed, realisation, maps in extent.draws:
        for start in range(0, maps, BLOCK_MAPS):
            block = tuple(range(start, min(start + BLOCK_MAPS, maps)))
            yield Unit(
                condition=condition,
                seed=seed,
                realisation=realisation,
                maps=block,
                record=record,
                leads=leads,
            )
            leads = False
