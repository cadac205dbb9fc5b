"""Plain data from YAML that users write, with error messages of one line.

YAML allows duplicate keys, a list that contains itself, and short text whose aliases
expand to a billion values. Such text is rejected before any value is built. As in YAML
1.2, 1e-3 is a number and a date is text.
"""

import re
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from benchnav.core.errors import ConfigError, check_text

MAX_DEPTH = 100  # maximum number of levels of nested mappings and lists
MAX_DIGITS = 100  # maximum number of digits of an integer
MAX_VALUES = 100_000  # maximum number of values, with aliases expanded

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


def load_yaml(text: str, source: str = "") -> Any:
    """Return the plain data that a YAML text contains.

    Args:
        text: text in YAML.
        source: path or name of the text, for messages; may be empty.

    Raises:
        ConfigError: If `text` is invalid YAML, or has a duplicate key, an alias within
            its own anchor, a value that is not plain data, more than `MAX_VALUES`
            values or more than `MAX_DEPTH` levels.
    """
    import yaml

    try:
        loader, node = _compose(text, source)
        return None if node is None else loader.construct_document(node)
    except ConfigError:
        raise
    # For example, `!!int many` raises a ValueError, and `!!bool perhaps` a KeyError.
    except (yaml.YAMLError, ValueError, KeyError) as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None)
        raise _error(text, source, problem or str(error), mark) from error


def read_yaml(path: Path) -> Any:
    """Return the plain data that a YAML file contains; see `load_yaml`.

    Raises:
        ConfigError: If the file cannot be read, or `load_yaml` rejects its text.
    """
    try:
        return load_yaml(path.read_text(), str(path))
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text"
        raise ConfigError(
            f"Expected a YAML file, got {str(path)!r}: {reason}."
        ) from error


def check_yaml(text: str) -> None:
    """Check that YAML is within the limits of `load_yaml`; accept invalid YAML.

    Raises:
        ConfigError: If `text` has a duplicate key, an alias within its own anchor, or
            too many values or levels.
    """
    import yaml

    try:
        _compose(text, "")
    except ConfigError:
        raise
    except (yaml.YAMLError, ValueError, KeyError):
        return


def _compose(text: str, source: str) -> tuple[Any, Any]:
    """Return a loader and its root node; the node of empty text is None."""
    import yaml

    _check_nesting(text, source)
    loader = _loader()(text)
    node = loader.get_single_node()
    for inner in _nodes(node) if node is not None else ():
        if isinstance(inner, yaml.ScalarNode):
            check_text(inner.value, source)
            if inner.tag == f"{_TAG}int" and len(inner.value) > MAX_DIGITS:
                raise _error(
                    text,
                    source,
                    f"a number of more than {MAX_DIGITS} digits",
                    inner.start_mark,
                )
        elif isinstance(inner, yaml.MappingNode):
            _check_keys(loader, inner, text, source)
    return loader, node


def _check_nesting(text: str, source: str) -> None:
    """Check the numbers of levels and values from parser events.

    Events build no values, so that the check itself needs little memory.
    """
    import yaml

    open_anchors: list[str | None] = []  # anchors of the collections around an event
    starts: list[int] = []  # number of values before each of these collections
    n_values = 0
    sizes = Counter[str]()  # number of values per anchor, with aliases expanded
    for event in yaml.parse(text, Loader=_loader()):
        if isinstance(event, yaml.AliasEvent):
            if event.anchor in open_anchors:
                raise _error(
                    text,
                    source,
                    f"*{event.anchor} is within &{event.anchor}",
                    event.start_mark,
                )
            n_values += sizes[event.anchor or ""]
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor = open_anchors.pop()
            sizes[anchor or ""] = n_values - starts.pop()
        elif isinstance(event, yaml.NodeEvent):
            n_values += 1
            if isinstance(event, yaml.CollectionStartEvent):
                open_anchors.append(event.anchor)
                starts.append(n_values - 1)
            else:
                sizes[event.anchor or ""] = 1
        if len(open_anchors) > MAX_DEPTH:
            raise _error(
                text,
                source,
                f"more than {MAX_DEPTH} levels of nesting",
                event.start_mark,
            )
        if n_values > MAX_VALUES:
            raise _error(
                text, source, f"more than {MAX_VALUES} values", event.start_mark
            )


def _nodes(root: Any) -> Iterator[Any]:
    """Iterate over a root node and all nodes below it, each once."""
    import yaml

    seen = set()
    pending = [root]
    while pending:
        node = pending.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        yield node
        if isinstance(node, yaml.MappingNode):
            pending += [inner for pair in node.value for inner in pair]
        elif isinstance(node, yaml.SequenceNode):
            pending += node.value


def _check_keys(loader: Any, mapping: Any, text: str, source: str) -> None:
    import yaml

    keys = set()
    for node, _ in mapping.value:
        if not isinstance(node, yaml.ScalarNode):
            continue  # the loader rejects keys that are not scalars
        is_merge = node.tag == f"{_TAG}merge"
        key = node.value if is_merge else loader.construct_object(node)
        if key in keys:
            problem = f"the key {key!r} occurs twice"
            raise _error(text, source, problem, node.start_mark)
        keys.add(key)


def _error(text: str, source: str, problem: str, mark: Any) -> ConfigError:
    line = f", line {mark.line + 1}" if source and mark else ""
    return ConfigError(f"Expected YAML, got {source or repr(text)}{line}: {problem}.")


@cache
def _loader() -> Any:
    """Return the class of loaders of plain data; it reads numbers as jsonargparse does."""
    import yaml

    base = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    resolvers = {
        first: [
            (tag, pattern)
            for tag, pattern in tagged_patterns
            if tag not in (f"{_TAG}timestamp", f"{_TAG}float")
        ]
        for first, tagged_patterns in base.yaml_implicit_resolvers.items()
    }
    constructors = {
        tag: construct
        for tag, construct in base.yaml_constructors.items()
        if tag is None or tag.removeprefix(_TAG) not in _NOT_PLAIN
    }
    attributes = {
        "yaml_implicit_resolvers": resolvers,
        "yaml_constructors": constructors,
    }
    loader: Any = type("PlainLoader", (base,), attributes)
    loader.add_implicit_resolver(f"{_TAG}float", _FLOAT, list("-+0123456789."))
    return loader
