"""Shares of work that several machines do apart, as they are written on the command line: 2/5."""

import re
from dataclasses import dataclass
from typing import Any

from benchnav.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class Share:
    """One share of some work.

    Args:
        index: which one, from 1 on.
        of: how many there are.
    """

    index: int
    of: int

    def __post_init__(self) -> None:
        """Refuses a share that is none of them."""
        if not 1 <= self.index <= self.of:
            raise ConfigError(f"Expected `shard` I/N with 1 ≤ I ≤ N, got {self}.")

    def __str__(self) -> str:
        """As it is written on the command line."""
        return f"{self.index}/{self.of}"

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {"index": self.index, "of": self.of}


def read_share(text: str) -> Share | None:
    """Reads a share as it is written on the command line; None of an empty text, which means all.

    Raises:
        ConfigError: it is no such text.
    """
    if not text:
        return None
    numbers = re.fullmatch(r"(\d+)/(\d+)", text)
    if numbers is None:
        raise ConfigError(f"Expected `shard` I/N, such as 2/5, got {text!r}.")
    return Share(index=int(numbers[1]), of=int(numbers[2]))
