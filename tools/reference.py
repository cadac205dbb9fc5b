"""Write the reference pages of the three commands and of the metrics.

    python tools/reference.py docs/reference/commands

Each command has a page, each subcommand a section, and each option a row, with the
contents of `--help`. The page of metrics has a row per metric, from its object.
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
    """Return the documentation of a function's parameters or a dataclass's fields.

    Fields of base classes are included.
    """
    descriptions: dict[str, str] = {}
    for owner in reversed(getattr(target, "__mro__", (target,))):
        parameters = (
            parse(inspect.getdoc(owner) or "").params if owner is not object else []
        )
        descriptions |= {
            parameter.arg_name: " ".join((parameter.description or "").split())
            for parameter in parameters
        }
    return descriptions


def line(*cells: str) -> str:
    """Return a row of a Markdown table."""
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def row(name: str, option: Option, meaning: str) -> str:
    """Return the row of an option."""
    default = ""
    if option.default is NO_DEFAULT:
        default = "needed"
    elif not dataclass_in(option.kind):
        value = (
            yaml.safe_dump(plain(option.default), default_flow_style=True)
            .removesuffix("...\n")
            .strip()
        )
        default = f"`{value}`"
    return line(f"`{name}`", in_words(option.kind).replace("'", "`"), default, meaning)


def section(program: str, name: str, command: Command) -> str:
    """Return the section of a subcommand."""
    meanings = documented(command.function)
    for kind in command.settings.values():
        meanings |= documented(kind)
    rows = []
    names = (
        *command.positionals,
        *(name for name in command.options if name not in command.positionals),
    )
    for option_name in names:
        option = command.options[option_name]
        is_positional = option_name in command.positionals
        flag = option_name.upper() if is_positional else f"--{option_name}"
        rows.append(row(flag, option, meanings.get(option_name, "")))
        if group := dataclass_in(option.kind):
            fields = documented(group)
            rows += [
                row(f"{flag}.{key}", item, fields.get(key, ""))
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
    """Return the page of metrics: first those of every run, then those on request."""
    shipped = [metric.name for metric in SHIPPED]
    head = [
        line("name", "column", "unit", "better", "meaning"),
        "|---|---|---|---|---|",
    ]
    parts = []
    for title, names in (
        ("In every run", shipped),
        (
            "By name, in `metrics`",
            [name for name in registry.names("metric") if name not in shipped],
        ),
    ):
        rows = []
        for name in names:
            quantity = registry.make("metric", name).quantity
            better = "" if quantity.better == "neither" else quantity.better
            rows.append(
                line(
                    f"`{name}`",
                    f"`{quantity.column}`",
                    quantity.unit,
                    better,
                    quantity.meaning,
                )
            )
        parts.append("\n".join([f"## {title}", "", *head, *rows, ""]))
    introduction = (
        "A metric is one number for each episode: a column of `episodes.parquet`. "
        "Hypotheses and `compare --metric` "
        "take its name; the unit is that of differences and margins. "
        "[A metric of your own](../../how-to/own-parts.md#metric) is a class in a "
        "file."
    )
    return "\n".join(["# Metrics of episodes", "", introduction, "", *parts])


def main() -> None:
    """Write the pages."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name, module in PROGRAMS.items():
        program = f"benchnav-{name}"
        commands: dict[str, Command] = import_module(module).COMMANDS
        sections = [
            section(program, subcommand, command)
            for subcommand, command in commands.items()
        ]
        write_text(folder / f"{name}.md", f"# {program}\n\n" + "\n".join(sections))
    write_text(folder / "metrics.md", metrics_page())


if __name__ == "__main__":
    main()
