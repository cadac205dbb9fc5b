"""Units of work: a trial's block of instances under one seed and realisation, run as one batch."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchnav.eval.trial import Trial

BLOCK_INSTANCES = 20


@dataclass(frozen=True, kw_only=True)
class Extent:
    """How often a trial is run.

    Args:
        seeds: root seeds.
        realisations: draws of the world's luck for each seed.
        instances: the first so many of the split.
    """

    seeds: tuple[int, ...]
    realisations: int
    instances: int

    def union(self, other: "Extent") -> "Extent":
        """The least extent that holds both."""
        return Extent(
            seeds=tuple(dict.fromkeys((*self.seeds, *other.seeds))),
            realisations=max(self.realisations, other.realisations),
            instances=max(self.instances, other.instances),
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self) | {"seeds": list(self.seeds)}

    @classmethod
    def from_dict(cls, about: Mapping[str, Any]) -> "Extent":
        """Reads what `to_dict` gave; other keys are left alone."""
        return cls(
            seeds=tuple(about["seeds"]), realisations=about["realisations"], instances=about["instances"]
        )


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
    for seed in extent.seeds:
        for realisation in range(extent.realisations):
            for start in range(0, extent.instances, BLOCK_INSTANCES):
                block = tuple(range(start, min(start + BLOCK_INSTANCES, extent.instances)))
                yield Unit(trial=trial, seed=seed, realisation=realisation, instances=block)


def _first_of_each_planner(every: Iterable[Unit]) -> Iterator[Unit]:
    seen = set()
    for unit in every:
        if unit.trial.planner.label not in seen:
            seen.add(unit.trial.planner.label)
            yield unit
