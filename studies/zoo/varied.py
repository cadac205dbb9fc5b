"""Fused model whose quality is varied deliberately."""

from dataclasses import replace

import torch

from benchnav import Observation, TraversabilityMixture
from benchnav.models import TraversabilityModel, load_model
from benchnav.models.fused import FusedModel


class Varied(TraversabilityModel):
    """Fused model of a checkpoint with changed properties.

    Args:
        checkpoint: folder of the fused model.
        temperature: factor on the temperature of class probabilities; below 1, the
            model is more certain than as trained.
        soft: factor on the weights of soft modes; at 0, the model has none.
        brightness: factor on the brightness of its input image.
    """

    def __init__(
        self,
        checkpoint: str,
        temperature: float = 1.0,
        soft: float = 1.0,
        brightness: float = 1.0,
    ) -> None:
        model = load_model(checkpoint)
        assert isinstance(model, FusedModel), checkpoint
        table = model.table
        if table.soft is not None and soft != 1:
            table = replace(
                table,
                soft=table.soft._replace(
                    weight=(soft * table.soft.weight).clamp(max=0.99)
                ),
            )
        self.model = FusedModel(
            model.classifiers,
            table,
            model.class_names,
            temperature * model.pool_temperature,
        )
        self.class_names, self.brightness = model.class_names, brightness

    def predict(self, observation: Observation) -> TraversabilityMixture:
        if self.brightness != 1:
            lit = (observation.rgb.float() * self.brightness).round().clamp(0, 255)
            observation = replace(observation, rgb=lit.to(torch.uint8))
        return self.model.predict(observation)
