"""SWAG: a Gaussian over the weights that the last steps of a training go through, of
which some draws predict.

Training does not stop early: the learning rate falls and stays, and from then on
running means and deviations of all weights are kept, the diagonal form. Draws are fixed
by the seed. Statistics of batch normalisation are made anew for each draw in the end,
on some batches of training maps, and kept. A checkpoint has three numbers a weight: the
last, its mean and its deviation.
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
from benchnav.models.nets.trainable import WARM_UP_SHARE
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

_BATCHES = 4  # of training maps, for the statistics of a draw


@dataclass(frozen=True, kw_only=True)
class SWAGConfig(MeanVarianceConfig):
    """What the network is and how it is trained.

    Args:
        collect: share of all steps, the last ones, whose weights are collected.
        collect_rate: learning rate meanwhile, in shares of `learning_rate`.
        draws: K, sets of weights that a prediction averages over.
    """

    collect: float = 0.4
    collect_rate: float = 0.25
    draws: int = 8

    def __post_init__(self) -> None:
        """Refuses numbers that cannot train."""
        super().__post_init__()
        expect(0 < self.collect <= 0.8, f"`collect` in (0, 0.8], got {self.collect!r}.")
        expect(
            0 < self.collect_rate <= 1,
            f"`collect_rate` in (0, 1], got {self.collect_rate!r}.",
        )
        expect(self.draws >= 1, f"`draws` ≥ 1, got {self.draws!r}.")


class SWAGModel(MeanVarianceModel):
    """Predicts the average over draws of its weights; until they are drawn, by the
    weights as they are.

    Args:
        config: what it is.
    """

    stops_early: ClassVar[bool] = False
    no_graph: ClassVar[str] = "draws its weights as it predicts"
    collected: Tensor
    draw_seed: Tensor
    statistics: Tensor
    is_drawn: Tensor

    def __init__(self, config: SWAGConfig) -> None:
        """Keeps the settings."""
        super().__init__(config)
        self.steps = 0

    def make_modules(self, scale: Mapping[str, LayerScale] | None) -> None:
        """Makes room for the moments of the weights, and for the statistics of each
        draw, in one row.
        """
        super().make_modules(scale)
        self.names = [name for name, _ in self.named_parameters()]
        self.norms = norms_of(self)
        for place, weights in enumerate(self.parameters()):
            self.register_buffer(f"mean_{place}", torch.zeros_like(weights.detach()))
            self.register_buffer(f"std_{place}", torch.zeros_like(weights.detach()))
        # stays float32
        self.register_buffer(
            "statistics", torch.zeros(self.config.draws * size_of(self.norms))
        )
        self.register_buffer("collected", torch.zeros((), dtype=torch.int64))
        self.register_buffer("is_drawn", torch.zeros((), dtype=torch.bool))
        self.register_buffer("draw_seed", torch.tensor(self.seed))

    def forward(self, maps: Maps, alone: bool = False) -> Gaussians:
        """Computes the outputs.

        Args:
            maps: B maps by field, `inputs` among them.
            alone: by the weights as they are.

        Returns:
            Means and standard deviations, each of shape [B, 1, H, W], and [B, K, H, W]
            once there are draws.
        """
        if alone or self.training or not self.is_drawn:
            return super().forward(maps)
        drawn = [
            functional_call(self, self.draw(index), (maps, True))
            for index in range(self.config.draws)
        ]
        means, stds = zip(*drawn, strict=True)
        return torch.cat(means, 1), torch.cat(stds, 1)

    def draw(self, index: int) -> dict[str, Tensor]:
        """Weights of a draw by name, and the statistics that fit them where they have
        been made.
        """
        generator = rng.generator(
            rng.stream_key(int(self.draw_seed), "models", "swag", index)
        )
        drawn: dict[str, Tensor] = {}
        for place, name in enumerate(self.names):
            mean, std = (
                self.get_buffer(f"mean_{place}"),
                self.get_buffer(f"std_{place}"),
            )
            drawn[name] = mean + std * torch.randn(mean.shape, generator=generator).to(
                mean
            )
        if self.is_drawn:
            drawn |= to_buffers(
                self.norms, self.statistics.view(self.config.draws, -1)[index]
            )
        return drawn

    def configure_schedule(self, optimizer: torch.optim.Optimizer, steps: int) -> Any:
        """The rate rises, falls to `collect_rate` along a cosine, and stays."""
        self.steps, floor = steps, self.config.collect_rate
        start = steps * (1 - self.config.collect)
        warm = min(steps * WARM_UP_SHARE, start)

        def rate(step: int) -> float:
            if step < warm:
                return (step + 1) / (warm + 1)
            done = min((step - warm) / max(start - warm, 1), 1)
            return floor + (1 - floor) * 0.5 * (1 + math.cos(math.pi * done))

        return torch.optim.lr_scheduler.LambdaLR(optimizer, rate)

    @torch.no_grad()
    def on_train_batch_end(self, outputs: Any, batch: Maps, batch_idx: int) -> None:
        """Adds the weights to their running moments, in the last steps."""
        if self.trainer.global_step <= self.steps * (1 - self.config.collect):
            return
        self.collected += 1
        count = float(self.collected)
        for place, weights in enumerate(self.parameters()):
            mean, std = (
                self.get_buffer(f"mean_{place}"),
                self.get_buffer(f"std_{place}"),
            )
            off = weights.detach() - mean
            mean += off / count
            # Deviations rather than squares, which float16 could not keep. Source:
            # Welford (1962).
            std.copy_(
                ((std.square() * (count - 1) + off * (weights.detach() - mean)) / count)
                .clamp(min=0)
                .sqrt()
            )

    def on_fit_end(self) -> None:
        """Makes the statistics of each draw, on training maps in the order of the first
        epoch.
        """
        if not self.collected:
            return
        loaded = islice(self.trainer.datamodule.train_dataloader(), _BATCHES)  # type: ignore[attr-defined]
        batches = [
            ({name: batch[name].to(self.device) for name in self.inputs}, True)
            for batch in loaded
        ]
        rows = [
            statistics_of(self, self.draw(index), batches)
            for index in range(self.config.draws)
        ]
        self.statistics.copy_(torch.cat(rows))
        self.is_drawn.fill_(True)
