"""The contract of traversability models, tried on small maps made on the spot.

`check_model` is for the tests of whoever writes a model, as Gymnasium's `check_env` is for those of
an environment: a model that passes can be trained against, evaluated and planned with like any
other. Letters in shapes: M members, B maps, H×W cells, C classes, K components.
"""

import pickle
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchnav.core.errors import BenchnavError, ConfigError
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Terrain
from benchnav.datagen.files.terrain import terrain_of
from benchnav.datagen.recipe.recipe import Split, load_recipe
from benchnav.datagen.synth.generate import generate
from benchnav.models.predictor import AnyModel, predict
from benchnav.models.probabilities import class_probabilities

SHAPES = ((32, 32), (20, 37))
TOLERANCE = 1e-4

_MAPS = 3


def check_model(
    model: AnyModel,
    shapes: Sequence[tuple[int, int]] = SHAPES,
    recipe: str = "tiny-v1",
    device: torch.device | str = "cpu",
    tolerance: float = TOLERANCE,
) -> None:
    """Tries whether a model keeps the contract, by letting it predict one map and three.

    The contract: a TraversabilityMixture of shape [B, K, H, W] for maps of any size, on the
    observation's device, of one floating-point dtype; finite parameters, weights ≥ 0 that sum to 1,
    standard deviations ≥ 0; the observation left as it was, and with it the global generators of
    Python, NumPy and PyTorch; the same answer when asked again, and for a map alone what it is in a
    batch; `class_names`, where given, one a class, which is a component, or what `group` sums up;
    `member_probabilities`, where given, of shape [M, B, C, H, W], and the class probabilities, in each
    cell, in the order of their average, which may have been calibrated as a whole.

    Args:
        model: any model; the oracle is given the Terrain.
        shapes: (H, W) of the maps to try; a model that takes maps of one size alone names it here.
        recipe: of the maps, a shipped id or the path of a YAML file; its first scenario is used.
        device: where the observations are.
        tolerance: by how much sums, averages, and a map's parameters alone and in a batch may differ;
            batches of other sizes are worked out in another order.

    Raises:
        ConfigError: the model breaks the contract; every breach is named.
    """
    found: dict[str, list[str]] = {}
    for height, width in shapes:
        terrain = _make_terrain(recipe, height, width, torch.device(device))
        for breach in dict.fromkeys(_breaches(model, terrain, tolerance)):
            found.setdefault(breach, []).append(f"{height}×{width}")
    if found:
        listed = " ".join(
            f"({number}) {breach} [maps of {', '.join(sizes)}]"
            for number, (breach, sizes) in enumerate(found.items(), start=1)
        )
        raise ConfigError(
            f"Expected a model that keeps the contract of `benchnav.testing.model.check_model`, got "
            f"{type(model).__name__}, which breaks it: {listed}"
        )


def _breaches(model: AnyModel, terrain: Terrain, tolerance: float) -> Iterator[str]:
    last = terrain.select(torch.tensor([_MAPS - 1], device=terrain.rgb.device))
    answers: list[TraversabilityMixture] = []
    for maps in (terrain, terrain, last):
        mixture, effects = _try(partial(predict, model), maps)
        yield from effects
        if mixture is None:
            return
        if elsewhere := {value.device for value in _values(mixture)} - {maps.rgb.device}:
            yield f"Expected parameters on the observation's device {maps.rgb.device}, got {elsewhere.pop()}."
            return
        yield from _unsound(mixture, tolerance)
        answers.append(mixture)
    whole, again, alone = answers
    if not _alike(whole, again, 0):
        yield "Expected the same answer for the same maps, got another when asked again."
    weights, means, stds = (values[-1:] for values in _values(whole))
    if not _alike(TraversabilityMixture(weights, means, stds, whole.group), alone, tolerance):
        yield "Expected of a map alone what was predicted of it in a batch, got something else."
    yield from _unsound_classes(model, terrain, whole, tolerance)


def _try(act: Callable[[Terrain], Any], terrain: Terrain) -> tuple[Any, list[str]]:
    """Lets a model act; gives what it answers, None for none, and what it did that it should not."""
    before, states = {name: layer.clone() for name, layer in _layers(terrain).items()}, _generators()
    answer, breaches = None, []
    try:
        answer = act(terrain)
    except BenchnavError as error:
        breaches.append(str(error))
    except Exception as error:
        breaches.append(f"Expected an answer, got {type(error).__name__}: {error}")
    changed = [name for name, layer in _layers(terrain).items() if not torch.equal(before[name], layer)]
    if changed:
        breaches.append(f"Expected the observation to stay as it was, got another {' and '.join(changed)}.")
    breaches += [
        f"Expected {whose} global generator to be left alone, got it changed. Draw from one of the model's own."
        for whose, state in _generators().items()
        if states.get(whose, state) != state
    ]
    return answer, breaches


def _layers(terrain: Terrain) -> dict[str, Tensor]:
    """Every tensor of the maps by name, those of the truth among them."""
    layers = {field.name: getattr(terrain, field.name) for field in fields(terrain)}
    truth = dict(zip(("weights", "means", "stds"), _values(terrain.truth), strict=True))
    return {name: layer for name, layer in (layers | truth).items() if isinstance(layer, Tensor)}


def _unsound(mixture: TraversabilityMixture, tolerance: float) -> Iterator[str]:
    """Tells what is wrong with a mixture by itself; its shape is known to fit."""
    values = dict(zip(("weights", "means", "stds"), _values(mixture), strict=True))
    dtypes = {str(value.dtype) for value in values.values()}
    if len(dtypes) > 1 or not mixture.weights.is_floating_point():
        yield f"Expected parameters of one floating-point dtype, got {', '.join(sorted(dtypes))}."
    for name, value in values.items():
        if not bool(value.isfinite().all()):
            yield f"Expected finite `{name}`, got some that are not."
    if bool((mixture.weights < 0).any()):
        yield "Expected `weights` ≥ 0, got some below."
    sums = mixture.weights.double().sum(1)
    if not _close(sums, torch.ones_like(sums), tolerance):
        yield "Expected `weights` that sum to 1 over the components, got other sums."
    if bool((mixture.stds < 0).any()):
        yield "Expected `stds` ≥ 0, got some below."


def _unsound_classes(
    model: Any, terrain: Terrain, mixture: TraversabilityMixture, tolerance: float
) -> Iterator[str]:
    """Tells where what a model says of classes does not fit its mixture."""
    names, components = getattr(model, "class_names", None), mixture.weights.shape[-3]
    if names is not None and mixture.group is None and len(names) != components:
        yield f"Expected a name in `class_names` for each of {components} components, got {len(names)}."
        return
    if names is not None and mixture.group is not None and max(mixture.group) >= len(names):
        yield f"Expected classes in `group` under {len(names)}, the number of `class_names`, got {max(mixture.group)}."
        return
    if not hasattr(model, "member_probabilities"):
        return
    if names is None:
        yield "Expected `class_names` beside `member_probabilities`, got none."
    members, effects = _try(lambda given: model.member_probabilities(given.observe()), terrain)
    yield from effects
    if effects and members is None:
        return
    weights = mixture.weights if names is None else class_probabilities(mixture, len(names))
    shape = weights.shape
    if not isinstance(members, Tensor) or members.shape[1:] != shape or len(members) == 0:
        got = list(members.shape) if isinstance(members, Tensor) else type(members).__name__
        yield f"Expected `member_probabilities` of shape [M, {', '.join(map(str, shape))}], got {got}."
    elif not _in_order(members.mean(0), weights, tolerance):
        yield "Expected class probabilities in the order of the average of `member_probabilities`, got another."


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
    maps = generate(made, "contract", np.arange(_MAPS))
    return terrain_of(maps, made).to(device)


def _generators() -> dict[str, bytes]:
    """States of the global generators, in a form that `==` compares."""
    states = {
        "Python's": pickle.dumps(random.getstate()),
        "NumPy's": pickle.dumps(np.random.get_state()),  # noqa: NPY002
        "PyTorch's": bytes(torch.random.get_rng_state().numpy()),
    }
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        states["CUDA's"] = bytes(torch.cuda.get_rng_state().numpy())
    return states


def _values(mixture: TraversabilityMixture) -> tuple[Tensor, Tensor, Tensor]:
    return mixture.weights, mixture.means, mixture.stds


def _alike(first: TraversabilityMixture, second: TraversabilityMixture, tolerance: float) -> bool:
    return all(_close(*pair, tolerance) for pair in zip(_values(first), _values(second), strict=True))


def _in_order(average: Tensor, weights: Tensor, tolerance: float) -> bool:
    """Whether a class that weighs more on average does not weigh less in the end, in any cell."""
    order = average.argsort(1, descending=True)
    return bool((weights.gather(1, order).diff(dim=1) <= tolerance).all())


def _close(values: Tensor, expected: Tensor, tolerance: float) -> bool:
    if values.shape != expected.shape:
        return False
    expected = expected.to(values.device).double()
    return torch.allclose(values.double(), expected, rtol=tolerance, atol=tolerance, equal_nan=True)
