"""Noise of MPPI: normal draws that are computed once and reused at each step.

Letters in shapes: B episodes, A action dimensions, T horizon steps, K samples, N draws
in a row of the bank.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from benchnav.core import rng

_RUNS_PER_ROW = 4  # N / K


@dataclass(frozen=True)
class NoiseBank:
    """Normal draws, and the offsets at which each step reads them.

    Drawing normals takes longer than rolling out the actions that they perturb. Hence a
    planner draws a bank once, of four times the draws of a step, and each step reads it
    at other offsets.

    The bank has a row of N draws for each action dimension and each time step of the
    horizon. A step of the planner reads a run of K consecutive draws from each row. In
    the next step of the planner, each time step of the horizon uses another row, and
    the offsets of the runs have moved by random strides. Within a step of the planner,
    all draws are independent, since each draw is read at most once. Later steps read
    the same draws in other combinations. The noise is a pure function of seed and step,
    on any device.

    Args:
        scale: standard deviation of each action's noise, shape [A].
        values: draws with these standard deviations, shape [A, T, N].
        offset: index of the first draw of each run in its row at step 0, int64, shape
            [T, A].
        stride: change of the offset per step, int64, shape [T, A].
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
        # The horizon moves forward by a time step per step of the planner. The rows
        # move the other way, so that a point in time gets another row at each step.
        part = (torch.arange(horizon, device=offset.device) - step) % horizon
        action = torch.arange(n_actions, device=offset.device)
        row = action * horizon + part[:, None]
        begin = row * n_draws + offset
        # Row i of `windows` is the run that begins at draw i of the bank. `windows` is
        # a view, so that only the selected runs are copied.
        n_windows = self.values.numel() - self.samples + 1
        windows = self.values.as_strided((n_windows, self.samples), (1, 1))
        runs = windows.index_select(0, begin.flatten())
        return runs.view(horizon, n_actions, self.samples)


class Sampled(NamedTuple):
    """Action sequences around a mean sequence.

    Args:
        mean: mean action sequences u, shape [B, T, A].
        noise: noise ε before clipping, shape [T, A, K].
        low: minimum actions, shape [A].
        high: maximum actions, shape [A].
    """

    mean: Tensor
    noise: Tensor
    low: Tensor
    high: Tensor


def sampled_actions(sampled: Sampled, step: int) -> Tensor:
    """Return actions at a step of the horizon, clip(u + ε), shape [B, K, A]."""
    mean, noise, low, high = sampled
    actions = perturb(mean[:, step, :, None], noise[step], low, high)
    return actions.movedim(1, 2)


def perturb(mean: Tensor, noise: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return clip(u + ε), whose last dimension but one counts the actions.

    Args:
        mean: mean actions u, shape […, A, 1].
        noise: noise ε, shape […, A, K].
        low: minimum actions, shape [A].
        high: maximum actions, shape [A].
    """
    return torch.clamp(mean + noise, low[:, None], high[:, None])


def draw_bank(seed: int, horizon: int, samples: int, scale: Tensor) -> NoiseBank:
    """Draw a bank of noise on the CPU, so that it is the same for all devices.

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
    n_draws = _RUNS_PER_ROW * samples
    bank_shape = n_actions, horizon, n_draws
    values = torch.randn(bank_shape, generator=generator, dtype=scale.dtype).to(device)
    n_offsets = n_draws - samples + 1
    run_shape = horizon, n_actions
    offset = torch.randint(n_offsets, run_shape, generator=generator).to(device)
    stride = torch.randint(n_offsets, run_shape, generator=generator).to(device)
    return NoiseBank(scale, values * scale[:, None, None], offset, stride, samples)
