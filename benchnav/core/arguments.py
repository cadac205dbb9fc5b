"""The words of a command line and the keys of its YAML files: how they may be spelled, and what is said of mistakes.

`--contact-sheet` is `--contact_sheet true`, `--maps 3` is `--maps [3]`; a flag whose value is a name or a
mapping may be given as both, `--world paper --world.noise stored`. What is unknown is refused here, with
what was perhaps meant, before the parser sees it.
"""

import copy
import inspect
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from benchnav.core.errors import ConfigError
from benchnav.core.options import dataclass_in, hint, list_options
from benchnav.core.registry import KINDS

_ALONE = {"help", "print_config"}  # flags of the parser's own that need no value


@dataclass(frozen=True, kw_only=True)
class Known:
    """What a subcommand knows.

    Args:
        program: its name with that of the command, for messages.
        kinds: types of flags by name, those within a dataclass with dots.
        defaults: default values of flags.
        positionals: names of what is given by place.
        configs: folder of shipped YAML files; None where there is none.
    """

    program: str
    kinds: Mapping[str, Any]
    defaults: Mapping[str, Any]
    positionals: tuple[str, ...] = ()
    configs: Path | None = None

    @property
    def shipped(self) -> dict[str, Path]:
        """Shipped YAML files by name."""
        return {path.stem: path for path in sorted(self.configs.glob("*.yaml"))} if self.configs else {}


def know(
    program: str,
    function: Callable[..., Any],
    positionals: tuple[str, ...] = (),
    settings: type | None = None,
    configs: Path | None = None,
) -> Known:
    """Tells what a subcommand knows; arguments as of `benchnav.core.command.Command`."""
    hints = {name: kind for name, kind in get_type_hints(function).items() if name != "return"}
    defaults = {
        name: parameter.default
        for name, parameter in inspect.signature(function).parameters.items()
        if parameter.default is not parameter.empty
    }
    if settings:
        hints.pop(next(iter(hints)))
        hints = get_type_hints(settings) | hints
        defaults |= {n: option.default for n, option in list_options(settings).items()}
    kinds = {"config": str, **dict(_nested(hints)), **dict.fromkeys(_ALONE, NoneType)}
    for name in positionals:
        kinds.pop(name)
    return Known(
        program=program,
        kinds=kinds,
        defaults=defaults,
        positionals=positionals,
        configs=configs,
    )


@dataclass(frozen=True)
class _Flag:
    """A flag as given: its name, the keys after it where it is a mapping, and its value."""

    name: str
    keys: tuple[str, ...]
    value: str


def spell(words: Sequence[str], known: Known) -> list[str]:
    """Spells the words of a subcommand as the parser knows them.

    What is given by place goes first, then YAML files, then flags, which so have the last word.

    Raises:
        ConfigError: a flag is unknown or lacks its value, or a YAML file cannot be used.
    """
    given, places = _read(words, known)
    paths = [_find_config(flag.value, known) for flag in given if flag.name == "config"]
    contents = [_read_config(path, known) for path in paths]
    spelled = [f"--config={path}" for path, content in zip(paths, contents, strict=True) if content]
    merged = {flag.name for flag in given if flag.keys}
    for flag in given:
        if flag.name not in merged and flag.name != "config":
            alone = flag.name in _ALONE and not flag.value
            spelled.append(f"--{flag.name}" if alone else f"--{flag.name}={flag.value}")
    for name in sorted(merged):
        own = [flag for flag in given if flag.name == name]
        spelled.append(f"--{name}={json.dumps(_merge(name, own, contents, known))}")
    return [*places, *spelled]


def explain(message: str, words: Sequence[str], known: Known) -> str:
    """Says in our words what the parser refused.

    Args:
        message: the parser's.
        words: the subcommand's, as the user gave them.
        known: what it knows.
    """
    message = " ".join(message.split())
    if found := re.match(r"the following arguments are required: (.*)", message):
        names = [name.rpartition(".")[2] for name in found[1].split(", ")]
        named = " and ".join(name.upper() if name in known.positionals else f"--{name}" for name in names)
        return f"Expected {named}, got none. See `{known.program} --help`."
    if found := re.match(r"unrecognized arguments: (.*)", message):
        return f"Expected nothing more, got {found[1]!r}. See `{known.program} --help`."
    if found := re.match(r"Subcommand '.*' does not accept option '([^']+)'", message):
        return f"Expected flags that `{known.program}` has, got {found[1]!r}.{hint(found[1], known.kinds)}"
    key = re.search(r'Parser key "([^"]+)"', message)
    value = re.search(
        r"(?:Got value|Given value|Unable to load config): ?(.*?)(?: - Expected .*)?$|Unable to load config '(.*?)'",
        message,
    )
    # The parser's key begins with the name of the command, which a setting may have too.
    names = [key[1], key[1].removeprefix(f"{known.program.split()[-1]}.")] if key else []
    if name := next((name for name in names if name in known.kinds), ""):
        given = [flag.value for flag in _read(words, known)[0] if flag.name == name]
        typed = bool(given)
        kind = known.kinds[name]
        # What the user typed reads better than what the parser made of it, without the brackets that `_read` adds.
        got = given[-1] if typed else (value[1] or value[2]) if value else message
        got = got if not typed or any(got in word for word in words) else got[1:-1]
        where = f"--{name}" if typed else f"`{name}`{_in_files(words)}"
        near = hint(got, [member for member in _members(kind) if isinstance(member, str)])
        return f"Expected {where} as {in_words(kind)}, got {got!r}.{near}"
    return re.sub(r"<class '([\w.]+)'>", r"\1", message)


def in_words(kind: Any) -> str:
    """A type as people call it."""
    members, origin = get_args(kind), get_origin(kind)
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(in_words(member) for member in members))
    if origin is Literal:
        return " or ".join(map(repr, members))
    if origin in (list, tuple) or kind in (list, tuple):
        inner = [member for member in members if member is not ...]
        if len(inner) > 1:
            return f"a list [{', '.join(map(in_words, inner))}]"
        return f"a list, each {in_words(inner[0])}" if inner else "a list"
    if origin is dict or kind is dict or dataclass_in(kind):
        return "a mapping"
    words = {int: "a whole number", float: "a number", str: "text", bool: "true or false", NoneType: "null"}
    return words.get(kind, getattr(kind, "__name__", "anything"))


def _nested(hints: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, kind in hints.items():
        yield prefix + name, kind
        if config := dataclass_in(kind):
            yield from _nested(get_type_hints(config), f"{prefix}{name}.")


def _read(words: Sequence[str], known: Known) -> tuple[list[_Flag], list[str]]:
    """Reads words as flags with their values, and what is given by place."""
    given: list[_Flag] = []
    places: list[str] = []
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if word in ("-h", "--help"):
            return [_Flag("help", (), "")], []
        if not word.startswith("-") or word == "-":
            places.append(word)
            continue
        flag, equals, value = word.partition("=")
        name, keys = _known_name(flag, known)
        kind = Any if keys else known.kinds[name]
        follows = rest[0] if rest and not rest[0].startswith("--") else None
        if not equals and kind is bool:
            is_value = follows is not None and follows.lower() in ("true", "false", "yes", "no")
            value = rest.pop(0) if is_value else "true"
        elif not equals and name not in _ALONE:
            if follows is None:
                expected = "" if kind is Any else f" ({in_words(kind)})"
                raise ConfigError(f"Expected a value after {flag}{expected}, got none.")
            value = rest.pop(0)
        if _is_list(kind) and str not in _members(kind) and not value.lstrip().startswith(("[", "(")):
            value = f"[{value}]"
        given.append(_Flag(name, keys, value))
    return given, places


def _known_name(flag: str, known: Known) -> tuple[str, tuple[str, ...]]:
    """A flag's name as the parser knows it, and keys within a mapping as they are.

    Raises:
        ConfigError: there is no such flag.
    """
    name = flag.lstrip("-").replace("-", "_")
    if flag.startswith("--") and name in known.kinds:
        return name, ()
    if flag.startswith("--") and (found := _split_keys(flag[2:], known)):
        return found
    names = [f"--{other}" for other in known.kinds]
    raise ConfigError(
        f"Expected flags that `{known.program}` has, got {flag}."
        f"{hint('--' + name, names)} "
        f"See `{known.program} --help`."
    )


def _split_keys(name: str, known: Known) -> tuple[str, tuple[str, ...]] | None:
    """Splits a name with dots into that of a flag that takes a mapping, and keys; None where there is none."""
    parts = name.split(".")
    for count in range(len(parts) - 1, 0, -1):
        head = ".".join(parts[:count]).replace("-", "_")
        if head in known.kinds and _takes_mapping(known.kinds[head]):
            return head, tuple(parts[count:])
    return None


def _merge(name: str, given: Sequence[_Flag], contents: Sequence[Mapping[str, Any]], known: Known) -> Any:
    """Makes one mapping of a flag's default, what files hold, its value as a whole, and its single keys."""
    from jsonargparse import get_loader

    load = get_loader("yaml")
    value = _as_mapping(name, known.defaults.get(name), known)
    for content in contents:
        held: Any = content
        for part in name.split("."):
            held = held.get(part) if isinstance(held, Mapping) else None
        if held is not None:
            value = _as_mapping(name, held, known)
    for flag in given:
        if not flag.keys and flag.value.lstrip().startswith("{"):
            value = _as_mapping(name, load(flag.value), known)
        elif not flag.keys:
            value |= _as_mapping(name, flag.value, known)
    for flag in given:
        place = value
        for key in flag.keys[:-1]:
            if not isinstance(place.get(key), dict):
                place[key] = {}
            place = place[key]
        if flag.keys:
            place[flag.keys[-1]] = load(flag.value)
    return value


def _as_mapping(name: str, value: Any, known: Known) -> dict[str, Any]:
    """Gives a copy of a mapping, or a mapping with a name in it."""
    if isinstance(value, Mapping):
        return copy.deepcopy(dict(value))
    if isinstance(value, str) and str in _members(known.kinds[name]):
        return {"part" if name in KINDS else "preset": value}
    if value is None:
        return {}
    raise ConfigError(f"Expected --{name} as {in_words(known.kinds[name])}, got {value!r}.")


def _in_files(words: Sequence[str]) -> str:
    """Which YAML file is meant, as far as that is known."""
    values = [
        word.partition("=")[2] or following
        for word, following in pairwise([*words, ""])
        if word.partition("=")[0] == "--config"
    ]
    return f" of {values[0]}" if len(values) == 1 else ""


def _find_config(value: str, known: Known) -> Path:
    path = Path(value).expanduser()
    if path.is_file():
        return path
    if value in known.shipped:
        return known.shipped[value]
    here = [str(path.parent / other.name) for other in path.parent.glob("*.y*ml")]
    among = f", or one of {', '.join(known.shipped)}" if known.shipped else ""
    raise ConfigError(
        f"Expected --config as a YAML file{among}, got {value!r}, which is not there."
        f"{hint(str(path), [*known.shipped, *here])}"
    )


def _read_config(path: Path, known: Known) -> dict[str, Any]:
    """Reads a YAML file and refuses keys that are unknown."""
    import yaml
    from jsonargparse import get_loader

    try:
        text = path.read_text()
        content = get_loader("yaml")(text)
        if isinstance(content, str):  # so it gives a mapping without values
            content = yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        at = f" in line {mark.line + 1}" if mark else ""
        raise ConfigError(f"{path} is no YAML{at}: {getattr(error, 'problem', None) or error}.") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"Expected {path} to hold settings as `name: value`, got {type(content).__name__}.")
    _check_keys(content, path, known)
    return content


def _check_keys(content: Mapping[str, Any], path: Path, known: Known, prefix: str = "") -> None:
    for key, value in content.items():
        name = f"{prefix}{key}"
        if name not in known.kinds and name not in known.positionals and not _split_keys(name, known):
            here = [other for other in known.kinds if other.startswith(prefix) and other not in _ALONE]
            raise ConfigError(
                f"Expected keys that `{known.program}` has in {path}, got {name!r}."
                f"{hint(name, here)} "
                f"See `{known.program} --help`."
            )
        kind = known.kinds.get(name, Any)
        if value is None and not {None, NoneType, Any} & set(_members(kind)):
            raise ConfigError(f"Expected `{name}` in {path} as {in_words(kind)}, got nothing.")
        if isinstance(value, dict) and dataclass_in(kind):
            _check_keys(value, path, known, f"{name}.")


def _members(kind: Any) -> tuple[Any, ...]:
    if get_origin(kind) in (Union, UnionType):
        return tuple(inner for member in get_args(kind) for inner in _members(member))
    return get_args(kind) if get_origin(kind) is Literal else (kind,)


def _is_list(kind: Any) -> bool:
    return any(get_origin(member) in (list, tuple) for member in _members(kind))


def _takes_mapping(kind: Any) -> bool:
    return any(member in (Any, dict) or get_origin(member) is dict for member in _members(kind))
