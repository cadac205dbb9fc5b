"""The paper's model: a classifier's probabilities times the class-wise Gaussian
processes.

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
from benchnav.models.checkpoint import GP, Checkpoint
from benchnav.models.slope_gp.table import SlopeTable

CHUNK_CELLS = 2**17


class FusedModel(ModelFamily):
    """P(λ) = Σ_c P(c)·P_c(λ | ψ), equation (1), with one component a class, and two
    where it has soft spots.

    P(c) is the average of the members' probabilities, calibrated as a whole. The
    paper's `single-class` option is `TraversabilityMixture.most_likely` of the
    prediction.

    Args:
        classifiers: the members, each from maps by field to logits [B, C, H, W]; one
            that has `inputs` is given these layers, and any other the colours alone.
        table: the GPs over slope.
        class_names: names of the C classes.
        pool_temperature: of the averaged probabilities (see `models.nets.calibration`).
    """

    def __init__(
        self,
        classifiers: Sequence[nn.Module],
        table: SlopeTable,
        class_names: tuple[str, ...],
        pool_temperature: float = 1.0,
    ) -> None:
        """Sets the classifiers to evaluation."""
        self.classifiers = tuple(classifier.eval() for classifier in classifiers)
        self.table, self.class_names, self.pool_temperature = (
            table,
            class_names,
            pool_temperature,
        )
        # Told here, since an exported graph cannot hold a number of components that its
        # tensors decide.
        self.soft_owners = (
            tuple(table.soft.weight.nonzero().flatten().tolist()) if table.soft else ()
        )

    def predict(self, observation: Observation) -> TraversabilityMixture:
        """Predicts on the observation's device, to which the classifiers are moved.

        Args:
            observation: B maps of any size.

        Returns:
            Mixture with float32 parameters of shape [B, K, H, W]: the C classes in
            order, and behind them the second modes of those that have one; `group`
            tells whose they are.
        """
        return self.fuse(self.member_probabilities(observation), observation)

    def fuse(
        self, member_probabilities: Tensor, observation: Observation
    ) -> TraversabilityMixture:
        """Makes the prediction of what the members said of the observation, [M, B, C,
        H, W].
        """
        return self.fuse_at(member_probabilities, observation.slope_deg)

    def fuse_at(
        self, member_probabilities: Tensor, slope_deg: Tensor
    ) -> TraversabilityMixture:
        """As `fuse`, of maps of which the slope is known, [B, H, W]."""
        weights = sharpen(
            member_probabilities.sum(0) / len(self.classifiers), self.pool_temperature
        )
        means, stds = self.table.lookup(slope_deg.float())
        group = tuple(range(len(self.class_names)))
        if soft := self.table.soft:
            group += self.soft_owners
            share, mean, std = (values.to(weights).view(-1, 1, 1) for values in soft)
            second = (weights * share, mean.expand_as(weights), std.expand_as(weights))
            pairs = zip((weights * (1 - share), means, stds), second, strict=True)
            weights, means, stds = (
                torch.cat([main, other[:, list(self.soft_owners)]], 1)
                for main, other in pairs
            )
        return TraversabilityMixture(weights, means, stds, group)

    def member_probabilities(self, observation: Observation) -> Tensor:
        """Class probabilities of each member, before the pool's temperature.

        Args:
            observation: B maps of any size.

        Returns:
            float32, shape [M, B, C, H, W].
        """
        height, width = observation.grid.shape
        size, members = max(1, CHUNK_CELLS // (height * width)), []
        with torch.inference_mode():
            for member in self.classifiers:
                layers = layers_of(observation, getattr(member, "inputs", ("rgb",)))
                member.to(observation.rgb.device)
                chunks = [
                    {name: layer[at : at + size] for name, layer in layers.items()}
                    for at in range(0, len(observation.rgb), size)
                ]
                members.append(
                    torch.cat([member(chunk).float().softmax(1) for chunk in chunks])
                )
        return torch.stack(members)

    @classmethod
    def from_checkpoint(cls, checkpoint: Checkpoint) -> "FusedModel":
        """Rebuilds the model from a checkpoint with GPs and one classifier or more.

        Raises:
            CheckpointError: a half is missing.
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
    """Divides the logarithms of class probabilities by a temperature, under 1 to make
    them surer.

    Args:
        probabilities: shape [B, C, H, W].
        temperature: > 0; at 1 nothing is changed.
    """
    if temperature == 1:
        return probabilities
    return (probabilities.log() / temperature).softmax(1)
