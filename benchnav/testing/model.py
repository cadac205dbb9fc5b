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
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.stored_terrain import terrain_of
from benchnav.datagen.recipe.recipe import Split, load_recipe
from benchnav.datagen.synth.generate import generate
from benchnav.models.base import TraversabilityModel, predict
from benchnav.models.predictor import load_model
from benchnav.testing.breaches import NOTHING, Breaches, same

_MAPS = 3


def check_model(
    model: TraversabilityModel | str | Path | Mapping[str, Any],
    shapes: Sequence[tuple[int, int]] = ((32, 32), (20, 37)),
    recipe: str = "tiny-v1",
    device: torch.device | str = "cpu",
    tolerance: float = 1e-4,
) -> None:
    """Tries whether a model keeps the contract, by letting it predict one map and three.

    A model that passes can be evaluated and planned with like any other. The contract: a TraversabilityMixture
    of shape [B, K, H, W] for maps of any size, on the observation's device, of one floating-point dtype; finite
    parameters, weights ≥ 0 that sum to 1, standard deviations ≥ 0; the observation left as it was, and with it
    the global generators of Python, NumPy and PyTorch; the same answer when asked again, and for a map alone
    what it is in a batch; `class_names`, where given, one a class, which is a component, or what `group` sums
    up; `member_probabilities`, where given, of shape [M, B, C, H, W], and the class probabilities, in each
    cell, in the order of their average, which may have been calibrated as a whole.

    Args:
        model: any model, or what `load_model` takes; the oracle is given the Terrain.
        shapes: (H, W) of the maps to try; a model that takes maps of one size alone names it here.
        recipe: of the maps, a shipped id or the path of a YAML file; its first scenario is used.
        device: where the observations are.
        tolerance: by how much sums, averages, and a map's parameters alone and in a batch may differ;
            batches of other sizes are worked out in another order.

    Raises:
        ConfigError: the model breaks the contract; every breach is named.
    """
    made = load_model(model) if isinstance(model, str | Path | Mapping) else registry.take("model", model)
    breaches = Breaches("model", type(made).__name__)
    for height, width in shapes:
        breaches.place = f"{height}×{width}"
        terrain = _make_terrain(recipe, height, width, torch.device(device))
        is_sound = partial(_is_sound, device=terrain.rgb.device, tolerance=tolerance, breaches=breaches)
        mixture = breaches.try_function(
            "predict",
            lambda observation: predict(made, observation),
            {"observation": terrain},
            is_sound,
            tolerance,
        )
        if mixture is not NOTHING:
            _check_classes(made, terrain, mixture, tolerance, breaches)
    breaches.refuse()


def _is_sound(
    mixture: TraversabilityMixture, device: torch.device, tolerance: float, breaches: Breaches
) -> bool:
    """Tells what is wrong with a mixture by itself, whose shape is known to fit; false where it lies elsewhere."""
    expect = breaches.expect
    values = {"weights": mixture.weights, "means": mixture.means, "stds": mixture.stds}
    for value in values.values():
        if not expect(
            value.device == device,
            f"Expected parameters on the observation's device {device}, got {value.device}.",
        ):
            return False
    dtypes = sorted({str(value.dtype) for value in values.values()})
    expect(
        len(dtypes) == 1 and mixture.weights.is_floating_point(),
        f"Expected parameters of one floating-point dtype, got {', '.join(dtypes)}.",
    )
    for name, value in values.items():
        expect(bool(value.isfinite().all()), f"Expected finite `{name}`, got some that are not.")
        below = name != "means" and bool((value < 0).any())
        expect(not below, f"Expected `{name}` ≥ 0, got some below.")
    sums = mixture.weights.double().sum(1)
    expect(
        same(sums, torch.ones_like(sums), tolerance),
        "Expected `weights` that sum to 1 over the components, got other sums.",
    )
    return True


def _check_classes(
    model: TraversabilityModel,
    terrain: Terrain,
    mixture: TraversabilityMixture,
    tolerance: float,
    breaches: Breaches,
) -> None:
    """Tells where what a model says of classes does not fit its mixture."""
    names, group, expect = len(model.class_names), mixture.group, breaches.expect
    components = mixture.weights.shape[1]
    if group is None:
        fits = names in (0, components)
        breach = f"Expected a name in `class_names` for each of {components} components, got {names}."
    else:
        fits = names == 0 or names > max(group)
        breach = f"Expected classes in `group` under {names}, the number of `class_names`, got {max(group)}."
    if not expect(fits, breach):
        return
    seen = terrain.observe()
    members = breaches.watch(
        "member_probabilities", lambda: model.member_probabilities(seen), observation=seen
    )
    if members is None or members is NOTHING:
        return
    expect(names > 0, "Expected `class_names` beside `member_probabilities`, got none.")
    weights = mixture.class_probabilities(names) if names else mixture.weights
    got = list(members.shape) if isinstance(members, Tensor) else type(members).__name__
    fits = isinstance(members, Tensor) and members.shape[1:] == weights.shape and len(members) > 0
    shape = f"[M, {str(list(weights.shape))[1:]}"
    if expect(fits, f"Expected `member_probabilities` of shape {shape}, got {got}."):
        # A class that weighs more on average does not weigh less in the end, in any cell.
        falls = weights.gather(1, members.mean(0).argsort(1, descending=True)).diff(dim=1) <= tolerance
        order = "in the order of the average of `member_probabilities`"
        expect(bool(falls.all()), f"Expected class probabilities {order}, got another.")


def _make_terrain(recipe: str, height: int, width: int, device: torch.device) -> Terrain:
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
