"""Loggers and callbacks of Lightning that a user names as text, and that are made when
a training begins.

A class is named as `CSVLogger`, `package.module.Class`, `package.module:Class` or
`path/to/file.py:Class`; with arguments as `{class_path: …, init_args: {…}}`, and
several as a list. Loggers do not change what is trained, callbacks
may: these are recorded, with a digest of the code of those that are not Lightning's.
"""

import importlib
import inspect
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.pytorch import callbacks as lightning_callbacks
from lightning.pytorch import loggers as lightning_loggers
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import Logger

from benchnav.core.errors import BenchnavError, ConfigError, expect, out_of_memory
from benchnav.core.settings import hint, one_line
from benchnav.core.sources import (
    attribute,
    digest_of_file_part,
    digest_of_target,
    load_file,
)

# Callbacks of Lightning whose effect on weights or rates the kept epoch would undo, and
# what to do in place of them.
_UNDONE = {
    "StochasticWeightAveraging": "`fit swag` averages weights.",
    "WeightAveraging": "`fit swag` averages weights.",
    "ModelPruning": "Leave it out.",
    "LearningRateFinder": "Set `learning_rate`.",
    "BatchSizeFinder": "Set `batch_size`.",
}
_LIGHTNING = {
    "logger": (lightning_loggers, Logger),
    "callbacks": (lightning_callbacks, Callback),
}


def make_loggers(given: Any, folder: Path | None) -> list[Logger]:
    """Make the loggers that a user asks for.

    Args:
        given: one or a list, as text, mapping or object; False for none.
        folder: where those write that are given no `save_dir`.

    Raises:
        ConfigError: there is no such class, its package is missing, or it does not take
            its arguments.
    """
    return (
        []
        if given is False
        else [_made("logger", item, folder) for item in _listed(given)]
    )


def make_callbacks(given: Any) -> list[Callback]:
    """Make the callbacks that a user asks for.

    Raises:
        ConfigError: As in `make_loggers`, or if what a callback does to weights or
            rates would be undone.
    """
    callbacks = [_made("callbacks", item, None) for item in _listed(given)]
    for name, remedy in _UNDONE.items():
        for callback in callbacks:
            expect(
                not isinstance(callback, getattr(lightning_callbacks, name)),
                "`trainer.callbacks` that leave weights and rates as they are, got "
                f"{type(callback).__name__}, "
                f"whose effect would be undone. {remedy}",
            )
    return callbacks


def described(given: Any) -> list[dict[str, Any]]:
    """What is recorded of callbacks, as plain data: their text, arguments, and a digest
    of code that is not ours.
    """
    found = []
    for item in _listed(given):
        if isinstance(item, Callback):
            kind, place = type(item), f"{type(item).__module__}.{type(item).__name__}"
            arguments: dict[str, Any] = {}
        else:
            place, arguments = _split("callbacks", item)
            kind = _class("callbacks", place)
        foreign = not kind.__module__.startswith("lightning.")
        found.append(
            {
                "class_path": place,
                **({"init_args": arguments} if arguments else {}),
                **({"digest": _digest(kind, place)} if foreign else {}),
            }
        )
    return found


def _listed(given: Any) -> list[Any]:
    return list(given) if isinstance(given, list | tuple) else [given]


def _split(what: str, item: Any) -> tuple[str, dict[str, Any]]:
    """The name of a class, and its arguments."""
    if isinstance(item, str):
        return item, {}
    fits = isinstance(item, Mapping) and {"class_path"} <= set(item) <= {
        "class_path",
        "init_args",
    }
    expect(
        fits
        and isinstance(item["class_path"], str)
        and isinstance(item.get("init_args") or {}, Mapping),
        f"`trainer.{what}` as a class or as {{class_path: CLASS, init_args: {{…}}}}, "
        f"got {item!r}.",
    )
    return item["class_path"], dict(item.get("init_args") or {})


def _class(what: str, place: str) -> type:
    module, base = _LIGHTNING[what]
    known = [name for name in vars(module) if _is_kind(getattr(module, name), base)]
    if place in known:
        return getattr(module, place)
    owner, colon, name = place.rpartition(":" if ":" in place else ".")
    if not colon or not owner:
        raise ConfigError(
            f"Expected `trainer.{what}` among {', '.join(known)}, "
            "package.module.Class or path/to/file.py:Class, got "
            f"{place!r}.{hint(place, known)}"
        )
    if owner.endswith(".py"):
        path = Path(os.path.expanduser(owner))
        try:
            content = path.read_bytes()
        except OSError as error:
            raise ConfigError(
                f"Expected `trainer.{what}` in a file, got {owner!r}, which cannot be "
                f"read: {error.strerror}."
            ) from error
        found = attribute(load_file(path.resolve(), content), owner, name)
    else:
        try:
            found = attribute(importlib.import_module(owner), owner, name)
        except BenchnavError:
            raise
        except Exception as error:  # a user's module may raise anything
            raise out_of_memory(error) or ConfigError(
                f"Expected `trainer.{what}` from a module, got {place!r}: "
                f"{one_line(error)}"
            ) from error
    expect(
        _is_kind(found, base),
        f"`trainer.{what}` as a class of lightning's {base.__name__}, got {place!r}.",
    )
    return found


def _is_kind(value: Any, base: type) -> bool:
    return inspect.isclass(value) and issubclass(value, base) and value is not base


def _made(what: str, item: Any, folder: Path | None) -> Any:
    if isinstance(item, _LIGHTNING[what][1]):
        return item
    place, arguments = _split(what, item)
    kind = _class(what, place)
    if what == "logger" and "save_dir" in inspect.signature(kind).parameters:
        arguments.setdefault("save_dir", str(folder or "."))
    try:
        return kind(**arguments)
    except ModuleNotFoundError as error:
        wanted = re.search(
            r"[Rr]equirement '([\w-]+)|pip install (?:-U )?'?([\w-]+)", str(error)
        )
        package = error.name or (wanted[1] or wanted[2] if wanted else "PACKAGE")
        raise ConfigError(
            f"Expected the package that {place} needs, got none: "
            f"{one_line(error)[:160]} "
            f"Install it, such as: pip install {package.partition('.')[0]}"
        ) from error
    except Exception as error:  # a user's class may raise anything
        raise out_of_memory(error) or ConfigError(
            f"Expected arguments that {place} takes, got: {one_line(error)[:300]}"
        ) from error


def _digest(kind: type, place: str) -> str:
    owner = place.rpartition(":")[0]
    if owner.endswith(".py"):
        path = Path(os.path.expanduser(owner)).resolve()
        return digest_of_file_part(path, path.read_bytes())
    return digest_of_target(kind)
