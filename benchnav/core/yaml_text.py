"""YAML that users write: plain data in one reading, or one line that says what is wrong
with it.

YAML allows what no setting means: a key twice, a list in itself, a page that stands for
a billion values. Such text is refused before it is built. Numbers are as in YAML 1.2,
so that 1e-3 is one, and a date is text.
"""

import re
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from benchnav.core.errors import ConfigError, check_text

MAX_DEPTH = 100  # mappings and lists within one another
MAX_DIGITS = 100
MAX_VALUES = 100_000  # with what aliases stand for

_TAG = "tag:yaml.org,2002:"
_NOT_PLAIN = ("timestamp", "binary", "set", "omap", "pairs")
_FLOAT = re.compile(
    r"""^(?:[-+]?[0-9][0-9_]*\.[0-9_]*(?:[eE][-+]?[0-9]+)?
    |[-+]?[0-9][0-9_]*[eE][-+]?[0-9]+
    |\.[0-9_]+(?:[eE][-+][0-9]+)?
    |[-+]?[0-9][0-9_]*(?::[0-5]?[0-9])+\.[0-9_]*
    |[-+]?\.(?:inf|Inf|INF)
    |\.(?:nan|NaN|NAN))$""",
    re.VERBOSE,
)


def load_yaml(text: str, place: str = "") -> Any:
    """Reads YAML in which 1e-3 is a number.

    Args:
        text: the YAML.
        place: where it stands, for messages.

    Raises:
        ConfigError: If it is no YAML, holds a key twice, an alias within what it stands
            for, or values that are not plain, or more than `MAX_VALUES` values or
            `MAX_DEPTH` levels.
    """
    import yaml

    try:
        loader, node = _composed(text, place)
        return None if node is None else loader.construct_document(node)
    except ConfigError:
        raise
    except (
        yaml.YAMLError,
        ValueError,
        KeyError,
    ) as error:  # `!!int many`, `!!bool perhaps`
        mark, problem = (
            getattr(error, "problem_mark", None),
            getattr(error, "problem", None),
        )
        raise _refusal(text, place, problem or str(error), mark) from error


def read_yaml(path: Path) -> Any:
    """Reads a YAML file; see `load_yaml`.

    Raises:
        ConfigError: If it cannot be read, or is no YAML.
    """
    try:
        return load_yaml(path.read_text(), str(path))
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        raise ConfigError(
            f"Expected a YAML file, got {str(path)!r}: {reason}."
        ) from error


def check_yaml(text: str) -> None:
    """Raises where text is YAML that `load_yaml` would not build; text that is no YAML
    passes.

    Raises:
        ConfigError: If it holds a key twice, an alias within what it stands for, or too
            much.
    """
    import yaml

    try:
        _composed(text, "")
    except ConfigError:
        raise
    except (yaml.YAMLError, ValueError, KeyError):
        return


def _composed(text: str, place: str) -> tuple[Any, Any]:
    """A loader, and the node that it has composed of text; None where there is nothing."""
    import yaml

    _check_nesting(text, place)
    loader = _loader()(text)
    node = loader.get_single_node()
    for inner in _nodes(node) if node is not None else ():
        if isinstance(inner, yaml.ScalarNode):
            check_text(inner.value, place)
            if inner.tag == f"{_TAG}int" and len(inner.value) > MAX_DIGITS:
                raise _refusal(
                    text,
                    place,
                    f"a number of more than {MAX_DIGITS} digits",
                    inner.start_mark,
                )
        elif isinstance(inner, yaml.MappingNode):
            _check_keys(loader, inner, text, place)
    return loader, node


def _check_nesting(text: str, place: str) -> None:
    """Reads events, which build nothing, so that no text is too deep or stands for too
    much.
    """
    import yaml

    open_anchors: list[str | None] = []  # of what an event is in
    starts: list[int] = []  # values before each of these
    values, sizes = 0, Counter[str]()
    for event in yaml.parse(text, Loader=_loader()):
        if isinstance(event, yaml.AliasEvent):
            if event.anchor in open_anchors:
                raise _refusal(
                    text,
                    place,
                    f"*{event.anchor} is within &{event.anchor}",
                    event.start_mark,
                )
            values += sizes[event.anchor or ""]
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, start = open_anchors.pop(), starts.pop()
            sizes[anchor or ""] = values - start
        elif isinstance(event, yaml.NodeEvent):
            values += 1
            if isinstance(event, yaml.CollectionStartEvent):
                open_anchors.append(event.anchor)
                starts.append(values - 1)
            else:
                sizes[event.anchor or ""] = 1
        if len(open_anchors) > MAX_DEPTH:
            raise _refusal(
                text,
                place,
                f"more than {MAX_DEPTH} levels of nesting",
                event.start_mark,
            )
        if values > MAX_VALUES:
            raise _refusal(
                text, place, f"more than {MAX_VALUES} values", event.start_mark
            )


def _nodes(root: Any) -> Iterator[Any]:
    """Yields each node once, the root among them."""
    import yaml

    seen, waiting = set(), [root]
    while waiting:
        node = waiting.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        yield node
        if isinstance(node, yaml.MappingNode):
            waiting += [inner for pair in node.value for inner in pair]
        elif isinstance(node, yaml.SequenceNode):
            waiting += node.value


def _check_keys(loader: Any, mapping: Any, text: str, place: str) -> None:
    import yaml

    keys = set()
    for node, _ in mapping.value:
        if not isinstance(node, yaml.ScalarNode):
            continue  # which the loader refuses
        key = (
            node.value if node.tag == f"{_TAG}merge" else loader.construct_object(node)
        )
        if key in keys:
            raise _refusal(
                text, place, f"the key {key!r} is there twice", node.start_mark
            )
        keys.add(key)


def _refusal(text: str, place: str, problem: str, mark: Any) -> ConfigError:
    line = f", line {mark.line + 1}" if place and mark else ""
    return ConfigError(f"Expected YAML, got {place or repr(text)}{line}: {problem}.")


@cache
def _loader() -> Any:
    """The loader of plain data, as `jsonargparse` reads the words of a command line."""
    import yaml

    base = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    resolvers = {
        first: [
            (tag, pattern)
            for tag, pattern in known
            if tag not in (f"{_TAG}timestamp", f"{_TAG}float")
        ]
        for first, known in base.yaml_implicit_resolvers.items()
    }
    constructors = {
        tag: make
        for tag, make in base.yaml_constructors.items()
        if tag is None or tag.removeprefix(_TAG) not in _NOT_PLAIN
    }
    members = {"yaml_implicit_resolvers": resolvers, "yaml_constructors": constructors}
    loader: Any = type("PlainLoader", (base,), members)
    loader.add_implicit_resolver(f"{_TAG}float", _FLOAT, list("-+0123456789."))
    return loader
