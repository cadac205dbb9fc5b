"""Units of work: a trial's block of instances under one seed and realisation, run as one batch."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchnav.eval.trial import Trial

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
        recorded: how many of them, from the first on, are recorded for playback.
    """

    trial: Trial
    seed: int
    realisation: int
    instances: tuple[int, ...]
    recorded: int = 0

    @property
    def block(self) -> int:
        """Number of the block."""
        return self.instances[0] // BLOCK_INSTANCES

    @property
    def path(self) -> Path:
        """The unit's file in a run folder."""
        return Path("units", self.trial.id, f"{self.seed}-{self.realisation}-{self.block:05d}.parquet")

    def stem(self, member: int) -> str:
        """A name for files of one of the unit's episodes."""
        labels = self.trial.labels
        words = [labels[name] for name in ("planner", "risk", "scenario")]
        words += [self.trial.id[:8], f"{self.seed}", f"{self.realisation}", f"{self.instances[member]:05d}"]
        return "+".join("".join(c if c.isalnum() or c in "._-" else "_" for c in word) for word in words)


def units(trials: Mapping[str, tuple[Trial, Extent]], recorded: int) -> list[Unit]:
    """Cuts trials into units of work, those that share a prediction next to one another.

    Args:
        trials: by id, with how often each is run.
        recorded: instances to record in the first trial of each planner.
    """
    every = [unit for trial, extent in trials.values() for unit in _blocks(trial, extent)]
    recorders = {id(unit) for unit in _first_of_each_planner(every)}
    made = [
        Unit(
            trial=unit.trial, seed=unit.seed, realisation=unit.realisation, instances=unit.instances,
            recorded=min(recorded, len(unit.instances)) if id(unit) in recorders else 0,
        )
        for unit in every
    ]  # fmt: skip
    order = {trial_id: place for place, trial_id in enumerate(trials)}
    return sorted(
        made,
        key=lambda u: (
            u.trial.data, u.trial.scenario, u.block, u.trial.model.part, u.seed, u.realisation,
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


def _first_of_each_planner(every: Iterable[Unit]) -> Iterator[Unit]:
    seen = set()
    for unit in every:
        if unit.trial.planner.label not in seen:
            seen.add(unit.trial.planner.label)
            yield unit
