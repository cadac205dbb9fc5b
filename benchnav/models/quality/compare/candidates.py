"""The models of a comparison: those that were asked for, and the privileged ones; and
what each costs.
"""

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
from benchnav.models.predictor import (
    Ideal,
    Oracle,
    find_checkpoint,
    load_model,
    networks_of,
    split_own,
    trained_on,
)

# That are always compared with, where the truth is known; the one that knows most
# first.
PRIVILEGED = ("oracle", "ideal")
_TIMED, _MOST_S = 15, 5.0


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A model of a comparison.

    Args:
        label: what tables call it.
        source: as it was asked for.
        model: the model.
        trained_on: names of the splits that it was trained on, by digest.
    """

    label: str
    source: str
    model: TraversabilityModel
    trained_on: Mapping[str, str]

    @property
    def privileged(self) -> bool:
        """Whether it is given part of the truth: a reference, which does not compete."""
        return isinstance(self.model, PrivilegedModel)

    @property
    def needs_truth(self) -> bool:
        """Whether it says what the class table says, which is not the truth of imported
        ground.
        """
        return isinstance(self.model, Oracle | Ideal)


def candidate(
    source: str, label: str, model: TraversabilityModel | None = None
) -> Candidate:
    """Return a model as a candidate; it is loaded from its source where it is not
    given.
    """
    return Candidate(
        label=label,
        source=source,
        model=model or load_model(source),
        trained_on=trained_on(source),
    )


def find_candidates(sources: Sequence[str]) -> list[Candidate]:
    """Loads the models that are compared: those asked for in their order, then the
    privileged ones.

    Args:
        sources: each as `load_model` takes it; one or more.

    Raises:
        ConfigError: there are none, one is there twice, or there is no such model.
        CheckpointError: a checkpoint cannot be used.
    """
    expect(
        len(sources) > 0,
        "one model or more to compare, got none. Name checkpoints or models.",
    )
    places = [str(_folder(source) or source) for source in sources]
    for place, times in Counter(places).items():
        if times > 1:
            named = " and ".join(
                source
                for source, own in zip(sources, places, strict=True)
                if own == place
            )
            raise ConfigError(
                f"Expected models that differ, got {named}. Name each model once."
            )
    models = {source: load_model(source) for source in sources}
    models |= {name: load_model(name) for name in PRIVILEGED if name not in models}
    labels = _labels(list(models))
    found = [
        candidate(source, labels[source], model) for source, model in models.items()
    ]
    return sorted(found, key=lambda one: one.privileged)


def _folder(source: str) -> Path | None:
    """The folder of a checkpoint; None of a model by name, module or file."""
    try:
        return find_checkpoint(source).resolve()
    except BenchnavError:
        return None


def _labels(sources: Sequence[str]) -> dict[str, str]:
    """Short names: of a folder its own, of a file the class in it; the whole source
    where these are alike.
    """
    short = {}
    for source in sources:
        own = split_own(source)
        place, _, name = source.rpartition(":")
        is_part = place.endswith(".py") or (bool(place) and not Path(source).exists())
        short[source] = (
            Path(own[1]).name
            if own
            else name
            if is_part
            else Path(source).name or source
        )
    times = Counter(short.values())
    return {
        source: name if times[name] == 1 else source for source, name in short.items()
    }


def count_parameters(model: TraversabilityModel) -> int | None:
    """Number of weights in the networks of a model and of its members; None where it
    has no network.
    """
    networks = list(networks_of(model))
    weights = {
        id(weight): weight.numel()
        for network in networks
        for weight in network.parameters()
    }
    return sum(weights.values()) if networks else None


def prediction_ms(model: TraversabilityModel, terrain: Terrain) -> float:
    """Median time of a prediction in milliseconds, over 15 repetitions after a first,
    or as many as 5 s hold.

    Args:
        model: any model.
        terrain: what is predicted, on the device where it is to be.
    """
    taken: list[float] = []
    while len(taken) <= _TIMED and (len(taken) < 2 or sum(taken) < 1000 * _MOST_S):
        _wait(terrain)
        start = time.perf_counter()
        predict(model, terrain)
        _wait(terrain)
        taken.append(1000 * (time.perf_counter() - start))
    return statistics.median(taken[1:])


def _wait(terrain: Terrain) -> None:
    if terrain.rgb.is_cuda:
        torch.cuda.synchronize()
