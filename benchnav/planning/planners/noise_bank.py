"""The noise of MPPI: normal numbers that are drawn once and read anew at each step.

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
    """Normal numbers, and where each step reads them.

    Drawing normals costs more than rolling out what they perturb. So a bank of them is
    drawn when a planner begins, a few times as many as a step needs, and each step
    reads it from other places: the bank has a part for each time step of the horizon,
    and of it every action gets a run that begins at a place of its own. From step to
    step the parts change hands and the places move, by strides that are drawn too.
    Within a step all numbers are independent, as no two of them lie at one place of the
    bank; from step to step numbers occur again, in other company. All is a pure
    function of seed and step, on any device. A part has N numbers.

    Args:
        scale: standard deviation of each action's noise, shape [A].
        values: so scaled, shape [A, T, N].
        place: where the runs of step 0 begin in their parts, int64, shape [T, A].
        stride: how far they move on from step to step, int64, shape [T, A].
        samples: K, the length of a run.
    """

    scale: Tensor
    values: Tensor
    place: Tensor
    stride: Tensor
    samples: int

    def at(self, step: int) -> Tensor:
        """The noise of a step, shape [T, A, K]."""
        actions, horizon, numbers = self.values.shape
        within = (self.place + step * self.stride) % (numbers - self.samples + 1)
        # Parts move backward: forward, with the plan, a moment of it would meet the
        # same part at every step.
        part = (torch.arange(horizon, device=within.device) - step) % horizon
        action = torch.arange(actions, device=within.device)
        begin = (action * horizon + part[:, None]) * numbers + within
        # Row i of the windows is the run that begins at number i; nothing is copied
        # before the selection.
        windows = self.values.as_strided(
            (self.values.numel() - self.samples + 1, self.samples), (1, 1)
        )
        return windows.index_select(0, begin.flatten()).view(
            horizon, actions, self.samples
        )


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
    """Samples actions: clip(u + ε), within bounds [A], the action dimension next to
    last.
    """
    return torch.clamp(mean + noise, low[:, None], high[:, None])


def draw_bank(seed: int, horizon: int, samples: int, scale: Tensor) -> NoiseBank:
    """Draws a bank on the CPU, the same for every device.

    Args:
        seed: root of the noise.
        horizon: T.
        samples: K.
        scale: standard deviation of each action's noise, shape [A].
    """
    # PyTorch's generator looks at 32 bits of a seed alone: the key is a hash of all of
    # them.
    generator = rng.generator(rng.stream_key(seed, "noise"))
    actions, numbers = len(scale), _RUNS * samples
    values = torch.randn(
        (actions, horizon, numbers), generator=generator, dtype=scale.dtype
    ).to(scale.device)
    places, shape = numbers - samples + 1, (horizon, actions)
    place, stride = (
        torch.randint(places, shape, generator=generator).to(scale.device)
        for _ in range(2)
    )
    return NoiseBank(scale, values * scale[:, None, None], place, stride, samples)
