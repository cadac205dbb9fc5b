"""Noise of MPPI: normal draws that are made once and reused at each step.

Letters in shapes: A action dimensions, T horizon steps, K samples, N draws in a part of
the bank.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from benchnav.core import rng

_RUNS = 4  # length N of a part of the bank, in runs of K draws


@dataclass(frozen=True)
class NoiseBank:
    """Normal draws, and the offsets at which each step reads them.

    Drawing normals takes longer than rolling out the actions that they perturb. Hence a
    bank of a few times the draws of a step is made when a planner starts, and each step
    reads it at different offsets. The bank has a part for each time step of the horizon.
    In a part, each action reads a run of draws at its own offset. From step to step the
    parts are exchanged, and the offsets move by random strides. Within a step all draws
    are independent, since each position is read at most once. Later steps read the same
    draws in other combinations. The noise is a pure function of seed and step, on any
    device.

    Args:
        scale: standard deviation of each action's noise, shape [A].
        values: draws of that scale, shape [A, T, N].
        offset: offsets of the runs of step 0 in their parts, int64, shape [T, A].
        stride: change of the offsets from step to step, int64, shape [T, A].
        samples: number of samples K, the length of a run.
    """

    scale: Tensor
    values: Tensor
    offset: Tensor
    stride: Tensor
    samples: int

    def at(self, step: int) -> Tensor:
        """Return the noise of a step, shape [T, A, K]."""
        n_actions, horizon, n_draws = self.values.shape
        n_offsets = n_draws - self.samples + 1
        offset = (self.offset + step * self.stride) % n_offsets
        # Parts move backward. If they moved forward, with the plan, a point of time
        # would get the same part at every step.
        part = (torch.arange(horizon, device=offset.device) - step) % horizon
        action = torch.arange(n_actions, device=offset.device)
        row = action * horizon + part[:, None]
        begin = row * n_draws + offset
        # Row i of the windows is the run with offset i. The windows are a view, so that
        # only the selected runs are copied.
        n_windows = self.values.numel() - self.samples + 1
        windows = self.values.as_strided((n_windows, self.samples), (1, 1))
        chosen = windows.index_select(0, begin.flatten())
        return chosen.view(horizon, n_actions, self.samples)


class Sampled(NamedTuple):
    """Action sequences about a mean.

    Args:
        mean: mean actions u, shape [B, T, A].
        noise: noise ε before clipping, shape [T, A, K].
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
    actions = perturb(mean[:, step, :, None], noise[step], low, high)
    return actions.movedim(1, 2)


def perturb(mean: Tensor, noise: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return clip(u + ε) within bounds [A]; the action dimension is next to last."""
    return torch.clamp(mean + noise, low[:, None], high[:, None])


def draw_bank(seed: int, horizon: int, samples: int, scale: Tensor) -> NoiseBank:
    """Draw a bank on the CPU, the same for all devices.

    Args:
        seed: seed of the noise.
        horizon: number of steps T.
        samples: number of samples K.
        scale: standard deviation of each action's noise, shape [A].
    """
    # PyTorch's generator uses only 32 bits of a seed, so the key is a hash of all bits.
    key = rng.stream_key(seed, "noise")
    generator = rng.generator(key)
    device = scale.device
    n_actions = len(scale)
    n_draws = _RUNS * samples
    bank_shape = n_actions, horizon, n_draws
    values = torch.randn(bank_shape, generator=generator, dtype=scale.dtype).to(device)
    n_offsets = n_draws - samples + 1
    run_shape = horizon, n_actions
    offset = torch.randint(n_offsets, run_shape, generator=generator).to(device)
    stride = torch.randint(n_offsets, run_shape, generator=generator).to(device)
    return NoiseBank(scale, values * scale[:, None, None], offset, stride, samples)
