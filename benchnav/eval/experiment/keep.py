"""What is kept of episodes beside their rows: recordings and steps."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Literal, cast, get_args

from benchnav.core.errors import ConfigError

Record = Literal["none", "failures", "first", "all"]
# What a unit was run for that was asked for failures and for the first episode.
_BOTH = "failures and first"
Steps = Literal["none", "recorded", "all"]


@dataclass(frozen=True, kw_only=True)
class Keep:
    """Which episodes are recorded, and of which the steps are stored.

    Args:
        record: `failures` are episodes that did not succeed; `first` is the first map of each condition,
            under its first seed and draw of λ.
        steps: `recorded` stores the steps of recorded episodes alone.
    """

    record: Record = "none"
    steps: Steps = "none"

    def __post_init__(self) -> None:
        """Refuses what is no choice."""
        for name, choices in (("record", get_args(Record)), ("steps", get_args(Steps))):
            if getattr(self, name) not in (*choices, _BOTH):
                raise ConfigError(
                    f"Expected `{name}` as {', '.join(choices[:-1])} or {choices[-1]}, got {getattr(self, name)!r}."
                )

    def watched(self, count: int) -> range:
        """Which of a unit's episodes may come to be recorded, known before they are run.

        Args:
            count: episodes of the unit.
        """
        return range({"none": 0, "first": 1}.get(self.record, count))

    def recorded(self, succeeded: Sequence[bool]) -> list[int]:
        """Which of a unit's episodes are recorded, by how they ended."""
        return _chosen(self.record, succeeded)

    def with_steps(self, succeeded: Sequence[bool]) -> list[int]:
        """Of which of a unit's episodes the steps are stored, by how they ended."""
        return _chosen(self._stored, succeeded)

    def covers(self, other: "Keep") -> bool:
        """Whether a unit that was run to keep this has all that the other asks for."""
        return _includes(self.record, other.record) and _includes(self._stored, other._stored)

    def joined(self, other: "Keep") -> "Keep":
        """What has all that either asks for."""
        record, stored = _joined(self.record, other.record), _joined(self._stored, other._stored)
        if stored == record:
            return Keep(record=record, steps="recorded" if stored != "none" else "none")
        return Keep(record=record, steps="none" if stored == "none" else "all")

    @property
    def _stored(self) -> Record:
        return self.record if self.steps == "recorded" else self.steps

    def to_dict(self) -> dict[str, str]:
        """Plain data for JSON."""
        return asdict(self)


def _chosen(rule: str, succeeded: Sequence[bool]) -> list[int]:
    """Which episodes of a unit a rule means; the unit is the first of its condition where it says `first`."""
    every = range(len(succeeded))
    if rule in ("failures", _BOTH):
        return [member for member in every if not succeeded[member] or (rule == _BOTH and member == 0)]
    return list(every[: {"none": 0, "first": 1, "all": None}[rule]])


def _joined(rule: Record, other: Record) -> Record:
    if _includes(rule, other):
        return rule
    return other if _includes(other, rule) else cast(Record, _BOTH)


def _includes(rule: str, other: str) -> bool:
    return rule == "all" or other in ("none", rule) or (rule == _BOTH and other in ("failures", "first"))
