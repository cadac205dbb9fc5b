"""Which options of a part are not its defaults, for tables."""

from collections.abc import Mapping
from typing import Any

from benchnav.core import registry
from benchnav.core.registry import NO_DEFAULT, Part


def changed_options(planner: Part) -> list[str]:
    """Options of a planner that differ from their defaults, as `name = value`, nested ones with dots."""
    target = registry.find("planner", planner.part).target
    known = registry.options_of("planner", target)
    given = {name: option.default for name, option in known.items() if option.default is not NO_DEFAULT}
    defaults = registry.complete(
        "planner", Part(part=planner.part, label="", options={**planner.options, **given})
    )
    return _differences(defaults.options, planner.options)


def _differences(defaults: Mapping[str, Any], values: Mapping[str, Any], prefix: str = "") -> list[str]:
    found = []
    for name, value in values.items():
        default = defaults.get(name)
        if isinstance(value, Mapping) and isinstance(default, Mapping):
            found += _differences(default, value, f"{prefix}{name}.")
        elif value != default:
            found.append(f"{prefix}{name} = {value}")
    return found
