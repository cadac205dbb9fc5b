"""Describe an object of this process by a part that creates it in another process.

An object that a user creates in a program, such as `CVaR(0.8)` or
`MPPI(MPPIConfig(samples=200))`, is described by the name, module or file of its class
and the arguments of its constructor. Other objects are registered by a name in this
process only: functions without a name, classes of a notebook, and objects that were
modified after their creation.
"""

import inspect
import pickle
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchnav.core import registry
from benchnav.core.errors import BenchnavError
from benchnav.core.registry import Part
from benchnav.core.settings import config_class, plain
from benchnav.core.sources import installed_folders
from benchnav.core.specified import arguments_of


def describe(kind: str, instance: Any) -> Part:
    """Describe an object, or read a part that is written as text or as a mapping.

    Args:
        kind: one of `registry.KINDS`.
        instance: an object of that kind; its class, if all options have defaults; or a
            text or mapping that `registry.read_part` reads.

    Returns:
        The part that creates the object again. If no part can do this, a part that
        names the object in this process only; see `registry.is_object`.

    Raises:
        ConfigError: If the object is not of that kind.
    """
    if isinstance(instance, str | Mapping | Part):
        return registry.read_part(kind, instance)
    if inspect.isclass(instance):
        source = _source_of(kind, instance)
        if source:
            return Part(part=source, label=_short(source))
        return name_object(kind, instance)
    registry.check_base(kind, instance, f"the {kind}")
    part = _from_arguments(kind, instance)
    if part is not None and _is_same(kind, part, instance):
        return part
    return name_object(kind, instance)


def name_object(kind: str, instance: Any) -> Part:
    """Register an object by a name in this process only, and return its part."""
    name = getattr(instance, "__name__", type(instance).__name__).strip("<>")
    return Part(part=registry.register_object(kind, name, instance), label=name)


def _from_arguments(kind: str, instance: Any) -> Part | None:
    """Describe an object by its class and constructor arguments.

    The result is None if the class or the arguments cannot be described.
    """
    if inspect.isroutine(instance):
        source = _source_of(kind, instance)
        return None if source is None else Part(part=source, label=_short(source))
    arguments = arguments_of(instance)
    target = type(instance)
    source = _source_of(kind, target)
    if arguments is None or source is None:
        return None
    bound = inspect.signature(target).bind(*arguments[0], **arguments[1]).arguments
    option_names = registry.options_of(kind, target)
    has_config = "config" in bound and config_class(
        target, registry.given_parameters(kind)
    )
    try:
        if has_config:
            options = _changed_settings(bound["config"])
        else:
            options = {
                name: plain(value)
                for name, value in bound.items()
                if name in option_names
            }
    except (BenchnavError, TypeError):
        return None  # an argument is not plain data, or a setting has no default
    first_option = next(iter(option_names), "")
    label = registry.label_of(_short(source), options, first_option)
    return Part(part=source, label=label, options=options)


def _changed_settings(config: Any) -> dict[str, Any]:
    """Return the settings that differ from their defaults."""
    settings = plain(config)
    defaults = plain(type(config)())
    return {
        name: value for name, value in settings.items() if value != defaults.get(name)
    }


def _source_of(kind: str, target: Any) -> str | None:
    """Return the name, module or file of a class or function for other processes.

    It is None if other processes cannot find the class or function.
    """
    module = getattr(target, "__module__", "")
    name = getattr(target, "__qualname__", "")
    if not name or "<" in name or module == "__main__":
        return None
    location = f"{module}:{name}"
    for point in registry.entry_points_of(kind):
        if point.value == location:
            return point.name
    if module.partition(".")[0] == "benchnav":
        return location
    file = Path(getattr(sys.modules.get(module), "__file__", None) or "")
    if not file.is_file():
        return None
    if "." in module or any(map(file.is_relative_to, installed_folders())):
        return location
    # A module outside a package is described by its file, which a command finds from
    # any folder.
    shown = file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file
    return f"{shown}:{name}"


def _is_same(kind: str, part: Part, instance: Any) -> bool:
    """Return whether a part creates an object of the same class and attributes."""
    try:
        parameters = {
            name: getattr(instance, name)
            for name in registry.given_parameters(kind)
            if hasattr(instance, name)
        }
        created = registry.make(kind, part, **parameters)
        if inspect.isfunction(instance):
            return bool(created.func.__code__ == instance.__code__)
        if _code_of(type(created)) != _code_of(type(instance)):
            return False
        attributes = _public(created)
        expected = _public(instance)
        if _is_equal(attributes, expected):
            return True
        return pickle.dumps(attributes) == pickle.dumps(expected)
    except Exception:  # a user's class may raise anything, and may not be picklable
        return False


def _code_of(target: type) -> list[tuple[str, Any]]:
    """Return the compiled functions of a class and its bases, to detect edits."""
    return [
        (f"{base.__qualname__}.{name}", value.__code__)
        for base in target.__mro__
        for name, value in vars(base).items()
        if inspect.isfunction(value)
    ]


def _is_equal(first: dict[str, Any], second: dict[str, Any]) -> bool:
    try:
        return bool(first == second)
    except (RuntimeError, ValueError):  # tensors and arrays of several elements
        return False


def _public(instance: Any) -> dict[str, Any]:
    return {
        name: value
        for name, value in vars(instance).items()
        if not name.startswith("_")
    }


def _short(source: str) -> str:
    return source.rpartition(":")[2]
