"""How the commands parse, report errors and show progress: one way for all three.

Bad input ends in one line on standard error and exit status 2; an interruption in status 130.
"""

import inspect
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any, get_args, get_origin, get_type_hints

from benchnav.errors import BenchnavError


@dataclass(frozen=True)
class Command:
    """One subcommand.

    Args:
        function: does the work; its type hints and docstring become flags and help. It returns the
            exit status, or None for success.
        positionals: names of its parameters that are given by place rather than by flag; one that is a
            list takes what is left.
        settings: a dataclass whose fields become flags; one of it is the function's first argument.
    """

    function: Callable[..., int | None]
    positionals: tuple[str, ...] = ()
    settings: type | None = None


def run(
    program: str, description: str, commands: dict[str, Command], argv: Sequence[str] | None = None
) -> int:
    """Parses a command line and runs the subcommand it names.

    Args:
        program: name of the command.
        description: one line for `--help`.
        commands: subcommands by name.
        argv: arguments, or None for the process's own.

    Returns:
        Exit status: 0, 1 where the command says so, 2 for bad input, 130 when interrupted.
    """
    from jsonargparse import ArgumentError, ArgumentParser

    # Notices of libraries to their own developers would bury what a user has to read.
    warnings.filterwarnings("ignore", category=FutureWarning, module=r"torch\..*")
    argv = _as_parsed(sys.argv[1:] if argv is None else argv, commands)
    parser = ArgumentParser(prog=program, description=description, exit_on_error=False)
    subcommands = parser.add_subcommands(required=True, metavar="COMMAND", dest="command")
    for name, command in commands.items():
        child = ArgumentParser(exit_on_error=False, description=_summary(command.function))
        child.add_argument("--config", action="config", help="Path of a YAML file with these settings.")
        hints = get_type_hints(command.function)
        for positional in command.positionals:
            rest = {"type": str, "nargs": "*", "default": []} if hints[positional] == list[str] else {}
            child.add_argument(
                positional,
                **({"type": hints[positional]} | rest),
                help=_argument_help(command.function, positional),
            )
        skip: set[str | int] = set(command.positionals)
        if command.settings:
            child.add_class_arguments(command.settings, as_group=False)
            skip.add(next(iter(hints)))
        child.add_function_arguments(command.function, as_group=False, skip=skip)
        subcommands.add_subcommand(name, child, help=_summary(command.function))
    if not argv:
        parser.print_help()
        return 2
    try:
        parsed = parser.instantiate_classes(parser.parse_args(argv))
        command = commands[parsed.command]
        arguments = dict(vars(parsed[parsed.command]))
        arguments.pop("config", None)
        if command.settings is None:
            return command.function(**arguments) or 0
        settings = command.settings(**{f.name: arguments.pop(f.name) for f in fields(command.settings)})
        return command.function(settings, **arguments) or 0
    except (ArgumentError, BenchnavError, UnicodeDecodeError) as error:
        print(f"{program}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except OSError as error:
        print(
            f"{program}: error: could not use {error.filename or 'a file'}: {error.strerror or error}",
            file=sys.stderr,
        )
        return 2
    except KeyboardInterrupt:
        print(f"{program}: interrupted; what was finished is kept", file=sys.stderr)
        return 130


def show_progress(steps: Iterable[tuple[int, int]], what: str) -> None:
    """Runs work to its end while showing how far it is: a bar in a terminal, plain lines elsewhere.

    Args:
        steps: the work, yielding (done, total) as it goes.
        what: what is counted, for example "maps".
    """
    from rich.console import Console

    console = Console(stderr=True)
    if console.is_terminal:
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        columns: list[Any] = [TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()]
        with Progress(*columns, TimeRemainingColumn(), console=console) as bar:
            task = bar.add_task(what, total=None)
            for done, total in steps:
                bar.update(task, completed=done, total=total)
        return
    tenths = 0
    for done, total in steps:
        if done * 10 // total > tenths:
            tenths = done * 10 // total
            print(f"{what}: {done}/{total}", file=sys.stderr, flush=True)


def _as_parsed(argv: Sequence[str], commands: dict[str, Command]) -> list[str]:
    """Spells flags as the parser knows them.

    `--contact-sheet` for `--contact_sheet true`, and `--maps 3` for `--maps [3]`.
    """
    hints = [get_type_hints(command.function) for command in commands.values()]
    hints += [get_type_hints(command.settings) for command in commands.values() if command.settings]
    kinds = {f"--{name}": kind for types in hints for name, kind in types.items()}
    switches = {name for name, kind in kinds.items() if kind is bool}
    lists = {name for name, kind in kinds.items() if _is_list(kind)}
    spelled: list[str] = []
    for word, following in zip(argv, [*argv[1:], ""], strict=True):
        if spelled and spelled[-1] in lists and not word.startswith(("[", "(", "-")):
            spelled.append(f"[{word}]")
            continue
        name, equals, value = word.partition("=")
        if not name.startswith("--"):
            spelled.append(word)
            continue
        name = "--" + name[2:].replace("-", "_")
        if name in switches and not equals and following.lower() not in ("true", "false", "yes", "no"):
            equals, value = "=", "true"
        spelled.append(name + equals + value)
    return spelled


def _is_list(kind: Any) -> bool:
    return any(get_origin(part) in (list, tuple) for part in (kind, *get_args(kind)))


def _summary(function: Callable[..., Any]) -> str:
    return (inspect.getdoc(function) or "").splitlines()[0]


def _argument_help(function: Callable[..., Any], name: str) -> str:
    from docstring_parser import parse

    documented = parse(inspect.getdoc(function) or "").params
    return next((p.description or "" for p in documented if p.arg_name == name), "")
