"""Noise of MPPI: normal numbers that are drawn once and read differently at each step.

Letters in shapes: A action dimensions, T horizon steps, K samples, N numbers of a part
of the bank.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from benchnav.core import rng

_RUNS = 4  # length N of a part of the bank, in runs of K numbers


@dataclass(frozen=True)
class NoiseBank:
    """Normal numbers, and the offsets at which each step reads them.

    To draw normals costs more than to roll out what they perturb. A bank of a few times
    as many as a step needs is therefore drawn when a planner starts, and each step
    reads it at other offsets. The bank has a part for each time step of the horizon. In
    a part, every action has a run of numbers with its own offset. From step to step
    the parts are exchanged and the offsets move, by strides that are drawn too. Within
    a step all numbers are independent, since no two are at the same position. From step
    to step numbers occur again in other combinations. All is a pure function of seed
    and step, on any device.

    Args:
        scale: standard deviation of each action's noise, shape [A].
        values: numbers of that scale, shape [A, T, N].
        offset: offsets of the runs of step 0 in their parts, int64, shape [T, A].
        stride: change of the offsets from step to step, int64, shape [T, A].
        samples: K, the length of a run.
    """

    scale: Tensor
    values: Tensor
    offset: Tensor
    stride: Tensor
    samples: int

    def at(self, step: int) -> Tensor:
        """Return the noise of a step, shape [T, A, K]."""
        actions, horizon, numbers = self.values.shape
        within = (self.offset + step * self.stride) % (numbers - self.samples + 1)
        # Parts move backward: forward, with the plan, a time of the horizon would get
        # the same part at every step.
        part = (torch.arange(horizon, device=within.device) - step) % horizon
        action = torch.arange(actions, device=within.device)
        begin = (action * horizon + part[:, None]) * numbers + within
        # Row i of the windows is the run with offset i; nothing is copied before the
        # selection.
        n_windows = self.values.numel() - self.samples + 1
        windows = self.values.as_strided((n_windows, self.samples), (1, 1))
        chosen = windows.index_select(0, begin.flatten())
        return chosen.view(horizon, actions, self.samples)


class Sampled(NamedTuple):
    """Action sequences about a mean.

    Args:
        mean: u, shape [B, T, A].
        noise: ε as drawn, shape [T, A, K].
        low: minimum actions, shape [A].
        high: maximum actions, shape [A].
    """

    mean: Tensor
    noise: Tensor
    low: Tensor
    high: Tensor


def sampled_actions(sampled: Sampled, step: int) -> Tensor:
    """Return the actions of a step of the horizon, clip(u + ε), shape [B, K, A]."""
    mean, noise, low, high = sampled
    return perturb(mean[:, step, :, None], noise[step], low, high).movedim(1, 2)


def perturb(mean: Tensor, noise: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return clip(u + ε) within bounds [A]; the action dimension is next to last."""
    return torch.clamp(mean + noise, low[:, None], high[:, None])


def draw_bank(seed: int, horizon: int, samples: int, scale: Tensor) -> NoiseBank:
    """Draw a bank on the CPU, the same for all devices.

    Args:
        seed: root of the noise.
        horizon: T.
        samples: K.
        scale: standard deviation of each action's noise, shape [A].
    """
    # PyTorch's generator only uses 32 bits of a seed: the key is a hash of all of them.
    generator = rng.generator(rng.stream_key(seed, "noise"))
    actions, numbers = len(scale), _RUNS * samples
    values = torch.randn(
        (actions, horizon, numbers), generator=generator, dtype=scale.dtype
    ).to(scale.device)
    n_offsets = numbers - samples + 1
    shape = horizon, actions
    offset, stride = (
        torch.randint(n_offsets, shape, generator=generator).to(scale.device)
        for _ in range(2)
    )
    return NoiseBank(scale, values * scale[:, None, None], offset, stride, samples)
