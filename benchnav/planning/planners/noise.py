"""The noise of a sampling planner: drawn once in bulk, and read anew at each step.

Drawing normals costs more than rolling out what they perturb. So a bank of them is drawn when a planner begins, a
few times as many as a step needs, and each step reads it elsewhere: every action of every time step gets a run of
the bank that begins at a place of its own, and the places move on from step to step by strides that are drawn too.
Within a step a sample's numbers are independent of one another, as they lie at different places of the bank; between
steps, and between samples of one step, numbers occur again in other company. All is a pure function of seed and
step, on any device. Letters in shapes: K samples, T horizon steps, A action dimensions, N numbers of the bank.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav import rng

_STEPS = 4  # as many of which the bank would serve without reading a number twice


@dataclass(frozen=True)
class NoiseBank:
    """Normal numbers, and where each step reads them.

    Args:
        values: scaled for each action, shape [A, N].
        place: where the runs of step 0 begin, int64, shape [T, A].
        stride: how far they move on from step to step, int64, shape [T, A].
        samples: K, the length of a run.
    """

    values: Tensor
    place: Tensor
    stride: Tensor
    samples: int

    def at(self, step: int) -> Tensor:
        """The noise of a step, shape [T, A, K]."""
        actions, numbers = self.values.shape
        runs = numbers - self.samples + 1
        begin = (self.place + step * self.stride) % runs
        begin = begin + numbers * torch.arange(actions, device=begin.device)
        every = self.values.as_strided((actions * numbers - self.samples + 1, self.samples), (1, 1))
        return every.index_select(0, begin.flatten()).view(*begin.shape, self.samples)


def draw_bank(seed: int, horizon: int, samples: int, scale: Tensor) -> NoiseBank:
    """Draws a bank on the CPU, the same for every device.

    Args:
        seed: root of the noise.
        horizon: T.
        samples: K.
        scale: standard deviation of each action's noise, shape [A].
    """
    # PyTorch's generator looks at 32 bits of a seed alone: the key is a hash of all of them.
    generator = rng.generator(rng.stream_key(seed, "noise"))
    actions, numbers = len(scale), _STEPS * horizon * samples
    values = torch.randn((actions, numbers), generator=generator, dtype=scale.dtype).to(scale.device)
    runs, shape = numbers - samples + 1, (horizon, actions)
    place, stride = (torch.randint(runs, shape, generator=generator).to(scale.device) for _ in range(2))
    return NoiseBank(values=values * scale[:, None], place=place, stride=stride, samples=samples)
