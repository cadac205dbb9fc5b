"""Registry of replaceable parts: their names, options, creation and identity.

Parts are planners, models, risk measures, robots, objectives, appearance sensors (kind
`sensor`), traversability sensors (kind `ground`), beliefs, metrics of episodes, layers
of recipes, and figures of reports. A user names a part in one of four forms:

- the name of an entry point in the group `benchnav.<kind>s` of an installed package,
  such as `mppi`, a shipped part;
- `package.module:Name`, for a module that can be imported;
- `path/to/file.py:Name`, for a single file;
- any of these forms followed by `:VALUE`, which sets the first option: `cvar:0.5` is
  `cvar` at level 0.5.

The name refers to a class or a function, whose keyword parameters are the options. If
the only parameter is a dataclass named `config`, its fields are the options. A class is
called with the options. A function that is a risk measure is called with the mixture of
λ and the options.

The identity of a part consists of digests of its source and all its imports, of each
file or folder that an option names, and of the part's `files`. Three attributes of the
class or function are lists of names:

- `files`, as in `files = ("weights.npz",)`: files that it reads, relative to its own
  file;
- `writes`, as in `writes = ("log",)`: options that name output files;
- `added`, as in `added = ("explore",)`: options that are newer than the first release;
  the dataclass of `config` may list them instead. Records omit these options if they
  have their default, so that older records still identify the same part.
"""

import importlib
import inspect
import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from benchnav.core.errors import ConfigError, check_label
from benchnav.core.part_lookup import KINDS as KINDS
from benchnav.core.part_lookup import Found as Found
from benchnav.core.part_lookup import entry_points_of as entry_points_of
from benchnav.core.part_lookup import find as find
from benchnav.core.part_lookup import is_object as is_object
from benchnav.core.part_lookup import names as names
from benchnav.core.part_lookup import register as register
from benchnav.core.part_lookup import register_object as register_object
from benchnav.core.part_lookup import shipped_names as shipped_names
from benchnav.core.part_lookup import with_article
from benchnav.core.part_options import added_options, config_class_of, split_value
from benchnav.core.part_options import given_parameters as given_parameters
from benchnav.core.part_options import label_of as label_of
from benchnav.core.part_options import later_options as later_options
from benchnav.core.part_options import options_of as options_of
from benchnav.core.settings import NO_DEFAULT as NO_DEFAULT
from benchnav.core.settings import Option as Option
from benchnav.core.settings import call, of, parameters, plain, read, read_options
from benchnav.core.settings import hint as hint
from benchnav.core.sources import digest_of_path
from benchnav.core.yaml_text import load_yaml

# Package and name of the base class of each kind. A risk measure has no base class: it
# may be any function.
_BASES = {
    "planner": ("benchnav.planning", "Planner"),
    "model": ("benchnav.models", "TraversabilityModel"),
    "robot": ("benchnav.planning", "Robot"),
    "objective": ("benchnav.planning", "Objective"),
    "sensor": ("benchnav.planning", "Sensor"),
    "ground": ("benchnav.planning", "Sensor"),
    "belief": ("benchnav.planning", "Belief"),
    "metric": ("benchnav.metrics", "Metric"),
    "layer": ("benchnav.datagen", "Layer"),
    "figure": ("benchnav.viz", "Figure"),
}


@dataclass(frozen=True, kw_only=True)
class Part:
    """Description of a part, from which any process can create the part's object.

    Args:
        part: a name, `package.module:Name` or `path/to/file.py:Name`.
        label: name of the part in tables.
        options: values of options by name.
        kind: one of `KINDS`.
    """

    part: str
    label: str
    options: Mapping[str, Any] = field(default_factory=dict)
    kind: str = field(default="", compare=False, repr=False)

    @property
    def found(self) -> Found:
        """The class or function that creates the object, and its origin."""
        return find(self.kind, self.part)

    @property
    def object(self) -> Any:
        """The object, for reading its properties; a process creates it once.

        Callers share the object, so it must not have state.
        """
        target = self.found.target
        description = json.dumps(
            [self.kind, self.part, plain(self.options)], sort_keys=True
        )
        cached_target, instance = _CREATED.get(description, (None, None))
        if cached_target is not target:
            instance = self.create()
            _CREATED[description] = (target, instance)
        return instance

    def create(self, **arguments: Any) -> Any:
        """Create a new object; see `make`."""
        return make(self.kind, self, **arguments)


# Class or function and the object that it created, by description of the part. A part
# in a file has another class or function after the file has changed.
_CREATED: dict[str, tuple[Any, Any]] = {}


# --- descriptions ---


def read_part(kind: str, entry: str | Mapping[str, Any] | Part) -> Part:
    """Read a part as `NAME` or as `{part: NAME, label: LABEL, options: {…}}`.

    Args:
        kind: one of `KINDS`.
        entry: the text or the mapping; a `Part` is returned unchanged.

    Returns:
        The part. A value after the last colon becomes the first option. The default
        label is the text without module or file.

    Raises:
        ConfigError: If the entry has neither form.
    """
    if isinstance(entry, Part):
        return entry
    fields: Any = {"part": entry} if isinstance(entry, str) else entry
    if not _is_part(fields):
        raise ConfigError(
            f"Expected {with_article(kind)} as NAME or as {{part: NAME, label: LABEL, "
            f"options: {{…}}}}, got {entry!r}."
        )
    text = fields["part"]
    source, value = split_value(kind, text)
    options = dict(fields.get("options") or {})
    if value is not None:
        name, first_value = _read_first_option(kind, text, source, value)
        if name in options:
            raise ConfigError(
                f"Expected option {name!r} of {kind} {text!r} once, got also "
                f"{options[name]!r} in `options`. Leave one of the values out."
            )
        options = {name: first_value, **options}
    label = fields.get("label")
    if label is None:
        location = source.rpartition(":")[0]
        label = text.removeprefix(f"{location}:") if location else text
    check_label(f"a label of {kind} {source!r}", str(label))
    return Part(part=source, label=str(label), options=options, kind=kind)


def _is_part(fields: Any) -> bool:
    """Return whether a value is a mapping with the keys and value types of a part."""
    if not isinstance(fields, Mapping):
        return False
    has_keys = {"part"} <= set(fields) <= {"part", "label", "options"}
    if not has_keys or not isinstance(fields["part"], str):
        return False
    has_options = isinstance(fields.get("options") or {}, Mapping)
    return has_options and not isinstance(fields.get("label"), Mapping | list | tuple)


def _read_first_option(
    kind: str, text: str, source: str, value: str
) -> tuple[str, Any]:
    """Return the name of the first option of a part, and its value read from text."""
    options = options_of(kind, find(kind, source).target)
    if not options:
        raise ConfigError(
            f"Expected {kind} {source!r} without a value, got {text!r}. This {kind} "
            "has no options."
        )
    name, option = next(iter(options.items()))
    data = load_yaml(value) if option.kind is Any else value
    return name, read(option.kind, data, of(f"{kind} {source!r}"), name)


def complete(kind: str, part: Part) -> Part:
    """Check the options of a part, and add the defaults of all other options.

    Two descriptions of the same part then have equal options. Options that the part
    lists in `added` are omitted if they have their default.

    Raises:
        ConfigError: If there is no such part or option, or a value has a different type.
    """
    target = find(kind, part.part).target
    values = _read_options(kind, part, target)
    added = added_options(kind, target)
    options = {}
    for name, option in options_of(kind, target).items():
        value = values.get(name, option.default)
        if name in added and value == option.default:
            continue
        try:
            options[name] = plain(value)
        except ConfigError as error:
            raise ConfigError(
                f"Option {name!r} of {kind} {part.part!r} cannot be recorded. {error}"
            ) from error
    return Part(part=part.part, label=part.label, options=options, kind=kind)


def _read_options(kind: str, part: Part, target: Any) -> dict[str, Any]:
    owner = of(f"{kind} {part.part!r}")
    return read_options(options_of(kind, target), part.options, owner)


# --- objects ---


def make(kind: str, part: str | Mapping[str, Any] | Part, **arguments: Any) -> Any:
    """Create the object of a part.

    Args:
        kind: one of `KINDS`.
        part: a part in any form that `read_part` reads.
        **arguments: arguments that benchnav passes, such as an objective's `robot`. An
            argument is ignored if the part has no parameter of its name.

    Returns:
        The object. For a risk measure, a function whose only argument is the mixture.

    Raises:
        ConfigError: If there is no such part or option, the part rejects its options,
            or the object is not of this kind.
    """
    part = read_part(kind, part)
    owner = f"{kind} {part.part!r}"
    target = find(kind, part.part).target
    complete(kind, part)  # raises an error if an option cannot be recorded
    values = _read_options(kind, part, target)
    config = config_class_of(kind, target)
    if config:
        values = {"config": call(f"options of {owner}", config, values)}
    for name in parameters(target):
        if name in arguments:
            values[name] = arguments[name]
    if kind == "risk" and not inspect.isclass(target):
        return partial(target, **values)
    instance = call(owner, target, values)
    check_base(kind, instance, owner)
    return instance


def take(kind: str, part: Any, **arguments: Any) -> Any:
    """Return an object unchanged, or create the object of a part as `make` does.

    Args:
        kind: one of `KINDS`.
        part: an object, or a part in any form that `read_part` reads.
        **arguments: arguments for `make`.

    Raises:
        ConfigError: If the object is not of this kind, or `make` raises an error.
    """
    if isinstance(part, str | Mapping | Part):
        return make(kind, part, **arguments)
    check_base(kind, part, f"the {kind}")
    return part


def check_base(kind: str, instance: Any, owner: str) -> None:
    """Check that an object is an instance of the base class of its kind.

    Args:
        kind: one of `KINDS`.
        instance: the object.
        owner: name of the object in the message.

    Raises:
        ConfigError: If the object is not an instance of the base class.
    """
    if kind not in _BASES:
        return
    package, base = _BASES[kind]
    base_class = getattr(importlib.import_module(package), base)
    if not isinstance(instance, base_class):
        name = type(instance).__name__
        raise ConfigError(
            f"Expected {owner} to be an instance of {package}.{base}, got {name}. "
            f"Write class {name}({base})."
        )


# --- files ---


def option_files(part: Part) -> dict[str, str]:
    """Return digests of the files and folders that options name, by path as written.

    A text that looks like a path is included even if no such file exists, with an empty
    digest, so that a later creation of the file changes the record. Options that the
    part lists in `writes` are excluded.

    Raises:
        ConfigError: If an option names a folder that contains the working folder.
    """
    written = getattr(part.found.target, "writes", ()) if part.options else ()
    values = [value for name, value in part.options.items() if name not in written]
    digests = {}
    for text in _texts(values):
        path = Path(os.path.expanduser(text))
        # `Path.exists` would raise an error for an invalid path.
        exists = os.path.exists(path)
        if exists and path.is_dir() and Path.cwd().is_relative_to(path.resolve()):
            raise ConfigError(
                f"Expected {part.kind} {part.part!r} to have no option that names a "
                f"folder around the working folder, got {text!r}. Name only the folder "
                "that the part reads, or list the option in the attribute `writes` of "
                "its class."
            )
        looks_like_path = os.sep in text or re.search(r"\.[A-Za-z]\w*$", text)
        if exists or looks_like_path:
            digests[text] = digest_of_path(path) if exists else ""
    return digests


def _texts(value: Any) -> Iterator[str]:
    """Return all non-empty texts in plain data."""
    if isinstance(value, str) and value:
        yield value
    elif isinstance(value, Mapping):
        yield from _texts(list(value.values()))
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _texts(item)
