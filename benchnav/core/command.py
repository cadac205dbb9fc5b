"""How the commands read their words, report errors and show progress: one way for all three.

Words and YAML files make one plain mapping, which `benchnav.core.settings` reads by the types of the function's
parameters; the help is jsonargparse's. `--contact-sheet` is `--contact_sheet true`, `--maps 3` is `--maps [3]`; a
flag whose value is a name or a mapping may be given as both, `--world paper --world.noise stored`. Bad input ends in
one line on standard error and exit status 2; an interruption in status 130.
"""

import errno
import inspect
import os
import sys
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any, Literal, get_origin

from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.registry import KINDS
from benchnav.core.settings import (
    NO_DEFAULT,
    Option,
    changed,
    dataclass_in,
    hint,
    in_words,
    list_options,
    load_yaml,
    members_of,
    plain,
    read,
    read_yaml,
)

INTERRUPTED = 130

Device = Literal["auto", "cpu", "cuda"]  # of the flag --device; see `benchnav.core.device`


@dataclass(frozen=True)
class Command:
    """One subcommand.

    Args:
        function: does the work; its type hints and docstring become flags and help. It returns the
            exit status, or None for success.
        positionals: names of its parameters that are given by place rather than by flag; one that is a
            list takes what is left.
        settings: a dataclass whose fields become flags; one of it is the function's first argument.
        configs: folder of shipped YAML files, which `--config NAME` finds where there is no such file.
    """

    function: Callable[..., int | None]
    positionals: tuple[str, ...] = ()
    settings: type | None = None
    configs: Path | None = None

    @cached_property
    def options(self) -> dict[str, Option]:
        """What can be given, by name."""
        options = list_options(self.function)
        if self.settings:
            options.pop(next(iter(options)))
            options = list_options(self.settings) | options
        return options

    @cached_property
    def kinds(self) -> dict[str, Any]:
        """Types by name of what can be given; names of fields of a dataclass have dots."""
        return {"config": str, "print_config": bool} | dict(_with_fields(self.options))

    @cached_property
    def shipped(self) -> dict[str, Path]:
        """Shipped YAML files by name."""
        return {path.stem: path for path in sorted(self.configs.glob("*.yaml"))} if self.configs else {}


def run(
    program: str, description: str, commands: dict[str, Command], argv: Sequence[str] | None = None
) -> int:
    """Reads a command line and runs the subcommand it names; without one it prints the help.

    Args:
        program: name of the command.
        description: one line for `--help`.
        commands: subcommands by name.
        argv: arguments, or None for the process's own.

    Returns:
        Exit status: 0, 1 where the command says so, 2 for bad input, 130 when interrupted.
    """
    # Notices of libraries to their own developers would bury what a user has to read.
    warnings.filterwarnings("ignore", category=FutureWarning, module=r"torch\..*")
    asked, *words = list(sys.argv[1:] if argv is None else argv) or ["--help"]
    command = commands.get(asked)
    try:
        if asked in ("-h", "--help"):
            _print_help(program, description, commands)
            return 0
        if command is None:
            raise ConfigError(
                f"Expected a command among {', '.join(commands)}, got {asked!r}.{hint(asked, commands)}"
            )
        if {"-h", "--help"} & set(words):
            _print_help_of(f"{program} {asked}", command)
            return 0
        arguments = _read_arguments(f"{program} {asked}", command, words)
        if arguments is None:
            return 0
        if command.settings is None:
            return command.function(**arguments) or 0
        own = {name: arguments.pop(name) for name in list_options(command.settings) if name in arguments}
        return command.function(command.settings(**own), **arguments) or 0
    except (BenchnavError, UnicodeDecodeError) as error:
        return _refuse(program, str(error))
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except OSError as error:
        return _refuse(program, _unusable(error, command))
    except KeyboardInterrupt:
        print(f"{program}: interrupted; what was finished is kept", file=sys.stderr)
        return INTERRUPTED


def tell(line: str) -> None:
    """Prints a line on standard error; where no one reads it any more, the work goes on without."""
    try:
        print(line, file=sys.stderr, flush=True)
    except BrokenPipeError:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115


def show_progress(steps: Iterable[tuple[int, int]], what: str) -> None:
    """Runs work to its end while showing how far it is: a bar in a terminal, plain lines elsewhere.

    Args:
        steps: the work, yielding (done, total) as it goes.
        what: what is counted, for example "maps".
    """
    from rich.console import Console

    console = Console(stderr=True)
    if console.is_terminal:
        from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn

        columns = [*Progress.get_default_columns(), MofNCompleteColumn(), TimeElapsedColumn()]
        with Progress(*columns, console=console) as bar:
            task = bar.add_task(what, total=None)
            for done, total in steps:
                bar.update(task, completed=done, total=total)
        return
    tenths = 0
    for done, total in steps:
        if done * 10 // total > tenths:
            tenths = done * 10 // total
            tell(f"{what}: {done}/{total}")


def _read_arguments(program: str, command: Command, words: Sequence[str]) -> dict[str, Any] | None:
    """Reads a subcommand's words to arguments by name; None where `--print_config` had them printed.

    YAML files come first, then flags, then keys within the value of a flag, wherever they stand.

    Raises:
        ConfigError: something given is unknown, missing or of another type.
    """
    flags, places = _read_words(program, command, words)
    entries = [
        (file, _path_of(program, command, key, file), value)
        for path, file in flags
        if path == ["config"]
        for key, value in _read_config(command, file).items()
    ]
    entries += [("", path, value) for path, value in sorted(flags, key=lambda flag: len(flag[0]))]
    given: dict[str, Any] = {}
    files: dict[str, str] = {}  # that keys stand in; empty for flags
    for file, path, value in entries:
        files[".".join(path)] = file
        given[path[0]] = _merged(command, given, path, value)
    for name in command.positionals:
        if command.options[name].kind == list[str]:
            given[name], places = places or given.get(name, []), []
        elif places:
            given[name] = places.pop(0)
    if places:
        raise ConfigError(f"Expected nothing more, got {' '.join(places)!r}. See `{program} --help`.")

    def known_as(key: str) -> str:
        around = [name for name in accumulate(key.split("."), "{}.{}".format) if name in files]
        file = files[around[-1]] if around else ""
        return f"`{key}` of {file}" if file else f"--{key}"

    arguments = {
        name: read(option.kind, given[name], known_as, name, option.default)
        for name, option in command.options.items()
        if name in given
    }
    if "print_config" in given:
        _print_config(command, arguments, given["print_config"])
        return None
    missing = [
        name.upper() if name in command.positionals else f"--{name}"
        for name, option in command.options.items()
        if option.default is NO_DEFAULT and name not in given
    ]
    if missing:
        raise ConfigError(f"Expected {' and '.join(missing)}, got none. See `{program} --help`.")
    return arguments


def _read_words(
    program: str, command: Command, words: Sequence[str]
) -> tuple[list[tuple[list[str], Any]], list[str]]:
    """Reads words as flags, each with the keys that it stands for and its value; and what is given by place."""
    flags: list[tuple[list[str], Any]] = []
    places: list[str] = []
    rest = deque(words)
    while rest:
        word = rest.popleft()
        if not word.startswith("-") or word == "-":
            places.append(word)
            continue
        flag, equals, value = word.partition("=")
        path = _path_of(program, command, flag)
        kind = command.kinds.get(".".join(path), Any)
        if not equals and kind is bool:
            value = rest.popleft() if rest and rest[0].lower() in ("true", "false", "yes", "no") else "true"
        elif not equals:
            if not rest or rest[0].startswith("--"):
                expected = "" if kind is Any else f" ({in_words(kind)})"
                raise ConfigError(f"Expected a value after {flag}{expected}, got none.")
            value = rest.popleft()
        is_yaml = (
            kind is Any or dataclass_in(kind) or (_takes_mapping(kind) and value.lstrip().startswith("{"))
        )
        flags.append((path, load_yaml(value) if is_yaml else value))
    return flags, places


def _path_of(program: str, command: Command, name: str, file: str = "") -> list[str]:
    """The option that a flag or a key of a file stands for, and keys within its value, which stay as they are.

    Raises:
        ConfigError: there is no such option.
    """
    parts = name.removeprefix("--").split(".")
    for count in range(len(parts), 0, -1):
        head = ".".join(parts[:count]).replace("-", "_")
        is_whole = count == len(parts) and (file or head not in command.positionals)
        if head in command.kinds and (is_whole or _takes_mapping(command.kinds[head])):
            return [*head.split("."), *parts[count:]]
    near = hint(name.lstrip("-").replace("-", "_"), command.kinds, "" if file else "--")
    where = f"{name!r} in {file}" if file else name
    raise ConfigError(f"Expected settings of `{program}`, got {where}.{near} See `{program} --help`.")


def _merged(command: Command, given: Mapping[str, Any], path: Sequence[str], value: Any) -> Any:
    """The value of an option when one more value, of it or of a key in it, is given."""
    name, *keys = path
    kind = command.kinds[name]
    is_group = dataclass_in(kind) is not None
    now = given.get(name, None if is_group or name not in command.options else command.options[name].default)
    if not keys:
        return now | value if is_group and isinstance(now, dict) and isinstance(value, dict) else value
    if isinstance(now, str) and str in members_of(kind):
        now = {"part" if name in KINDS else "preset": now}
    return changed(now, keys, value)


def _read_config(command: Command, value: str) -> dict[str, Any]:
    """Reads a YAML file of settings, by path or by the name of a shipped one."""
    path = Path(value).expanduser()
    if not path.is_file():
        path = command.shipped.get(value, path)
    if not path.exists():
        among = f", or one of {', '.join(command.shipped)}" if command.shipped else ""
        near = [*command.shipped, *(str(path.parent / other.name) for other in path.parent.glob("*.y*ml"))]
        raise ConfigError(
            f"Expected --config as a YAML file{among}, got {value!r}, which is not there.{hint(str(path), near)}"
        )
    content = read_yaml(path)
    if not isinstance(content, dict | None):
        raise ConfigError(f"Expected {path} to hold settings as `name: value`, got {type(content).__name__}.")
    return {str(key): item for key, item in (content or {}).items()}


def _print_config(command: Command, arguments: Mapping[str, Any], how: str) -> None:
    """Prints settings as YAML, as far as they are known; with `skip_default` those that are given alone."""
    import yaml

    settings = {
        name: plain(arguments.get(name, option.default))
        for name, option in command.options.items()
        if name in arguments or (option.default is not NO_DEFAULT and how != "skip_default")
    }
    print(yaml.safe_dump(settings, sort_keys=False, allow_unicode=True), end="")


def _print_help(program: str, description: str, commands: Mapping[str, Command]) -> None:
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(prog=program, description=description)
    subcommands = parser.add_subcommands(metavar="COMMAND")
    for name, command in commands.items():
        subcommands.add_subcommand(name, ArgumentParser(), help=_summary(command.function))
    parser.print_help()


def _print_help_of(program: str, command: Command) -> None:
    from docstring_parser import parse
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(prog=program, description=_summary(command.function))
    shipped = f", or one of {', '.join(command.shipped)}" if command.shipped else ""
    about = f"Path of a YAML file with these settings{shipped}."
    parser.add_argument("--config", action="config", help=about)
    documented = {p.arg_name: p.description for p in parse(inspect.getdoc(command.function) or "").params}
    for name in command.positionals:
        many = {"nargs": "*"} if command.options[name].kind == list[str] else {}
        parser.add_argument(name, type=str, help=documented.get(name), **many)
    skip: set[str | int] = set(command.positionals)
    if command.settings:
        parser.add_class_arguments(command.settings, as_group=False)
        skip.add(next(iter(inspect.signature(command.function).parameters)))
    parser.add_function_arguments(command.function, as_group=False, skip=skip)
    parser.print_help()


def _with_fields(options: Mapping[str, Option], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, option in options.items():
        yield prefix + name, option.kind
        if config := dataclass_in(option.kind):
            yield from _with_fields(list_options(config), f"{prefix}{name}.")


def _takes_mapping(kind: Any) -> bool:
    return any(member in (Any, dict) or get_origin(member) is dict for member in members_of(kind))


def _refuse(program: str, message: str) -> int:
    print(f"{program}: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _unusable(error: OSError, command: Command | None) -> str:
    """Says which file or folder the system refused, and what to do."""
    reason = error.strerror or str(error)
    if not error.filename:
        return f"could not use a file: {reason}"
    path = Path(str(error.filename))
    if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"could not use {path}: {reason}"
    existing = next(place for place in (path.absolute(), *path.absolute().parents) if place.exists())
    remedy = "Choose another place with --out, or change" if command and "out" in command.kinds else "Change"
    return f"could not use {path.absolute()}: {reason}. {remedy} the permissions of {existing}."


def _summary(function: Callable[..., Any]) -> str:
    return (inspect.getdoc(function) or "").splitlines()[0]
