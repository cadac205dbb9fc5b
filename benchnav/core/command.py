"""How the commands read their words and report errors: one way for all three.

Words and YAML files make one plain mapping, which `benchnav.core.settings` reads by the
types of the function's parameters; the help is jsonargparse's. `--contact-sheet` is
`--contact_sheet true`, `--maps 3` is `--maps [3]`; a flag whose value is a name or a
mapping may be given as both, `--world paper --world.noise stored`. Bad input ends in
one line on standard error and exit status 2; an interruption in status 130.
"""

import errno
import inspect
import os
import signal
import sys
import threading
import warnings
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_origin

from benchnav.core.errors import (
    BenchnavError,
    ConfigError,
    check_text,
    expect,
    out_of_memory,
)
from benchnav.core.registry import KINDS
from benchnav.core.settings import (
    NO_DEFAULT,
    Option,
    changed,
    dataclass_in,
    hint,
    in_words,
    list_options,
    members_of,
    of,
    plain,
    read_options,
)
from benchnav.core.store import check_output
from benchnav.core.yaml_text import load_yaml, read_yaml

INTERRUPTED = 130

# Options that name what a command writes, of all commands.
OUTPUTS = ("out", "json", "onnx", "video")
_LONGEST = (
    2000  # characters of a message, of which the middle of a longer one is left out
)

# the option that a flag stands for, keys within its value; and its text
_Flag = tuple[list[str], str]

# of the flag --device; see `benchnav.core.device`
Device = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class Command:
    """One subcommand.

    Args:
        function: does the work; its type hints and docstring become flags and help. Of
            a dataclass without a default each field becomes a flag. It returns the exit
            status, or None for success.
        positionals: names of its parameters that are given by place rather than by
            flag; one that is a list takes what is left.
        repeated: names of lists whose flag may be given again, which adds to the list;
            of others the last one holds.
        configs: folder of shipped YAML files, which `--config NAME` finds where there
            is no such file.
    """

    function: Callable[..., int | None]
    positionals: tuple[str, ...] = ()
    repeated: tuple[str, ...] = ()
    configs: Path | None = None

    @cached_property
    def settings(self) -> dict[str, type]:
        """Dataclasses whose fields are flags, by the function's parameter."""
        known = list_options(self.function).items()
        kinds = {
            name: dataclass_in(option.kind)
            for name, option in known
            if option.default is NO_DEFAULT
        }
        return {name: kind for name, kind in kinds.items() if kind}

    @cached_property
    def options(self) -> dict[str, Option]:
        """What can be given, by name."""
        options: dict[str, Option] = {}
        for name, option in list_options(self.function).items():
            options |= (
                list_options(self.settings[name])
                if name in self.settings
                else {name: option}
            )
        return options

    @cached_property
    def flags(self) -> dict[str, Any]:
        """Types by flag; flags for the fields of a dataclass have a dot, those of a
        dataclass in it two.
        """
        kinds = {
            name: option.kind
            for name, option in self.options.items()
            if name not in self.positionals
        }
        level = kinds
        while level:
            level = {
                f"{name}.{field}": option.kind
                for name, kind in level.items()
                if (group := dataclass_in(kind))
                for field, option in list_options(group).items()
            }
            kinds |= level
        return kinds | {"config": str, "print_config": bool}

    @cached_property
    def shipped(self) -> dict[str, Path]:
        """Shipped YAML files by name."""
        return (
            {path.stem: path for path in sorted(self.configs.glob("*.yaml"))}
            if self.configs
            else {}
        )


def run(
    program: str,
    description: str,
    commands: dict[str, Command],
    argv: Sequence[str] | None = None,
) -> int:
    """Reads a command line and runs the subcommand it names; without one it prints the
    help.

    Args:
        program: name of the command.
        description: one line for `--help`.
        commands: subcommands by name.
        argv: arguments, or None for the process's own.

    Returns:
        Exit status: 0, 1 where the command or its error says so, 2 for bad input, 130
            when interrupted.
    """
    # Notices of libraries to their own developers would bury what a user has to read.
    warnings.filterwarnings("ignore", category=FutureWarning, module=r"torch\..*")
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    asked, *words = list(sys.argv[1:] if argv is None else argv) or ["--help"]
    command = commands.get(asked)
    try:
        if asked in ("-h", "--help"):
            _print_help(program, description, commands)
            return 0
        if command is None:
            raise ConfigError(
                f"Expected a command among {', '.join(commands)}, got "
                f"{asked!r}.{hint(asked, commands)}"
            )
        return _call(f"{program} {asked}", command, words) or 0
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except Exception as error:
        line = _said(error, command)
        if line is None:
            raise
        return _refuse(
            program, line, error.status if isinstance(error, BenchnavError) else 2
        )
    except KeyboardInterrupt as stopped:  # by Ctrl-C, or by a scheduler's SIGTERM
        # A command that knows what it has kept says so by the interruption's text.
        print(
            "; ".join([f"{program}: interrupted", *map(str, stopped.args)]),
            file=sys.stderr,
        )
        return INTERRUPTED


def tell(line: str) -> None:
    """Prints a line on standard error; where no one reads it any more, the work goes on
    without.
    """
    try:
        print(line, file=sys.stderr, flush=True)
    except BrokenPipeError:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115


def _call(program: str, command: Command, words: Sequence[str]) -> int | None:
    """Calls the function of a subcommand with what its words say, or prints its help or
    settings.
    """
    import yaml

    for word in words:
        check_text(word)
    if {"-h", "--help"} & set(words):
        return _print_help_of(program, command)
    flags, places = _read_words(program, command, words)
    arguments = _read_arguments(program, command, flags, places)
    known = {
        name: option.default
        for name, option in command.options.items()
        if option.default is not NO_DEFAULT
    }
    if printed := [value for path, value in flags if path == ["print_config"]]:
        settings = plain(arguments if "skip_default" in printed else known | arguments)
        print(yaml.safe_dump(settings, sort_keys=False, allow_unicode=True), end="")
        return 0
    if lacking := [name for name in command.options if name not in known | arguments]:
        named = [
            name.upper() if name in command.positionals else f"--{name}"
            for name in lacking
        ]
        raise ConfigError(
            f"Expected {' and '.join(named)}, got none. See `{program} --help`."
        )
    _check_texts(command, arguments)
    for parameter, kind in command.settings.items():
        own = {
            name: arguments.pop(name)
            for name in list_options(kind)
            if name in arguments
        }
        arguments[parameter] = kind(**own)
    return command.function(**arguments)


def _check_texts(command: Command, arguments: dict[str, Any]) -> None:
    """Refuse text that is empty where that means nothing, and outputs that are no paths
    here; fill in `~` in these.
    """
    for name, value in arguments.items():
        option = command.options[name]
        shown = name.upper() if name in command.positionals else f"--{name}"
        texts = value if option.kind == list[str] else [value]
        expect(option.default == "" or "" not in texts, f"{shown} as text, got ''.")
        if name in OUTPUTS and option.kind is str and value:
            check_output(value, name)
            arguments[name] = os.path.expanduser(value)


def _read_arguments(
    program: str, command: Command, flags: Sequence[_Flag], places: Sequence[str]
) -> dict[str, Any]:
    """Makes arguments by name of flags and of what is given by place.

    YAML files come first, then flags, then keys within the value of a flag, wherever
    they stand.

    Raises:
        ConfigError: something given is unknown or of another type.
    """
    options = command.options
    arguments: dict[str, Any] = {}  # from which later ones begin
    for file in [value for path, value in flags if path == ["config"]]:
        arguments |= read_options(
            options, _read_config(command, file), of(file), now=arguments
        )
    given: dict[str, Any] = {}
    for (name, *keys), value in sorted(flags, key=lambda flag: len(flag[0])):
        if name in options:
            kind, now = (
                options[name].kind,
                given.get(name, arguments.get(name, options[name].default)),
            )
            again = name in given and name in command.repeated
            given[name] = (
                _appended(now, value)
                if again
                else _merged(name, kind, now, keys, value)
            )
    for name in command.positionals:
        if options[name].kind == list[str] and (places or name not in arguments):
            given[name], places = list(places), []
        elif places:
            given[name], *places = places
    if places:
        raise ConfigError(
            f"Expected nothing more, got {' '.join(places)!r}. See `{program} --help`."
        )
    return arguments | read_options(options, given, "--{}".format, now=arguments)


def _read_words(
    program: str, command: Command, words: Sequence[str]
) -> tuple[list[_Flag], list[str]]:
    """Reads words as flags, each with the keys that it stands for and its value; and
    what is given by place.
    """
    flags: list[_Flag] = []
    places: list[str] = []
    rest = deque(words)
    while rest:
        word = rest.popleft()
        if not word.startswith("-") or word == "-":
            places.append(word)
            continue
        flag, equals, value = word.partition("=")
        path = _path_of(program, command, flag)
        kind = command.flags.get(".".join(path), Any)
        has_value = bool(rest) and not rest[0].startswith("--")
        is_switch = bool in members_of(kind)
        if is_switch:
            has_value = has_value and rest[0].lower() in ("true", "false", "yes", "no")
        if not equals and not has_value and not is_switch:
            raise ConfigError(
                f"Expected a value after {flag} ({in_words(kind)}), got none."
            )
        if not equals:
            value = rest.popleft() if has_value else "true"
        flags.append((path, value))
    return flags, places


def _path_of(program: str, command: Command, flag: str) -> list[str]:
    """The option that a flag stands for, and keys within its value.

    Raises:
        ConfigError: there is no such option.
    """
    name, *keys = flag.removeprefix("--").split(".")
    name, whole = name.replace("-", "_"), flag.removeprefix("--").replace("-", "_")
    if whole in command.flags:
        return whole.split(".")
    if keys and _takes_mapping(command.flags.get(name)):
        return [name, *keys]  # which stay as they are
    near = hint(whole, command.flags, "--")
    raise ConfigError(
        f"Expected flags that `{program}` has, got {flag}.{near} See `{program} "
        "--help`."
    )


def _merged(name: str, kind: Any, now: Any, keys: Sequence[str], text: str) -> Any:
    """The value of an option when the text of a flag is added to it: of the whole, or
    of a key in it.
    """
    is_group, value = dataclass_in(kind) is not None, text
    if (keys and not is_group) or (
        text.lstrip().startswith("{") and (is_group or _takes_mapping(kind))
    ):
        value = load_yaml(text)
    if is_group and not isinstance(now, dict):
        now = {}  # what is not given stays as it is
    if not keys:
        return value
    if isinstance(now, str) and str in members_of(kind):
        now = {"part" if name in KINDS else "preset": now}
    return changed(now, keys, value)


def _read_config(command: Command, value: str) -> dict[str, Any]:
    """Reads a YAML file of settings, by path or by the name of a shipped one."""
    path = Path(os.path.expanduser(value))
    if not path.is_file():
        path = command.shipped.get(value, path)
    if not path.exists():
        among = f", or one of {', '.join(command.shipped)}" if command.shipped else ""
        near = [
            *command.shipped,
            *(str(path.parent / other.name) for other in path.parent.glob("*.y*ml")),
        ]
        raise ConfigError(
            f"Expected --config as a YAML file{among}, got {value!r}, which is not "
            f"there.{hint(str(path), near)}"
        )
    content = read_yaml(path)
    if not isinstance(content, dict | None):
        raise ConfigError(
            f"Expected {path} to hold settings as `name: value`, got "
            f"{type(content).__name__}."
        )
    settings: dict[str, Any] = {}
    for key, item in (content or {}).items():
        keys = str(key).split(".")
        expect(
            not _is_set(settings, keys),
            f"each setting of {path} once, got {str(key)!r} twice.",
        )
        settings = changed(settings, keys, item)
    return settings


def _is_set(settings: Any, keys: Sequence[str]) -> bool:
    """Whether settings have a value, or values within it, where keys lead to."""
    for key in keys:
        if not isinstance(settings, Mapping) or key not in settings:
            return False
        settings = settings[key]
    return True


def _print_help(
    program: str, description: str, commands: Mapping[str, Command]
) -> None:
    print(
        f"usage: {program} COMMAND …\n\n{description}\n\ncommands, each with a --help "
        "of its own:"
    )
    width = max(map(len, commands))
    for name, command in commands.items():
        print(f"  {name:{width}}  {_summary(command.function)}")


def _print_help_of(program: str, command: Command) -> int:
    from docstring_parser import parse
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(prog=program, description=_summary(command.function))
    shipped = f", or one of {', '.join(command.shipped)}" if command.shipped else ""
    about = f"Path of a YAML file with these settings{shipped}."
    parser.add_argument("--config", action="config", help=about)
    documented = {
        p.arg_name: p.description
        for p in parse(inspect.getdoc(command.function) or "").params
    }
    for name in command.positionals:
        is_list = command.options[name].kind == list[str]
        action = parser.add_argument(
            name, help=documented.get(name), nargs="*" if is_list else None
        )
        # whether an empty list will do is the function's to say
        action.required = not is_list
    skip: set[str | int] = set(command.positionals)
    for kind in command.settings.values():
        parser.add_class_arguments(kind, as_group=False)
    parser.add_function_arguments(
        command.function, as_group=False, skip=skip | set(command.settings)
    )
    parser.print_help()
    return 0


def _appended(one: str, other: str) -> str:
    """Two lists, each as text with or without brackets, as one."""
    inner = (
        text.strip().removeprefix("[").removesuffix("]").strip()
        for text in (one, other)
    )
    return f"[{', '.join(text for text in inner if text)}]"


def _takes_mapping(kind: Any) -> bool:
    return any(get_origin(member) is dict for member in members_of(kind))


def _refuse(program: str, message: str, status: int) -> int:
    line = " ".join(message.split())
    if len(line) > _LONGEST:
        line = f"{line[: _LONGEST // 2]} … {line[-_LONGEST // 2 :]}"
    print(f"{program}: error: {line}", file=sys.stderr)
    return status


def _said(error: Exception, command: Command | None) -> str | None:
    """A line on what a user can mend; None of a fault of ours."""
    if no_memory := out_of_memory(error):
        return str(no_memory)
    if isinstance(error, BenchnavError | UnicodeDecodeError):
        return str(error)
    return _unusable(error, command) if isinstance(error, OSError) else None


def _unusable(error: OSError, command: Command | None) -> str:
    """Says which file or folder the system refused, and what to do."""
    reason = error.strerror or str(error)
    if not error.filename:
        return f"could not use a file: {reason}"
    path = Path(str(error.filename))
    if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"could not use {path}: {reason}"
    existing = next(
        place
        for place in (path.absolute(), *path.absolute().parents)
        if os.path.exists(place)
    )
    remedy = (
        "Choose another place with --out, or change"
        if command and "out" in command.flags
        else "Change"
    )
    return (
        f"could not use {path.absolute()}: {reason}. {remedy} the permissions of "
        f"{existing}."
    )


def _summary(function: Callable[..., Any]) -> str:
    return (inspect.getdoc(function) or "").splitlines()[0]
