"""A mixture-density network: from colour and slope straight to the distribution of traversability.

It knows no terrain classes: it learns from observed λ alone, by the likelihood of a Gaussian mixture
clipped to [0, 1]. Colour goes through a convolutional network, for what the ground is shows in its
surroundings; slope joins cell by cell, for traversability hangs on the slope of the cell itself.
Sources: Bishop (1994), "Mixture density networks"; Tobin (1958), "Estimation of relationships for
limited dependent variables". Letters in shapes: B maps, H×W cells, K components.
"""

import math

import torch
from torch import Tensor, nn
from torchmetrics import MeanSquaredError

from benchnav.core.mixture import TraversabilityMixture, component_log_prob
from benchnav.core.terrain import Observation
from benchnav.models.base import ModelFamily
from benchnav.models.checkpoint import Checkpoint
from benchnav.models.config import ClassifierConfig, MDNConfig
from benchnav.models.nets.classifier import TerrainClassifier
from benchnav.models.nets.trainable import NO_SCALE, MapScale, TrainableNetwork

MDN = "mdn"
LEAST_STD = 0.01

_FIRST_STD, _FIRST_SPREAD = 0.2, 0.1
_FEATURES = 32
_CHUNK_CELLS = 2**17


def censored_nll(log_weights: Tensor, means: Tensor, stds: Tensor, observed: Tensor) -> Tensor:
    """Negative log likelihood of observed λ under a Gaussian mixture clipped to [0, 1].

    Inside (0, 1) it is that of the density; at 0 and 1 that of the probability mass clipped there.

    Args:
        log_weights: logarithms of weights that sum to 1 over K, shape [B, K, H, W].
        means: before clipping, shape [B, K, H, W].
        stds: before clipping, > 0, shape [B, K, H, W].
        observed: λ in [0, 1], and NaN where it was not observed, shape [B, H, W].

    Returns:
        Mean over the observed cells, a number; 0 where none was.
    """
    seen = observed.isfinite()
    # A cell left out needs some value that is finite: NaN times 0 would reach the gradients.
    at = torch.where(seen, observed, 0.5).unsqueeze(1)
    component = component_log_prob(means, stds, at)
    total = torch.logsumexp(component + log_weights, dim=1)
    return -torch.where(seen, total, 0.0).sum() / seen.sum().clamp(min=1)


class MixtureDensityNetwork(TrainableNetwork):
    """Predicts the mixture of every cell from colour and slope.

    Args:
        config: what it is.
        class_count: which does not matter.
        scale: of the training maps.
        seed: root seed of the initial weights.
    """

    part, kind = MDN, MDNConfig
    fields = ("slope_deg", "traversability")
    slope_scale_deg: Tensor

    def __init__(
        self, config: MDNConfig, class_count: int, scale: MapScale = NO_SCALE, seed: int = 0
    ) -> None:
        """Builds the network with fresh weights."""
        super().__init__(config, rmse=MeanSquaredError(squared=False))
        self.register_buffer("slope_scale_deg", scale.slope_deg.clone())
        image = ClassifierConfig(
            architecture=config.architecture, encoder=config.encoder, pretrained=config.pretrained
        )
        # The classifier's network, whose outputs tell of the ground by features rather than by classes.
        self.ground = TerrainClassifier(image, _FEATURES, scale, seed)
        count, hidden = config.components, config.hidden
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(seed)
            self.joint = nn.Sequential(
                nn.Conv2d(_FEATURES + 1, hidden, 1), nn.SiLU(), nn.Conv2d(hidden, hidden, 1), nn.SiLU()
            )
            self.head = nn.Conv2d(hidden, 3 * count, 1)
        self.joint.to(memory_format=torch.channels_last)
        # Components begin with means evenly over [0, 1], and with nearly the same weight and width.
        means = (torch.arange(count) + 0.5) / count
        width = math.log(math.expm1(_FIRST_STD - LEAST_STD))  # softplus⁻¹
        first = torch.cat([torch.zeros(count), means, torch.full((count,), width)])
        self.head.load_state_dict({"weight": _FIRST_SPREAD * self.head.weight, "bias": first})

    def forward(self, rgb: Tensor, slope_deg: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Computes the mixtures of maps of any size; their parameters are float32 under autocast too.

        Args:
            rgb: uint8, shape [B, 3, H, W].
            slope_deg: shape [B, H, W].

        Returns:
            Logarithms of the weights, means and standard deviations, each of shape [B, K, H, W].
        """
        features = self.ground(rgb)
        slope = (slope_deg.to(self.slope_scale_deg) / self.slope_scale_deg).unsqueeze(1)
        hidden = self.joint(torch.cat([features, slope.to(features.dtype)], dim=1))
        with torch.autocast(rgb.device.type, enabled=False):
            logits, means, widths = self.head(hidden.to(self.head.weight.dtype)).chunk(3, dim=1)
            return logits.log_softmax(1), means, nn.functional.softplus(widths) + LEAST_STD

    def assess(self, batch: dict[str, Tensor]) -> tuple[Tensor, int]:
        """Computes the loss of a batch, and how many of its cells were observed; in evaluation updates `metrics`."""
        log_weights, means, stds = self(batch["rgb"], batch["slope_deg"])
        observed = batch["traversability"]
        seen = observed.isfinite()
        with torch.autocast(observed.device.type, enabled=False):
            loss = censored_nll(log_weights, means, stds, observed)
        if not self.training:
            expected = TraversabilityMixture(log_weights.exp(), means, stds).mean()
            self.metrics["rmse"].update(expected[seen], observed[seen])
        return loss, int(seen.sum())


class MixtureDensityModel(ModelFamily):
    """A trained mixture-density network as a model.

    Args:
        network: the network.
    """

    def __init__(self, network: MixtureDensityNetwork) -> None:
        """Sets the network to evaluation."""
        self.network = network.eval()

    def predict(self, observation: Observation) -> TraversabilityMixture:
        """Predicts on the observation's device, to which the network is moved.

        Args:
            observation: B maps of any size.

        Returns:
            Mixture with float32 parameters of shape [B, K, H, W].
        """
        rgb, (height, width) = observation.rgb, observation.grid.shape
        self.network.to(rgb.device)
        size = max(1, _CHUNK_CELLS // (height * width))
        with torch.inference_mode():
            chunks = zip(rgb.split(size), observation.slope_deg.split(size), strict=True)
            parts = [self.network(*chunk) for chunk in chunks]
        log_weights, means, stds = (torch.cat(values) for values in zip(*parts, strict=True))
        return TraversabilityMixture(log_weights.exp(), means, stds)

    @classmethod
    def from_checkpoint(cls, checkpoint: Checkpoint) -> "MixtureDensityModel":
        """Rebuilds the model from a checkpoint with a part `mdn`.

        Raises:
            CheckpointError: the part is missing.
        """
        part = checkpoint.part(MDN)
        return cls(MixtureDensityNetwork.from_tensors(part.config, 0, part.tensors))
