"""Write the reference pages of commands, metrics and public names.

    python tools/reference.py commands docs/reference/commands
    python tools/reference.py names docs/reference/api

Each command has a page, each subcommand a section, and each option a row, with the
contents of `--help`. The page of metrics has a row per metric, from its object. Each
package with public names has a page with a row per name, from its docstring; the site
adds parameters, returned values and errors there.
"""

import inspect
import sys
from enum import Enum
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

# Packages with public names, and those that a page has in addition.
PACKAGES = (
    "benchnav",
    *(
        f"benchnav.{name}"
        for name in (
            "datagen",
            "models",
            "planning",
            "env",
            "metrics",
            "eval",
            "viz",
            "testing",
        )
    ),
)
EXTRA = {"benchnav.viz": ("benchnav.eval.figures",)}
MAX_PARAMETERS = 5
IMPORTED = (
    "Import the names of this table from `{}`. The site, which `make docs` builds, adds "
    "parameters with units and shapes, returned values and errors."
)
DETAILS = """::: {}
    options:
      show_root_heading: false
      show_root_toc_entry: false
"""


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
        "[A metric of your own](../../how-to/own-metric.md) is a class in a "
        "file."
    )
    return "\n".join(["# Metrics of episodes", "", introduction, "", *parts])


def call_of(name: str, target: Any) -> str:
    """Return a name with its parameters, or only the name if it takes none."""
    no_call = inspect.isabstract(target) or is_derived(target, (BaseException, Enum))
    if no_call or not callable(target):
        return name
    parameters = list(inspect.signature(target).parameters)
    if parameters == ["args", "kwargs"]:
        return name
    shown = parameters[:MAX_PARAMETERS]
    if len(parameters) > MAX_PARAMETERS:
        shown.append("…")
    return f"{name}({', '.join(shown)})"


def is_derived(target: Any, bases: tuple[type, ...]) -> bool:
    """Return whether a target is a class derived from one of some bases."""
    return isinstance(target, type) and issubclass(target, bases)


def names_page(package: str) -> str:
    """Return the page of a package's public names."""
    parts = [f"# {package}"]
    for section_package in (package, *EXTRA.get(package, ())):
        module = import_module(section_package)
        introduction = (inspect.getdoc(module) or "").partition("\n\n")[0]
        rows = []
        for name in module.__all__:
            target = getattr(module, name)
            summary = (inspect.getdoc(target) or "").partition("\n\n")[0]
            meaning = " ".join(summary.split()).removesuffix(".")
            rows.append(line(f"`{call_of(name, target)}`", meaning))
        if len(parts) > 1:
            parts.append(f"## {section_package}")
        parts += [
            f"{' '.join(introduction.split())} {IMPORTED.format(section_package)}",
            "\n".join([line("name", "meaning"), "|---|---|", *rows]),
            DETAILS.format(section_package),
        ]
    return "\n\n".join(parts)


def write_commands(folder: Path) -> None:
    """Write the pages of commands and metrics."""
    for name, module in PROGRAMS.items():
        program = f"benchnav-{name}"
        commands: dict[str, Command] = import_module(module).COMMANDS
        sections = [
            section(program, subcommand, command)
            for subcommand, command in commands.items()
        ]
        write_text(folder / f"{name}.md", f"# {program}\n\n" + "\n".join(sections))
    write_text(folder / "metrics.md", metrics_page())


def write_names(folder: Path) -> None:
    """Write the pages of public names."""
    for package in PACKAGES:
        page = package.rpartition(".")[2]
        write_text(folder / f"{page}.md", names_page(package))


def main() -> None:
    """Write the pages of a kind."""
    kind, path = sys.argv[1:]
    folder = Path(path)
    folder.mkdir(parents=True, exist_ok=True)
    {"commands": write_commands, "names": write_names}[kind](folder)


if __name__ == "__main__":
    main()
