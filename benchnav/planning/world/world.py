"""World: what traversability does to a robot, as a value; and the presets of world and rules."""

from collections.abc import Mapping
from dataclasses import dataclass

from benchnav.errors import ConfigError
from benchnav.planning.free_space import Rules

NOISES = ("resampled", "stored")


@dataclass(frozen=True, kw_only=True)
class World:
    """What λ does; the defaults are the paper's. Low λ slows a robot and ends nothing.

    Args:
        noise: `resampled` at each step, or `stored`, the map's own realised λ.
        time_budget_s: T; an episode that is not at the goal by then has failed.
    """

    noise: str = "resampled"
    time_budget_s: float = 100.0

    def __post_init__(self) -> None:
        """Refuses worlds in which no episode can run."""
        if self.noise == "frozen":
            raise ConfigError(
                "Expected `noise` 'resampled' or 'stored', got 'frozen', which is now 'stored'."
            )
        if self.noise not in NOISES:
            raise ConfigError(f"Expected `noise` {' or '.join(map(repr, NOISES))}, got {self.noise!r}.")
        if not 0 < self.time_budget_s < float("inf"):
            raise ConfigError(f"Expected `time_budget_s` > 0 and finite, got {self.time_budget_s}.")

    def steps(self, dt_s: float) -> int:
        """Number of time steps in the time budget.

        Raises:
            ConfigError: there is none.
        """
        steps = round(self.time_budget_s / dt_s)
        if steps < 1:
            raise ConfigError(
                f"Expected `time_budget_s` of at least one time step of {dt_s:g} s, got {self.time_budget_s}."
            )
        return steps


@dataclass(frozen=True, kw_only=True)
class Preset:
    """A world, and the rules of a task that go with it.

    Args:
        world: what λ does.
        rules: free space, least λ̂, goal radius.
    """

    world: World
    rules: Rules


PRESETS: Mapping[str, Preset] = {"paper": Preset(world=World(), rules=Rules())}
