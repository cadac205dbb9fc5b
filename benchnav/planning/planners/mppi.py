"""Model predictive path integral control (MPPI).

MPPI samples K action sequences around a mean action sequence. It rolls out each of them
through the motion model F under λ̂, and averages them with weights that decrease
exponentially with their costs. It plans no global path.

Letters in shapes: B episodes, M fields, K samples, T horizon steps, N cells of a padded
map, S state and A action dimensions. In formulas u is the mean action sequence, ε the
noise, Σ its covariance and w the weight of a sample.

As in Williams et al. (2018), rollouts use clipped actions, F(x, clip(u + ε)), and the
mean moves by the unclipped noise: u ← clip(u + Σ_k w_k ε_k). If clipped actions were
averaged, the mean would drift to the middle of the bounds wherever costs are flat,
since clipping moves actions beyond a bound back onto it. The mean is also clipped.
Otherwise it could move so far beyond the bounds that all samples would be clipped.

`risk_on` selects the quantity whose risk is taken. With `map`, it is λ of each cell,
and rollouts use the risk map. With `cost`, it is the cost: each sequence is rolled out
on M fields of λ, and its cost is the CVaR over the fields (module `cost_risk`).

Beyond the horizon, the objective J assumes a straight line over good terrain.
`cost_to_go` replaces it by the cost of the map's cheapest path.

For a robot with a steering angle, MPPI also tries turns (module `turns`) if the mean
action sequence costs no less than standing still.

Differences from the sources: by default, noise is relative to the range of the actions
and the temperature to the spread of the costs. Hence one setting suits robots and
objectives of any unit. The control cost is off by default. The mean is not smoothed.
All episodes of a batch share one bank of noise (`NoiseBank`), a pure function of seed
and step. Hence the noise of an episode does not depend on the batch.

Sources: Williams et al. (2017), "Information theoretic MPC for model-based
reinforcement learning", algorithm 2; for the control cost (γ, α) and the action bounds,
Williams et al. (2018), "Information-theoretic model predictive control", algorithms 1
and 2; and section IV-A3 of the paper that this benchmark implements.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.batch import Batch
from benchnav.core.errors import expect
from benchnav.planning import risk
from benchnav.planning.objective import has_path_cost
from benchnav.planning.planners.astar import astar
from benchnav.planning.planners.compilation import Fused
from benchnav.planning.planners.cost_risk import (
    advance_entrapped,
    pad_fields,
    within_reach,
)
from benchnav.planning.planners.mppi_config import MPPIConfig
from benchnav.planning.planners.mppi_rollouts import (
    BATCHED_ARGUMENTS,
    ENTRAPPED_BATCHED_ARGUMENTS,
    Dwell,
    TerminalInputs,
    advance_chunk,
    control_cost,
    plotted_paths,
    roll_out,
    total_cost,
    weigh,
)
from benchnav.planning.planners.noise_bank import NoiseBank, Sampled, draw_bank
from benchnav.planning.planners.planner import LocalPlanner, Plan
from benchnav.planning.planners.turns import choose, is_steered
from benchnav.planning.problem import Problem, Task
from benchnav.planning.robots import steps_in
from benchnav.planning.sensing.sensor import Step


@dataclass(frozen=True)
class MPPIState(Batch):
    """Plan state of MPPI.

    Args:
        problem: problems of B episodes.
        mean: mean action sequences, shape [B, T, A].
        dwell_steps: consecutive steps on immobilising terrain, shape [B].
        on_dubins_path: mask of robots that follow a Dubins path, bool, shape [B]; see
            `turns.choose`.
        constant_fields: fields of λ for all steps, padded by `pad_fields`, shape
            [B, M, N]; None if fields are drawn at each step, or not used.
        cost_to_go: costs of the cheapest paths, padded by `astar.pad_costs`, shape
            [B, 2, N]; None if J provides the terminal cost.
        noise: bank of noise that all episodes share.
        key: stream key from which fields of λ are drawn.
        step: number of planned steps.
    """

    problem: Problem
    mean: Tensor
    dwell_steps: Tensor
    on_dubins_path: Tensor
    constant_fields: Tensor | None
    cost_to_go: Tensor | None
    noise: NoiseBank
    key: int
    step: int


class MPPI(LocalPlanner[MPPIState]):
    """MPPI as a local planner, for robots with any actions.

    Args:
        config: settings; None for the defaults.
    """

    name = "MPPI"
    worth_compiling: ClassVar[int] = 2000
    """Minimum number of rollouts per episode and step for compilation."""

    def __init__(self, config: MPPIConfig | None = None) -> None:
        """Store the settings."""
        self.config = config or MPPIConfig()
        rollouts = self.config.samples * self._fields
        minimum = self.worth_compiling
        self._advance = Fused(advance_chunk, rollouts, minimum, BATCHED_ARGUMENTS)
        self._advance_entrapped = Fused(
            advance_entrapped, rollouts, minimum, ENTRAPPED_BATCHED_ARGUMENTS
        )
        # Items 12 and 13 of the arguments of `weigh` are `is_mobile` and `cost_to_go`.
        batched_in_weigh = (*BATCHED_ARGUMENTS, 12, 13)
        self._weigh = Fused(weigh, rollouts, minimum, batched_in_weigh)

    @property
    def seeks_goal(self) -> bool:
        """Whether the terminal cost is a cost to go.

        Then the costs of steps must also be counted until the goal. If they were
        counted only until a waypoint, waiting at the waypoint would cost nothing.
        """
        return self.config.cost_to_go != "objective"

    @property
    def _fields(self) -> int:
        """Number of fields M on which each sequence is rolled out."""
        return self.config.fields if self.config.risk_on == "cost" else 1

    @property
    def compiled(self) -> bool | None:
        """Whether rollouts run compiled; None before the first step."""
        rollout = self._advance_entrapped.compiled
        if rollout is None:
            rollout = self._advance.compiled
        weighing = self._weigh.compiled
        if rollout is None or weighing is None:
            return None
        return rollout and weighing

    def uses(self, task: Task) -> frozenset[str]:
        """Return the inputs that rollouts, free space and cost to go need."""
        config = self.config
        inputs = {"fields" if config.risk_on == "cost" else "risk_map"}
        inputs.add(task.rules.free_space.source)
        if config.cost_to_go == "map":
            inputs.add("risk_map")
        if config.cost_to_go == "expected-time":
            inputs.add("distribution")
        return frozenset(inputs)

    def follows(self, task: Task) -> str:
        """Return the cost that the planner minimises instead of J; see `Planner`."""
        config = self.config
        terms = []
        if config.risk_on == "cost":
            tail = f"CVaR {config.level:g} of J" if config.level else "mean of J"
            terms.append(f"{tail} over {config.fields} fields of λ")
        if config.entrapment:
            terms.append("plus the remaining time of immobilised rollouts")
        if config.cost_to_go != "objective":
            map_name = "λ̂" if config.cost_to_go == "map" else "λ̂ of expected-time"
            terms.append(f"plus A*'s cost to go from the last state under {map_name}")
        if config.risk_on != "cost" and terms:
            terms = ["J", *terms]
        return ", ".join(terms)

    def init(self, problem: Problem, generator: torch.Generator) -> MPPIState:
        """Return the plan state of standing robots; see `Planner`.

        Raises:
            ConfigError: If `noise` does not have one value for each action of the
                robot, or if `cost_to_go` needs an objective with a path cost.
        """
        names = problem.robot.action_names
        config = self.config
        expect(
            config.noise is None or len(names) == len(config.noise),
            f"option `noise` of MPPI with {len(names)} values (one for each of "
            f"{', '.join(names)}), got {config.noise}.",
        )
        seed = int(torch.randint(2**62, (), generator=generator))
        low, high = problem.action_bounds
        horizon = steps_in(config.horizon_s, problem.dt_s)
        mean = problem.start.new_zeros(len(problem), horizon, len(names))
        scale = config.noise_share * (high - low)
        if config.noise is not None:
            scale = low.new_tensor(config.noise)
        bank = draw_bank(seed, horizon, config.samples, scale)
        key = rng.stream_key(seed, "fields")
        no_dwell = problem.start.new_zeros(len(problem))
        return MPPIState(
            problem=problem,
            mean=mean,
            dwell_steps=no_dwell,
            on_dubins_path=no_dwell.bool(),
            constant_fields=self._constant_fields(problem, key),
            cost_to_go=self._cost_to_go(problem),
            noise=bank,
            key=key,
            step=0,
        )

    def revise(self, plan_state: MPPIState, problem: Problem) -> MPPIState:
        """Return the plan state with the same mean; see `Planner`."""
        constant_fields = self._constant_fields(problem, plan_state.key)
        cost_to_go = self._cost_to_go(problem)
        return replace(
            plan_state,
            problem=problem,
            constant_fields=constant_fields,
            cost_to_go=cost_to_go,
        )

    def _cost_to_go(self, problem: Problem) -> Tensor | None:
        """Return padded costs of cheapest paths; None if J gives the terminal cost."""
        option = self.config.cost_to_go
        if option == "objective":
            return None
        name = type(problem.objective).__name__
        expect(
            has_path_cost(problem.objective),
            "an objective with `path_cost` for option `cost_to_go` of MPPI, got "
            f"{name}. Set `cost_to_go` to 'objective', or use another objective.",
        )
        if option == "expected-time":
            expected_time = risk.ExpectedTime()
            risk_map = expected_time(problem.distribution).to(problem.risk_map)
            risk_map = problem.task.inflate(risk_map, problem.grid)
            problem = replace(problem, risk_map=risk_map)
        return astar.pad_costs(problem, astar.search(problem))

    def _constant_fields(self, problem: Problem, key: int) -> Tensor | None:
        """Return padded fields, [B, M, N]; None if each step draws its own fields."""
        if self.config.risk_on == "map" or not self.config.once:
            return None
        fields = problem.sample_fields(self._fields, key)
        padded_ground = pad_fields(problem, fields)
        return padded_ground.unflatten(0, (len(problem), -1))

    def plan_toward(
        self, step: Step, plan_state: MPPIState, target_m: Tensor
    ) -> tuple[Tensor, MPPIState, Plan]:
        """Return the first action of the updated mean sequence; see `LocalPlanner`."""
        problem = plan_state.problem
        config = self.config
        noise = plan_state.noise.at(plan_state.step)
        padded_ground = self._padded_ground(plan_state, step.state)
        dwell = self._dwell(plan_state, step)
        mean, on_dubins_path = self._mean_or_turns(
            step, plan_state, target_m, padded_ground, dwell
        )
        advance = self._advance if dwell is None else self._advance_entrapped
        states, cost, is_mobile = roll_out(
            problem, step.state, mean, noise, target_m, advance, padded_ground, dwell
        )
        if config.control_cost:
            episode_costs = control_cost(mean, noise, plan_state.noise.scale)
            rollout_costs = episode_costs.repeat_interleave(self._fields, 0)
            cost = cost + config.control_cost * rollout_costs
        sampled = Sampled(mean, noise, *problem.action_bounds)
        terminal_inputs = self._terminal_inputs(
            plan_state, target_m, padded_ground, is_mobile
        )
        weights, updated = self._weigh(
            states,
            cost,
            sampled,
            terminal_inputs,
            config.temperature,
            config.temperature_share,
        )
        if is_steered(problem.robot):
            updated = torch.where(on_dubins_path[:, None, None], mean, updated)
        shifted = torch.cat((updated[:, 1:], updated[:, -1:]), dim=1)
        layers = {}
        if step.draw:
            layers = plotted_paths(problem, step.state, updated, mean, noise, weights)
        plan = Plan.empty(len(problem), step.state.device, **layers)
        next_step = plan_state.step + 1
        next_plan_state = replace(
            plan_state, mean=shifted, on_dubins_path=on_dubins_path, step=next_step
        )
        if dwell is not None:
            next_plan_state = replace(next_plan_state, dwell_steps=dwell.dwell_steps)
        return updated[:, 0], next_plan_state, plan

    def _terminal_inputs(
        self,
        plan_state: MPPIState,
        target_m: Tensor,
        padded_ground: Tensor,
        is_mobile: Tensor | None,
    ) -> TerminalInputs:
        """Return the inputs of the terminal costs of this step's rollouts."""
        problem = plan_state.problem
        target = target_m[:, None].repeat_interleave(self._fields, 0).contiguous()
        return TerminalInputs(
            padded_ground,
            target,
            problem.grid,
            problem.objective,
            fields=self._fields,
            level=self.config.level,
            is_mobile=is_mobile,
            cost_to_go=plan_state.cost_to_go,
        )

    def _mean_or_turns(
        self,
        step: Step,
        plan_state: MPPIState,
        target_m: Tensor,
        padded_ground: Tensor,
        dwell: Dwell | None,
    ) -> tuple[Tensor, Tensor]:
        """Return the mean action sequences, or turns where these cost less.

        Returns:
            Action sequences, shape [B, T, A], and a mask of robots that follow a Dubins
            path, bool, shape [B]; see `turns.choose`.
        """
        problem = plan_state.problem
        state = step.state
        mean = plan_state.mean
        on_dubins_path = plan_state.on_dubins_path
        if not is_steered(problem.robot):
            return mean, on_dubins_path

        def cost_of(base: Tensor, offset: Tensor) -> Tensor:
            advance = advance_chunk if dwell is None else advance_entrapped
            states, cost, is_mobile = roll_out(
                problem, state, base, offset, target_m, advance, padded_ground, dwell
            )
            terminal_inputs = self._terminal_inputs(
                plan_state, target_m, padded_ground, is_mobile
            )
            cost, _ = total_cost(states, cost, terminal_inputs)
            return cost

        return choose(
            cost_of, mean, problem, state, target_m, padded_ground, on_dubins_path
        )

    def _padded_ground(self, plan_state: MPPIState, state: Tensor) -> Tensor:
        """Return padded maps of λ for rollouts from these states, shape [B·M, N]."""
        problem = plan_state.problem
        if self.config.risk_on == "map":
            return problem.padded_ground
        if plan_state.constant_fields is not None:
            return plan_state.constant_fields.flatten(0, 1)
        key = rng.stream_key(plan_state.key, plan_state.step)
        horizon_s = plan_state.mean.shape[1] * problem.dt_s
        cells = within_reach(problem, state, horizon_s)
        fields = problem.sample_fields(self._fields, key, cells)
        return pad_fields(problem, fields)

    def _dwell(self, plan_state: MPPIState, step: Step) -> Dwell | None:
        """Return dwell times on immobilising terrain; None if rollouts ignore them."""
        immobile = plan_state.problem.immobile
        if not self.config.entrapment or immobile is None:
            return None
        immobilises = step.traversability < immobile.below
        dwell_steps = torch.where(immobilises, plan_state.dwell_steps + 1, 0)
        return Dwell(dwell_steps, step.time_s)
