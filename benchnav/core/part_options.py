"""Options of parts: their types and defaults, values in names, and labels."""

import inspect
from collections.abc import Mapping
from typing import Any

from benchnav.core.part_lookup import find, names
from benchnav.core.settings import Option, config_class, list_options, parameters

# Parameters whose arguments the program passes. They are not options.
_PASSED: Mapping[str, tuple[str, ...]] = {"objective": ("robot", "goal_radius_m")}


def options_of(kind: str, target: Any) -> dict[str, Option]:
    """Return the options of a class or function by name, in order.

    Parameters that the program passes are not options: an objective's `robot` and
    `goal_radius_m`, and a risk measure's mixture.
    """
    return list_options(target, _non_options(kind, target))


def config_class_of(kind: str, target: Any) -> Any:
    """Return the dataclass of the `config` of a part, or None."""
    return config_class(target, _non_options(kind, target))


def _non_options(kind: str, target: Any) -> tuple[str, ...]:
    """Return the parameters that the program passes."""
    if kind == "risk" and not inspect.isclass(target):
        return tuple(parameters(target))[:1]
    return given_parameters(kind)


def given_parameters(kind: str) -> tuple[str, ...]:
    """Return the parameters that the program passes to all parts of a kind.

    An example is an objective's `robot`.
    """
    return _PASSED.get(kind, ())


def added_options(kind: str, target: Any) -> tuple[str, ...]:
    """Return the options that a part lists as `added` after its first release."""
    owner = config_class_of(kind, target) or target
    added: tuple[str, ...] = getattr(owner, "added", ())
    return added


def later_options(kind: str, source: str) -> dict[str, Any]:
    """Return the defaults of the options that were added after the first release.

    At these defaults, the options are omitted from records.
    """
    target = find(kind, source).target
    options = options_of(kind, target)
    return {name: options[name].default for name in added_options(kind, target)}


def split_value(kind: str, text: str) -> tuple[str, str | None]:
    """Split `NAME:VALUE`; the colon of a module or file remains in the name."""
    head, colon, tail = text.rpartition(":")
    if not colon:
        return text, None
    head_is_source = ":" in head or head in names(kind)
    tail_is_name = tail[:1].isidentifier()
    if tail_is_name and not head_is_source:
        return text, None
    return head, tail


def label_of(name: str, options: Mapping[str, Any], first: str) -> str:
    """Return a label with options: `name:value`, or `name a=1 b=2`.

    Args:
        name: name of the part.
        options: options to show. The first option of the part has no name if it is the
            only one to show.
        first: name of the part's first option.
    """
    texts = {}
    for option, value in options.items():
        texts[option] = f"{value:g}" if isinstance(value, float) else str(value)
    if list(texts) == [first]:
        return f"{name}:{texts[first]}"
    pairs = [f"{option}={text}" for option, text in texts.items()]
    return " ".join([name, *pairs])
