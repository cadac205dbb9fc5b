"""The one registry: how every replaceable part is named, found, configured and
identified.

Parts are planners, models, risk measures, robots, objectives, sensors of appearance
(`sensor`) and of the ground (`ground`), beliefs, metrics of episodes, layers of
recipes, and figures of a report. A part is named by one of four forms:

- a shipped name (`mppi`) or the name of an entry point of the group `benchnav.<kind>s`
  of an installed package; the shipped parts are entry points too;
- `package.module:Name`, from anything that can be imported;
- `path/to/file.py:Name`, from a file that stands alone;
- any of these followed by `:VALUE`, which sets its first option: `cvar:0.5` is `cvar`
  at level 0.5.

What stands at the name is a class or a function. Its keyword parameters are its
options; where the one parameter is a dataclass named `config`, the fields of that are.
A class is made with them; a risk measure that is a function is called with them beside
its mixture.

A part is identified by its source and all that this imports, by every file or folder
that an option names, and by those that its class or function lists as `files`, relative
to its own file: `files = ("weights.npz",)`. Options that
name what it writes stand in `writes`: `writes = ("log",)`. Options that came later
stand in `added`, as `added = ("explore",)`, on the class or on that of its `config`: at
their default they are left out of what is recorded, so that what was recorded before
they came is still the same part.
"""

import importlib
import importlib.util
import inspect
import itertools
import json
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from benchnav.core import touched
from benchnav.core.errors import ConfigError, check_label, out_of_memory
from benchnav.core.renamed import PARTS
from benchnav.core.settings import NO_DEFAULT as NO_DEFAULT
from benchnav.core.settings import Option as Option
from benchnav.core.settings import (
    call,
    config_class,
    list_options,
    of,
    one_line,
    parameters,
    plain,
    read,
    read_options,
)
from benchnav.core.settings import hint as hint
from benchnav.core.sources import (
    attribute,
    digest_of,
    digest_of_file_part,
    digest_of_modules,
    digest_of_path,
    digest_of_target,
    distribution_of,
    load_file,
    moved,
)
from benchnav.core.yaml_text import load_yaml

KINDS = (
    "planner",
    "model",
    "risk",
    "robot",
    "objective",
    "sensor",
    "ground",
    "belief",
    "metric",
    "layer",
    "figure",
)

# What a part of each kind is a subclass of, and where users import that from. A risk
# measure is any function.
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

# Parameters that the program gives, so no options.
_GIVEN: Mapping[str, tuple[str, ...]] = {"objective": ("robot", "goal_radius_m")}


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part: the description that creates it in any process, and the object itself.

    Args:
        part: a name, `package.module:Name` or `path/to/file.py:Name`.
        label: what tables call it.
        options: values of its options.
        kind: one of `KINDS`.
    """

    part: str
    label: str
    options: Mapping[str, Any] = field(default_factory=dict)
    kind: str = field(default="", compare=False, repr=False)

    @property
    def found(self) -> "Found":
        """The class or function that creates the object, and where it comes from."""
        return find(self.kind, self.part)

    @property
    def object(self) -> Any:
        """The object. A process creates it once; it is asked for its properties and
        keeps no state.
        """
        target = self.found.target
        description = json.dumps(
            [self.kind, self.part, plain(self.options)], sort_keys=True
        )
        known, created = _CREATED.get(description, (None, None))
        if known is not target:
            created = self.create()
            _CREATED[description] = target, created
        return created

    def create(self, **given: Any) -> Any:
        """Create a new object; see `make`."""
        return make(self.kind, self, **given)


# By description, with the class or function that the object was created by: that of a
# file changes with the file.
_CREATED: dict[str, tuple[Any, Any]] = {}


@dataclass(frozen=True, kw_only=True)
class Found:
    """A part that was found.

    Args:
        target: the class or function.
        origin: where it comes from, for people.
        source_digest: gives the digest of its source and of what that imports; empty
            for the parts of this package, and where no source is to be had.
        shipped: it is one of ours.
        everywhere: other processes find it too.
        instance: the object itself, if nothing describes it.
    """

    target: Any
    origin: str
    source_digest: Callable[[], str] = str
    shipped: bool = False
    everywhere: bool = True
    instance: Any = None

    @property
    def digest(self) -> str:
        """SHA-256 of its source, of what that imports, and of the `files` that it
        lists.

        Raises:
            ConfigError: a file that it lists is not there.
        """
        source, listed = self.source_digest(), list(_listed_files(self.target))
        return digest_of(map(str.encode, (source, *listed))) if listed else source


# What only this process knows, by kind and name.
_REGISTERED: dict[tuple[str, str], Found] = {}


def register(kind: str, name: str, target: Any) -> None:
    """Makes a part known by name in this process alone, as a notebook needs it.

    Args:
        kind: one of `KINDS`.
        name: what it is to be called.
        target: the class or function.
    """
    digest = partial(digest_of_target, target)
    _REGISTERED[_checked(kind), name] = Found(
        target=target, origin="this process", source_digest=digest, everywhere=False
    )


def register_object(kind: str, name: str, instance: Any) -> str:
    """Make an object itself known by name, in this process only.

    Args:
        kind: one of `KINDS`.
        name: what it is to be called; a number follows if the name is taken.
        instance: the object.

    Returns:
        The name under which `make` returns it.
    """
    known = names(kind)
    candidates = (
        name if number == 1 else f"{name}-{number}" for number in itertools.count(1)
    )
    free = next(
        one
        for one in candidates
        if one not in known or _instance_of(kind, one) is instance
    )
    # A class is created, a risk measure is called with a distribution; anything else is
    # returned as it is.
    register(
        kind,
        free,
        instance if kind == "risk" or inspect.isclass(instance) else lambda: instance,
    )
    source = (
        instance
        if inspect.isroutine(instance) or inspect.isclass(instance)
        else type(instance)
    )
    digest = partial(digest_of_target, source)
    _REGISTERED[kind, free] = replace(
        _REGISTERED[kind, free], source_digest=digest, instance=instance
    )
    return free


def is_object(kind: str, source: str) -> bool:
    """Whether a name stands for an object of this process."""
    return _instance_of(kind, source) is not None


def _instance_of(kind: str, source: str) -> Any:
    return _REGISTERED[kind, source].instance if (kind, source) in _REGISTERED else None


def names(kind: str) -> list[str]:
    """Names of a kind that are known here, sorted."""
    registered = {name for known, name in _REGISTERED if known == kind}
    return sorted(registered | {point.name for point in entry_points_of(kind)})


def shipped_names(kind: str) -> list[str]:
    """Names of the parts of a kind that this package ships, sorted; nothing is
    imported.
    """
    return sorted(
        point.name
        for point in entry_points_of(kind)
        if point.value.startswith("benchnav.")
    )


def read_part(kind: str, given: str | Mapping[str, Any] | Part) -> Part:
    """Reads a part as users write it: `NAME`, or `{part: NAME, label: L, options:
    {…}}`.

    Args:
        kind: one of `KINDS`.
        given: the text or the mapping.

    Returns:
        The part, with a value after its last colon moved to its options. Without a
        label it is called as it was written, less the module or file.

    Raises:
        ConfigError: it is of neither form.
    """
    if isinstance(given, Part):
        return given
    fields: Any = {"part": given} if isinstance(given, str) else given
    if (
        not isinstance(fields, Mapping)
        or not {"part"} <= set(fields) <= {"part", "label", "options"}
        or not isinstance(fields["part"], str)
        or not isinstance(fields.get("options") or {}, Mapping)
        or isinstance(fields.get("label"), Mapping | list | tuple)
    ):
        raise ConfigError(
            f"Expected {_a(kind)} as NAME or as {{part: NAME, label: LABEL, options: "
            f"{{…}}}}, got {given!r}."
        )
    text = fields["part"]
    source, value = _split_value(kind, text)
    options = dict(fields.get("options") or {})
    if value is not None:
        known = options_of(kind, find(kind, source).target)
        if not known:
            raise ConfigError(
                f"Expected {kind} {source!r} without a value, got {text!r}: it has no "
                "options."
            )
        name, option = next(iter(known.items()))
        if name in options:
            raise ConfigError(
                f"Expected option {name!r} of {kind} {text!r} once, got "
                f"{options[name]!r} too."
            )
        value = read(
            option.kind,
            load_yaml(value) if option.kind is Any else value,
            of(f"{kind} {source!r}"),
            name,
        )
        options = {name: value, **options}
    place = source.rpartition(":")[0]
    label = fields.get("label")
    if label is None:
        label = text[len(place) + 1 :] if place else text
    check_label(f"a label of {kind} {source!r}", str(label))
    return Part(part=source, label=str(label), options=options, kind=kind)


def complete(kind: str, part: Part) -> Part:
    """Checks a part's options and fills in their defaults, so that like parts have like
    options.

    Those that the part lists as `added` are left out at their default.

    Raises:
        ConfigError: there is no such part or option, or a value is of another type.
    """
    target = find(kind, part.part).target
    given, options = _read_options(kind, part, target), {}
    added = getattr(_owner(kind, target), "added", ())
    for name, option in options_of(kind, target).items():
        value = given.get(name, option.default)
        if name in added and value == option.default:
            continue
        try:
            options[name] = plain(value)
        except ConfigError as error:
            raise ConfigError(
                f"Option {name!r} of {kind} {part.part!r} cannot be recorded. {error}"
            ) from error
    return Part(part=part.part, label=part.label, options=options, kind=kind)


def make(kind: str, part: str | Mapping[str, Any] | Part, **given: Any) -> Any:
    """Makes a part.

    Args:
        kind: one of `KINDS`.
        part: which, in any form that `read_part` reads.
        given: what the part is made for, such as an objective's `robot`; passed on
            where a parameter bears the name.

    Returns:
        The object; of a risk measure a function of the mixture alone.

    Raises:
        ConfigError: there is no such part or option, it refuses its options, or it is
            of no such kind.
    """
    part = read_part(kind, part)
    owner = f"{kind} {part.part!r}"
    target = find(kind, part.part).target
    complete(kind, part)  # which rejects options that cannot be recorded
    arguments = _read_options(kind, part, target)
    config = config_class(target, _skipped(kind, target))
    if config:
        arguments = {"config": call(f"options of {owner}", config, arguments)}
    arguments |= {
        name: value for name, value in given.items() if name in parameters(target)
    }
    if kind == "risk" and not inspect.isclass(target):
        return partial(target, **arguments)
    made = call(owner, target, arguments)
    check_base(kind, made, owner)
    return made


def take(kind: str, part: Any, **given: Any) -> Any:
    """Makes a part that is named, as `make` does, or takes the object itself.

    Raises:
        ConfigError: as of `make`.
    """
    if isinstance(part, str | Mapping | Part):
        return make(kind, part, **given)
    check_base(kind, part, f"the {kind}")
    return part


def check_base(kind: str, made: Any, owner: str) -> None:
    """Refuses an object that is no subclass of what its kind has to be.

    Args:
        kind: one of `KINDS`.
        made: the object.
        owner: what the message calls it.

    Raises:
        ConfigError: it is not; the line names the base class and where to import it
            from.
    """
    if kind not in _BASES:
        return
    place, base = _BASES[kind]
    if not isinstance(made, getattr(importlib.import_module(place), base)):
        name = type(made).__name__
        raise ConfigError(
            f"Expected {owner} to be a subclass of {place}.{base}, got {name}. Write "
            f"class {name}({base})."
        )


def find(kind: str, source: str) -> Found:
    """Finds a part by name, module or file.

    Args:
        kind: one of `KINDS`.
        source: a name, `package.module:Name` or `path/to/file.py:Name`.

    Raises:
        ConfigError: there is none, or it cannot be imported.
    """
    if (_checked(kind), source) in _REGISTERED:
        touched.watch()
        return _REGISTERED[kind, source]
    points = [point for point in entry_points_of(kind) if point.name == source]
    if len(points) > 1:
        raise ConfigError(
            f"Expected one {kind} {source!r}, got several: "
            f"{', '.join(point.value for point in points)}. "
            "Write package.module:Name."
        )
    place, colon, name = (
        points[0].value.partition(":") if points else source.rpartition(":")
    )
    if place.endswith(".py"):
        return _found_in_file(kind, Path(place), name)
    if colon and place:
        return _found_in_module(kind, place, name.partition("[")[0].strip())
    new = PARTS.get((kind, source))
    remedy = f" It is now {new!r}." if new else hint(source, names(kind))
    if source.endswith(".py"):
        remedy = f" Say which class or function of it: {source}:Name."
    elif Path(f"{source}.py").is_file():
        remedy = f" Did you mean './{source}.py:Name'?"
    raise _unknown(kind, source, remedy)


def options_of(kind: str, target: Any) -> dict[str, Option]:
    """Lists the options of a class or function, in order, by name.

    Parameters that are given by the caller (an objective's `robot` and `goal_radius_m`,
    a risk measure's mixture) are none.
    """
    return list_options(target, _skipped(kind, target))


def _checked(kind: str) -> str:
    if kind not in KINDS:
        raise ConfigError(
            f"Expected a kind of part among {', '.join(KINDS)}, got "
            f"{kind!r}.{hint(kind, KINDS)}"
        )
    return kind


def entry_points_of(kind: str) -> tuple[EntryPoint, ...]:
    """Return the entry points of a kind of all that is installed."""
    return _points_on(_checked(kind), tuple(sys.path))


@cache
def _points_on(kind: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Entry points of what is installed; asked again when the path has changed."""
    return tuple(entry_points(group=f"benchnav.{kind}s"))


def _split_value(kind: str, text: str) -> tuple[str, str | None]:
    """Splits `NAME:VALUE`; a colon that belongs to a module or file stays."""
    head, colon, tail = text.rpartition(":")
    is_part = ":" in head or head in names(kind) or not tail[:1].isidentifier()
    return (head, tail) if colon and is_part else (text, None)


def _read_options(kind: str, part: Part, target: Any) -> dict[str, Any]:
    return read_options(
        options_of(kind, target), part.options, of(f"{kind} {part.part!r}")
    )


def later_options(kind: str, source: str) -> dict[str, Any]:
    """Options that came later than the part, with the defaults at which they are left
    out of what is recorded.
    """
    target = find(kind, source).target
    known = options_of(kind, target)
    return {
        name: known[name].default for name in getattr(_owner(kind, target), "added", ())
    }


def _owner(kind: str, target: Any) -> Any:
    """The class or function whose options a part has: its own, or that of its `config`."""
    return config_class(target, _skipped(kind, target)) or target


def _skipped(kind: str, target: Any) -> tuple[str, ...]:
    """Parameters that are no options, since the program gives them."""
    if kind == "risk" and not inspect.isclass(target):
        return tuple(parameters(target))[:1]
    return given_parameters(kind)


def given_parameters(kind: str) -> tuple[str, ...]:
    """Names of the parameters that the program gives, such as an objective's `robot`."""
    return _GIVEN.get(kind, ())


def label_of(name: str, options: Mapping[str, Any], first: str) -> str:
    """Label a part by its options: the first option behind a colon, others by their
    names.

    Args:
        name: of the part.
        options: those that tables show.
        first: name of the part's first option.
    """
    texts = {
        option: f"{value:g}" if isinstance(value, float) else str(value)
        for option, value in options.items()
    }
    if list(texts) == [first]:
        return f"{name}:{texts[first]}"
    return " ".join([name, *(f"{option}={text}" for option, text in texts.items())])


def _a(kind: str) -> str:
    return f"an {kind}" if kind == "objective" else f"a {kind}"


def _unknown(kind: str, source: str, remedy: str, reason: str = "") -> ConfigError:
    return ConfigError(
        f"Expected {_a(kind)} among {', '.join(names(kind))}, package.module:Name or "
        "path/to/file.py:Name, "
        f"got {source!r}{reason}.{remedy}"
    )


def _found_in_module(kind: str, place: str, name: str) -> Found:
    if place.partition(".")[0] != "benchnav":
        touched.watch(_installed_folder(place))
    try:
        module = importlib.import_module(place)
    except (Exception, SystemExit) as error:
        if not isinstance(error, ModuleNotFoundError) or not f"{place}.".startswith(
            f"{error.name}."
        ):
            line = f"{one_line(error)}{moved(error)}"
            raise out_of_memory(error) or ConfigError(
                f"module {place} could not be imported: {line}"
            ) from error
        file = Path(*place.split(".")).with_suffix(".py")
        beside = (
            f" Did you mean './{file}:{name}'?"
            if file.is_file()
            else hint(place, names(kind))
        )
        remedy = moved(error).removeprefix(".") or beside
        raise _unknown(
            kind,
            f"{place}:{name}",
            remedy or " Install its package, or name a file: path/to/file.py:Name.",
            f", and there is no module {error.name!r}",
        ) from error
    target = attribute(module, place, name)
    if place.partition(".")[0] == "benchnav":
        return Found(target=target, origin="benchnav", shipped=True)
    modules = {place, str(getattr(target, "__module__", place))}
    foreign = [
        name
        for name in modules
        if name.partition(".")[0] not in ("benchnav", "builtins")
    ]
    return Found(
        target=target,
        origin=distribution_of(place.partition(".")[0]) or f"module {place}",
        source_digest=partial(digest_of_modules, foreign),
    )


def _installed_folder(place: str) -> Path | None:
    """The folder of a package, whose code is a part's although it may lie among
    installed packages.

    None of the standard library, which a name may lead to by mistake.
    """
    package = place.partition(".")[0]
    if package in sys.stdlib_module_names:
        return None
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return None
    folders = list(spec.submodule_search_locations or ()) if spec else []
    return Path(folders[0]) if folders else None


def _found_in_file(kind: str, path: Path, name: str) -> Found:
    path = Path(os.path.expanduser(path))
    try:
        content = path.read_bytes()
    except OSError as error:
        near = hint(path.name, (other.name for other in path.parent.glob("*.py")))
        raise ConfigError(
            f"Expected {_a(kind)} in a file, got {str(path)!r}, which cannot be read: "
            f"{error.strerror}.{near}"
        ) from error
    touched.watch()
    target = attribute(load_file(path.resolve(), content), str(path), name)
    source = partial(digest_of_file_part, path.resolve(), content)
    return Found(target=target, origin=f"file {path}", source_digest=source)


def _listed_files(target: Any) -> Iterator[str]:
    """What a part lists as `files`, each followed by its digest."""
    listed = getattr(target, "files", ())
    if (
        not listed
        or not isinstance(listed, list | tuple)
        or "files" in parameters(target)
    ):
        return
    module = sys.modules.get(str(getattr(target, "__module__", "")))
    folder = Path(getattr(module, "__file__", None) or "").parent
    for name in map(str, listed):
        digest = digest_of_path(folder / name)
        if not digest:
            raise ConfigError(
                f"Expected `files` of {target.__qualname__} in {folder}, got "
                f"{name!r}, which is not there."
            )
        yield from (name, digest)


def option_files(part: Part) -> dict[str, str]:
    """Digests of what a part's options name: files and folders, by the path as it is
    written.

    What reads as a path and is not there is among them, with an empty digest, so that
    it is seen when it comes or goes. Options that the part lists as `writes` are not.

    Raises:
        ConfigError: an option names a folder that holds the working folder.
    """
    written = getattr(part.found.target, "writes", ()) if part.options else ()
    found = {}
    for text in _texts(
        [value for name, value in part.options.items() if name not in written]
    ):
        path = Path(os.path.expanduser(text))
        # of what cannot be a path false, where Path raises
        there = os.path.exists(path)
        if there and path.is_dir() and Path.cwd().is_relative_to(path.resolve()):
            raise ConfigError(
                f"Expected options of {part.kind} {part.part!r} that name files or "
                f"folders of their own, got {text!r}, "
                "which holds the working folder. Name the folder that is read, or "
                "list the option in its `writes`."
            )
        if there or os.sep in text or re.search(r"\.[A-Za-z]\w*$", text):
            found[text] = digest_of_path(path) if there else ""
    return found


def _texts(value: Any) -> Iterator[str]:
    """All texts in a value of plain data that say something."""
    if isinstance(value, str) and value:
        yield value
    elif isinstance(value, Mapping | list | tuple):
        for inner in value.values() if isinstance(value, Mapping) else value:
            yield from _texts(inner)
