"""Command lines: parsing of arguments, help and error reports of all three commands.

The arguments of a command line and of YAML files are merged into one plain mapping.
`benchnav.core.settings` converts its values to the types of the function's parameters;
jsonargparse prints the help. `--contact-sheet` means `--contact_sheet true`, and
`--maps 3` means `--maps [3]`. A flag whose value is a name or a mapping accepts both in
one command: `--world paper --world.noise stored`. Invalid input ends the command with
one line on standard error and exit status 2, an interruption with status 130.
`benchnav.core.failures` formulates the error messages.
"""

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
)
from benchnav.core.failures import describe_failure, report_failure
from benchnav.core.failures import tell as tell
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

INTERRUPTED = 130  # exit status

# Options whose value is the path of an output, over all commands.
OUTPUTS = ("out", "json", "onnx", "video")

_SWITCH_VALUES = ("true", "false", "yes", "no")

# Option of a flag followed by keys within the option's value; text of the value.
_Flag = tuple[list[str], str]

# Type of the flag --device; see `benchnav.core.device`.
Device = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class Command:
    """A subcommand.

    Args:
        function: function that runs the subcommand. Its type hints become flags, and
            its docstring becomes the help. If a parameter without a default is a
            dataclass, each field becomes a flag. The function returns the exit status,
            or None for success.
        positionals: names of the function's positional parameters; a parameter that is
            a list takes all remaining arguments.
        repeated: names of lists to which a repeated flag appends. Any other repeated
            flag replaces the earlier value.
        configs: folder of shipped YAML files. `--config NAME` means the shipped file of
            this name, unless the path NAME exists.
    """

    function: Callable[..., int | None]
    positionals: tuple[str, ...] = ()
    repeated: tuple[str, ...] = ()
    configs: Path | None = None

    @cached_property
    def settings(self) -> dict[str, type]:
        """Dataclasses whose fields are flags, by name of the function's parameter."""
        kinds = {
            name: dataclass_in(option.kind)
            for name, option in list_options(self.function).items()
            if option.default is NO_DEFAULT
        }
        return {name: kind for name, kind in kinds.items() if kind}

    @cached_property
    def options(self) -> dict[str, Option]:
        """Options by name, including positional arguments."""
        options: dict[str, Option] = {}
        for name, option in list_options(self.function).items():
            if name in self.settings:
                options |= list_options(self.settings[name])
            else:
                options[name] = option
        return options

    @cached_property
    def flags(self) -> dict[str, Any]:
        """Types by name of the flag; a dot separates levels of nested dataclasses."""
        kinds = {
            name: option.kind
            for name, option in self.options.items()
            if name not in self.positionals
        }
        level = kinds
        while level:
            next_level: dict[str, Any] = {}
            for name, kind in level.items():
                group = dataclass_in(kind)
                if not group:
                    continue
                for field, option in list_options(group).items():
                    next_level[f"{name}.{field}"] = option.kind
            kinds |= next_level
            level = next_level
        return kinds | {"config": str, "print_config": bool}

    @cached_property
    def shipped(self) -> dict[str, Path]:
        """Shipped YAML files by name."""
        if not self.configs:
            return {}
        return {path.stem: path for path in sorted(self.configs.glob("*.yaml"))}


def run(
    program: str,
    description: str,
    commands: dict[str, Command],
    argv: Sequence[str] | None = None,
) -> int:
    """Run the subcommand that a command line names; without arguments, print the help.

    Args:
        program: name of the command.
        description: one line for `--help`.
        commands: subcommands by name.
        argv: arguments; if None, the arguments of the process.

    Returns:
        Exit status: 0 for success, 1 if the command or its error sets it, 2 for invalid
            input, 130 if interrupted.
    """
    # Warnings that address developers of libraries would hide messages to the user.
    warnings.filterwarnings("ignore", category=FutureWarning, module=r"torch\..*")
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    arguments = list(sys.argv[1:] if argv is None else argv) or ["--help"]
    command_name, *words = arguments
    command = commands.get(command_name)
    try:
        if command_name in ("-h", "--help"):
            _print_help(program, description, commands)
            return 0
        if command is None:
            raise ConfigError(
                f"Expected a command among {', '.join(commands)}, got "
                f"{command_name!r}.{hint(command_name, commands)}"
            )
        return _call(f"{program} {command_name}", command, words) or 0
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except Exception as error:
        has_out = command is not None and "out" in command.flags
        message = describe_failure(error, has_out)
        if message is None:
            raise
        status = error.status if isinstance(error, BenchnavError) else 2
        report_failure(program, message)
        return status
    except KeyboardInterrupt as stopped:  # Ctrl-C, or SIGTERM from a scheduler
        # The interruption's text describes the partial results that a command saved.
        parts = [f"{program}: interrupted", *map(str, stopped.args)]
        print("; ".join(parts), file=sys.stderr)
        return INTERRUPTED


def _call(program: str, command: Command, words: Sequence[str]) -> int | None:
    """Call the function of a subcommand, or print the subcommand's help or settings."""
    import yaml

    for word in words:
        check_text(word)
    if {"-h", "--help"} & set(words):
        return _print_help_of(program, command)
    flags, positionals = _read_words(program, command, words)
    arguments = _read_arguments(program, command, flags, positionals)
    defaults = {
        name: option.default
        for name, option in command.options.items()
        if option.default is not NO_DEFAULT
    }
    print_modes = [text for path, text in flags if path == ["print_config"]]
    if print_modes:
        settings = arguments
        if "skip_default" not in print_modes:
            settings = defaults | arguments
        text = yaml.safe_dump(plain(settings), sort_keys=False, allow_unicode=True)
        print(text, end="")
        return 0
    available = defaults | arguments
    missing = [
        _shown_name(command, name) for name in command.options if name not in available
    ]
    if missing:
        raise ConfigError(
            f"Expected {' and '.join(missing)}, got none. See `{program} --help`."
        )
    _check_texts(command, arguments)
    for parameter, kind in command.settings.items():
        field_values = {
            name: arguments.pop(name)
            for name in list_options(kind)
            if name in arguments
        }
        arguments[parameter] = kind(**field_values)
    return command.function(**arguments)


def _shown_name(command: Command, name: str) -> str:
    """Return an option's name for messages: `NAME` if positional, else `--name`."""
    return name.upper() if name in command.positionals else f"--{name}"


def _check_texts(command: Command, arguments: dict[str, Any]) -> None:
    """Reject empty texts and invalid output paths, and expand `~` in output paths."""
    for name, value in arguments.items():
        option = command.options[name]
        shown = _shown_name(command, name)
        texts = value if option.kind == list[str] else [value]
        expect(option.default == "" or "" not in texts, f"{shown} as text, got ''.")
        if name in OUTPUTS and option.kind is str and value:
            check_output(value, name)
            arguments[name] = os.path.expanduser(value)


def _read_arguments(
    program: str, command: Command, flags: Sequence[_Flag], positionals: Sequence[str]
) -> dict[str, Any]:
    """Return arguments by name from flags and positional words.

    Whatever the order on the command line, YAML files are read first, then flags, and
    then flags for a key within an option's value.

    Raises:
        ConfigError: If an argument is unknown or has a different type.
    """
    options = command.options
    arguments: dict[str, Any] = {}
    config_files = [text for path, text in flags if path == ["config"]]
    for file in config_files:
        config = _read_config(command, file)
        arguments |= read_options(options, config, of(file), present=arguments)
    values: dict[str, Any] = {}
    for (name, *keys), text in sorted(flags, key=lambda flag: len(flag[0])):
        if name not in options:
            continue
        option = options[name]
        present = values.get(name, arguments.get(name, option.default))
        if name in values and name in command.repeated:
            values[name] = _appended(present, text)
        else:
            values[name] = _merged(name, option.kind, present, keys, text)
    remaining = list(positionals)
    for name in command.positionals:
        if options[name].kind == list[str] and (remaining or name not in arguments):
            values[name] = remaining
            remaining = []
        elif remaining:
            values[name] = remaining.pop(0)
    if remaining:
        raise ConfigError(
            f"Expected no further arguments, got {' '.join(remaining)!r}. See "
            f"`{program} --help`."
        )
    return arguments | read_options(options, values, "--{}".format, present=arguments)


def _read_words(
    program: str, command: Command, words: Sequence[str]
) -> tuple[list[_Flag], list[str]]:
    """Split the words of a command line into flags and positional words."""
    flags: list[_Flag] = []
    positionals: list[str] = []
    remaining = deque(words)
    while remaining:
        word = remaining.popleft()
        if not word.startswith("-") or word == "-":
            positionals.append(word)
            continue
        flag, equals, value = word.partition("=")
        path = _path_of(program, command, flag)
        kind = command.flags.get(".".join(path), Any)
        has_value = bool(remaining) and not remaining[0].startswith("--")
        is_switch = bool in members_of(kind)
        if is_switch:
            has_value = has_value and remaining[0].lower() in _SWITCH_VALUES
        if not equals and not has_value and not is_switch:
            raise ConfigError(
                f"Expected a value after {flag} ({in_words(kind)}), got none."
            )
        if not equals:
            value = remaining.popleft() if has_value else "true"
        flags.append((path, value))
    return flags, positionals


def _path_of(program: str, command: Command, flag: str) -> list[str]:
    """Return a flag's option, followed by keys within the option's value.

    Raises:
        ConfigError: If the command has no such option.
    """
    full_name = flag.removeprefix("--")
    name, *keys = full_name.split(".")
    name = name.replace("-", "_")
    full_name = full_name.replace("-", "_")
    if full_name in command.flags:
        return full_name.split(".")
    if keys and _takes_mapping(command.flags.get(name)):
        return [name, *keys]  # Keys of a mapping may contain hyphens.
    remedy = hint(full_name, command.flags, "--")
    raise ConfigError(
        f"Expected a flag of `{program}`, got {flag}.{remedy} See `{program} --help`."
    )


def _merged(name: str, kind: Any, present: Any, keys: Sequence[str], text: str) -> Any:
    """Return the value of an option after a flag has set the option or a key in it."""
    value = text
    is_group = dataclass_in(kind) is not None
    is_mapping = text.lstrip().startswith("{") and (is_group or _takes_mapping(kind))
    if (keys and not is_group) or is_mapping:
        value = load_yaml(text)
    if is_group and not isinstance(present, dict):
        present = {}  # `read` keeps the values of fields that are not set
    if not keys:
        return value
    if isinstance(present, str) and str in members_of(kind):
        present = {"part" if name in KINDS else "preset": present}
    return changed(present, keys, value)


def _read_config(command: Command, value: str) -> dict[str, Any]:
    """Read a YAML file of settings, given its path or the name of a shipped file."""
    path = Path(os.path.expanduser(value))
    if not path.is_file():
        path = command.shipped.get(value, path)
    if not path.exists():
        among = f", or one of {', '.join(command.shipped)}" if command.shipped else ""
        candidates = list(command.shipped)
        for sibling in path.parent.glob("*.y*ml"):
            candidates.append(str(path.parent / sibling.name))
        raise ConfigError(
            f"Expected --config to be an existing YAML file{among}, got {value!r}."
            f"{hint(str(path), candidates)}"
        )
    content = read_yaml(path)
    if not isinstance(content, dict | None):
        raise ConfigError(
            f"Expected {path} to contain settings as `name: value`, got a value of type "
            f"{type(content).__name__}."
        )
    settings: dict[str, Any] = {}
    for key, item in (content or {}).items():
        keys = str(key).split(".")
        expect(
            not _is_set(settings, keys),
            f"each setting once in {path}, got {str(key)!r} twice. Remove one.",
        )
        settings = changed(settings, keys, item)
    return settings


def _is_set(settings: Any, keys: Sequence[str]) -> bool:
    """Return whether nested settings contain a value at the path of keys."""
    for key in keys:
        if not isinstance(settings, Mapping) or key not in settings:
            return False
        settings = settings[key]
    return True


def _print_help(
    program: str, description: str, commands: Mapping[str, Command]
) -> None:
    print(
        f"usage: {program} COMMAND …\n\n{description}\n\ncommands, each with its "
        "own --help:"
    )
    width = max(map(len, commands))
    for name, command in commands.items():
        print(f"  {name:{width}}  {_summary(command.function)}")


def _print_help_of(program: str, command: Command) -> int:
    from docstring_parser import parse
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(prog=program, description=_summary(command.function))
    shipped = f", or one of {', '.join(command.shipped)}" if command.shipped else ""
    config_help = f"Path of a YAML file with these settings{shipped}."
    parser.add_argument("--config", action="config", help=config_help)
    documented = {
        p.arg_name: p.description
        for p in parse(inspect.getdoc(command.function) or "").params
    }
    for name in command.positionals:
        is_list = command.options[name].kind == list[str]
        action = parser.add_argument(
            name, help=documented.get(name), nargs="*" if is_list else None
        )
        # The function checks whether a list may be empty.
        action.required = not is_list
    skip: set[str | int] = set(command.positionals)
    for kind in command.settings.values():
        parser.add_class_arguments(kind, as_group=False)
    parser.add_function_arguments(
        command.function, as_group=False, skip=skip | set(command.settings)
    )
    parser.print_help()
    return 0


def _appended(first: str, second: str) -> str:
    """Return two lists, as text with or without brackets, as one list in brackets."""
    inner = (
        text.strip().removeprefix("[").removesuffix("]").strip()
        for text in (first, second)
    )
    return f"[{', '.join(text for text in inner if text)}]"


def _takes_mapping(kind: Any) -> bool:
    return any(get_origin(member) is dict for member in members_of(kind))


def _summary(function: Callable[..., Any]) -> str:
    return (inspect.getdoc(function) or "").splitlines()[0]
