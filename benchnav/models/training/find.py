"""Search for trainable models by name, file or module."""

from pathlib import Path
from typing import Any

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.core.settings import config_class, of, read
from benchnav.models.checkpoint import FUSED
from benchnav.models.config import TrainingConfig
from benchnav.models.nets.trainable import TrainableModel
from benchnav.models.parts import CLASSIFIER, GP
from benchnav.models.training.check import Trainable


def find_trainable(source: str, settings: dict[str, Any]) -> Trainable:
    """Find a trainable model by name, file or module.

    Raises:
        ConfigError: If the model does not exist, cannot be trained, or has no such
            settings.
    """
    match = find_kind(source)
    kind = match.target
    if not (isinstance(kind, type) and issubclass(kind, TrainableModel)):
        raise ConfigError(
            f"Expected a trainable model ({', '.join(_trainable_names())} or "
            f"FILE.py:Class with a benchnav.models.TrainableModel), got {source!r}, "
            "which is not trainable."
        )
    owner = f"model {source!r}"
    config_kind = config_class(kind)
    if config_kind is None or not issubclass(config_kind, TrainingConfig):
        raise ConfigError(
            f"Expected __init__ of {owner} to have only the parameter `config`, whose "
            "type is a subclass of benchnav.models.TrainingConfig, got other "
            "parameters. Write def __init__(self, config: MyConfig = MyConfig()) with "
            "such a subclass MyConfig."
        )
    config = read(config_kind, settings, of(owner))
    name = kind.__name__
    registered = registry.names("model")
    if source in registered:
        name = source
    elif name in (CLASSIFIER, GP) or (
        name in registered and registry.find("model", name).target is not kind
    ):
        raise ConfigError(
            "Expected a class with a name that differs from those of this package's "
            f"models, got {name!r}. Checkpoints identify a class by its name. Rename "
            "the class."
        )
    code = "" if match.shipped else match.digest
    return Trainable(kind=kind, config=config, name=name, family=name, code=code)


def find_kind(source: str) -> registry.Found:
    """Find the class of a model by the name of the model, of a file or of a module.

    Raises:
        ConfigError: If the class or name does not exist or cannot be imported.
    """
    is_file = source.endswith(".py") or Path(f"{source}.py").is_file()
    is_name = ":" not in source and not is_file
    if is_name and source not in registry.names("model"):
        names = _trainable_names()
        raise ConfigError(
            f"Expected a trainable model ({', '.join(names)} or FILE.py:Class), got "
            f"{source!r}.{registry.hint(source, names)}"
        )
    return registry.find("model", source)


def _trainable_names() -> list[str]:
    return [FUSED, *(name for name in registry.names("model") if is_trainable(name))]


def is_trainable(name: str) -> bool:
    """Return whether a registered model can be imported and trained."""
    try:
        kind = registry.find("model", name).target
    except ConfigError:
        return False
    return isinstance(kind, type) and issubclass(kind, TrainableModel)
