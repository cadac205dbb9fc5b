"""The check of traversability models on small generated maps.

Letters in shapes: M members of an ensemble, B maps, H×W cells, C classes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.stored_terrain import terrain_of
from benchnav.datagen.recipe.load import load_recipe
from benchnav.datagen.recipe.recipe import Split
from benchnav.datagen.synth.generate import generate
from benchnav.models.base import TraversabilityModel, predict
from benchnav.models.nets.trainable import TrainableModel
from benchnav.models.predictor import load_model
from benchnav.testing.breaches import NOTHING, Breaches, same
from benchnav.testing.distribution import check_functions
from benchnav.testing.trainable import try_training, untrained, with_inputs

_MAPS = 3
_CLASSES = tuple(map(str, range(10)))  # names of more classes than any map contains


def check_model(
    model: TraversabilityModel
    | type[TraversabilityModel]
    | str
    | Path
    | Mapping[str, Any],
    shapes: Sequence[tuple[int, int]] = ((32, 32), (20, 37)),
    recipe: str = "tiny-v1",
    device: torch.device | str = "cpu",
    tolerance: float = 1e-4,
) -> None:
    """Check that a model fulfils its contract, on one map and on a batch of three.

    The contract:

    - the prediction is a TraversabilityDistribution of shape [B, H, W] for maps of any
      size, on the observation's device, of one floating-point dtype;
    - its CDF ascends from 0 to 1, its quantiles are in [0, 1] and are the inverse of
      the CDF, and mean, CVaR and times agree with both;
    - a mixture has finite parameters, weights ≥ 0 that sum to 1, and standard
      deviations ≥ 0;
    - the observation and the global generators of Python, NumPy and PyTorch are
      unchanged;
    - the prediction is the same when repeated, and for a single map as in a batch;
    - `class_names`, if not empty, has one name for each class of the distribution. The
      classes of a mixture are its components, or the values of `group`;
    - `member_probabilities`, if not None, has shape [M, B, C, H, W]. In each cell, the
      prediction ranks the classes as the average over members does; its probabilities
      may differ from the average, since they may be calibrated.

    The check also trains a class of trainable models: its hooks are consistent, a
    training step changes its weights, the loss is finite if λ of some cells is
    unobserved, and settings and tensors restore the same model. If the recipe lacks a
    layer that the model requires, random values are used.

    Args:
        model: a model, an argument of `load_model`, or a class of trainable models: the
            class, path/to/file.py:Class or its name. The oracle receives the Terrain.
        shapes: (H, W) of the maps. If the model requires a fixed size, pass that size.
        recipe: recipe of the maps, a shipped id or the path of a YAML file; its first
            scenario is used.
        device: device of the observations.
        tolerance: tolerance of sums, averages, λ and probabilities. It also applies
            between a single map and a batch, whose order of operations may differ.

    Raises:
        ConfigError: If the model breaks the contract; the message lists all breaches.
    """
    trainable = untrained(model)
    new_model: Any = trainable
    if trainable is None and isinstance(model, str | Path | Mapping):
        new_model = load_model(model)
    elif trainable is None:
        new_model = registry.take("model", model)
    breaches = Breaches("model", type(new_model).__name__)
    for height, width in shapes:
        breaches.location = f"{height}×{width}"
        terrain = _create_terrain(recipe, height, width, torch.device(device))
        if isinstance(new_model, TrainableModel):
            terrain = with_inputs(terrain, new_model)
        if trainable is not None:
            can_predict = try_training(trainable, terrain, _CLASSES, breaches)
            if not can_predict:
                continue
        is_sound = partial(
            _is_sound, device=terrain.rgb.device, tolerance=tolerance, breaches=breaches
        )
        predicted = breaches.try_function(
            "predict",
            lambda observation: predict(new_model, observation),
            {"observation": terrain},
            is_sound,
            tolerance,
        )
        if predicted is not NOTHING:
            _check_classes(new_model, terrain, predicted, tolerance, breaches)
    breaches.raise_any()


def _is_sound(
    predicted: TraversabilityDistribution,
    device: torch.device,
    tolerance: float,
    breaches: Breaches,
) -> bool:
    """Note faults of a prediction; return whether it can be checked further."""
    if isinstance(predicted, TraversabilityMixture):
        values = {
            "weights": predicted.weights,
            "means": predicted.means,
            "stds": predicted.stds,
        }
        tensors = list(values.values())
        if not _are_on(device, tensors, breaches):
            return False
        if not _are_parameters(values, tolerance, breaches):
            return True
    elif not _are_on(device, [predicted], breaches):
        return False
    check_functions(predicted, tolerance, breaches)
    return True


def _are_on(
    device: torch.device,
    values: Sequence[Tensor | TraversabilityDistribution],
    breaches: Breaches,
) -> bool:
    others = [value.device for value in values if value.device != device]
    got = others[0] if others else ""
    return breaches.expect(
        not others,
        f"Expected parameters on the observation's device {device}, got {got}.",
    )


def _are_parameters(
    values: Mapping[str, Tensor], tolerance: float, breaches: Breaches
) -> bool:
    """Note faults of a mixture's parameters; return whether it is free of faults."""
    expect = breaches.expect
    weights = values["weights"]
    dtypes = sorted({str(value.dtype) for value in values.values()})
    listed = ", ".join(dtypes)
    is_sound = expect(
        len(dtypes) == 1 and weights.is_floating_point(),
        f"Expected parameters of one floating-point dtype, got {listed}.",
    )
    for name, value in values.items():
        is_finite = bool(value.isfinite().all())
        is_sound &= expect(
            is_finite, f"Expected finite `{name}`, got NaN or infinite values."
        )
        is_negative = name != "means" and bool((value < 0).any())
        is_sound &= expect(
            not is_negative, f"Expected `{name}` ≥ 0, got negative values."
        )
    sums = weights.double().sum(1)
    ones = torch.ones_like(sums)
    return is_sound & expect(
        same(sums, ones, tolerance),
        "Expected `weights` that sum to 1 over the components, got other sums.",
    )


def _fit_names(n_names: int, predicted: TraversabilityDistribution) -> str:
    """Return a message if the number of `class_names` is wrong; empty if it is right."""
    if n_names == 0:
        return ""
    if not isinstance(predicted, TraversabilityMixture):
        try:
            probabilities = predicted.class_probabilities(n_names)
            got: Any = list(probabilities.shape)
        except ConfigError:
            got = f"a {type(predicted).__name__} without classes"
        shape = [*predicted.shape[:-2], n_names, *predicted.shape[-2:]]
        if got == shape:
            return ""
        return f"Expected class probabilities of shape {shape}, got {got}."
    group = predicted.group
    n_components = predicted.weights.shape[1]
    if group is None and n_names != n_components:
        return (
            f"Expected a name in `class_names` for each of {n_components} "
            f"components, got {n_names}."
        )
    if group is not None and n_names <= max(group):
        return (
            f"Expected classes in `group` below {n_names}, which is the number of "
            f"`class_names`, got {max(group)}."
        )
    return ""


def _check_classes(
    model: TraversabilityModel,
    terrain: Terrain,
    predicted: TraversabilityDistribution,
    tolerance: float,
    breaches: Breaches,
) -> None:
    """Note where a model's classes do not fit its distribution."""
    n_names = len(model.class_names)
    expect = breaches.expect
    breach = _fit_names(n_names, predicted)
    if not expect(not breach, breach):
        return
    observation = terrain.observe()
    members = breaches.watch(
        "member_probabilities",
        lambda: model.member_probabilities(observation),
        observation=observation,
    )
    if members is None or members is NOTHING:
        return
    expect(
        n_names > 0,
        "Expected `class_names` with `member_probabilities`, got no names. Name the "
        "classes, or return None from `member_probabilities`.",
    )
    if n_names:
        weights = predicted.class_probabilities(n_names)
    elif isinstance(predicted, TraversabilityMixture):
        weights = predicted.weights
    else:
        return
    got: Any = type(members).__name__
    fits = False
    if isinstance(members, Tensor):
        got = list(members.shape)
        fits = members.shape[1:] == weights.shape and len(members) > 0
    shape = f"[M, {str(list(weights.shape))[1:]}"
    if expect(fits, f"Expected `member_probabilities` of shape {shape}, got {got}."):
        # The weights must descend in the order in which the average descends.
        descending = members.mean(0).argsort(1, descending=True)
        rise = weights.gather(1, descending).diff(dim=1)
        is_ordered = rise <= tolerance
        expect(
            bool(is_ordered.all()),
            "Expected class probabilities that rank the classes as the average of "
            "`member_probabilities` does, got another order.",
        )


def _create_terrain(
    recipe: str, height: int, width: int, device: torch.device
) -> Terrain:
    """Return three maps of a recipe's first scenario, of a given size in cells."""
    original = load_recipe(recipe)
    name, scenario = next(iter(original.scenarios.items()))
    cell_m = original.resolution_m
    goal_m = ((width - 0.5) * cell_m, (height - 0.5) * cell_m)
    adapted = replace(
        original,
        height=height,
        width=width,
        places=None,
        start_m=(0.0, 0.0),
        goal_m=goal_m,
        scenarios={name: scenario},
        splits={"contract": Split(scenario=name, maps=_MAPS)},
    )
    maps = generate(adapted, "contract", np.arange(_MAPS))
    return terrain_of(maps, adapted).to(device)
