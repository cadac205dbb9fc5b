"""Writes the pages of the three commands for the documentation, from their parsers, and
that of the metrics.

    python tools/reference.py docs/reference/commands

A page a command, a section a subcommand, a row an option, as `--help` has them; and a
row a metric, as its object has them.
"""

import inspect
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import yaml
from docstring_parser import parse

from benchnav.core import registry
from benchnav.core.command import Command
from benchnav.core.settings import (
    NO_DEFAULT,
    Option,
    dataclass_in,
    in_words,
    list_options,
    plain,
)
from benchnav.core.store import write_text
from benchnav.metrics import SHIPPED

PROGRAMS = {
    "datagen": "benchnav.datagen.cli",
    "train": "benchnav.models.cli",
    "eval": "benchnav.eval.cli",
}


def documented(target: Any) -> dict[str, str]:
    """What docstrings say of each parameter of a function, or of each field of a
    dataclass and of its bases.
    """
    found: dict[str, str] = {}
    for owner in reversed(getattr(target, "__mro__", (target,))):
        told = parse(inspect.getdoc(owner) or "").params if owner is not object else []
        found |= {
            own.arg_name: " ".join((own.description or "").split()) for own in told
        }
    return found


def line(*cells: str) -> str:
    """A row of a table."""
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def row(name: str, option: Option, about: str) -> str:
    """The row of an option."""
    shown = ""
    if option.default is NO_DEFAULT:
        shown = "needed"
    elif not dataclass_in(option.kind):
        value = (
            yaml.safe_dump(plain(option.default), default_flow_style=True)
            .removesuffix("...\n")
            .strip()
        )
        shown = f"`{value}`"
    return line(f"`{name}`", in_words(option.kind).replace("'", "`"), shown, about)


def section(program: str, name: str, command: Command) -> str:
    """The section of a subcommand."""
    about = documented(command.function)
    for kind in command.settings.values():
        about |= documented(kind)
    rows = []
    for option in (
        *command.positionals,
        *(own for own in command.options if own not in command.positionals),
    ):
        own = command.options[option]
        flag = option.upper() if option in command.positionals else f"--{option}"
        rows.append(row(flag, own, about.get(option, "")))
        if group := dataclass_in(own.kind):
            told = documented(group)
            rows += [
                row(f"{flag}.{key}", item, told.get(key, ""))
                for key, item in list_options(group).items()
            ]
    shipped = f", or one of {', '.join(command.shipped)}" if command.shipped else ""
    rows.append(
        line("`--config`", "text", "", f"A YAML file with these settings{shipped}.")
    )
    rows.append(
        line(
            "`--print_config`",
            "true or false",
            "",
            "Print the settings as YAML and end.",
        )
    )
    text = (inspect.getdoc(command.function) or "").partition("\nArgs:")[0].strip()
    head = [line("option", "type", "default", "meaning"), "|---|---|---|---|"]
    return "\n".join(
        [f"## {name}", "", f"`{program} {name}`: {text}", "", *head, *rows, ""]
    )


def metrics_page() -> str:
    """The page of the metrics: those of every run in the order of columns, then those
    that a suite can name.
    """
    every = [metric.name for metric in SHIPPED]
    head = [
        line("name", "column", "unit", "better", "meaning"),
        "|---|---|---|---|---|",
    ]
    parts = []
    for title, names in (
        ("In every run", every),
        (
            "By name, in `metrics`",
            [name for name in registry.names("metric") if name not in every],
        ),
    ):
        rows = []
        for name in names:
            own = registry.make("metric", name).quantity
            better = "" if own.better == "neither" else own.better
            rows.append(
                line(f"`{name}`", f"`{own.column}`", own.unit, better, own.meaning)
            )
        parts.append("\n".join([f"## {title}", "", *head, *rows, ""]))
    said = (
        "A metric is one number for each episode: a column of `episodes.parquet`. "
        "Hypotheses and `compare --metric` "
        "take its name; the unit is that of differences and margins. "
        "[A metric of your own](../../how-to/own-parts.md#metric) is a class in a "
        "file."
    )
    return "\n".join(["# Metrics of episodes", "", said, "", *parts])


def main() -> None:
    """Writes the pages."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name, module in PROGRAMS.items():
        program = f"benchnav-{name}"
        commands: dict[str, Command] = import_module(module).COMMANDS
        sections = [section(program, own, command) for own, command in commands.items()]
        write_text(folder / f"{name}.md", f"# {program}\n\n" + "\n".join(sections))
    write_text(folder / "metrics.md", metrics_page())


if __name__ == "__main__":
    main()
