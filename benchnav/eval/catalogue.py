"""Catalogue of parts, worlds and checkpoints that a suite can name."""

import inspect
import json
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

from benchnav.core import registry
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.registry import Option
from benchnav.core.settings import (
    check_known,
    config_class,
    dataclass_in,
    list_options,
    plain,
)
from benchnav.core.tables import Bold, Table, print_table

TITLES = {
    "planner": "planners",
    "model": "models",
    "risk": "risk measures",
    "robot": "robots",
    "objective": "objectives",
    "sensor": "appearance sensors: the observed part of the map",
    "ground": "traversability sensors: the measured λ",
    "belief": "beliefs: updates of the prediction by measurements",
    "metric": "metrics of episodes",
    "layer": "layers of recipes",
    "figure": "figures of reports",
    "world": "worlds, each with rules of the task",
}
HELP = (
    "Custom parts are named package.module:Name or path/to/file.py:Name. "
    "NAME:VALUE sets a part's first option, "
    "{part: NAME, label: LABEL, options: {...}} sets any options."
)


class Entry(NamedTuple):
    """An entry of the catalogue.

    Args:
        name: name in a suite.
        purpose: purpose in one line.
        options: options, each as `name: type = default`.
    """

    name: str
    purpose: str
    options: tuple[str, ...] = ()


def print_catalogue(*kinds: str) -> None:
    """Print the catalogue: tables if stdout is a terminal, otherwise plain lines.

    Args:
        kinds: keys of `TITLES`; without any, all kinds are printed.

    Raises:
        ConfigError: If a kind is not in `TITLES`.
    """
    chosen = [kind for kind in kinds if kind] or list(TITLES)
    for kind in chosen:
        check_known("a kind", kind, TITLES)
    if not sys.stdout.isatty():
        print("\n".join(line for kind in chosen for line in plain_lines(kind)))
        return
    for kind in chosen:
        print_table(make_table(kind))
        print()
    print(HELP)


def list_entries(kind: str) -> list[Entry]:
    """List the named parts of a kind, or the worlds; models include checkpoints."""
    if kind == "world":
        return list(_worlds())
    entries = [_describe(kind, name) for name in registry.names(kind)]
    return entries + list(_checkpoints()) if kind == "model" else entries


def plain_lines(kind: str) -> list[str]:
    """Return the catalogue of a kind as lines: `KIND NAME: PURPOSE`, then its options."""
    lines = []
    for entry in list_entries(kind):
        lines.append(f"{kind} {entry.name}: {entry.purpose}")
        lines += [f"    {option}" for option in entry.options]
    return lines


def make_table(kind: str) -> Table:
    """Return the catalogue of a kind as a table."""
    rows = []
    for entry in list_entries(kind):
        rows.append((Bold(entry.name), entry.purpose, "\n".join(entry.options)))
    return Table(
        title=TITLES[kind],
        headings=("name", "purpose", "options"),
        rows=tuple(rows),
    )


def _describe(kind: str, name: str) -> Entry:
    """Describe a part; if it cannot be imported, its purpose is the error."""
    from benchnav.models.base import is_family

    try:
        target = registry.find(kind, name).target
        purpose = _purpose(target)
        if kind == "model" and is_family(target):
            settings: tuple[str, ...] = ()
            if config_class(target):
                settings = tuple(_option_lines(list_options(target)))
            purpose += (
                f" Train it by `benchnav-train fit {name}`; a suite names the "
                "checkpoint."
            )
            return Entry(name, purpose, settings)
        options = registry.options_of(kind, target)
        return Entry(name, purpose, tuple(_option_lines(options)))
    except BenchnavError as error:
        return Entry(name, f"cannot be used: {error}")


def _purpose(target: Any) -> str:
    """Return the first line of a docstring; empty if Python generated the docstring."""
    line = (inspect.getdoc(target) or "").partition("\n")[0]
    return "" if line.startswith(f"{getattr(target, '__name__', '')}(") else line


def _option_lines(
    options: dict[str, Option], prefix: str = "", instance: Any = None
) -> Iterator[str]:
    """Yield each option with type and default, dotted names for nested dataclasses.

    Args:
        options: options by name.
        prefix: names of the enclosing options, each followed by a dot.
        instance: object whose attributes override the defaults.
    """
    for name, option in options.items():
        config = dataclass_in(option.kind)
        default = getattr(instance, name, option.default)
        if config and default is not None:
            yield from _option_lines(list_options(config), f"{prefix}{name}.", default)
        else:
            kind = "" if option.kind is Any else f": {_type_words(option.kind)}"
            yield f"{prefix}{name}{kind}{_default(default)}"


def _type_words(kind: Any) -> str:
    """Return a type without module names, with `|` between literals and in unions."""
    words = re.sub(r"(\w+\.)+", "", inspect.formatannotation(kind))
    words = re.sub(r"Literal\[(.*?)\]", lambda match: match[1].replace("'", ""), words)
    union = re.fullmatch(r"Union\[(.*)\]", words)
    return union[1].replace(", ", " | ") if union else words


def _default(value: Any) -> str:
    if value is registry.NO_DEFAULT:
        return " (required)"
    try:
        return f" = {json.dumps(plain(value), ensure_ascii=False)}"
    except ConfigError:
        return f" = {type(value).__name__}"


def _worlds() -> Iterator[Entry]:
    """Yield worlds with their settings, named as in options and suites."""
    from benchnav.planning.world.world import PRESETS

    for name, preset in PRESETS.items():
        settings = {"world": preset.world.to_dict(), "task": asdict(preset.rules)}
        yield Entry(name, preset.purpose, tuple(_setting_lines(settings)))


def _setting_lines(settings: Mapping[str, Any]) -> Iterator[str]:
    for name, value in settings.items():
        if isinstance(value, Mapping):
            nested = {f"{name}.{key}": inner for key, inner in value.items()}
            yield from _setting_lines(nested)
        else:
            yield f"{name}{_default(value)}"


def _checkpoints() -> Iterator[Entry]:
    from benchnav.models.checkpoint import read_config
    from benchnav.models.checkpoint_folders import list_checkpoints

    for folder in list_checkpoints():
        try:
            config = read_config(folder)
            family = config.get("model")
            n_classes = len(config.get("class_names") or ())
            note = f", {n_classes} classes" if n_classes else ""
            purpose = f"Checkpoint of the family {family} in {folder}{note}."
        except BenchnavError as error:
            purpose = f"cannot be used: {error}"
        yield Entry(folder.name, purpose)
