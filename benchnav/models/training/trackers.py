"""Loggers and callbacks of Lightning that users specify as text.

A class is specified as `CSVLogger`, `package.module.Class`, `package.module:Class` or
`path/to/file.py:Class`, or with arguments as `{class_path: …, init_args: {…}}`; several
are specified as a list. Loggers do not affect the result of training. Callbacks may
affect it, so they are recorded, with a digest of the code of callbacks that are not part
of Lightning.
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

from benchnav.core.errors import BenchnavError, ConfigError, expect, out_of_memory_error
from benchnav.core.settings import hint, one_line
from benchnav.core.sources import (
    attribute,
    digest_of_file_and_imports,
    digest_of_target,
    load_file,
)

# Callbacks of Lightning that are rejected, with a remedy: training restores the weights of
# an epoch and determines the batches, which would undo their effect.
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


def make_loggers(specs: Any, folder: Path | None) -> list[Logger]:
    """Create the loggers that a user requests.

    Args:
        specs: one logger or a list, as text, mapping or object; False for no logger.
        folder: output folder of loggers whose specification has no `save_dir`.

    Raises:
        ConfigError: If a class does not exist, its package is missing, or it does not
            accept its arguments.
    """
    if specs is False:
        return []
    return [_create("logger", spec, folder) for spec in _as_list(specs)]


def make_callbacks(specs: Any) -> list[Callback]:
    """Create the callbacks that a user requests.

    Args:
        specs: one callback or a list, as text, mapping or object.

    Raises:
        ConfigError: As in `make_loggers`, or if the effect of a callback would be undone.
    """
    callbacks = [_create("callbacks", spec, None) for spec in _as_list(specs)]
    for name, remedy in _UNDONE.items():
        kind = getattr(lightning_callbacks, name)
        for callback in callbacks:
            expect(
                not isinstance(callback, kind),
                "`trainer.callbacks` that change neither weights, learning rate nor "
                f"batch size, got {type(callback).__name__}. Its effect would be "
                f"undone. {remedy}",
            )
    return callbacks


def described(specs: Any) -> list[dict[str, Any]]:
    """Return callbacks as plain data: class, arguments, and a digest of custom code."""
    records = []
    for spec in _as_list(specs):
        arguments: dict[str, Any] = {}
        if isinstance(spec, Callback):
            kind = type(spec)
            class_path = f"{kind.__module__}.{kind.__name__}"
        else:
            class_path, arguments = _split("callbacks", spec)
            kind = _class("callbacks", class_path)
        record: dict[str, Any] = {"class_path": class_path}
        if arguments:
            record["init_args"] = arguments
        if not kind.__module__.startswith("lightning."):
            record["digest"] = _digest(kind, class_path)
        records.append(record)
    return records


def _as_list(specs: Any) -> list[Any]:
    return list(specs) if isinstance(specs, list | tuple) else [specs]


def _split(setting: str, spec: Any) -> tuple[str, dict[str, Any]]:
    """Return the name of a class and its arguments from a specification."""
    if isinstance(spec, str):
        return spec, {}
    is_valid = (
        isinstance(spec, Mapping)
        and {"class_path"} <= set(spec) <= {"class_path", "init_args"}
        and isinstance(spec["class_path"], str)
        and isinstance(spec.get("init_args") or {}, Mapping)
    )
    expect(
        is_valid,
        f"`trainer.{setting}` as the name of a class or as {{class_path: CLASS, "
        f"init_args: {{…}}}}, got {spec!r}.",
    )
    return spec["class_path"], dict(spec.get("init_args") or {})


def _class(setting: str, class_path: str) -> type:
    """Return the class of a logger or callback.

    Raises:
        ConfigError: If the class does not exist or has the wrong base class.
    """
    module, base = _LIGHTNING[setting]
    options = [name for name in vars(module) if _is_kind(getattr(module, name), base)]
    if class_path in options:
        return getattr(module, class_path)
    separator = ":" if ":" in class_path else "."
    owner, _, name = class_path.rpartition(separator)
    if not owner:
        raise ConfigError(
            f"Expected `trainer.{setting}` among {', '.join(options)}, "
            "package.module.Class or path/to/file.py:Class, got "
            f"{class_path!r}.{hint(class_path, options)}"
        )
    if owner.endswith(".py"):
        path = Path(os.path.expanduser(owner))
        try:
            content = path.read_bytes()
        except OSError as error:
            raise ConfigError(
                f"Expected `trainer.{setting}` in a file that can be read, got "
                f"{owner!r}: {error.strerror}."
            ) from error
        kind = attribute(load_file(path.resolve(), content), owner, name)
    else:
        try:
            kind = attribute(importlib.import_module(owner), owner, name)
        except BenchnavError:
            raise
        except Exception as error:  # a custom module may raise any error
            raise out_of_memory_error(error) or ConfigError(
                f"Expected `trainer.{setting}` from a module that can be imported, got "
                f"{class_path!r}: {one_line(error)}"
            ) from error
    expect(
        _is_kind(kind, base),
        f"`trainer.{setting}` to be a subclass of lightning's {base.__name__}, got "
        f"{class_path!r}.",
    )
    return kind


def _is_kind(value: Any, base: type) -> bool:
    return inspect.isclass(value) and issubclass(value, base) and value is not base


def _create(setting: str, spec: Any, folder: Path | None) -> Any:
    """Return a logger or callback from its specification."""
    if isinstance(spec, _LIGHTNING[setting][1]):
        return spec
    class_path, arguments = _split(setting, spec)
    kind = _class(setting, class_path)
    if setting == "logger" and "save_dir" in inspect.signature(kind).parameters:
        arguments.setdefault("save_dir", str(folder or "."))
    try:
        return kind(**arguments)
    except ModuleNotFoundError as error:
        package = error.name or _package_in(str(error))
        raise ConfigError(
            f"Expected the package that {class_path} needs, got none: "
            f"{one_line(error)[:160].rstrip('.')}. Install the package, for example: pip "
            f"install {package.partition('.')[0]}"
        ) from error
    except Exception as error:  # a custom class may raise any error
        raise out_of_memory_error(error) or ConfigError(
            f"Expected arguments that {class_path} accepts, got: {one_line(error)[:300]}"
        ) from error


def _package_in(message: str) -> str:
    """Return the package that an error message of Lightning names."""
    pattern = r"[Rr]equirement '([\w-]+)|pip install (?:-U )?'?([\w-]+)"
    match = re.search(pattern, message)
    return (match[1] or match[2]) if match else "PACKAGE"


def _digest(kind: type, class_path: str) -> str:
    owner = class_path.rpartition(":")[0]
    if owner.endswith(".py"):
        path = Path(os.path.expanduser(owner)).resolve()
        return digest_of_file_and_imports(path, path.read_bytes())
    return digest_of_target(kind)
