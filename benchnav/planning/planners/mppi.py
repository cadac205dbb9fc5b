"""Model predictive path integral control (MPPI).

MPPI samples K action sequences about the current mean, rolls out each through F under
λ̂, and averages them with weights that decrease exponentially with their costs. There is
no global path. Sources: Williams et al. (2017), "Information theoretic MPC for
model-based reinforcement learning", algorithm 2; for γ, α and bounds Williams et al.
(2018), "Information-theoretic model predictive control", algorithms 1 and 2; paper
IV-A3. Letters in shapes: B episodes, K samples, T horizon steps, S state, A action
dimensions; in formulas u is the mean, ε the noise, Σ its covariance.

As in Williams et al. (2018), rollouts use clipped actions F(x, clip(u + ε)), while the
unclipped noise moves the mean: u ← clip(u + Σwε). If clipped samples were averaged, the
mean would drift to the middle of the bounds wherever costs are flat, since clipping
moves samples beyond a bound back onto it. The mean is clipped too. Otherwise it could
move so far beyond the bounds that no sample would return.

`risk_on` selects the risk. With `map` it is the risk of λ in each cell, from the risk
map. With `cost` it is the risk of the cost: each sequence is rolled out on M fields of
λ, and its cost is the CVaR over them; see `benchnav.planning.planners.cost_risk`.
Beyond the horizon J assumes a straight line over good terrain; `cost_to_go` uses the
map's cheapest paths instead.

A robot that is steered by an angle also considers turns (`turns`) if its mean is no
better than standing.

Differences from the sources: noise and temperature are relative by default, so that one
setting suits robots and objectives of any unit. The control cost is off by default. The
mean is not smoothed. Noise comes from one bank (`NoiseBank`), a pure function of seed
and step, which the episodes of a batch share. Hence the noise of an episode does not
depend on the batch.
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
    framed_fields,
    within_reach,
)
from benchnav.planning.planners.mppi_config import MPPIConfig
from benchnav.planning.planners.mppi_rollouts import (
    ENTRAPPED_OF_EPISODES,
    OF_EPISODES,
    Dwell,
    Ends,
    advance_chunk,
    control_cost,
    drawn_paths,
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
        problem: the problem.
        mean: mean action sequence, shape [B, T, A].
        dwell_steps: consecutive steps on immobilising terrain, shape [B].
        follows: mask of robots that follow a Dubins path, bool, shape [B]; see
            `turns.choose`.
        ground: fields of λ that are drawn once, as in `framed_fields`, shape
            [B, M, N]; None if they are drawn at each step, or not used.
        to_go: costs of the cheapest paths, as in `astar.framed`, shape [B, 2, N]; None
            if the terminal cost is that of J.
        noise: noise of all steps, shared by the episodes.
        key: key of the fields' streams.
        step: number of steps planned so far.
    """

    problem: Problem
    mean: Tensor
    dwell_steps: Tensor
    follows: Tensor
    ground: Tensor | None
    to_go: Tensor | None
    noise: NoiseBank
    key: int
    step: int


class MPPI(LocalPlanner[MPPIState]):
    """MPPI as a local planner, for robots with any actions.

    Args:
        config: settings.
    """

    name = "MPPI"
    worth_compiling: ClassVar[int] = 2000
    """Minimum number of rollouts per episode and step for compilation."""

    def __init__(self, config: MPPIConfig | None = None) -> None:
        """Store the settings."""
        self.config = config or MPPIConfig()
        rollouts = self.config.samples * self._fields
        minimum = self.worth_compiling
        self._advance = Fused(advance_chunk, rollouts, minimum, OF_EPISODES)
        self._advance_entrapped = Fused(
            advance_entrapped, rollouts, minimum, ENTRAPPED_OF_EPISODES
        )
        of_weigh = (*OF_EPISODES, 12, 13)  # 12 and 13 are `going` and `to_go`
        self._weigh = Fused(weigh, rollouts, minimum, of_weigh)

    @property
    def seeks_goal(self) -> bool:
        """Whether the terminal cost is a cost to go.

        Then the costs of steps must also be costs to the goal: if they ended at a
        waypoint, standing at the waypoint would cost nothing.
        """
        return self.config.cost_to_go != "objective"

    @property
    def _fields(self) -> int:
        """Number of fields M of each rollout."""
        return self.config.fields if self.config.risk_on == "cost" else 1

    @property
    def compiled(self) -> bool | None:
        """Whether it runs compiled; None before the first step."""
        rollout = self._advance_entrapped.compiled
        if rollout is None:
            rollout = self._advance.compiled
        weighing = self._weigh.compiled
        if rollout is None or weighing is None:
            return None
        return rollout and weighing

    def uses(self, task: Task) -> frozenset[str]:
        """Return the inputs of rollouts, free space and cost to go; see `Planner`."""
        config = self.config
        inputs = {"fields" if config.risk_on == "cost" else "risk_map"}
        inputs.add(task.rules.free_space.source)
        if config.cost_to_go == "map":
            inputs.add("risk_map")
        if config.cost_to_go == "expected-time":
            inputs.add("distribution")
        return frozenset(inputs)

    def follows(self, task: Task) -> str:
        """Return what it minimises instead of J; see `Planner`."""
        config = self.config
        parts = []
        if config.risk_on == "cost":
            tail = f"CVaR {config.level:g} of J" if config.level else "mean of J"
            parts.append(f"{tail} over {config.fields} fields of λ")
        if config.entrapment:
            parts.append("immobilised rollouts pay the rest of the time")
        if config.cost_to_go != "objective":
            to_go_map = "λ̂" if config.cost_to_go == "map" else "expected-time"
            parts.append(f"the last state pays A*'s cost to go under {to_go_map}")
        if config.risk_on != "cost" and parts:
            parts = ["J", *parts]
        return ", ".join(parts)

    def init(self, problem: Problem, generator: torch.Generator) -> MPPIState:
        """Return the plan state of standing robots; see `Planner`.

        Raises:
            ConfigError: If the number of values of `noise` is not that of the robot's
                actions, or `cost_to_go` needs an objective with a path cost.
        """
        names = problem.robot.action_names
        config = self.config
        expect(
            config.noise is None or len(names) == len(config.noise),
            f"option `noise` of MPPI with {len(names)} values, for "
            f"{', '.join(names)}, got {config.noise}.",
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
            follows=no_dwell.bool(),
            ground=self._drawn_once(problem, key),
            to_go=self._to_go(problem),
            noise=bank,
            key=key,
            step=0,
        )

    def revise(self, plan_state: MPPIState, problem: Problem) -> MPPIState:
        """Return the plan state with the same mean; see `Planner`."""
        ground = self._drawn_once(problem, plan_state.key)
        to_go = self._to_go(problem)
        return replace(plan_state, problem=problem, ground=ground, to_go=to_go)

    def _to_go(self, problem: Problem) -> Tensor | None:
        """Return padded costs of cheapest paths; None if the terminal cost is of J."""
        option = self.config.cost_to_go
        if option == "objective":
            return None
        name = type(problem.objective).__name__
        expect(
            has_path_cost(problem.objective),
            "an objective with `path_cost` for option `cost_to_go` of MPPI, got "
            f"{name}.",
        )
        if option == "expected-time":
            expected_time = risk.ExpectedTime()
            risk_map = expected_time(problem.distribution).to(problem.risk_map)
            problem = replace(problem, risk_map=risk_map)
        field = astar.search(problem)
        return astar.framed(problem, field)

    def _drawn_once(self, problem: Problem, key: int) -> Tensor | None:
        """Return padded fields for all steps, [B, M, N]; None without option `once`."""
        if self.config.risk_on == "map" or not self.config.once:
            return None
        fields = problem.sample_fields(self._fields, key)
        ground = framed_fields(problem, fields)
        return ground.unflatten(0, (len(problem), -1))

    def plan_toward(
        self, step: Step, plan_state: MPPIState, target_m: Tensor
    ) -> tuple[Tensor, MPPIState, Plan]:
        """Return the first action of the updated mean; see `LocalPlanner`."""
        problem = plan_state.problem
        config = self.config
        noise = plan_state.noise.at(plan_state.step)
        ground = self._ground(plan_state, step.state)
        dwell = self._dwell(plan_state, step)
        mean, follows = self._turned(step, plan_state, target_m, ground, dwell)
        advance = self._advance if dwell is None else self._advance_entrapped
        states, cost, going = roll_out(
            problem, step.state, mean, noise, target_m, advance, ground, dwell
        )
        if config.control_cost:
            per_episode = control_cost(mean, noise, plan_state.noise.scale)
            control = per_episode.repeat_interleave(self._fields, 0)
            cost = cost + config.control_cost * control
        sampled = Sampled(mean, noise, *problem.action_bounds)
        ends = self._ends(plan_state, target_m, ground, going)
        weights, updated = self._weigh(
            states,
            cost,
            sampled,
            ends,
            config.temperature,
            config.temperature_share,
        )
        if is_steered(problem.robot):
            updated = torch.where(follows[:, None, None], mean, updated)
        shifted = torch.cat((updated[:, 1:], updated[:, -1:]), dim=1)
        layers = {}
        if step.draw:
            layers = drawn_paths(problem, step.state, updated, mean, noise, weights)
        plan = Plan.empty(len(problem), step.state.device, **layers)
        next_step = plan_state.step + 1
        after = replace(plan_state, mean=shifted, follows=follows, step=next_step)
        if dwell is not None:
            after = replace(after, dwell_steps=dwell.dwell_steps)
        return updated[:, 0], after, plan

    def _ends(
        self,
        plan_state: MPPIState,
        target_m: Tensor,
        ground: Tensor,
        going: Tensor | None,
    ) -> Ends:
        """Return the terminal costs of rollouts on this step's maps."""
        problem = plan_state.problem
        target = target_m[:, None].repeat_interleave(self._fields, 0).contiguous()
        return Ends(
            ground,
            target,
            problem.grid,
            problem.objective,
            fields=self._fields,
            level=self.config.level,
            going=going,
            to_go=plan_state.to_go,
        )

    def _turned(
        self,
        step: Step,
        plan_state: MPPIState,
        target_m: Tensor,
        ground: Tensor,
        dwell: Dwell | None,
    ) -> tuple[Tensor, Tensor]:
        """Return mean action sequences or turns, and a mask of Dubins paths.

        See `turns.choose`.
        """
        problem = plan_state.problem
        state = step.state
        mean = plan_state.mean
        follows = plan_state.follows
        if not is_steered(problem.robot):
            return mean, follows

        def cost_of(base: Tensor, offset: Tensor) -> Tensor:
            advance = advance_chunk if dwell is None else advance_entrapped
            states, cost, going = roll_out(
                problem, state, base, offset, target_m, advance, ground, dwell
            )
            ends = self._ends(plan_state, target_m, ground, going)
            cost, _ = total_cost(states, cost, ends)
            return cost

        return choose(cost_of, mean, problem, state, target_m, ground, follows)

    def _ground(self, plan_state: MPPIState, state: Tensor) -> Tensor:
        """Return the padded maps of rollouts from these states, shape [B·M, N]."""
        problem = plan_state.problem
        if self.config.risk_on == "map":
            return problem.padded_ground
        if plan_state.ground is not None:
            return plan_state.ground.flatten(0, 1)
        key = rng.stream_key(plan_state.key, plan_state.step)
        horizon_s = plan_state.mean.shape[1] * problem.dt_s
        cells = within_reach(problem, state, horizon_s)
        fields = problem.sample_fields(self._fields, key, cells)
        return framed_fields(problem, fields)

    def _dwell(self, plan_state: MPPIState, step: Step) -> Dwell | None:
        """Return dwell times on immobilising terrain; None without entrapment."""
        immobile = plan_state.problem.immobile
        if not self.config.entrapment or immobile is None:
            return None
        immobilises = step.traversability < immobile.below
        dwell_steps = torch.where(immobilises, plan_state.dwell_steps + 1, 0)
        return Dwell(dwell_steps, step.time_s)
