"""Models of a comparison, requested and privileged, and their costs."""

import statistics
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from benchnav.core.errors import BenchnavError, ConfigError, expect
from benchnav.core.terrain import Terrain
from benchnav.models.base import PrivilegedModel, TraversabilityModel, predict
from benchnav.models.checkpoint_folders import (
    find_checkpoint,
    split_class_and_checkpoint,
)
from benchnav.models.predictor import (
    Ideal,
    Oracle,
    load_model,
    networks_of,
    trained_on,
)

# Models that are added to each comparison if the truth is available; the one that
# receives more of the truth is first.
PRIVILEGED = ("oracle", "ideal")
_N_REPETITIONS = 15
_MAX_TIMING_MS = 5000.0  # total time after which no prediction is repeated


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A model of a comparison.

    Args:
        label: name of the model in tables.
        source: name of the model in the request.
        model: the model.
        trained_on: names of the splits on which the model was trained, by digest.
    """

    label: str
    source: str
    model: TraversabilityModel
    trained_on: Mapping[str, str]

    @property
    def privileged(self) -> bool:
        """Whether the model receives part of the truth, so that it does not compete."""
        return isinstance(self.model, PrivilegedModel)

    @property
    def needs_truth(self) -> bool:
        """Whether the model uses the class table, valid only for generated maps."""
        return isinstance(self.model, Oracle | Ideal)


def load_candidate(
    source: str, label: str, model: TraversabilityModel | None = None
) -> Candidate:
    """Return a candidate; if `model` is None, load it from its source."""
    return Candidate(
        label=label,
        source=source,
        model=model or load_model(source),
        trained_on=trained_on(source),
    )


def find_candidates(sources: Sequence[str]) -> list[Candidate]:
    """Load the models to compare: the requested models in order, then privileged models.

    Args:
        sources: arguments of `load_model`, at least one.

    Raises:
        ConfigError: If `sources` is empty or names a model twice, or if a model does
            not exist.
        CheckpointError: If a checkpoint cannot be used.
    """
    expect(
        len(sources) > 0,
        "at least one model to compare, got none. Give checkpoints or names of models.",
    )
    by_location: dict[str, list[str]] = {}
    for source in sources:
        location = str(_folder(source) or source)
        by_location.setdefault(location, []).append(source)
    for same in by_location.values():
        if len(same) > 1:
            listed = " and ".join(same)
            raise ConfigError(
                f"Expected models that differ, got {listed}, which are the same. Give "
                "each model once."
            )
    models = {source: load_model(source) for source in sources}
    for name in PRIVILEGED:
        if name not in models:
            models[name] = load_model(name)
    labels = _labels(list(models))
    candidates = [
        load_candidate(source, labels[source], model)
        for source, model in models.items()
    ]
    return sorted(candidates, key=lambda candidate: candidate.privileged)


def _folder(source: str) -> Path | None:
    """Return the folder of a checkpoint; None for a model by name, module or file."""
    try:
        return find_checkpoint(source).resolve()
    except BenchnavError:
        return None


def _labels(sources: Sequence[str]) -> dict[str, str]:
    """Return short names of models, or their sources if short names are equal."""
    short = {source: _short_name(source) for source in sources}
    counts = Counter(short.values())
    labels = {}
    for source, name in short.items():
        is_unique = counts[name] == 1
        labels[source] = name if is_unique else source
    return labels


def _short_name(source: str) -> str:
    """Return the name of a checkpoint's folder, or of the class in a module or file."""
    part_and_checkpoint = split_class_and_checkpoint(source)
    if part_and_checkpoint:
        return Path(part_and_checkpoint[1]).name
    module, _, name = source.rpartition(":")
    is_module = bool(module) and not Path(source).exists()
    if module.endswith(".py") or is_module:
        return name
    return Path(source).name or source


def count_parameters(model: TraversabilityModel) -> int | None:
    """Return the number of weights in a model's networks; None if it has no network."""
    networks = list(networks_of(model))
    sizes: dict[int, int] = {}
    for network in networks:
        for weight in network.parameters():
            sizes[id(weight)] = weight.numel()
    return sum(sizes.values()) if networks else None


def prediction_ms(model: TraversabilityModel, terrain: Terrain) -> float:
    """Return the median time of a prediction in milliseconds.

    The median is over 15 repetitions after a warm-up, or fewer if all take more than 5 s.

    Args:
        model: any model.
        terrain: maps to predict, on the device to use.
    """
    times_ms: list[float] = []
    while len(times_ms) <= _N_REPETITIONS:
        if len(times_ms) >= 2 and sum(times_ms) >= _MAX_TIMING_MS:
            break
        _wait(terrain)
        start = time.perf_counter()
        predict(model, terrain)
        _wait(terrain)
        elapsed_s = time.perf_counter() - start
        times_ms.append(1000 * elapsed_s)
    return statistics.median(times_ms[1:])


def _wait(terrain: Terrain) -> None:
    if terrain.rgb.is_cuda:
        torch.cuda.synchronize()
