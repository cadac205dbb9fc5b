"""Worlds as users write them: a preset by name, or a mapping of changes to one."""

from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass, replace
from typing import Any

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.planning.free_space import FreeSpace, Rules
from benchnav.planning.world.world import PRESETS, Immobile, World

_BUDGETS = ("time_budget_s", "time_budget_ratio")
# Fields that may be null, with what they are like where they are not.
_OPTIONAL: Mapping[str, Any] = {"immobile": Immobile(), "time_budget_s": 100.0, "time_budget_ratio": 3.0}


def read_world(
    world: Any, task: Any = None, short: Mapping[str, Any] | None = None
) -> tuple[World, Rules, str]:
    """Reads a world and the rules that go with it.

    Args:
        world: name of a preset, or a mapping of changes with the preset's name under `preset`; without it
            they change the paper's.
        task: a mapping of changes to the preset's rules, if there are any.
        short: further changes to the world, for what `world` itself does not name.

    Returns:
        World, rules, and what tables call them: the preset's name and all that is changed.

    Raises:
        ConfigError: there is no such preset or field, or a value is of the wrong kind.
    """
    if not isinstance(world, Mapping | str):
        raise ConfigError(f"Expected `world` as a mapping of settings, got {world!r}.")
    if not isinstance(task, Mapping | None):
        raise ConfigError(f"Expected `task` as a mapping of settings, got {task!r}.")
    given = {"preset": world} if isinstance(world, str) else dict(world)
    name = given.pop("preset", "paper")
    if name not in PRESETS:
        raise ConfigError(
            f"Expected a world among {', '.join(PRESETS)}, got {name!r}.{registry.hint(name, PRESETS)}"
        )
    preset = PRESETS[name]
    further = dict(short or {})
    if set(_BUDGETS) & set(given):
        further = {key: value for key, value in further.items() if key not in _BUDGETS}
    changed_world = _changed_world(preset.world, {**further, **given})
    rules = _changed(preset.rules, dict(task or {}), "task")
    changes = _differences(preset.world, changed_world) + _differences(preset.rules, rules)
    return changed_world, rules, " ".join([name, *changes])


def _changed_world(preset: World, given: dict[str, Any]) -> World:
    """Replaces fields of a world; of the two ways to give a time budget one takes the other's place."""
    named = {name for name in _BUDGETS if given.get(name) is not None}
    if len(named) == 1:
        given = given | dict.fromkeys(set(_BUDGETS) - named)
    made: World = _changed(preset, given, "world")
    if "correlation_m" in given and made.noise != "frozen":
        raise ConfigError(
            f"Expected `world.correlation_m` with `world.noise` frozen, got it with {made.noise!r}."
        )
    return made


def _changed(value: Any, changes: dict[str, Any], where: str) -> Any:
    """Replaces fields of a dataclass by what is given, of dataclasses in it likewise."""
    known = {f.name: getattr(value, f.name) for f in fields(value)}
    made: dict[str, Any] = {}
    for name, change in changes.items():
        if name not in known:
            raise ConfigError(
                f"Expected keys of `{where}` among {', '.join(known)}, got {name!r}.{registry.hint(name, known)}"
            )
        like = _OPTIONAL.get(name) if known[name] is None else known[name]
        if change is None and name in _OPTIONAL:
            made[name] = None
        elif isinstance(like, FreeSpace | Immobile) and isinstance(change, Mapping):
            made[name] = _changed(like, dict(change), f"{where}.{name}")
        elif isinstance(like, float) and isinstance(change, int | float) and not isinstance(change, bool):
            made[name] = float(change)
        elif isinstance(like, str) and isinstance(change, str):
            made[name] = change
        else:
            like = asdict(like) if is_dataclass(like) and not isinstance(like, type) else like
            raise ConfigError(f"Expected `{where}.{name}` like {like!r}, got {change!r}.")
    return replace(value, **made)


def _differences(preset: Any, made: Any) -> list[str]:
    changed = []
    for f in fields(preset):
        before, after = getattr(preset, f.name), getattr(made, f.name)
        if before == after or (after is None and f.name != "immobile"):
            continue
        if isinstance(after, FreeSpace):
            changed += _differences(before, after)
        elif f.name == "immobile":
            changed.append(f"immobile={after.below:g}/{after.for_s:g}s" if after else "immobile=none")
        else:
            changed.append(f"{f.name}={after:g}" if isinstance(after, float) else f"{f.name}={after}")
    return changed
