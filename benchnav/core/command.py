"""How the commands parse, report errors and show progress: one way for all three.

Bad input ends in one line on standard error and exit status 2; an interruption in status 130.
"""

import errno
import inspect
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_type_hints

from benchnav.core.arguments import Known, explain, know, spell
from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.options import hint

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


def run(
    program: str, description: str, commands: dict[str, Command], argv: Sequence[str] | None = None
) -> int:
    """Parses a command line and runs the subcommand it names; without one it prints the help.

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
    argv = list(sys.argv[1:] if argv is None else argv)
    parser = ArgumentParser(prog=program, description=description, exit_on_error=False)
    subcommands = parser.add_subcommands(required=True, metavar="COMMAND", dest="command")
    known: dict[str, Known] = {}
    for name, command in commands.items():
        known[name] = know(f"{program} {name}", *(getattr(command, item.name) for item in fields(command)))
        subcommands.add_subcommand(name, _subparser(command, known[name]), help=_summary(command.function))
    if not argv:
        parser.print_help()
        return 0
    asked, words = argv[0], argv[1:]
    try:
        if asked not in commands and asked not in ("-h", "--help"):
            raise ConfigError(
                f"Expected a command among {', '.join(commands)}, got {asked!r}.{hint(asked, commands)}"
            )
        spelled = spell(words, known[asked]) if asked in commands else words
        parsed = parser.instantiate(parser.parse_args([asked, *spelled]))
        command = commands[asked]
        arguments = dict(vars(parsed[asked]))
        arguments.pop("config", None)
        if command.settings is None:
            return command.function(**arguments) or 0
        settings = command.settings(**{f.name: arguments.pop(f.name) for f in fields(command.settings)})
        return command.function(settings, **arguments) or 0
    except ArgumentError as error:
        return _refuse(program, explain(str(error), words, known[asked]))
    except (BenchnavError, UnicodeDecodeError) as error:
        return _refuse(program, str(error))
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except OSError as error:
        return _refuse(program, _unusable(error, known[asked]))
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
            tell(f"{what}: {done}/{total}")


def _subparser(command: Command, known: Known) -> Any:
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(exit_on_error=False, description=_summary(command.function))
    shipped = f", or one of {', '.join(known.shipped)}" if known.shipped else ""
    parser.add_argument(
        "--config", action="config", help=f"Path of a YAML file with these settings{shipped}."
    )
    hints = get_type_hints(command.function)
    for positional in command.positionals:
        rest = {"type": str, "nargs": "*", "default": []} if hints[positional] == list[str] else {}
        parser.add_argument(
            positional,
            **({"type": hints[positional]} | rest),
            help=_argument_help(command.function, positional),
        )
    skip: set[str | int] = set(command.positionals)
    if command.settings:
        parser.add_class_arguments(command.settings, as_group=False)
        skip.add(next(iter(hints)))
    parser.add_function_arguments(command.function, as_group=False, skip=skip)
    return parser


def _refuse(program: str, message: str) -> int:
    print(f"{program}: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _unusable(error: OSError, known: Known) -> str:
    """Says which file or folder the system refused, and what to do."""
    reason = error.strerror or str(error)
    if not error.filename:
        return f"could not use a file: {reason}"
    path = Path(str(error.filename))
    if error.errno not in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"could not use {path}: {reason}"
    there = next(place for place in (path.absolute(), *path.absolute().parents) if place.exists())
    remedy = "Choose another place with --out, or change" if "out" in known.kinds else "Change"
    return f"could not use {path.absolute()}: {reason}. {remedy} the permissions of {there}."


def _summary(function: Callable[..., Any]) -> str:
    return (inspect.getdoc(function) or "").splitlines()[0]


def _argument_help(function: Callable[..., Any], name: str) -> str:
    from docstring_parser import parse

    documented = parse(inspect.getdoc(function) or "").params
    return next((p.description or "" for p in documented if p.arg_name == name), "")
