"""Units of work: a trial's block of instances under one seed and realisation, run as one batch."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from benchnav.eval.keep import Keep
from benchnav.eval.trial import Trial
from benchnav.share import Share

BLOCK_INSTANCES = 50


@dataclass(frozen=True, kw_only=True)
class Extent:
    """How often a trial is run.

    Args:
        draws: (seed, realisation, instances): under each seed and draw of the world's luck the first so
            many instances of the split.
    """

    draws: tuple[tuple[int, int, int], ...]

    @classmethod
    def product(cls, seeds: Iterable[int], realisations: int, instances: int) -> "Extent":
        """The same instances under every seed and realisation."""
        return cls(draws=tuple((seed, r, instances) for seed in seeds for r in range(realisations)))

    @property
    def seeds(self) -> tuple[int, ...]:
        """Root seeds."""
        return tuple(dict.fromkeys(seed for seed, _, _ in self.draws))

    @property
    def instances(self) -> int:
        """The most instances that any draw has."""
        return max(instances for _, _, instances in self.draws)

    def union(self, other: "Extent") -> "Extent":
        """What is in either, and no more."""
        most: dict[tuple[int, int], int] = {}
        for seed, realisation, instances in (*self.draws, *other.draws):
            most[seed, realisation] = max(instances, most.get((seed, realisation), 0))
        return Extent(draws=tuple((*key, instances) for key, instances in most.items()))

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
        trial: what is run.
        seed: root seed.
        realisation: which draw of the world's luck.
        instances: which instances of the trial's split; of one block.
        keep: what is kept beside rows; a unit that does not begin its trial has no first instance.
    """

    trial: Trial
    seed: int
    realisation: int
    instances: tuple[int, ...]
    keep: Keep = field(default_factory=Keep)

    @property
    def block(self) -> int:
        """Number of the block."""
        return self.instances[0] // BLOCK_INSTANCES

    def share(self, of: int) -> Share:
        """The share that the unit is in, where so many machines make a run apart.

        It depends on the unit and that number alone, so that an extended run leaves every unit where it was.
        Blocks, realisations and seeds of a trial go to the shares in turn; the share that a trial begins with is
        drawn by its id, which is a digest.
        """
        turn = int(self.trial.id, 16) + self.seed + self.realisation + self.block
        return Share(index=turn % of + 1, of=of)

    @property
    def path(self) -> Path:
        """The unit's file in a run folder."""
        return Path("units", self.trial.id, self._file)

    @property
    def steps_path(self) -> Path:
        """The file of the unit's steps in a run folder, one partition a trial."""
        return Path("steps", f"trial={self.trial.id}", self._file)

    @property
    def _file(self) -> str:
        return f"{self.seed}-{self.realisation}-{self.block:05d}.parquet"

    def stem(self, member: int) -> str:
        """A name for files of one of the unit's episodes."""
        labels = self.trial.labels
        words = [labels[name] for name in ("planner", "risk", "scenario")]
        words += [self.trial.id[:8], f"{self.seed}", f"{self.realisation}", f"{self.instances[member]:05d}"]
        return "+".join("".join(c if c.isalnum() or c in "._-" else "_" for c in word) for word in words)


def units(trials: Mapping[str, tuple[Trial, Extent]], keep: Keep) -> list[Unit]:
    """Cuts trials into units of work, those that share a prediction next to one another.

    Those that look at no prediction are the shortest and come last of their block: a worker's memory is measured
    after its first unit, and one whose memory grows much thereafter is replaced, which takes long.

    Args:
        trials: by id, with how often each is run.
        keep: what is kept beside rows.
    """
    later = replace(keep, record="none") if keep.record == "first" else keep
    made = [
        replace(unit, keep=later if place else keep)
        for trial, extent in trials.values()
        for place, unit in enumerate(_blocks(trial, extent))
    ]
    order = {trial_id: place for place, trial_id in enumerate(trials)}
    return sorted(
        made,
        key=lambda u: (
            u.trial.data, u.trial.scenario, u.block, u.trial.blind, u.trial.model.part, u.seed, u.realisation,
            order[u.trial.id],
        ),
    )  # fmt: skip


def in_table_order(made: Iterable[Unit], trials: Mapping[str, Any]) -> list[Unit]:
    """Units in the order in which tables list them, whatever the order they were run in."""
    order = {trial_id: place for place, trial_id in enumerate(trials)}
    return sorted(made, key=lambda u: (order[u.trial.id], u.seed, u.realisation, u.block))


def _blocks(trial: Trial, extent: Extent) -> Iterator[Unit]:
    for seed, realisation, instances in extent.draws:
        for start in range(0, instances, BLOCK_INSTANCES):
            block = tuple(range(start, min(start + BLOCK_INSTANCES, instances)))
            yield Unit(trial=trial, seed=seed, realisation=realisation, instances=block)
