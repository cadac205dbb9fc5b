"""The contract of traversability models, tried on small maps made on the spot.

Letters in shapes: M members, B maps, H×W cells, C classes, K components.
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
from benchnav.datagen.recipe.recipe import Split, load_recipe
from benchnav.datagen.synth.generate import generate
from benchnav.models.base import TraversabilityModel, predict
from benchnav.models.nets.trainable import TrainableModel
from benchnav.models.predictor import load_model
from benchnav.testing.breaches import NOTHING, Breaches, same
from benchnav.testing.distribution import check_functions
from benchnav.testing.trainable import try_training, untrained, with_inputs

_MAPS = 3
_CLASSES = tuple(map(str, range(10)))  # more than any map of the contract shows


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
    """Tries whether a model keeps the contract, by letting it predict one map and
    three.

    A model that passes can be evaluated and planned with like any other. The contract:
    a TraversabilityDistribution of shape [B, H, W] for maps of any size, on the
    observation's device, of one floating-point dtype; a CDF that ascends from 0 to 1,
    quantiles in [0, 1] that are its inverse, and integrals that are theirs; of a
    mixture finite parameters, weights ≥ 0 that sum to 1, standard deviations ≥ 0; the
    observation left as it was, and with it the global generators of Python, NumPy and
    PyTorch; the same answer when asked again, and for a map alone what it is in a
    batch; `class_names`, where given, one a class, whose probabilities the distribution
    gives: of a mixture a component, or what `group` sums up; `member_probabilities`,
    where given, of shape [M, B, C, H, W], and the class probabilities, in each
    cell, in the order of their average, which may have been calibrated as a whole.

    A class of trainable models is tried as training uses it: its hooks fit, a step
    changes its weights, cells whose λ was not observed are left out of a finite loss,
    and settings and tensors give the same model back. Layers that it asks for and the
    recipe's maps do not have are drawn at random.

    Args:
        model: any model, or what `load_model` takes; the oracle is given the Terrain.
            Or a class of trainable models, by itself, as path/to/file.py:Class or by
            name.
        shapes: (H, W) of the maps to try; a model that takes maps of one size alone
            names it here.
        recipe: of the maps, a shipped id or the path of a YAML file; its first scenario
            is used.
        device: where the observations are.
        tolerance: by how much sums, averages, λ, probabilities, and a map's parameters
            alone and in a batch may differ; batches of other sizes are worked out in
            another order.

    Raises:
        ConfigError: the model breaks the contract; every breach is named.
    """
    fresh = untrained(model)
    made: Any = fresh
    if fresh is None:
        made = (
            load_model(model)
            if isinstance(model, str | Path | Mapping)
            else registry.take("model", model)
        )
    breaches = Breaches("model", type(made).__name__)
    for height, width in shapes:
        breaches.place = f"{height}×{width}"
        terrain = _make_terrain(recipe, height, width, torch.device(device))
        if isinstance(made, TrainableModel):
            terrain = with_inputs(terrain, made)
        if fresh is not None and not try_training(fresh, terrain, _CLASSES, breaches):
            continue
        is_sound = partial(
            _is_sound, device=terrain.rgb.device, tolerance=tolerance, breaches=breaches
        )
        predicted = breaches.try_function(
            "predict",
            lambda observation: predict(made, observation),
            {"observation": terrain},
            is_sound,
            tolerance,
        )
        if predicted is not NOTHING:
            _check_classes(made, terrain, predicted, tolerance, breaches)
    breaches.refuse()


def _is_sound(
    predicted: TraversabilityDistribution,
    device: torch.device,
    tolerance: float,
    breaches: Breaches,
) -> bool:
    """Tells what is wrong with a distribution whose shape is known to fit; false where
    it lies elsewhere.
    """
    if isinstance(predicted, TraversabilityMixture):
        values = {
            "weights": predicted.weights,
            "means": predicted.means,
            "stds": predicted.stds,
        }
        if not _are_on(device, list(values.values()), breaches):
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
    found = (
        f"Expected parameters on the observation's device {device}, got "
        f"{others[0] if others else ''}."
    )
    return breaches.expect(not others, found)


def _are_parameters(
    values: Mapping[str, Tensor], tolerance: float, breaches: Breaches
) -> bool:
    """Tells whether a mixture can be made of its parameters."""
    expect, weights = breaches.expect, values["weights"]
    dtypes = sorted({str(value.dtype) for value in values.values()})
    sound = expect(
        len(dtypes) == 1 and weights.is_floating_point(),
        f"Expected parameters of one floating-point dtype, got {', '.join(dtypes)}.",
    )
    for name, value in values.items():
        sound &= expect(
            bool(value.isfinite().all()),
            f"Expected finite `{name}`, got some that are not.",
        )
        below = name != "means" and bool((value < 0).any())
        sound &= expect(not below, f"Expected `{name}` ≥ 0, got some below.")
    sums = weights.double().sum(1)
    return sound & expect(
        same(sums, torch.ones_like(sums), tolerance),
        "Expected `weights` that sum to 1 over the components, got other sums.",
    )


def _fit_names(names: int, predicted: TraversabilityDistribution) -> str:
    """Says where a distribution does not have the classes that a model names; empty
    where it does.
    """
    if not isinstance(predicted, TraversabilityMixture):
        try:
            got: Any = list(predicted.class_probabilities(names).shape) if names else []
        except ConfigError:
            got = f"a {type(predicted).__name__} without classes"
        shape = [*predicted.shape[:-2], names, *predicted.shape[-2:]] if names else []
        return (
            ""
            if got == shape
            else f"Expected class probabilities of shape {shape}, got {got}."
        )
    group, components = predicted.group, predicted.weights.shape[1]
    if group is None:
        fits = names in (0, components)
        return (
            ""
            if fits
            else f"Expected a name in `class_names` for each of {components} "
            f"components, got {names}."
        )
    fits = names == 0 or names > max(group)
    breach = (
        f"Expected classes in `group` under {names}, the number of "
        f"`class_names`, got {max(group)}."
    )
    return "" if fits else breach


def _check_classes(
    model: TraversabilityModel,
    terrain: Terrain,
    predicted: TraversabilityDistribution,
    tolerance: float,
    breaches: Breaches,
) -> None:
    """Tells where what a model says of classes does not fit its distribution."""
    names, expect = len(model.class_names), breaches.expect
    breach = _fit_names(names, predicted)
    if not expect(not breach, breach):
        return
    seen = terrain.observe()
    members = breaches.watch(
        "member_probabilities",
        lambda: model.member_probabilities(seen),
        observation=seen,
    )
    if members is None or members is NOTHING:
        return
    expect(names > 0, "Expected `class_names` beside `member_probabilities`, got none.")
    if names:
        weights = predicted.class_probabilities(names)
    elif isinstance(predicted, TraversabilityMixture):
        weights = predicted.weights
    else:
        return
    got = list(members.shape) if isinstance(members, Tensor) else type(members).__name__
    fits = (
        isinstance(members, Tensor)
        and members.shape[1:] == weights.shape
        and len(members) > 0
    )
    shape = f"[M, {str(list(weights.shape))[1:]}"
    if expect(fits, f"Expected `member_probabilities` of shape {shape}, got {got}."):
        # A class that weighs more on average does not weigh less in the end, in any
        # cell.
        falls = (
            weights.gather(1, members.mean(0).argsort(1, descending=True)).diff(dim=1)
            <= tolerance
        )
        order = "in the order of the average of `member_probabilities`"
        expect(bool(falls.all()), f"Expected class probabilities {order}, got another.")


def _make_terrain(
    recipe: str, height: int, width: int, device: torch.device
) -> Terrain:
    """Makes three maps of a recipe's first scenario on another grid."""
    made = load_recipe(recipe)
    name, scenario = next(iter(made.scenarios.items()))
    made = replace(
        made,
        height=height,
        width=width,
        places=None,
        start_m=(0.0, 0.0),
        goal_m=((width - 0.5) * made.resolution_m, (height - 0.5) * made.resolution_m),
        scenarios={name: scenario},
        splits={"contract": Split(scenario=name, maps=_MAPS)},
    )
    return terrain_of(generate(made, "contract", np.arange(_MAPS)), made).to(device)
