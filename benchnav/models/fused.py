"""The paper's model: class probabilities fused with class-wise Gaussian processes.

Source: paper III-B, equation (1); ensembles: Lakshminarayanan et al. (2017), "Simple
and scalable predictive uncertainty estimation using deep ensembles". Letters in shapes:
M members, B maps, H×W cells, C classes.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.terrain import Observation
from benchnav.models.base import ModelFamily, layers_of
from benchnav.models.checkpoint import Checkpoint
from benchnav.models.parts import GP
from benchnav.models.slope_gp.table import SlopeTable

CHUNK_CELLS = 2**17  # number of cells that a classifier receives at a time


class FusedModel(ModelFamily):
    """P(λ) = Σ_c P(c)·P_c(λ | ψ), equation (1), with one component per class.

    Classes with soft spots have two components. P(c) is the average of the members'
    probabilities, calibrated by a temperature. For the paper's `single-class` option,
    call `TraversabilityMixture.most_likely` on the prediction.

    Args:
        classifiers: the members. Each is a network that maps a dictionary of layers, by
            name, to logits of shape [B, C, H, W]. A member with an attribute `inputs`
            receives the layers named there; any other member receives only `rgb`.
        table: predictions of the GPs over slope.
        class_names: names of the C classes.
        pool_temperature: temperature of the averaged probabilities (see
            `models.nets.calibration`).
    """

    def __init__(
        self,
        classifiers: Sequence[nn.Module],
        table: SlopeTable,
        class_names: tuple[str, ...],
        pool_temperature: float = 1.0,
    ) -> None:
        """Set the classifiers to evaluation mode."""
        self.classifiers = tuple(classifier.eval() for classifier in classifiers)
        self.table = table
        self.class_names = class_names
        self.pool_temperature = pool_temperature
        # Computed here, since the number of components in an exported graph cannot
        # depend on tensors.
        self.soft_class_ids: tuple[int, ...] = ()
        if table.soft:
            self.soft_class_ids = tuple(table.soft.weight.nonzero().flatten().tolist())

    def predict(self, observation: Observation) -> TraversabilityMixture:
        """Predict on the observation's device.

        Args:
            observation: B maps of any size. The classifiers are moved to the device of
                the observation.

        Returns:
            Mixture with float32 parameters of shape [B, K, H, W]. Its K components are
            the C classes in order, then the soft spots of each class that has them;
            `group` gives the class of each component.
        """
        return self.fuse(self.member_probabilities(observation), observation)

    def fuse(
        self, member_probabilities: Tensor, observation: Observation
    ) -> TraversabilityMixture:
        """Return the prediction from the members' probabilities, [M, B, C, H, W]."""
        return self.fuse_at(member_probabilities, observation.slope_deg)

    def fuse_at(
        self, member_probabilities: Tensor, slope_deg: Tensor
    ) -> TraversabilityMixture:
        """Like `fuse`, but take slopes in degrees, [B, H, W], not an observation."""
        mean_probability = member_probabilities.sum(0) / len(self.classifiers)
        weights = sharpen(mean_probability, self.pool_temperature)
        means, stds = self.table.lookup(slope_deg.float())
        group = tuple(range(len(self.class_names)))
        if self.table.soft:
            soft_ids = list(self.soft_class_ids)
            group += self.soft_class_ids
            weight, mean, std = (v.to(weights).view(-1, 1, 1) for v in self.table.soft)
            soft_weights = (weights * weight)[:, soft_ids]
            soft_means = mean.expand_as(weights)[:, soft_ids]
            soft_stds = std.expand_as(weights)[:, soft_ids]
            weights = torch.cat([weights * (1 - weight), soft_weights], 1)
            means = torch.cat([means, soft_means], 1)
            stds = torch.cat([stds, soft_stds], 1)
        return TraversabilityMixture(weights, means, stds, group)

    def member_probabilities(self, observation: Observation) -> Tensor:
        """Return class probabilities of each member, before the temperature is applied.

        Args:
            observation: B maps of any size.

        Returns:
            float32, shape [M, B, C, H, W].
        """
        height, width = observation.grid.shape
        chunk_size = max(1, CHUNK_CELLS // (height * width))
        members = []
        with torch.inference_mode():
            for member in self.classifiers:
                layers = layers_of(observation, getattr(member, "inputs", ("rgb",)))
                member.to(observation.rgb.device)
                probabilities = []
                for start in range(0, len(observation.rgb), chunk_size):
                    chunk = slice(start, start + chunk_size)
                    logits = member(
                        {name: layer[chunk] for name, layer in layers.items()}
                    )
                    probabilities.append(logits.float().softmax(1))
                members.append(torch.cat(probabilities))
        return torch.stack(members)

    @classmethod
    def from_checkpoint(cls, checkpoint: Checkpoint) -> "FusedModel":
        """Rebuild the model from a checkpoint with GPs and at least one classifier.

        Raises:
            CheckpointError: If GPs or classifiers are missing.
        """
        from benchnav.models.nets.classifier import classifiers_of

        table = SlopeTable.from_tensors(checkpoint.part(GP).tensors)
        return cls(
            classifiers_of(checkpoint),
            table,
            checkpoint.class_names,
            checkpoint.pool_temperature,
        )


def sharpen(probabilities: Tensor, temperature: float) -> Tensor:
    """Return softmax(log p / T) of class probabilities p, with T the temperature.

    Args:
        probabilities: p, shape [B, C, H, W].
        temperature: T > 0; below 1 it sharpens, at 1 it changes nothing.
    """
    if temperature == 1:
        return probabilities
    return (probabilities.log() / temperature).softmax(1)
