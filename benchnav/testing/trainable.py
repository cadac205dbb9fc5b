"""The check of trainable models: hooks, a training step, and restoring from tensors."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.core.errors import BenchnavError
from benchnav.core.grid import is_azimuth
from benchnav.core.settings import config_class, of, one_line, read
from benchnav.core.terrain import Terrain
from benchnav.models.base import layers_of
from benchnav.models.nets.inputs import LayerScale
from benchnav.models.nets.trainable import TrainableModel
from benchnav.models.training.check import try_network
from benchnav.testing.breaches import SEED, Breaches, same


def untrained(model: Any) -> TrainableModel | None:
    """Return a trainable model that is not yet built; None for other arguments.

    Args:
        model: class of trainable models, its name, file or mapping; or any other
            argument of `check_model`.
    """
    options: Mapping[str, Any] = {}
    if isinstance(model, str | Mapping | registry.Part):
        try:
            part = registry.read_part("model", model)
            model = registry.find("model", part.part).target
            options = part.options
        except BenchnavError:
            return None  # a checkpoint, or a value that `load_model` rejects
    if not (isinstance(model, type) and issubclass(model, TrainableModel)):
        return None
    kind = config_class(model)
    if not kind:
        return model()  # type: ignore[call-arg]
    settings = read(kind, dict(options), of(model.__name__))
    return model(settings)


def with_inputs(terrain: Terrain, model: TrainableModel) -> Terrain:
    """Return maps with all input layers of a model.

    Layers that the maps lack are random, and NaN in a tenth of the cells.
    """
    generator = torch.Generator().manual_seed(SEED)
    layers = dict(terrain.layers)
    like = terrain.elevation_m
    for name in model.inputs:
        if name not in ("rgb", "elevation_m", "slope_deg", *layers):
            drawn = torch.rand(like.shape, generator=generator)
            drawn = torch.where(drawn < 0.1, torch.nan, drawn)
            layers[name] = drawn.to(like)
    return replace(terrain, layers=layers)


def try_training(
    model: TrainableModel,
    terrain: Terrain,
    classes: tuple[str, ...],
    breaches: Breaches,
) -> bool:
    """Build a model, and check its hooks and a training step.

    Args:
        model: model that is not yet built.
        terrain: maps to train on.
        classes: names of the classes.
        breaches: collection of breaches.

    Returns:
        Whether the model can predict.
    """
    try:
        device = terrain.rgb.device
        maps = _maps(model, terrain)
        scales = {name: _scale(name) for name in model.inputs}
        model.build(scales, classes, SEED).to(device)
        try_network(model, maps)
        target = maps[model.target]
        partial = torch.where(maps["slope_deg"] > 5, torch.nan, target)
        missing = torch.full_like(target, torch.nan)
        for what, values in (("some", partial), ("all", missing)):
            changed = maps | {model.target: values}
            loss, _ = model.train().assess(changed)
            breaches.expect(
                bool(loss.isfinite()),
                f"Expected a finite loss if λ of {what} cells is unobserved, got "
                f"{loss.item()}.",
            )
        before = {name: value.clone() for name, value in model.named_parameters()}
        loss, _ = model.train().assess(maps)
        loss.backward()
        torch.optim.SGD(model.parameters(), 1e-4).step()
        is_changed = False
        for name, value in model.named_parameters():
            is_changed |= not torch.equal(before[name], value)
        breaches.expect(
            is_changed,
            "Expected a training step to change the weights, got no change.",
        )
        model.eval().zero_grad()
        settings = model.settings()
        restored = type(model).from_tensors(settings, classes, model.state_dict())
        layers = layers_of(terrain.observe(), model.inputs)
        mean = model.to(device).predict_raw(layers).mean()
        restored_mean = restored.to(device).predict_raw(layers).mean()
        breaches.expect(
            same(restored_mean, mean, 1e-5),
            "Expected the same prediction from a model restored from its settings and "
            "tensors, got a different prediction.",
        )
    except Exception as error:
        text = str(error) if isinstance(error, BenchnavError) else one_line(error)
        return breaches.expect(
            False, f"Expected a model that can be trained, got: {text}"
        )
    return True


def _maps(model: TrainableModel, terrain: Terrain) -> dict[str, Tensor]:
    """Return a batch as in training: inputs, slope, λ and classes."""
    inputs = layers_of(terrain.observe(), (*model.inputs, "slope_deg"))
    return {
        **inputs,
        "traversability": terrain.traversability,
        "class_id": terrain.class_id,
    }


def _scale(name: str) -> LayerScale:
    """Return an arbitrary scale of a layer."""
    if name == "rgb":
        mean = torch.full((3,), 128.0)
        std = torch.full((3,), 64.0)
    else:
        n_channels = 1 + is_azimuth(name)
        mean = torch.zeros(n_channels)
        std = torch.ones(n_channels)
    return LayerScale(mean, std, torch.tensor(10.0))
