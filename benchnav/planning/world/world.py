"""Worlds, presets of a world with its rules, and endpoints of episodes.

A world defines how λ varies and how it affects a robot. Letters in shapes: B episodes.
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
from benchnav.planning.free_space import IMMOBILE_BY, FreeSpace, Immobile, Rules
from benchnav.planning.world.physics.settings import Physics, differences

NOISES = ("resampled", "stored", "frozen")
BACKENDS = ("kinematic", "tracks", "physics")

MAX_STEPS = 10**6
"""Maximum number of steps of an episode; at 0.1 s per step, 28 hours."""

_BUDGETS = ("time_budget_s", "time_budget_ratio")


@dataclass(frozen=True, kw_only=True)
class Endpoints(Batch):
    """Endpoints and reference times of episodes.

    Args:
        start_m: start (x, y) in metres, shape [B, 2].
        goal_m: goal (x, y) in metres, shape [B, 2].
        reference_time_s: reference time of the fastest grid path at 1 m/s in seconds,
            NaN if the dataset has none, shape [B].
    """

    start_m: Tensor
    goal_m: Tensor
    reference_time_s: Tensor


@dataclass(frozen=True, kw_only=True)
class World:
    """Model of λ; by default the paper's model, in which low λ only slows a robot.

    Args:
        noise: source of λ. `resampled`: λ is drawn at each step. `stored`: λ is the
            value in the dataset. `frozen`: λ is drawn once per episode, as a correlated
            field in which each cell has its own distribution.
        correlation_m: correlation length ℓ ≥ 0 of frozen noise in metres. With the
            Gaussian kernel, normal scores of cells at distance d have the correlation
            exp(−d²/2ℓ²).
        kernel: kernel of frozen noise: `gaussian`, or `matern32`, a rougher field with
            the same correlation at distance ℓ. Beliefs assume the Gaussian kernel.
        backend: model of how λ slows a robot. `kinematic`: λ of the cell at its
            position scales its motion. `tracks`: the mean λ of the contacts on each
            side scales that side, so that the sides slip apart; this needs a robot
            with a footprint. `physics`: rigid bodies on wheels that soil pulls.
        physics: soil, body, entrapment and sub-step of the backend `physics`; None for
            the defaults. Other backends have no such settings.
        lag_s: time constant of the wheel speeds in seconds, for `tracks`; None for
            wheels that follow the command at once.
        clearance_m: minimum clearance of an acceptable draw of frozen noise: start and
            goal are connected by cells around which no cell within this distance, in
            metres, immobilises a robot. None for the cells themselves. A suite takes
            the largest footprint of its robots.
        start_shift_m: distance in metres by which starts move along x, while planners
            draw other samples; None for neither. It measures how far episodes agree
            with themselves, the ceiling of agreement between worlds.
        immobile: rule by which terrain immobilises a robot and ends its episode; None
            if terrain only slows robots.
        time_budget_s: time budget T in seconds, after which an episode fails; None to
            use `time_budget_ratio`.
        time_budget_ratio: T as a multiple of the map's grid reference time at the
            robot's top speed; None to use `time_budget_s`.
        preset: name of the preset from which the world was derived, and whose rules
            apply.
    """

    noise: str = "resampled"
    correlation_m: float = 1.5
    kernel: str = KERNELS[0]
    backend: str = BACKENDS[0]
    physics: Physics | None = None
    lag_s: float | None = None
    clearance_m: float | None = None
    start_shift_m: float | None = None
    immobile: Immobile | None = None
    time_budget_s: float | None = 100.0
    time_budget_ratio: float | None = None
    preset: str = field(default="paper", compare=False, repr=False)

    def __post_init__(self) -> None:
        """Validate noise, kernel, correlation and time budget."""
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
        expect(
            self.backend in BACKENDS,
            f"`backend` {', '.join(map(repr, BACKENDS[:-1]))} or {BACKENDS[-1]!r}, got "
            f"{self.backend!r}.",
        )
        is_physics = self.backend == "physics"
        if is_physics and self.physics is None:
            object.__setattr__(self, "physics", Physics())
        expect(
            is_physics or self.physics is None,
            f"`backend` 'physics' with `physics`, got {self.backend!r}. Set `backend` to "
            "'physics', or omit `physics`.",
        )
        if self.lag_s is not None:
            expect(
                0 < self.lag_s < float("inf") and self.backend == "tracks",
                "`lag_s` > 0 and finite, with `backend` 'tracks', got "
                f"{self.lag_s} with {self.backend!r}.",
            )
        if self.clearance_m is not None:
            expect(
                0 < self.clearance_m < float("inf"),
                f"`clearance_m` > 0 and finite, got {self.clearance_m}.",
            )
            expect(
                self.noise == "frozen" and self.immobile is not None,
                "`noise` 'frozen' and a rule `immobile` with `clearance_m`, since other "
                f"draws are all accepted, got {self.noise!r} and {self.immobile}.",
            )
        if self.start_shift_m is not None:
            expect(
                0 < self.start_shift_m < float("inf"),
                f"`start_shift_m` > 0 and finite, got {self.start_shift_m}.",
            )
        is_ratio = self.time_budget_s is None
        expect(
            is_ratio != (self.time_budget_ratio is None),
            "exactly one of `time_budget_s` and `time_budget_ratio`, got "
            f"{self.time_budget_s} and {self.time_budget_ratio}. "
            "Set the other to None.",
        )
        name = "time_budget_ratio" if is_ratio else "time_budget_s"
        value = getattr(self, name)
        expect(0 < value < float("inf"), f"`{name}` > 0 and finite, got {value}.")

    @classmethod
    def paper(cls, **changes: Any) -> "World":
        """Return the paper's world: λ is resampled at each step and only slows a robot.

        Args:
            **changes: fields, by name, that replace those of the preset.
        """
        return _changed_preset("paper", changes)

    @classmethod
    def stakes(cls, **changes: Any) -> "World":
        """Return a world of constant λ in which low λ immobilises a robot.

        Args:
            **changes: fields, by name, that replace those of the preset.
        """
        return _changed_preset("stakes", changes)

    @property
    def spec(self) -> dict[str, Any]:
        """Name of the preset and all fields that differ from it, for `read_world`."""
        base = _plain(PRESETS[self.preset].world)
        spec: dict[str, Any] = {"preset": self.preset}
        for name, value in _plain(self).items():
            if value != base[name]:
                spec[name] = value
        return spec

    def with_clearance(self, clearance_m: float) -> "World":
        """Return the world with at least a clearance of accepted draws.

        Args:
            clearance_m: clearance in metres, such as the radius of a footprint; 0 for
                none. Worlds whose draws are all accepted do not change.
        """
        is_rejecting = self.noise == "frozen" and self.immobile is not None
        if not is_rejecting or clearance_m <= (self.clearance_m or 0):
            return self
        return replace(self, clearance_m=clearance_m)

    def starts_m(self, start_m: Tensor) -> Tensor:
        """Return the starts (x, y) of episodes, given those of the maps, [B, 2]."""
        if self.start_shift_m is None:
            return start_m
        return start_m + start_m.new_tensor([self.start_shift_m, 0.0])

    def budget_s(self, reference_time_s: Tensor, top_speed_mps: float) -> Tensor:
        """Return the time budget of each episode.

        Args:
            reference_time_s: grid reference times at 1 m/s in seconds, NaN if missing,
                shape [B].
            top_speed_mps: top speed of the robot in m/s.

        Returns:
            Time budgets in seconds, float64, shape [B].

        Raises:
            ConfigError: If `time_budget_ratio` is set and a reference time is missing.
        """
        reference_time_s = reference_time_s.double()
        if self.time_budget_s is not None:
            return torch.full_like(reference_time_s, self.time_budget_s)
        assert self.time_budget_ratio is not None
        is_missing = reference_time_s.isnan()
        if bool(is_missing.any()):
            raise ConfigError(
                "Expected a reference time on each map for `time_budget_ratio`, got "
                f"none on {int(is_missing.sum())} of {len(is_missing)} maps. The "
                "recipe of the maps does not require solvable maps. Create solvable "
                "maps: benchnav-datagen create RECIPE id=NAME "
                "splits.SPLIT.solvable=true; or set `time_budget_s`, as in "
                "world={'preset': 'stakes', 'time_budget_s': 60}."
            )
        return self.time_budget_ratio * reference_time_s / top_speed_mps

    def steps(self, budget_s: Tensor, dt_s: float) -> Tensor:
        """Return time budgets as numbers of time steps.

        Args:
            budget_s: time budgets in seconds, any shape.
            dt_s: time step in seconds.

        Returns:
            Numbers of steps, int64, shape of `budget_s`.

        Raises:
            ConfigError: If a time budget has less than one step, or more than
                `MAX_STEPS`.
        """
        steps = (budget_s / dt_s).round()
        is_too_short = ~(steps >= 1)  # true for NaN
        if bool(is_too_short.any()):
            raise ConfigError(
                f"Expected a time budget of at least {dt_s:g} s (one time step), got "
                f"{float(budget_s.min()):g} s. Raise `time_budget_s` or "
                "`time_budget_ratio`."
            )
        if bool((steps > MAX_STEPS).any()):
            raise ConfigError(
                f"Expected a time budget of at most {MAX_STEPS:,} time steps of "
                f"{dt_s:g} s, got {float(budget_s.max()):g} s. "
                "Lower `time_budget_s` or `time_budget_ratio`."
            )
        return steps.long()

    def to_dict(self) -> dict[str, Any]:
        """Return all settings that affect episodes, as plain data for JSON.

        Settings that the noise does not use are omitted. The first kernel, backend and
        rule of immobilisation are also omitted, since version 1 had no others, and ids
        must not change.
        """
        unused = {"preset"}
        if self.noise != "frozen":
            unused |= {"correlation_m", "kernel"}
        if self.kernel == KERNELS[0]:
            unused.add("kernel")
        if self.backend == BACKENDS[0]:
            unused.add("backend")
        settings = {}
        for name, value in _plain(self).items():
            if value is not None and name not in unused:
                settings[name] = value
        if self.immobile is not None and self.immobile.by == IMMOBILE_BY[0]:
            del settings["immobile"]["by"]
        return settings


@dataclass(frozen=True, kw_only=True)
class Preset:
    """World with the default rules of its tasks.

    Args:
        purpose: description in one line.
        world: model of λ.
        rules: default rules of a task in this world.
    """

    purpose: str
    world: World
    rules: Rules


PRESETS: Mapping[str, Preset] = {
    "paper": Preset(
        purpose="The paper's: λ is resampled at each step; low λ only slows a robot.",
        world=World(),
        rules=Rules(),
    ),
    "stakes": Preset(
        purpose="λ of a cell is constant, and soft terrain immobilises a robot.",
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


def _plain(world: World) -> dict[str, Any]:
    """Return all fields of a world as plain data."""
    settings = {}
    for entry in fields(world):
        value = getattr(world, entry.name)
        is_physics = isinstance(value, Physics)
        settings[entry.name] = value.to_dict() if is_physics else plain(value)
    return settings


def _changed_preset(name: str, changes: Mapping[str, Any]) -> World:
    no_budget = {}
    if changes.keys() & set(_BUDGETS):
        # A changed time budget replaces that of the preset.
        no_budget = dict.fromkeys(_BUDGETS)
    return replace(PRESETS[name].world, **{**no_budget, **changes})


def read_world(world: Any, task: Any = None) -> tuple[World, Rules, str]:
    """Return a world and the rules of its tasks.

    Args:
        world: name of a preset; or a mapping of fields that replace those of a preset,
            with the preset's name under `preset`, by default `paper`; or a `World`.
        task: mapping of fields that replace the preset's rules; None for no changes.

    Returns:
        The world, its rules, and their label in tables: the preset's name and all
        changes.

    Raises:
        ConfigError: If a preset or field does not exist, or a value has the wrong type.
    """
    if isinstance(world, World):
        world = world.spec
    expect(
        isinstance(world, Mapping | str),
        f"`world` to be the name of a preset or a mapping of settings, got {world!r}.",
    )
    changes = {"preset": world} if isinstance(world, str) else dict(world)
    name = changes.pop("preset", "paper")
    check_known("a world", name, PRESETS)
    preset = PRESETS[name]
    budgets = [key for key in _BUDGETS if changes.get(key) is not None]
    if len(budgets) == 1:
        # A changed time budget replaces that of the preset.
        changes |= dict.fromkeys(set(_BUDGETS) - set(budgets))
    as_option = "`{}`".format
    changed_world = read(World, changes, as_option, "world", preset.world)
    for key in ("correlation_m", "kernel"):
        expect(
            key not in changes or changed_world.noise == "frozen",
            f"`world.noise` 'frozen' with `world.{key}`, got "
            f"{changed_world.noise!r}. Set `world.noise` to 'frozen', or omit "
            f"`world.{key}`.",
        )
    task = {} if task is None else task
    rules = read(Rules, task, as_option, "task", preset.rules)
    world_changes = _differences(preset.world, changed_world)
    rule_changes = _differences(preset.rules, rules)
    label = " ".join([name, *world_changes, *rule_changes])
    return changed_world, rules, label


def split_label(label: str, rules: Rules) -> tuple[str, str]:
    """Split the label of a world and its rules.

    Args:
        label: label from `read_world`.
        rules: rules of the label.

    Returns:
        Label of the world without rules, and the changes of the preset's rules; the
        second is empty if the rules are those of the preset.
    """
    name = label.split()[0]
    if name not in PRESETS:
        return label, ""
    changes = " ".join(_differences(PRESETS[name].rules, rules))
    if not changes or not label.endswith(f" {changes}"):
        return label, ""
    return label.removesuffix(f" {changes}"), changes


def _differences(preset: Any, value: Any) -> list[str]:
    """Return the fields that differ from the preset, as `name=value` for tables."""
    changed = []
    for entry in fields(preset):
        name = entry.name
        before = getattr(preset, name)
        after = getattr(value, name)
        if before == after or (after is None and name != "immobile"):
            continue
        if isinstance(after, FreeSpace):
            changed += _differences(before, after)
            continue
        if isinstance(after, Physics):
            changed += differences(Physics().to_dict(), after.to_dict())
            continue
        text = str(after)
        if isinstance(after, float):
            text = f"{after:g}"
        elif name == "immobile":
            text = f"{after.below:g}/{after.for_s:g}s" if after else "none"
            if after and after.by != IMMOBILE_BY[0]:
                text += f"/{after.by}"
        changed.append(f"{name}={text}")
    return changed
