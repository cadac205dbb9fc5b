"""World: what traversability does to a robot, as a value; the presets of world and
rules; and places.

Letters in shapes: B episodes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.copula import KERNELS
from benchnav.core.errors import ConfigError, expect
from benchnav.core.settings import check_known, plain, read
from benchnav.planning.free_space import FreeSpace, Immobile, Rules

NOISES = ("resampled", "stored", "frozen")

MAX_STEPS = 10**6  # of an episode; a day at 0.1 s is 864 000

_BUDGETS = ("time_budget_s", "time_budget_ratio")


@dataclass(frozen=True, kw_only=True)
class Endpoints(Batch):
    """Where episodes begin and end.

    Args:
        start_m: (x, y), shape [B, 2].
        goal_m: (x, y), shape [B, 2].
        reference_time_s: grid reference times at 1 m/s, NaN where there is none, shape
            [B].
    """

    start_m: Tensor
    goal_m: Tensor
    reference_time_s: Tensor


@dataclass(frozen=True, kw_only=True)
class World:
    """What λ does; the defaults are the paper's, where low λ slows a robot and ends
    nothing.

    Args:
        noise: `resampled` at each step; `stored`, the map's own realised λ; or
            `frozen`, drawn once an episode as a correlated field, each cell with its
            own distribution.
        correlation_m: ℓ of frozen noise: cells at distance d have the correlation
            exp(−d²/2ℓ²) before each takes its own distribution.
        kernel: of frozen noise: `gaussian`, or `matern32`, a rougher field, whose
            correlation is the same at distance ℓ; beliefs go on believing the Gaussian.
        immobile: what ends an episode as immobilised; None for nothing.
        time_budget_s: T; an episode that is not at the goal by then has failed.
        time_budget_ratio: T in multiples of the map's grid reference time at the
            robot's top speed, instead of `time_budget_s`.
        preset: the entry of `PRESETS` that the world was derived from, whose rules go
            with it.
    """

    noise: str = "resampled"
    correlation_m: float = 1.5
    kernel: str = KERNELS[0]
    immobile: Immobile | None = None
    time_budget_s: float | None = 100.0
    time_budget_ratio: float | None = None
    preset: str = field(default="paper", compare=False, repr=False)

    def __post_init__(self) -> None:
        """Refuses worlds in which no episode can run."""
        expect(
            self.noise in NOISES,
            f"`noise` {', '.join(map(repr, NOISES[:-1]))} or {NOISES[-1]!r}, got "
            f"{self.noise!r}.",
        )
        expect(
            self.kernel in KERNELS,
            f"`kernel` {' or '.join(map(repr, KERNELS))}, got {self.kernel!r}.",
        )
        expect(
            0 <= self.correlation_m < float("inf"),
            f"`correlation_m` ≥ 0 and finite, got {self.correlation_m}.",
        )
        budgets = {
            name: getattr(self, name)
            for name in _BUDGETS
            if getattr(self, name) is not None
        }
        expect(
            len(budgets) == 1,
            "either `time_budget_s` or `time_budget_ratio`, got "
            f"{self.time_budget_s} and {self.time_budget_ratio}.",
        )
        for name, value in budgets.items():
            expect(0 < value < float("inf"), f"`{name}` > 0 and finite, got {value}.")

    @classmethod
    def paper(cls, **changes: Any) -> "World":
        """Return the paper's world: λ is resampled at each step; low λ slows a robot
        and ends nothing.

        Args:
            **changes: fields with other values than the preset's.
        """
        return _changed_preset("paper", changes)

    @classmethod
    def stakes(cls, **changes: Any) -> "World":
        """Return the world in which λ stays the same during an episode and low λ
        immobilises a robot.

        Args:
            **changes: fields with other values than the preset's.
        """
        return _changed_preset("stakes", changes)

    @property
    def spec(self) -> dict[str, Any]:
        """The preset by name, and all fields that differ from it, as `read_world` takes
        them.
        """
        base, now = plain(PRESETS[self.preset].world), plain(self)
        return {
            "preset": self.preset,
            **{name: value for name, value in now.items() if value != base[name]},
        }

    def budget_s(self, reference_time_s: Tensor, top_speed_mps: float) -> Tensor:
        """T of each episode.

        Args:
            reference_time_s: grid reference times at 1 m/s, NaN where there is none,
                shape [B].
            top_speed_mps: of the robot.

        Returns:
            Seconds, float64, shape [B].

        Raises:
            ConfigError: T is a multiple of a reference time that is not there.
        """
        reference_time_s = reference_time_s.double()
        if self.time_budget_s is not None:
            return torch.full_like(reference_time_s, self.time_budget_s)
        assert self.time_budget_ratio is not None
        lacking = reference_time_s.isnan()
        if bool(lacking.any()):
            raise ConfigError(
                "Expected a reference time on each map, of which the time budget is a "
                "multiple (`time_budget_ratio`), "
                f"got none on {int(lacking.sum())} of {len(lacking)} maps, which were "
                "not asked to be solvable. Make "
                "such maps: benchnav-datagen create RECIPE id=NAME "
                "splits.SPLIT.solvable=true; or give "
                "`time_budget_s`, as in world={'preset': 'stakes', 'time_budget_s': "
                "60}."
            )
        return self.time_budget_ratio * reference_time_s / top_speed_mps

    def steps(self, budget_s: Tensor, dt_s: float) -> Tensor:
        """Time steps in time budgets, int64, shape of `budget_s`.

        Raises:
            ConfigError: If there is none, or more than `MAX_STEPS`.
        """
        steps = (budget_s / dt_s).round()
        if bool((~(steps >= 1)).any()):
            raise ConfigError(
                f"Expected a time budget of at least one time step of {dt_s:g} s, got "
                f"{float(budget_s.min()):g} s."
            )
        if bool((steps > MAX_STEPS).any()):
            raise ConfigError(
                f"Expected a time budget of at most {MAX_STEPS:,} time steps of "
                f"{dt_s:g} s, got "
                f"{float(budget_s.max()):g} s."
            )
        return steps.long()

    def to_dict(self) -> dict[str, Any]:
        """All that bears on what happens, as plain data for JSON.

        What the noise does not use is left out, and the kernel where it is the one that
        was there before there was a choice, so that ids stay.
        """
        unused = () if self.noise == "frozen" else ("correlation_m", "kernel")
        if self.kernel == KERNELS[0]:
            unused = (*unused, "kernel")
        unused = (*unused, "preset")
        return {
            n: value
            for n, value in plain(self).items()
            if value is not None and n not in unused
        }


@dataclass(frozen=True, kw_only=True)
class Preset:
    """A world, and the rules of a task that go with it.

    Args:
        purpose: one line.
        world: what λ does.
        rules: free space, least λ̂, goal radius.
    """

    purpose: str
    world: World
    rules: Rules


PRESETS: Mapping[str, Preset] = {
    "paper": Preset(
        purpose="The paper's: λ is drawn anew at each step; low λ slows a robot and "
        "ends nothing.",
        world=World(),
        rules=Rules(),
    ),
    "stakes": Preset(
        purpose="λ stays what it is at a place, and soft ground immobilises a robot.",
        world=World(
            noise="frozen",
            immobile=Immobile(),
            time_budget_s=None,
            time_budget_ratio=3.0,
            preset="stakes",
        ),
        rules=Rules(
            free_space=FreeSpace(by="mean", above=0.1), min_traversability=0.05
        ),
    ),
}


def _changed_preset(name: str, changes: Mapping[str, Any]) -> World:
    # One of the two ways to give a time budget replaces the other.
    no_budget = dict.fromkeys(_BUDGETS) if changes.keys() & set(_BUDGETS) else {}
    return replace(PRESETS[name].world, **{**no_budget, **changes})


def read_world(world: Any, task: Any = None) -> tuple[World, Rules, str]:
    """Reads a world and the rules that go with it.

    Args:
        world: name of a preset, or a mapping of changes with the preset's name under
            `preset`; without it they change the paper's.
        task: a mapping of changes to the preset's rules, if there are any.

    Returns:
        World, rules, and what tables call them: the preset's name and all that is
            changed.

    Raises:
        ConfigError: there is no such preset or field, or a value is of the wrong kind.
    """
    world = world.spec if isinstance(world, World) else world
    expect(
        isinstance(world, Mapping | str),
        f"`world` as a mapping of settings, got {world!r}.",
    )
    changes_given = {"preset": world} if isinstance(world, str) else dict(world)
    name = changes_given.pop("preset", "paper")
    check_known("a world", name, PRESETS)
    preset = PRESETS[name]
    budgets = [key for key in _BUDGETS if changes_given.get(key) is not None]
    if (
        len(budgets) == 1
    ):  # of the two ways to give a time budget one takes the other's place
        changes_given |= dict.fromkeys(set(_BUDGETS) - set(budgets))
    changed_world = read(World, changes_given, "`{}`".format, "world", preset.world)
    for key in ("correlation_m", "kernel"):
        expect(
            key not in changes_given or changed_world.noise == "frozen",
            f"`world.{key}` with `world.noise` frozen, got it with "
            f"{changed_world.noise!r}.",
        )
    rules = read(
        Rules, {} if task is None else task, "`{}`".format, "task", preset.rules
    )
    changes = _differences(preset.world, changed_world) + _differences(
        preset.rules, rules
    )
    return changed_world, rules, " ".join([name, *changes])


def _differences(preset: Any, value: Any) -> list[str]:
    """What tables call the fields in which a value differs from its preset."""
    changed = []
    for f in fields(preset):
        before, after = getattr(preset, f.name), getattr(value, f.name)
        if before == after or (after is None and f.name != "immobile"):
            continue
        if isinstance(after, FreeSpace):
            changed += _differences(before, after)
        elif f.name == "immobile":
            changed.append(
                f"immobile={after.below:g}/{after.for_s:g}s"
                if after
                else "immobile=none"
            )
        else:
            changed.append(
                f"{f.name}={after:g}"
                if isinstance(after, float)
                else f"{f.name}={after}"
            )
    return changed
