"""Smooth MPPI and iCEM, for a comparison with MPPI at equal planning time.

Smooth MPPI: Kim, Park, Choi and Ha (2022), "Smooth model predictive path integral
control without smoothing". iCEM: Pinneri et al. (2020), "Sample-efficient cross-entropy
method for real-time planning", algorithm 1. Letters in shapes are those of
`benchnav/planning/planners/mppi.py`, and E elites.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.planning import MPPI, MPPIConfig, Plan, Problem
from benchnav.planning.planners.compilation import Fused
from benchnav.planning.planners.mppi import MPPIState
from benchnav.planning.planners.mppi_rollouts import (
    TerminalInputs,
    advance_chunk,
    roll_out,
    total_cost,
)
from benchnav.planning.planners.noise_bank import NoiseBank, Sampled, perturb
from benchnav.planning.robots import component_wise


@dataclass(frozen=True, kw_only=True)
class SmoothConfig(MPPIConfig):
    """Settings of Smooth MPPI.

    Args:
        noise_share: standard deviation of an action's change in one step, as a fraction
            of the action's range.
        smoothness: weight of the squared changes of actions from step to step, each as
            a fraction of the action's range.
    """

    noise_share: float = 0.1
    smoothness: float = 1.0


@dataclass(frozen=True)
class _Summed(NoiseBank):
    def at(self, step: int) -> Tensor:
        return super().at(step).cumsum(0)


class SmoothMPPI(MPPI):
    """MPPI that samples changes of actions and penalises large ones."""

    def __init__(self, config: SmoothConfig | None = None) -> None:
        super().__init__(config or SmoothConfig())

    def init(self, problem: Problem, generator: torch.Generator) -> MPPIState:
        state = super().init(problem, generator)
        return replace(state, noise=_Summed(**vars(state.noise)))

    def plan_toward(
        self, step: Any, plan_state: MPPIState, target_m: Tensor
    ) -> tuple[Tensor, MPPIState, Plan]:
        problem, mean, config = plan_state.problem, plan_state.mean, self.config
        noise, (low, high) = plan_state.noise.at(plan_state.step), problem.action_bounds
        states, cost, _ = roll_out(
            problem, step.state, mean, noise, target_m, self._advance
        )
        changes = (
            perturb(mean[..., None], noise, low, high).diff(dim=1)
            / (high - low)[:, None]
        )
        cost = cost + config.smoothness * changes.square().sum((1, 2))
        ends = self._terminal_inputs(plan_state, target_m, problem.padded_ground, None)
        _, updated = self._weigh(
            states,
            cost,
            Sampled(mean, noise, low, high),
            ends,
            config.temperature,
            config.temperature_share,
        )
        shifted = torch.cat((updated[:, 1:], updated[:, -1:]), dim=1)
        after = replace(plan_state, mean=shifted, step=plan_state.step + 1)
        return updated[:, 0], after, Plan.empty(len(problem), step.state.device)


@dataclass(frozen=True, kw_only=True)
class ICEMConfig(MPPIConfig):
    """Settings of iCEM; `samples` is the number of the first iteration.

    Args:
        iterations: number of iterations per step.
        elites: number of best sequences, to which the distribution is fitted.
        kept: fraction of the elites that the next iteration and the next step reuse.
        decay: factor by which the number of samples falls from iteration to iteration.
        momentum: weight of the previous distribution.
        colour: exponent β of the noise's spectrum, 1 / f^β.
    """

    iterations: int = 3
    elites: int = 10
    kept: float = 0.3
    decay: float = 1.25
    momentum: float = 0.1
    colour: float = 2.0


@dataclass(frozen=True)
class Coloured:
    """Noise of variance 1, shared by all episodes, shape [T, A, 4K].

    Each iteration reads a part of it.
    """

    values: Tensor

    def take(self, key: int, count: int) -> Tensor:
        """Return `count` sequences from an index set by `key`, shape [T, A, count]."""
        first = key % (self.values.shape[2] - count + 1)
        return self.values[..., first : first + count]


@dataclass(frozen=True)
class ICEMState(MPPIState):
    """Plan state of iCEM, which extends that of MPPI.

    Args:
        elites: sequences to reuse, shape [B, T, A, E].
        coloured: the noise that iterations read.
    """

    elites: Tensor
    coloured: Coloured


class ICEM(MPPI):
    """Improved cross-entropy method: coloured noise, and reuse of the best sequences."""

    def __init__(self, config: ICEMConfig | None = None) -> None:
        super().__init__(config or ICEMConfig())
        self._roll = Fused(
            _advance, self.config.samples, self.worth_compiling, batched=(0, 1, 2, 5, 6)
        )

    @property
    def _kept(self) -> int:
        return max(1, round(self.config.kept * self.config.elites))

    def init(self, problem: Problem, generator: torch.Generator) -> ICEMState:
        base, config = super().init(problem, generator), self.config
        horizon, actions = base.mean.shape[1:]
        noise_generator = rng.generator(rng.stream_key(base.key, "coloured"))
        coloured = coloured_noise(
            horizon, (actions, 4 * config.samples), config.colour, noise_generator
        ).to(base.mean)
        elites = base.mean[..., None].expand(-1, -1, -1, self._kept)
        return ICEMState(**vars(base), elites=elites, coloured=Coloured(coloured))

    def plan_toward(
        self, step: Any, plan_state: Any, target_m: Tensor
    ) -> tuple[Tensor, Any, Plan]:
        problem, config, mean = plan_state.problem, self.config, plan_state.mean
        low, high = problem.action_bounds
        std = (config.noise_share * (high - low)).expand_as(mean)
        retried = plan_state.elites
        for iteration in range(config.iterations):
            count = max(
                2 * config.elites, int(config.samples / config.decay**iteration)
            )
            key = rng.stream_key(plan_state.key, plan_state.step, iteration)
            noise = plan_state.coloured.take(key, count)
            samples = torch.clamp(
                mean[..., None] + std[..., None] * noise, low[:, None], high[:, None]
            )
            last = [mean[..., None]] if iteration == config.iterations - 1 else []
            samples = torch.cat((samples, retried, *last), dim=3)
            cost = self._cost(
                problem, step.state, samples, target_m, plan_state.cost_to_go
            )
            best = cost.topk(config.elites, dim=1, largest=False).indices
            elites = samples.gather(
                3, best[:, None, None].expand(-1, *samples.shape[1:3], -1)
            )
            mean = config.momentum * mean + (1 - config.momentum) * elites.mean(3)
            std = config.momentum * std + (1 - config.momentum) * elites.std(3)
            retried = elites[..., : self._kept]
        shifted, next_elites = (
            torch.cat((values[:, 1:], values[:, -1:]), dim=1)
            for values in (mean, retried)
        )
        after = replace(
            plan_state, mean=shifted, elites=next_elites, step=plan_state.step + 1
        )
        return elites[:, 0, :, 0], after, Plan.empty(len(problem), step.state.device)

    def _cost(
        self,
        problem: Problem,
        state: Tensor,
        samples: Tensor,
        target_m: Tensor,
        to_go: Tensor | None,
    ) -> Tensor:
        """Return the costs of sampled sequences, shape [B, K]."""
        ground, target = problem.padded_ground, target_m[:, None].contiguous()
        states = component_wise(state[:, None].expand(-1, samples.shape[3], -1))
        cost = state.new_zeros(states.shape[:2])
        for chunk in samples.split(10, dim=1):
            states, cost = self._roll(
                states,
                cost,
                chunk.contiguous(),
                *problem.action_bounds,
                ground,
                target,
                problem.dynamics,
            )
        return total_cost(
            states,
            cost,
            TerminalInputs(
                ground, target, problem.grid, problem.objective, cost_to_go=to_go
            ),
        )[0]


def _advance(
    states: Tensor, cost: Tensor, actions: Tensor, low: Tensor, high: Tensor, *rest: Any
) -> tuple[Tensor, Tensor]:
    """Roll out actions [B, T, A, K] that differ by episode.

    They are passed to MPPI's rollouts as deviations from a mean of 0.
    """
    sampled = Sampled(
        torch.zeros_like(actions[..., 0]), actions.movedim(1, 0), low, high
    )
    return advance_chunk(states, cost, sampled, *rest)


def coloured_noise(
    steps: int, shape: tuple[int, ...], colour: float, generator: torch.Generator
) -> Tensor:
    """Return normal noise whose spectrum over time is 1 / f^colour, [steps, *shape].

    Its mean is 0 and its variance 1.

    Source: Timmer and König (1995), "On generating power law noise".
    """
    frequencies = torch.fft.rfftfreq(steps)
    # Frequency 0 has no finite scale: it takes that of the lowest frequency above 0.
    frequencies[0] = frequencies[1]
    scale = frequencies ** (-colour / 2)
    real, imaginary = torch.randn((2, len(scale), *shape), generator=generator)
    imaginary[0] = 0
    spectrum = torch.complex(real, imaginary) * scale.view(-1, *(1 for _ in shape))
    noise = torch.fft.irfft(spectrum, n=steps, dim=0)
    return noise / noise.std(dim=(0, -1), keepdim=True)
