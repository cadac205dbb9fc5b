"""The classifier's network: one of segmentation-models-pytorch, joined by the image at full resolution.

Sources: Ronneberger et al. (2015), "U-Net"; He et al. (2016), "Deep residual learning". Letters in
shapes: B maps, H×W cells, C classes.
"""

import inspect
from typing import Any

import segmentation_models_pytorch as smp
import timm
import torch
from torch import Tensor, nn

from benchnav.core.errors import ConfigError, quiet
from benchnav.core.settings import hint, one_line
from benchnav.models.config import DEEPEST, ClassifierConfig

_DETAIL_CHANNELS = 32
_CONDITION_SIDE = 64


class WithFullResolution(nn.Module):
    """A network whose features are joined by those of the image at full resolution before classes are told.

    Args:
        network: from images [B, 3, H, W] to features [B, 32, H, W].
        class_count: C.
    """

    def __init__(self, network: nn.Module, class_count: int) -> None:
        """Adds a layer beside the network and two behind it."""
        super().__init__()
        self.network = network
        self.detail = _convolution(3, _DETAIL_CHANNELS)
        self.head = nn.Sequential(
            _convolution(2 * _DETAIL_CHANNELS, _DETAIL_CHANNELS), nn.Conv2d(_DETAIL_CHANNELS, class_count, 1)
        )

    def forward(self, image: Tensor) -> Tensor:
        """Computes logits [B, C, H, W] of images [B, 3, H, W]."""
        return self.head(torch.cat([self.network(image), self.detail(image)], dim=1))


@torch.inference_mode(False)  # idle stages are found by gradients, which a caller may have switched off
def build_network(config: ClassifierConfig, class_count: int, seed: int) -> nn.Module:
    """Builds the network with fresh weights; leaves PyTorch's global generator as it was.

    Args:
        config: what it is.
        class_count: C.
        seed: root seed of the weights.

    Returns:
        From images [B, 3, H, W], whose sides are multiples of 2^encoder_depth, to logits [B, C, H, W].

    Raises:
        ConfigError: there is no such architecture or encoder, or they do not take these settings.
    """
    _check_names(config)
    known = inspect.signature(smp.MODEL_ARCHITECTURES_MAPPING[config.architecture]).parameters
    own = known["decoder_channels"].default if "decoder_channels" in known else None
    if config.decoder_channels and not isinstance(own, tuple):
        raise ConfigError(
            f"Expected no `decoder_channels` for architecture {config.architecture}, which has no such setting, "
            f"got {list(config.decoder_channels)}. Leave them out."
        )
    # What is not asked for is left to the architecture; at a lesser depth it would have too many channels.
    size: dict[str, Any] = {"decoder_channels": config.decoder_channels} if config.decoder_channels else {}
    if config.encoder_depth < DEEPEST:
        size["encoder_depth"] = config.encoder_depth
        if isinstance(own, tuple):
            size.setdefault("decoder_channels", own[-config.encoder_depth :])
    # The hub's own lines on each trial to reach it would bury the error.
    with torch.random.fork_rng(devices=[]), quiet("huggingface_hub"):
        torch.default_generator.manual_seed(seed)
        try:
            network = smp.create_model(
                config.architecture,
                encoder_name=config.encoder,
                encoder_weights="imagenet" if config.pretrained else None,
                in_channels=3,
                classes=_DETAIL_CHANNELS if config.full_resolution else class_count,
                **size,
            )
            if config.encoder_depth < DEEPEST:
                _drop_unused_stages(network)
        except (OSError, KeyError, RuntimeError) as error:
            if not config.pretrained:
                raise
            raise ConfigError(
                f"Expected to download ImageNet weights of {config.encoder} for `pretrained`, got: {one_line(error)} "
                "Try again where there is a connection, or leave --classifier.pretrained or --mdn.pretrained out."
            ) from error
        except (ValueError, TypeError) as error:
            raise ConfigError(
                f"Expected settings that {config.architecture} of {config.encoder} takes, got `encoder_depth` "
                f"{config.encoder_depth} and `decoder_channels` {list(config.decoder_channels)}: {error} "
                "Change them, or leave them out."
            ) from error
        if config.full_resolution:
            network = WithFullResolution(network, class_count)
    return network.to(memory_format=torch.channels_last)


def _check_names(config: ClassifierConfig) -> None:
    architectures, encoder = smp.MODEL_ARCHITECTURES_MAPPING, config.encoder
    if config.architecture not in architectures:
        near = hint(config.architecture.lower().replace("+", "plus"), architectures)
        raise ConfigError(
            f"Expected `architecture` among {', '.join(architectures)}, got {config.architecture!r}.{near}"
        )
    known, own = list(smp.encoders.get_encoder_names()), encoder.startswith("tu-")
    # Of a name such as tu-resnet18.a1_in1k what follows the dot names weights; one with a colon is on a hub.
    if encoder not in known and not (
        own and (":" in encoder or timm.is_model(encoder[3:].partition(".")[0]))
    ):
        known += [f"tu-{name}" for name in timm.list_models()] if own else []
        raise ConfigError(
            "Expected `encoder` to be one of segmentation-models-pytorch, such as resnet18, or of timm, such as "
            f"tu-resnet18, got {encoder!r}.{hint(encoder, known)}"
        )


def _drop_unused_stages(network: Any) -> None:
    """Takes out what a lesser depth leaves idle in a network's encoder: it would be stored all the same.

    Idle is what has weights of which none is given a gradient.

    Raises:
        ValueError: at this depth the network's answer is not of the image's size.
    """
    answer = network.eval()(torch.zeros(1, 3, _CONDITION_SIDE, _CONDITION_SIDE))
    if answer.shape[-1] != _CONDITION_SIDE:
        raise ValueError(f"it answers {_CONDITION_SIDE} cells with {answer.shape[-1]}.")
    answer.sum().backward()
    for part in list(network.encoder.modules()):
        for name, inner in list(part.named_children()):
            weights = list(inner.parameters())
            if weights and all(weight.grad is None for weight in weights):
                setattr(part, name, nn.Identity())
    network.train().zero_grad()


def _convolution(channels: int, out: int) -> nn.Module:
    return nn.Sequential(nn.Conv2d(channels, out, 3, padding=1, bias=False), nn.BatchNorm2d(out), nn.ReLU())
