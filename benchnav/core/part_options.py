"""Options of parts: types, defaults, values within a part's name, and labels."""

import inspect
from collections.abc import Mapping
from typing import Any

from benchnav.core.part_lookup import find, names
from benchnav.core.settings import Option, config_class, list_options, parameters

# Parameters to which benchnav passes arguments, by kind. They are not options.
_PASSED: Mapping[str, tuple[str, ...]] = {"objective": ("robot", "goal_radius_m")}


def options_of(kind: str, target: Any) -> dict[str, Option]:
    """Return the options of a class or function by name, in the order of parameters.

    Parameters to which benchnav passes arguments are not options: an objective's
    `robot` and `goal_radius_m`, and a risk measure's mixture.
    """
    return list_options(target, _non_options(kind, target))


def config_class_of(kind: str, target: Any) -> Any:
    """Return the dataclass of a part's parameter `config`; None if it has none."""
    return config_class(target, _non_options(kind, target))


def _non_options(kind: str, target: Any) -> tuple[str, ...]:
    """Return the parameters of a part to which benchnav passes arguments."""
    if kind == "risk" and not inspect.isclass(target):
        return tuple(parameters(target))[:1]
    return given_parameters(kind)


def given_parameters(kind: str) -> tuple[str, ...]:
    """Return the parameters to which benchnav passes arguments in all parts of a kind.

    An example is an objective's `robot`.
    """
    return _PASSED.get(kind, ())


def added_options(kind: str, target: Any) -> tuple[str, ...]:
    """Return the options that a part lists in `added`: newer than its first release."""
    owner = config_class_of(kind, target) or target
    added: tuple[str, ...] = getattr(owner, "added", ())
    return added


def later_options(kind: str, source: str) -> dict[str, Any]:
    """Return the defaults of the options that a part lists in `added`.

    Records omit an option that has this default.
    """
    target = find(kind, source).target
    options = options_of(kind, target)
    return {name: options[name].default for name in added_options(kind, target)}


def split_value(kind: str, text: str) -> tuple[str, str | None]:
    """Split `NAME:VALUE` into the name and the value, which is None if missing.

    The colon of `package.module:Name` or `file.py:Name` remains in the name.
    """
    head, colon, tail = text.rpartition(":")
    if not colon:
        return text, None
    head_is_source = ":" in head or head in names(kind)
    tail_is_name = tail[:1].isidentifier()
    if tail_is_name and not head_is_source:
        return text, None
    return head, tail


def label_of(name: str, options: Mapping[str, Any], first: str) -> str:
    """Return the label of a part with options: `name:value`, or `name a=1 b=2`.

    Args:
        name: name of the part.
        options: options to show. If the part's first option is the only one to show,
            the label omits the option's name.
        first: name of the part's first option.
    """
    texts = {}
    for option, value in options.items():
        texts[option] = f"{value:g}" if isinstance(value, float) else str(value)
    if list(texts) == [first]:
        return f"{name}:{texts[first]}"
    pairs = [f"{option}={text}" for option, text in texts.items()]
    return " ".join([name, *pairs])
