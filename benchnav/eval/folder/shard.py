"""Shards: the shares of a run that several machines make apart, to be merged afterwards.

Which shard a unit is in depends on the unit and the number of shards alone: not on what else is run, in which
order, or what is finished. An extended run therefore leaves every unit where it was.
"""

import re
from dataclasses import dataclass
from typing import Any

from benchnav.errors import ConfigError
from benchnav.eval.unit import Unit


@dataclass(frozen=True, kw_only=True)
class Shard:
    """One share of a run.

    Args:
        index: which one, from 1 on.
        of: how many there are.
    """

    index: int
    of: int

    def __post_init__(self) -> None:
        """Refuses a shard that is none of them."""
        if not 1 <= self.index <= self.of:
            raise ConfigError(f"Expected `shard` I/N with 1 ≤ I ≤ N, got {self}.")

    def __str__(self) -> str:
        """As it is written on the command line."""
        return f"{self.index}/{self.of}"

    def has(self, unit: Unit) -> bool:
        """Whether a unit is in this shard."""
        return shard_of(unit, self.of) == self

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {"index": self.index, "of": self.of}


def read_shard(text: str) -> Shard | None:
    """Reads a shard as it is written on the command line, `2/5`; None of an empty text, which means all.

    Raises:
        ConfigError: it is no such text.
    """
    if not text:
        return None
    numbers = re.fullmatch(r"(\d+)/(\d+)", text)
    if numbers is None:
        raise ConfigError(f"Expected `shard` I/N, such as 2/5, got {text!r}.")
    return Shard(index=int(numbers[1]), of=int(numbers[2]))


def shard_of(unit: Unit, of: int) -> Shard:
    """The shard that a unit is in, of so many.

    Blocks, realisations and seeds of a trial go to the shards in turn; the shard that a trial begins with is
    drawn by its id, which is a digest.
    """
    turn = int(unit.trial.id, 16) + unit.seed + unit.realisation + unit.block
    return Shard(index=turn % of + 1, of=of)
