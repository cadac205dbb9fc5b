"""Model predictive path integral control (MPPI).

Samples K action sequences about the current mean, rolls each out through F with predicted
traversability, and averages them by their exponentiated cost. No global path. Source: Williams et
al. (2017), "Information theoretic MPC for model-based reinforcement learning", algorithms 1 and 2;
paper IV-A3. Letters in shapes: B episodes, K samples, T horizon steps, S state, A action dimensions.

The samples' noise is shared by the episodes of a batch: it is drawn once a step, as a pure function
of the plan state's seed and step.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchnav.errors import ConfigError
from benchnav.planning.compilation import compiled, worth_compiling
from benchnav.planning.dynamics import Dynamics
from benchnav.planning.objective import Objective
from benchnav.planning.planner import Plan
from benchnav.planning.problem import Problem
from benchnav.terrain import Grid

# A chunk of the horizon compiles in seconds and runs as fast as the whole of it unrolled.
_CHUNK_STEPS = 10


@dataclass(frozen=True, kw_only=True)
class MPPIConfig:
    """Settings of MPPI; the defaults are the paper's.

    Args:
        horizon: steps T.
        samples: action sequences K.
        noise: standard deviation of each sampled action, for (v, ω) in m/s and rad/s.
        temperature: scale of cost below which samples count alike.
        control_cost: weight γ of the information-theoretic control cost γ·uᵀΣ⁻¹ε; 0 takes the
            current mean itself as the base distribution (α = 1 in the source).
        drawn_samples: most of the best samples that `Plan` carries for playback, besides the mean's
            path; 0 leaves both out.
    """

    horizon: int = 50
    samples: int = 5000
    noise: tuple[float, ...] = (0.5, 0.5)
    temperature: float = 0.5
    control_cost: float = 0.0
    drawn_samples: int = 0

    def __post_init__(self) -> None:
        """Refuses settings that sample nothing."""
        for name in ("horizon", "samples", "temperature"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"Expected `{name}` > 0 for MPPI, got {getattr(self, name)}.")
        if not self.noise or not all(0 < scale < math.inf for scale in self.noise):
            raise ConfigError(f"Expected `noise` > 0 for each action of MPPI, got {self.noise}.")
        if self.drawn_samples < 0:
            raise ConfigError(f"Expected `drawn_samples` ≥ 0 for MPPI, got {self.drawn_samples}.")


@dataclass(frozen=True)
class MPPIState:
    """What MPPI carries from step to step.

    Args:
        problem: what is being solved.
        mean: mean action sequence, shape [B, T, A].
        seed: root of the noise.
        step: steps planned so far.
    """

    problem: Problem
    mean: Tensor
    seed: int
    step: int


class MPPI:
    """MPPI as a planner.

    Args:
        config: settings.
    """

    def __init__(self, config: MPPIConfig | None = None) -> None:
        """Keeps the settings; all else is in the plan state."""
        self.config = config or MPPIConfig()

    def init(self, problem: Problem, generator: torch.Generator) -> MPPIState:
        """Starts from a standing robot; see `Planner`.

        Raises:
            ConfigError: the robot has another number of actions than there are noise scales.
        """
        if len(problem.dynamics.action_low) != len(self.config.noise):
            raise ConfigError(
                f"Expected `noise` of MPPI for {len(problem.dynamics.action_low)} actions, got {self.config.noise}."
            )
        seed = int(torch.randint(2**62, (), generator=generator))
        mean = problem.start.new_zeros(len(problem), self.config.horizon, len(problem.dynamics.action_low))
        return MPPIState(problem, mean, seed, 0)

    def plan(self, state: Tensor, plan_state: MPPIState) -> tuple[Tensor, MPPIState, Plan]:
        """Solves one step; see `Planner`."""
        problem, config = plan_state.problem, self.config
        scale = state.new_tensor(config.noise)
        noise = self._noise(plan_state, state) * scale[:, None]
        cost = rollout_cost(problem, state, plan_state.mean, noise)
        if config.control_cost:
            weighted = plan_state.mean / scale**2
            cost = cost + config.control_cost * torch.einsum("bta,tak->bk", weighted, noise)
        weights = torch.softmax(-cost / config.temperature, dim=1)
        large = worth_compiling(cost.numel(), cost.device)
        average = _average_compiled if large else _average
        mean = average(plan_state.mean, noise, weights, *_bounds(problem, state))
        shifted = torch.cat((mean[:, 1:], mean[:, -1:]), dim=1)
        drawn = self._drawn(problem, state, mean, plan_state.mean, noise, weights)
        return mean[:, 0], replace(plan_state, mean=shifted, step=plan_state.step + 1), drawn

    def _noise(self, plan_state: MPPIState, like: Tensor) -> Tensor:
        """Standard normal noise of one step, shape [T, A, K]."""
        generator = torch.Generator(device=like.device).manual_seed(plan_state.seed + plan_state.step)
        shape = (*plan_state.mean.shape[1:], self.config.samples)
        return torch.randn(shape, generator=generator, device=like.device, dtype=like.dtype)

    def _drawn(
        self, problem: Problem, state: Tensor, mean: Tensor, earlier: Tensor, noise: Tensor, weights: Tensor
    ) -> Plan:
        count = min(self.config.drawn_samples, self.config.samples)
        if not count:
            return Plan.empty(len(problem), state.device)
        best = noise[..., weights.topk(count, dim=1).indices].movedim(2, 0)
        samples = _perturb(earlier[..., None], best, *_bounds(problem, state))
        paths = rollout_path(problem, state, torch.cat((mean[..., None], samples), dim=3))
        return Plan.empty(len(problem), state.device, path=paths[:, 0], samples=paths[:, 1:])


def rollout_cost(problem: Problem, state: Tensor, mean: Tensor, noise: Tensor) -> Tensor:
    """Sums J along sampled action sequences.

    Args:
        problem: B problems.
        state: initial states, shape [B, S].
        mean: mean action sequences, shape [B, T, A].
        noise: added to every mean and clipped to the action bounds, shape [T, A, K].

    Returns:
        Cost of each sequence, shape [B, K].
    """
    samples = noise.shape[2]
    # State dimensions outermost in memory, so that each is contiguous in samples.
    states = state.T[:, :, None].expand(-1, -1, samples).contiguous().movedim(0, -1)
    target = problem.goal_m[:, None].contiguous()
    cost = state.new_zeros(states.shape[:2])
    advance = _advance_compiled if worth_compiling(cost.numel(), cost.device) else _advance
    bounds = _bounds(problem, state)
    for first in range(0, mean.shape[1], _CHUNK_STEPS):
        chunk = slice(first, first + _CHUNK_STEPS)
        states, cost = advance(
            states, cost, mean[:, chunk].contiguous(), noise[chunk].contiguous(), *bounds,
            problem.padded_traversability, target, problem.grid, problem.dynamics, problem.objective,
        )  # fmt: skip
    return cost + problem.objective.terminal(states, problem.traversability_at(states), target)


def rollout_path(problem: Problem, state: Tensor, actions: Tensor) -> Tensor:
    """Positions along action sequences, the first included.

    Args:
        problem: B problems.
        state: initial states, shape [B, S].
        actions: shape [B, T, A, K].

    Returns:
        Shape [B, K, T + 1, 2].
    """
    states = state[:, None].expand(-1, actions.shape[-1], -1)
    positions = [states[..., :2]]
    for action in actions.movedim(-1, 2).unbind(1):
        states = problem.dynamics(states, action, problem.traversability_at(states))
        positions.append(states[..., :2])
    return torch.stack(positions, dim=2)


def _advance(
    states: Tensor, cost: Tensor, mean: Tensor, noise: Tensor, low: Tensor, high: Tensor,
    padded: Tensor, target: Tensor, grid: Grid, dynamics: Dynamics, objective: Objective,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Rolls samples out over a chunk of the horizon, adding up their costs."""
    for step in range(mean.shape[1]):
        action = _perturb(mean[:, step, :, None], noise[step], low, high).movedim(1, 2)
        traversability = grid.lookup(padded, states[..., 0], states[..., 1])
        cost = cost + objective.stage(states, action, traversability, target)
        states = dynamics(states, action, traversability)
    return states.movedim(-1, 0).contiguous().movedim(0, -1), cost


def _average(mean: Tensor, noise: Tensor, weights: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Averages the sampled action sequences by their weights [B, K], shape [B, T, A]."""
    return (_perturb(mean[..., None], noise, low, high) * weights[:, None, None]).sum(-1)


def _perturb(mean: Tensor, noise: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Samples actions: mean plus noise within the bounds, control dimension next to last."""
    return torch.clamp(mean + noise, low[:, None], high[:, None])


def _bounds(problem: Problem, like: Tensor) -> tuple[Tensor, Tensor]:
    return like.new_tensor(problem.dynamics.action_low), like.new_tensor(problem.dynamics.action_high)


_advance_compiled = compiled(_advance)
_average_compiled = compiled(_average)
