"""A mixture-density network: from colour and slope straight to the distribution of traversability.

It knows no terrain classes: it learns from observed λ alone, by the likelihood of a Gaussian mixture
clipped to [0, 1]. Colour goes through a convolutional network, for what the ground is shows in its
surroundings; slope joins cell by cell, for traversability hangs on the slope of the cell itself.
Sources: Bishop (1994), "Mixture density networks"; Tobin (1958), "Estimation of relationships for
limited dependent variables". Letters in shapes: B maps, H×W cells, K components.
"""

import math
from typing import Any, Self

import torch
from torch import Tensor, nn
from torchmetrics import MeanSquaredError, Metric

from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.settings import of, read
from benchnav.core.terrain import Observation
from benchnav.models.base import ModelFamily
from benchnav.models.checkpoint import Checkpoint, refitting
from benchnav.models.config import ClassifierConfig, MDNConfig
from benchnav.models.nets.classifier import TerrainClassifier
from benchnav.models.nets.trainable import TrainableNetwork

MDN = "mdn"
LEAST_STD = 0.01

_FIRST_STD, _FIRST_SPREAD = 0.2, 0.1
_FEATURES = 32
_CHUNK_CELLS = 2**17

Parameters = tuple[Tensor, Tensor, Tensor]


class LogNormalCDF(torch.autograd.Function):
    """log Φ(z) with the gradient φ/Φ as √(2/π) / erfcx(−z/√2).

    That of `torch.special.log_ndtr` takes the difference of two squares: in float32 it is 5 % off at
    z = −10³ and of no use from −10⁴ on, and a component of small width that lies far off gets there.
    """

    @staticmethod
    def forward(context: Any, z: Tensor) -> Tensor:
        """log Φ(z), shape of `z`."""
        context.save_for_backward(z)
        return torch.special.log_ndtr(z)

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> Tensor:
        """Gradient by z."""
        (z,) = context.saved_tensors
        return gradients[0] * math.sqrt(2 / math.pi) / torch.special.erfcx(-z / math.sqrt(2))


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
    z = (at - means) / stds
    density = -0.5 * z**2 - stds.log() - 0.5 * math.log(2 * math.pi)
    mass = LogNormalCDF.apply(torch.where(at <= 0, -means, means - 1) / stds)
    component = torch.where((at <= 0) | (at >= 1), mass, density)
    total = torch.logsumexp(component + log_weights, dim=1)
    return -torch.where(seen, total, 0.0).sum() / seen.sum().clamp(min=1)


class MixtureDensityNetwork(TrainableNetwork):
    """Predicts the mixture of every cell from colour and slope.

    Args:
        config: what it is.
        colour_mean: of the training maps, 0–255, shape [3].
        colour_std: of the training maps, shape [3].
        slope_scale_deg: by which slopes are divided; the root mean square of the training maps'.
        seed: root seed of the initial weights.
    """

    part = MDN
    fields = ("slope_deg", "traversability")
    slope_scale_deg: Tensor

    def __init__(
        self,
        config: MDNConfig,
        colour_mean: Tensor,
        colour_std: Tensor,
        slope_scale_deg: Tensor,
        seed: int = 0,
    ) -> None:
        """Builds the network with fresh weights."""
        super().__init__(config)
        self.register_buffer("slope_scale_deg", slope_scale_deg.clone())
        image = ClassifierConfig(
            architecture=config.architecture, encoder=config.encoder, pretrained=config.pretrained
        )
        # The classifier's network, whose outputs tell of the ground by features rather than by classes.
        self.ground = TerrainClassifier(image, _FEATURES, colour_mean, colour_std, seed)
        self.joint, self.head = self.configure_head(seed)

    @classmethod
    def untrained(cls, config: Any, class_count: int, data: Any = None, seed: int = 0) -> Self:
        """Builds it with fresh weights, for images of the colours and slopes of `data`; classes do not matter."""
        if data is None:
            return cls(config, torch.zeros(3), torch.ones(3), torch.ones(()), seed)
        squares = sum(maps["slope_deg"].double().square().sum() for _, maps in data.train.chunks())
        cells = len(data.train) * data.train.shape[0] * data.train.shape[1]
        # Flat ground alone would have no scale.
        scale = (torch.as_tensor(squares) / cells).sqrt().clamp(min=1).float()
        mean, std = data.colour_statistics()
        return cls(config, mean, std, scale, seed)

    def configure_metrics(self) -> dict[str, Metric]:
        """The error of the expectation, in root mean square over the observed cells."""
        return {"rmse": MeanSquaredError(squared=False)}

    def configure_head(self, seed: int) -> tuple[nn.Module, nn.Module]:
        """Builds the layers that join features and slope; leaves PyTorch's global generator as it was.

        Components begin with means evenly over [0, 1], and with nearly the same weight and width.
        """
        count, hidden = self.config.components, self.config.hidden
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(seed)
            joint = nn.Sequential(
                nn.Conv2d(_FEATURES + 1, hidden, 1), nn.SiLU(), nn.Conv2d(hidden, hidden, 1), nn.SiLU()
            )
            head = nn.Conv2d(hidden, 3 * count, 1)
        means = (torch.arange(count) + 0.5) / count
        width = math.log(math.expm1(_FIRST_STD - LEAST_STD))  # softplus⁻¹
        first = torch.cat([torch.zeros(count), means, torch.full((count,), width)])
        head.load_state_dict({"weight": _FIRST_SPREAD * head.weight, "bias": first})
        return joint.to(memory_format=torch.channels_last), head

    def forward(self, rgb: Tensor, slope_deg: Tensor) -> Parameters:
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

    @classmethod
    def from_tensors(cls, config: dict[str, Any], tensors: dict[str, Tensor]) -> "MixtureDensityNetwork":
        """Rebuilds a trained network, downloading nothing.

        Args:
            config: fields of `MDNConfig`.
            tensors: a state dict.

        Raises:
            ConfigError: the settings are not those of a mixture-density network.
            RuntimeError: the tensors do not fit them.
        """
        built = read(MDNConfig, {**config, "pretrained": False}, of("MDNConfig"))
        network = cls(built, torch.zeros(3), torch.ones(3), torch.ones(()))
        network.load_state_dict(tensors)
        return network.eval()


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
        rgb, slope_deg, (height, width) = observation.rgb, observation.slope_deg, observation.grid.shape
        self.network.to(rgb.device)
        shape = (len(rgb), self.network.config.components, height, width)
        weights, means, stds = (torch.empty(shape, device=rgb.device) for _ in range(3))
        step = max(1, _CHUNK_CELLS // (height * width))
        with torch.inference_mode():
            for start in range(0, len(rgb), step):
                some = slice(start, start + step)
                log_weights, means[some], stds[some] = self.network(rgb[some], slope_deg[some])
                weights[some] = log_weights.exp()
        return TraversabilityMixture(weights, means, stds)

    @classmethod
    def from_checkpoint(cls, checkpoint: Checkpoint) -> "MixtureDensityModel":
        """Rebuilds the model from a checkpoint with a part `mdn`.

        Raises:
            CheckpointError: the part is missing, or its tensors do not fit its settings.
        """
        part = checkpoint.part(MDN)
        with refitting():
            return cls(MixtureDensityNetwork.from_tensors(part.config, part.tensors))
