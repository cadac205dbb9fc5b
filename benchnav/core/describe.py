"""Describe an object of this process by the part that creates it again elsewhere.

A part that a user creates in a program, such as `CVaR(0.8)` or
`MPPI(MPPIConfig(samples=200))`, is described by the name, module or file of its class
and the arguments of its constructor. What cannot be described so (a function without a
name, a class of a notebook, an object that was changed after it was created) is known
by a name in this process only.
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
        instance: an object of that kind; its class, if all options have defaults; or
            what `registry.read_part` reads.

    Returns:
        The part that creates the object again. If there is none, a part by a name that
        this process knows; see `registry.is_object`.

    Raises:
        ConfigError: If the object is not of that kind.
    """
    if isinstance(instance, str | Mapping | Part):
        return registry.read_part(kind, instance)
    if inspect.isclass(instance):
        source = _source_of(kind, instance)
        return (
            Part(part=source, label=_short(source))
            if source
            else name_object(kind, instance)
        )
    registry.check_base(kind, instance, f"the {kind}")
    part = _from_arguments(kind, instance)
    return (
        part
        if part is not None and _is_same(kind, part, instance)
        else name_object(kind, instance)
    )


def name_object(kind: str, instance: Any) -> Part:
    """Return a part by which this process only knows an object."""
    name = getattr(instance, "__name__", type(instance).__name__).strip("<>")
    return Part(part=registry.register_object(kind, name, instance), label=name)


def _from_arguments(kind: str, instance: Any) -> Part | None:
    """Describe an object by its class and the arguments of its constructor; None if
    either is unknown.
    """
    if inspect.isroutine(instance):
        source = _source_of(kind, instance)
        return None if source is None else Part(part=source, label=_short(source))
    arguments, target = arguments_of(instance), type(instance)
    source = _source_of(kind, target)
    if arguments is None or source is None:
        return None
    bound = inspect.signature(target).bind(*arguments[0], **arguments[1]).arguments
    known = registry.options_of(kind, target)
    try:
        if "config" in bound and config_class(target, registry.given_parameters(kind)):
            settings = plain(bound["config"])
            defaults = plain(type(bound["config"])())
            options = {
                name: value
                for name, value in settings.items()
                if value != defaults.get(name)
            }
        else:
            options = {
                name: plain(value) for name, value in bound.items() if name in known
            }
    except (
        BenchnavError,
        TypeError,
    ):  # an argument is an object itself, or a setting has no default
        return None
    return Part(
        part=source,
        label=registry.label_of(_short(source), options, next(iter(known), "")),
        options=options,
    )


def _source_of(kind: str, target: Any) -> str | None:
    """Name a class or function so that other processes find it; None if they cannot."""
    module, name = (
        getattr(target, "__module__", ""),
        getattr(target, "__qualname__", ""),
    )
    if not name or "<" in name or module == "__main__":
        return None
    place = f"{module}:{name}"
    for point in registry.entry_points_of(kind):
        if point.value == place:
            return point.name
    if module.partition(".")[0] == "benchnav":
        return place
    file = Path(getattr(sys.modules.get(module), "__file__", None) or "")
    if not file.is_file():
        return None
    if "." in module or any(map(file.is_relative_to, installed_folders())):
        return place
    # A module that lies by itself is found by its file, wherever a command is called
    # from.
    shown = file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file
    return f"{shown}:{name}"


def _is_same(kind: str, part: Part, instance: Any) -> bool:
    """Whether a part creates an object of the same class and the same public
    attributes.
    """
    try:
        given = {
            name: getattr(instance, name)
            for name in registry.given_parameters(kind)
            if hasattr(instance, name)
        }
        created = registry.make(kind, part, **given)
        if inspect.isfunction(instance):
            return bool(created.func.__code__ == instance.__code__)
        if _code_of(type(created)) != _code_of(type(instance)):
            return False
        attributes, expected = _public(created), _public(instance)
        return _is_equal(attributes, expected) or pickle.dumps(
            attributes
        ) == pickle.dumps(expected)
    except Exception:  # a user's class may raise anything, and may not be picklable
        return False


def _code_of(target: type) -> list[tuple[str, Any]]:
    """Compiled functions of a class and of those it derives from, which a file may have
    others of by now.
    """
    return [
        (f"{base.__qualname__}.{name}", value.__code__)
        for base in target.__mro__
        for name, value in vars(base).items()
        if inspect.isfunction(value)
    ]


def _is_equal(one: dict[str, Any], other: dict[str, Any]) -> bool:
    try:
        return bool(one == other)
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
