"""SWAG: the average prediction of networks whose weights are drawn from a Gaussian.

The Gaussian is fitted to the weights of the last training steps, in its diagonal form:
training does not stop early, and once the learning rate has fallen to a constant, the
running mean and standard deviation of each weight are updated. The seed determines the
draws. After training, the statistics of batch normalisation are computed for each draw,
on a few batches of training maps, and stored. A checkpoint has three numbers per weight:
its last value, mean and standard deviation.
Sources: Maddox et al. (2019), "A simple baseline for Bayesian uncertainty in deep
learning"; Izmailov et al. (2018), "Averaging weights leads to wider optima and better
generalization". Letters in shapes: B maps, H×W cells, K draws.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.func import functional_call

from benchnav.core import rng
from benchnav.core.errors import expect
from benchnav.models.nets.inputs import LayerScale, Maps
from benchnav.models.nets.trainable import WARM_UP_FRACTION
from benchnav.models.zoo.batch_statistics import (
    norms_of,
    size_of,
    statistics_of,
    to_buffers,
)
from benchnav.models.zoo.mean_variance import (
    Gaussians,
    MeanVarianceConfig,
    MeanVarianceModel,
)

_N_BATCHES = 4  # number of batches of training maps for the statistics of a draw


@dataclass(frozen=True, kw_only=True)
class SWAGConfig(MeanVarianceConfig):
    """Settings of the network and its training.

    Args:
        collect: fraction of the training steps, at the end, whose weights are collected;
            in (0, 0.8].
        collect_rate: learning rate in these steps, relative to `learning_rate`; in (0, 1].
        draws: K, number of draws of the weights over which a prediction is averaged.
    """

    collect: float = 0.4
    collect_rate: float = 0.25
    draws: int = 8

    def __post_init__(self) -> None:
        """Check the ranges of the settings."""
        super().__post_init__()
        expect(0 < self.collect <= 0.8, f"`collect` in (0, 0.8], got {self.collect!r}.")
        expect(
            0 < self.collect_rate <= 1,
            f"`collect_rate` in (0, 1], got {self.collect_rate!r}.",
        )
        expect(self.draws >= 1, f"`draws` ≥ 1, got {self.draws!r}.")


class SWAGModel(MeanVarianceModel):
    """Model whose prediction is the average over K draws of the weights.

    Until the statistics of the draws are computed, the current weights are used.

    Args:
        config: settings of the model and its training.
    """

    stops_early: ClassVar[bool] = False
    no_graph: ClassVar[str] = "draws its weights during prediction"
    collected: Tensor
    draw_seed: Tensor
    statistics: Tensor
    is_drawn: Tensor

    def __init__(self, config: SWAGConfig) -> None:
        """Store the settings; `build` creates the network."""
        super().__init__(config)
        self.steps = 0

    def make_modules(self, scale: Mapping[str, LayerScale] | None) -> None:
        """Register buffers for weight moments and for the statistics of each draw."""
        super().make_modules(scale)
        self.weight_names = [name for name, _ in self.named_parameters()]
        self.norms = norms_of(self)
        for index, weights in enumerate(self.parameters()):
            self.register_buffer(f"mean_{index}", torch.zeros_like(weights.detach()))
            self.register_buffer(f"std_{index}", torch.zeros_like(weights.detach()))
        statistics = torch.zeros(self.config.draws * size_of(self.norms))
        # A one-dimensional buffer, since these are stored as float32.
        self.register_buffer("statistics", statistics)
        self.register_buffer("collected", torch.zeros((), dtype=torch.int64))
        self.register_buffer("is_drawn", torch.zeros((), dtype=torch.bool))
        self.register_buffer("draw_seed", torch.tensor(self.seed))

    def forward(self, maps: Maps, use_current: bool = False) -> Gaussians:
        """Compute the outputs.

        Args:
            maps: layers of B maps by name, including `inputs`.
            use_current: whether to use the current weights instead of the draws.

        Returns:
            Means and standard deviations, each of shape [B, K, H, W], or [B, 1, H, W]
            from the current weights.
        """
        if use_current or self.training or not self.is_drawn:
            return super().forward(maps)
        outputs = [
            functional_call(self, self.draw(index), (maps, True))
            for index in range(self.config.draws)
        ]
        means, stds = zip(*outputs, strict=True)
        return torch.cat(means, 1), torch.cat(stds, 1)

    def draw(self, index: int) -> dict[str, Tensor]:
        """Return the weights of a draw by name, and its statistics if computed."""
        key = rng.stream_key(int(self.draw_seed), "models", "swag", index)
        generator = rng.generator(key)
        weights: dict[str, Tensor] = {}
        for i, name in enumerate(self.weight_names):
            mean = self.get_buffer(f"mean_{i}")
            std = self.get_buffer(f"std_{i}")
            noise = torch.randn(mean.shape, generator=generator)
            weights[name] = mean + std * noise.to(mean)
        if self.is_drawn:
            row = self.statistics.view(self.config.draws, -1)[index]
            weights |= to_buffers(self.norms, row)
        return weights

    def configure_schedule(self, optimizer: torch.optim.Optimizer, steps: int) -> Any:
        """Return a schedule: warm-up, cosine decay to `collect_rate`, then constant."""
        self.steps = steps
        final_rate = self.config.collect_rate
        collect_from = steps * (1 - self.config.collect)
        warm_up = min(steps * WARM_UP_FRACTION, collect_from)

        def rate(step: int) -> float:
            if step < warm_up:
                return (step + 1) / (warm_up + 1)
            progress = min((step - warm_up) / max(collect_from - warm_up, 1), 1)
            cosine = 1 + math.cos(math.pi * progress)
            return final_rate + (1 - final_rate) * 0.5 * cosine

        return torch.optim.lr_scheduler.LambdaLR(optimizer, rate)

    @torch.no_grad()
    def on_train_batch_end(self, outputs: Any, batch: Maps, batch_idx: int) -> None:
        """Update the moments of the weights during the last steps."""
        if self.trainer.global_step <= self.steps * (1 - self.config.collect):
            return
        self.collected += 1
        count = float(self.collected)
        for index, parameter in enumerate(self.parameters()):
            weights = parameter.detach()
            mean = self.get_buffer(f"mean_{index}")
            std = self.get_buffer(f"std_{index}")
            deviation = weights - mean
            mean += deviation / count
            # Standard deviations are stored, since squares exceed the range of float16.
            # Source: Welford (1962).
            sum_of_squares = std.square() * (count - 1) + deviation * (weights - mean)
            std.copy_((sum_of_squares / count).clamp(min=0).sqrt())

    def on_fit_end(self) -> None:
        """Compute the statistics of each draw on the first batches of training maps."""
        if not self.collected:
            return
        loader = self.trainer.datamodule.train_dataloader()  # type: ignore[attr-defined]
        batches = []
        for batch in islice(loader, _N_BATCHES):
            maps = {name: batch[name].to(self.device) for name in self.inputs}
            batches.append((maps, True))
        rows = [
            statistics_of(self, self.draw(index), batches)
            for index in range(self.config.draws)
        ]
        self.statistics.copy_(torch.cat(rows))
        self.is_drawn.fill_(True)
