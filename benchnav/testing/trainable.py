"""The contract of trainable models: that their hooks fit, that a step trains them, and
that tensors give them back.
"""

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
    """Makes a trainable model that has not been built, of a class or of what names one;
    None of any other model.
    """
    options: Mapping[str, Any] = {}
    if isinstance(model, str | Mapping | registry.Part):
        try:
            part = registry.read_part("model", model)
            model, options = registry.find("model", part.part).target, part.options
        except BenchnavError:
            return None  # a checkpoint, or what `load_model` refuses
    if not (isinstance(model, type) and issubclass(model, TrainableModel)):
        return None
    kind = config_class(model)
    return model(read(kind, dict(options), of(model.__name__))) if kind else model()  # type: ignore[call-arg]


def with_inputs(terrain: Terrain, model: TrainableModel) -> Terrain:
    """Adds the layers that a model asks for and maps of a recipe do not have, at
    random, a tenth of them missing.
    """
    generator = torch.Generator().manual_seed(SEED)
    layers = dict(terrain.layers)
    for name in model.inputs:
        if name not in ("rgb", "elevation_m", "slope_deg", *layers):
            drawn = torch.rand(terrain.elevation_m.shape, generator=generator)
            layers[name] = torch.where(drawn < 0.1, torch.nan, drawn).to(
                terrain.elevation_m
            )
    return replace(terrain, layers=layers)


def try_training(
    model: TrainableModel,
    terrain: Terrain,
    classes: tuple[str, ...],
    breaches: Breaches,
) -> bool:
    """Builds a model, tries its hooks and takes a step; tells what breaks the contract,
    and whether it can predict.
    """
    try:
        maps = _maps(model, terrain)
        model.build({name: _scale(name) for name in model.inputs}, classes, SEED).to(
            terrain.rgb.device
        )
        try_network(model, maps)
        hidden = maps | {model.target: torch.full_like(maps[model.target], torch.nan)}
        some = maps | {
            model.target: torch.where(
                maps["slope_deg"] > 5, torch.nan, maps[model.target]
            )
        }
        for what, batch in (("in part", some), ("anywhere", hidden)):
            loss, _ = model.train().assess(batch)
            breaches.expect(
                bool(loss.isfinite()),
                f"Expected a finite loss where λ is not observed {what}, got "
                f"{loss.item()}.",
            )
        before = {name: value.clone() for name, value in model.named_parameters()}
        loss, _ = model.train().assess(maps)
        loss.backward()
        torch.optim.SGD(model.parameters(), 1e-4).step()
        moved = any(
            not torch.equal(before[name], value)
            for name, value in model.named_parameters()
        )
        breaches.expect(
            moved,
            "Expected weights that a step of training changes, got them as they were.",
        )
        model.eval().zero_grad()
        rebuilt = type(model).from_tensors(
            model.settings(), classes, model.state_dict()
        )
        layers = layers_of(terrain.observe(), model.inputs)
        means = [
            one.to(terrain.rgb.device).predict_raw(layers).mean()
            for one in (model, rebuilt)
        ]
        breaches.expect(
            same(means[1], means[0], 1e-5),
            "Expected the same prediction from settings and tensors, as a checkpoint "
            "keeps them, got another.",
        )
    except Exception as error:
        told = str(error) if isinstance(error, BenchnavError) else one_line(error)
        return breaches.expect(
            False, f"Expected a model that can be trained, got: {told}"
        )
    return True


def _maps(model: TrainableModel, terrain: Terrain) -> dict[str, Tensor]:
    """A batch as training gives it: the inputs, the slope and what is learned."""
    known = layers_of(terrain.observe(), (*model.inputs, "slope_deg"))
    return {
        **known,
        "traversability": terrain.traversability,
        "class_id": terrain.class_id,
    }


def _scale(name: str) -> LayerScale:
    """Some scale of a layer."""
    count = 3 if name == "rgb" else 1 + is_azimuth(name)
    mean, std = (128.0, 64.0) if name == "rgb" else (0.0, 1.0)
    return LayerScale(
        torch.full((count,), mean), torch.full((count,), std), torch.tensor(10.0)
    )
