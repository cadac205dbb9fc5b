"""Model predictive path integral control (MPPI).

Samples K action sequences about the current mean, rolls each out through F under λ̂,
and averages them by their exponentiated cost. No global path. Sources: Williams et al.
(2017), "Information theoretic MPC for model-based reinforcement learning", algorithm 2;
for γ, α and bounds Williams et al. (2018), "Information-theoretic model predictive
control", algorithms 1 and 2; paper IV-A3. Letters in shapes: B episodes, K samples, T
horizon steps, S state, A action dimensions; in formulas u is the mean, ε the noise, Σ
its covariance.

As in Williams et al. (2018), rollouts run on clipped actions F(x, clip(u + ε)), while
the mean is moved by the
noise as drawn: u ← clip(u + Σwε). Were clipped samples averaged, the mean would drift
to the middle of the bounds wherever costs are flat, since samples beyond a bound are
drawn back onto it. The mean is clipped too, so that it cannot wind up beyond the
bounds, where no sample would reach back.

Risk is that of λ in each cell, as the risk map has it, or that of the cost (`risk_on:
cost`): each sequence is rolled out on M fields of λ, and its cost is the CVaR over
them; see `benchnav.planning.planners.cost_risk`. What is beyond the horizon J takes for
a straight line over good ground; `cost_to_go` looks at the map's cheapest paths
instead.

A robot that is steered by an angle also considers turns (`turns`), where its mean is no
better than standing.

What differs: noise and temperature are relative by default, so that one setting serves
robots and objectives of any unit. The control cost is off by default. The mean is not
smoothed. Noise is read anew from one bank, a pure function of seed and step
(`NoiseBank`); the episodes of a batch share it, so an episode has the same noise alone
as in any batch.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.batch import Batch
from benchnav.core.errors import expect
from benchnav.core.grid import Grid
from benchnav.planning import risk
from benchnav.planning.free_space import PENALTY
from benchnav.planning.objective import Objective, has_path_cost
from benchnav.planning.planners.astar import astar
from benchnav.planning.planners.compilation import Fused
from benchnav.planning.planners.cost_risk import (
    Entrapment,
    advance_entrapped,
    framed_fields,
    tail_cost,
    within_reach,
)
from benchnav.planning.planners.noise_bank import (
    NoiseBank,
    Sampled,
    draw_bank,
    perturb,
    sampled_actions,
)
from benchnav.planning.planners.planner import (
    LocalPlanner,
    Plan,
    check_finite,
    rollout_path,
)
from benchnav.planning.planners.turns import choose, is_steered
from benchnav.planning.problem import (
    Dynamics,
    Problem,
    Task,
    motion_traversability,
    stage_cost,
    terminal_cost,
)
from benchnav.planning.robots import component_wise, steps_in
from benchnav.planning.sensing.sensor import Step

# A chunk of the horizon compiles in seconds and runs as fast as the whole of it
# unrolled.
_CHUNK_STEPS = 10
# arguments of what is compiled: states, cost, mean, padded_ground, target
OF_EPISODES = (
    0,
    1,
    2,
    6,
    7,
)
# states, cost, held, mean, padded_ground, target, goal, steps_left of what is compiled
# with entrapment
ENTRAPPED_OF_EPISODES = (0, 1, 2, 3, 7, 8, 9, 10)
_DRAWN_SAMPLES = 40
_LEAST_TAIL = 10  # fields in the tail of which a cost is the mean
_LEAST_SPREAD = 1e-30  # where all samples cost alike, all weigh alike


@dataclass(frozen=True, kw_only=True)
class MPPIConfig:
    """Settings of MPPI; the paper gives none, these are ours.

    Args:
        horizon_s: how far rollouts look ahead, in seconds; T is the nearest number of
            steps, at least 1.
        samples: action sequences K.
        noise_share: standard deviation of each sampled action, as a share of the range
            from its least to its greatest value; refused with `noise`.
        noise: the same in the units of the actions, such as m/s and rad/s, in place of
            `noise_share`.
        temperature_share: the scale of cost below which samples count alike, as a share
            of the spread of costs (`cost_spread`) of the episode and step; refused with
            `temperature`.
        temperature: the same in the units of J, in place of `temperature_share`; λ in
            the source.
        control_cost: weight γ of the information-theoretic control cost γ·uᵀΣ⁻¹ε; 0
            takes the current mean itself as the base distribution (α = 1 in the
            source), the value of `temperature` takes 0 (α = 0).
        risk_on: `map`, rollouts are on λ̂; `cost`, on fields of λ, and λ̂ tells which
            ground is free where the rules ask it.
        level: α of the CVaR of the cost, in [0, 1); at 0 its mean.
        fields: M, on which each sequence is rolled out; at least 10 in the tail, M ≥ 10
            / (1 − α), where α > 0.
        once: draws fields once for a map as it is known, not anew at each step.
        entrapment: rollouts stop for good on ground that immobilises robots in the
            world.
        cost_to_go: what the last state of a rollout pays: `objective`, as J has it;
            `map`, what A*'s cheapest path from there to the goal costs under λ̂;
            `expected-time`, the same under the λ̂ of that risk setting, whatever the
            problem's own.
    """

    added: ClassVar = ("risk_on", "level", "fields", "once", "entrapment", "cost_to_go")

    horizon_s: float = 5.0
    samples: int = 5000
    noise_share: float = 0.5
    noise: tuple[float, ...] | None = None
    temperature_share: float = 0.1
    temperature: float | None = None
    control_cost: float = 0.0
    risk_on: Literal["map", "cost"] = "map"
    level: float = 0.0
    fields: int = 64
    once: bool = False
    entrapment: bool = False
    cost_to_go: str = "objective"

    def __post_init__(self) -> None:
        """Refuses settings that sample nothing."""
        above = (
            "horizon_s",
            "samples",
            "noise_share",
            "temperature_share",
            "temperature",
            "fields",
        )
        check_finite("MPPI", self, above, ("control_cost",))
        fits = self.noise is None or (
            self.noise and all(0 < scale < math.inf for scale in self.noise)
        )
        expect(fits, f"`noise` > 0 for each action of MPPI, got {self.noise}.")
        for name in ("noise", "temperature"):
            fraction, default = (
                getattr(self, f"{name}_share"),
                getattr(type(self), f"{name}_share"),
            )
            expect(
                getattr(self, name) is None or fraction == default,
                f"`{name}` or `{name}_share` for MPPI, got both, "
                f"{getattr(self, name)} and {fraction}. Leave one out.",
            )
        expect(
            self.risk_on in ("map", "cost"),
            f"`risk_on` 'map' or 'cost' for MPPI, got {self.risk_on!r}.",
        )
        expect(0 <= self.level < 1, f"`level` in [0, 1) for MPPI, got {self.level}.")
        alone = self.level == 0 and not self.once and self.fields == MPPIConfig.fields
        expect(
            self.risk_on == "cost" or alone,
            "`risk_on: cost` for `level`, `fields` and `once` of MPPI, got 'map', "
            "whose risk is the risk setting's.",
        )
        known = "objective", "map", "expected-time"
        expect(
            self.cost_to_go in known,
            f"`cost_to_go` among {', '.join(known)} for MPPI, got {self.cost_to_go!r}.",
        )
        least = math.ceil(_LEAST_TAIL / (1 - self.level) - 1e-9)
        expect(
            self.level == 0 or self.fields >= least,
            f"`fields` of at least {_LEAST_TAIL} / (1 − `level`) = {least} for MPPI, "
            f"got {self.fields}.",
        )


@dataclass(frozen=True)
class MPPIState(Batch):
    """What MPPI carries from step to step.

    Args:
        problem: what is being solved.
        mean: mean action sequence, shape [B, T, A].
        held: steps in a row, up to now, on immobilising ground, shape [B].
        follows: a robot that is steered by an angle follows a Dubins path, see
            `turns.choose`, bool, shape [B].
        ground: fields of λ that were drawn once, as of `framed_fields`, shape [B, M,
            N]; None where there are none.
        to_go: of the cheapest paths, as of `astar.framed`, shape [B, 2, N]; None where
            J tells the last cost.
        noise: of all steps, the same for each episode.
        key: of the fields' streams.
        step: steps planned so far.
    """

    problem: Problem
    mean: Tensor
    held: Tensor
    follows: Tensor
    ground: Tensor | None
    to_go: Tensor | None
    noise: NoiseBank
    key: int
    step: int


class MPPI(LocalPlanner[MPPIState]):
    """Model predictive path integral control: sampled action sequences, weighed by
    their cost.

    Args:
        config: settings.
    """

    name = "MPPI"
    worth_compiling: ClassVar[int] = 2000
    """Rollouts of an episode and step from which on they run compiled."""

    def __init__(self, config: MPPIConfig | None = None) -> None:
        """Keeps the settings; all else is in the plan state."""
        self.config = config or MPPIConfig()
        rollouts, least = self.config.samples * self._fields, self.worth_compiling
        self._advance = Fused(advance_chunk, rollouts, least, batched=OF_EPISODES)
        self._advance_entrapped = Fused(
            advance_entrapped, rollouts, least, batched=ENTRAPPED_OF_EPISODES
        )
        # going, to_go
        self._weigh = Fused(weigh, rollouts, least, batched=(*OF_EPISODES, 12, 13))

    @property
    def seeks_goal(self) -> bool:
        """True with a cost to go: the last state pays to the goal, and so must the
        steps before it.

        If the steps ended at a waypoint, to stand on it would cost nothing.
        """
        return self.config.cost_to_go != "objective"

    @property
    def _fields(self) -> int:
        return self.config.fields if self.config.risk_on == "cost" else 1

    @property
    def compiled(self) -> bool | None:
        """Whether it runs compiled; None before the first step."""
        rolled = (
            self._advance.compiled
            if self._advance_entrapped.compiled is None
            else self._advance_entrapped.compiled
        )
        verdicts = (rolled, self._weigh.compiled)
        return None if None in verdicts else all(verdicts)

    def uses(self, task: Task) -> frozenset[str]:
        """The map or the fields that rollouts are on, and that of free space and the
        cost to go; see `Planner`.
        """
        to_go = {"map": {"risk_map"}, "expected-time": {"distribution"}}.get(
            self.config.cost_to_go, set()
        )
        rollouts = "fields" if self.config.risk_on == "cost" else "risk_map"
        return frozenset({rollouts, task.rules.free_space.source, *to_go})

    def follows(self, task: Task) -> str:
        """What it minimises where that is not J alone; see `Planner`."""
        config, found = self.config, []
        if config.risk_on == "cost":
            tail = f"CVaR {config.level:g} of J" if config.level else "mean of J"
            found.append(f"{tail} over {config.fields} fields of λ")
        if config.entrapment:
            found.append("immobilised rollouts pay the rest of the time")
        if config.cost_to_go != "objective":
            known = "λ̂" if config.cost_to_go == "map" else "expected-time"
            found.append(f"the last state pays A*'s cost to go under {known}")
        return ", ".join(
            found if config.risk_on == "cost" or not found else ["J", *found]
        )

    def init(self, problem: Problem, generator: torch.Generator) -> MPPIState:
        """Starts from a standing robot; see `Planner`.

        Raises:
            ConfigError: the robot has another number of actions than there are noise
                scales; there is to be a cost to go, and the objective does not say what
                a path costs.
        """
        names, config = problem.robot.action_names, self.config
        expect(
            config.noise is None or len(names) == len(config.noise),
            f"option `noise` of MPPI with {len(names)} values, for "
            f"{', '.join(names)}, got {config.noise}.",
        )
        seed = int(torch.randint(2**62, (), generator=generator))
        low, high = problem.action_bounds
        horizon = steps_in(config.horizon_s, problem.dt_s)
        mean = problem.start.new_zeros(len(problem), horizon, len(names))
        scale = (
            config.noise_share * (high - low)
            if config.noise is None
            else low.new_tensor(config.noise)
        )
        bank = draw_bank(seed, horizon, config.samples, scale)
        key = rng.stream_key(seed, "fields")
        held, ground = (
            problem.start.new_zeros(len(problem)),
            self._drawn_once(problem, key),
        )
        return MPPIState(
            problem, mean, held, held.bool(), ground, self._to_go(problem), bank, key, 0
        )

    def revise(self, plan_state: MPPIState, problem: Problem) -> MPPIState:
        """Keeps the mean; see `Planner`."""
        ground = self._drawn_once(problem, plan_state.key)
        return replace(
            plan_state, problem=problem, ground=ground, to_go=self._to_go(problem)
        )

    def _to_go(self, problem: Problem) -> Tensor | None:
        wanted = self.config.cost_to_go
        if wanted == "objective":
            return None
        name = type(problem.objective).__name__
        expect(
            has_path_cost(problem.objective),
            "an objective with `path_cost` for option `cost_to_go` of MPPI, got "
            f"{name}.",
        )
        if wanted == "expected-time":
            risk_map = risk.ExpectedTime()(problem.distribution).to(problem.risk_map)
            problem = replace(problem, risk_map=risk_map)
        return astar.framed(problem, astar.search(problem))

    def _drawn_once(self, problem: Problem, key: int) -> Tensor | None:
        if self.config.risk_on == "map" or not self.config.once:
            return None
        ground = framed_fields(problem, problem.sample_fields(self._fields, key))
        return ground.unflatten(0, (len(problem), -1))

    def plan_toward(
        self, step: Step, plan_state: MPPIState, target_m: Tensor
    ) -> tuple[Tensor, MPPIState, Plan]:
        """Solves one step; see `LocalPlanner`."""
        problem, config = plan_state.problem, self.config
        noise, ground = (
            plan_state.noise.at(plan_state.step),
            self._ground(plan_state, step.state),
        )
        dwell = self._dwell(plan_state, step)
        mean, follows = self._turned(step, plan_state, target_m, ground, dwell)
        advance = self._advance if dwell is None else self._advance_entrapped
        states, cost, going = roll_out(
            problem, step.state, mean, noise, target_m, advance, ground, dwell
        )
        if config.control_cost:
            own = control_cost(mean, noise, plan_state.noise.scale)
            cost = cost + config.control_cost * own.repeat_interleave(self._fields, 0)
        weights, updated = self._weigh(
            states,
            cost,
            Sampled(mean, noise, *problem.action_bounds),
            self._ends(plan_state, target_m, ground, going),
            config.temperature,
            config.temperature_share,
        )
        if is_steered(problem.robot):
            updated = torch.where(follows[:, None, None], mean, updated)
        shifted = torch.cat((updated[:, 1:], updated[:, -1:]), dim=1)
        layers = (
            _drawn(problem, step.state, updated, mean, noise, weights)
            if step.draw
            else {}
        )
        plan = Plan.empty(len(problem), step.state.device, **layers)
        after = replace(
            plan_state, mean=shifted, follows=follows, step=plan_state.step + 1
        )
        return (
            updated[:, 0],
            after if dwell is None else replace(after, held=dwell.held),
            plan,
        )

    def _ends(
        self,
        plan_state: MPPIState,
        target_m: Tensor,
        ground: Tensor,
        going: Tensor | None,
    ) -> "Ends":
        problem = plan_state.problem
        target = target_m[:, None].repeat_interleave(self._fields, 0).contiguous()
        return Ends(
            ground,
            target,
            problem.grid,
            problem.objective,
            self._fields,
            self.config.level,
            going,
            plan_state.to_go,
        )

    def _turned(
        self,
        step: Step,
        plan_state: MPPIState,
        target_m: Tensor,
        ground: Tensor,
        dwell: "Dwell | None",
    ) -> tuple[Tensor, Tensor]:
        """Mean action sequences or turns, shape [B, T, A], and which are of Dubins
        paths, [B]; see `turns.choose`.
        """
        problem, mean = plan_state.problem, plan_state.mean
        if not is_steered(problem.robot):
            return mean, plan_state.follows

        def cost_of(base: Tensor, offset: Tensor) -> Tensor:
            advance = advance_chunk if dwell is None else advance_entrapped
            states, cost, going = roll_out(
                problem, step.state, base, offset, target_m, advance, ground, dwell
            )
            return total_cost(
                states, cost, self._ends(plan_state, target_m, ground, going)
            )[0]

        return choose(
            cost_of, mean, problem, step.state, target_m, ground, plan_state.follows
        )

    def _ground(self, plan_state: MPPIState, state: Tensor) -> Tensor:
        """What rollouts from these states are on in this step, shape [B·M, N]."""
        problem = plan_state.problem
        if self.config.risk_on == "map":
            return problem.padded_ground
        if plan_state.ground is not None:
            return plan_state.ground.flatten(0, 1)
        key = rng.stream_key(plan_state.key, plan_state.step)
        cells = within_reach(problem, state, plan_state.mean.shape[1] * problem.dt_s)
        return framed_fields(problem, problem.sample_fields(self._fields, key, cells))

    def _dwell(self, plan_state: MPPIState, step: Step) -> "Dwell | None":
        """How long robots have been on immobilising terrain; None without entrapment."""
        immobile = plan_state.problem.immobile
        if not self.config.entrapment or immobile is None:
            return None
        held = torch.where(step.traversability < immobile.below, plan_state.held + 1, 0)
        return Dwell(held, step.time_s)


def control_cost(mean: Tensor, noise: Tensor, scale: Tensor) -> Tensor:
    """The cost uᵀΣ⁻¹ε of drawing about the mean rather than about 0.

    Args:
        mean: mean action sequences u, shape [B, T, A].
        noise: as drawn, not clipped, ε, shape [T, A, K].
        scale: standard deviations, Σ = diag(scale²), shape [A].

    Returns:
        Shape [B, K].
    """
    return torch.einsum("bta,tak->bk", mean / scale**2, noise)


class Dwell(NamedTuple):
    """How long robots have been on immobilising terrain.

    Args:
        held: consecutive steps, up to now, shape [B].
        time_s: since the start.
    """

    held: Tensor
    time_s: float


class Ends(NamedTuple):
    """What the last states of rollouts are judged by.

    Args:
        padded_ground: M maps of an episode after another, shape [B·M, N].
        target: (x, y) to be reached, shape [B·M, 1, 2].
        grid: size and resolution of the maps.
        objective: J.
        fields: M.
        level: of the CVaR over them.
        going: which rollouts have not stopped, bool, shape [B·M, K]; None if none
            stops.
        to_go: of the cheapest paths, as of `astar.framed`, shape [B, 2, N]; None if J
            tells the last cost.
    """

    padded_ground: Tensor
    target: Tensor
    grid: Grid
    objective: Objective
    fields: int = 1
    level: float = 0.0
    going: Tensor | None = None
    to_go: Tensor | None = None


def roll_out(
    problem: Problem,
    state: Tensor,
    mean: Tensor,
    noise: Tensor,
    target_m: Tensor,
    advance: Callable[..., Any],
    ground: Tensor | None = None,
    dwell: Dwell | None = None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Rolls sampled action sequences out, summing J and the penalty of ground that is
    not free.

    Args:
        problem: B problems.
        state: initial states, shape [B, S].
        mean: mean action sequences, shape [B, T, A].
        noise: added to every mean and clipped to the action bounds, shape [T, A, K].
        target_m: (x, y) to be reached, shape [B, 2].
        advance: `advance_chunk`, with `dwell` `advance_entrapped`, or the same
            compiled.
        ground: M maps of an episode after another, as of `framed_fields`, shape [B·M,
            N]; None for λ̂.
        dwell: how long robots have been on immobilising terrain; None without
            entrapment.

    Returns:
        The last states, shape [B·M, K, S], the cost but for theirs, shape [B·M, K],
        and, with `dwell`, which have not stopped, bool of that shape.
    """
    ground = problem.padded_ground if ground is None else ground
    count = len(ground) // len(problem)
    state, mean, target_m = (
        each.repeat_interleave(count, 0) for each in (state, mean, target_m)
    )
    states = component_wise(state[:, None].expand(-1, noise.shape[2], -1))
    # Contiguous, as all that is passed on: another layout is compiled for anew.
    target = target_m[:, None].contiguous()
    cost = state.new_zeros(states.shape[:2])
    chunks = [
        slice(first, min(first + _CHUNK_STEPS, mean.shape[1]))
        for first in range(0, mean.shape[1], _CHUNK_STEPS)
    ]
    parts = [
        Sampled(mean[:, chunk].contiguous(), noise[chunk], *problem.action_bounds)
        for chunk in chunks
    ]
    dynamics = problem.dynamics
    if dwell is None or problem.immobile is None:
        for sampled in parts:
            states, cost = advance(states, cost, sampled, ground, target, dynamics)
        return states, cost, None
    most = steps_in(problem.immobile.for_s, problem.dt_s)
    held = (
        dwell.held.repeat_interleave(count, 0)[:, None]
        .expand_as(cost)
        .clamp(max=most - 1)
        .contiguous()
    )
    left = ((problem.time_budget_s - dwell.time_s) / problem.dt_s).round().to(state)
    left = left.repeat_interleave(count, 0)[:, None]
    goal = problem.goal_m.repeat_interleave(count, 0)[:, None].contiguous()
    for chunk, sampled in zip(chunks, parts, strict=True):
        rules = Entrapment(
            goal,
            left - chunk.start,
            problem.goal_radius_m,
            problem.immobile.below,
            most,
        )
        states, cost, held = advance(
            states, cost, held, sampled, ground, target, rules, dynamics
        )
    return states, cost, held < most


def advance_chunk(
    states: Tensor,
    cost: Tensor,
    sampled: Sampled,
    padded_ground: Tensor,
    target: Tensor,
    dynamics: Dynamics,
) -> tuple[Tensor, Tensor]:
    """Roll samples out over a chunk of the horizon, and add up their costs; takes a
    problem in its parts.
    """
    grid, robot, objective, min_traversability = dynamics
    for step in range(sampled.mean.shape[1]):
        action = sampled_actions(sampled, step)
        ground = grid.lookup(padded_ground, states[..., 0], states[..., 1])
        cost = cost + stage_cost(objective, states, action, ground, target)
        states = robot(
            states, action, motion_traversability(ground, min_traversability)
        )
    return component_wise(states), cost


def weigh(
    states: Tensor,
    cost: Tensor,
    sampled: Sampled,
    ends: Ends,
    temperature: float | None,
    temperature_share: float,
) -> tuple[Tensor, Tensor]:
    """Adds the cost of the last states, weighs the samples by exp(−cost / temperature)
    and moves the mean.

    Returns:
        Weights of the samples, shape [B, K], and the mean action sequences, shape [B,
        T, A].
    """
    cost, each = total_cost(states, cost, ends)
    scale: Tensor | float | None = temperature
    if scale is None:
        stopped = (
            None
            if ends.going is None
            else (~ends.going).unflatten(0, (-1, ends.fields)).sum(1)
        )
        scale = temperature_share * cost_spread(cost, each, stopped)
    weights = torch.softmax((cost.amin(dim=1, keepdim=True) - cost) / scale, dim=1)
    return weights, average(
        sampled.mean, sampled.noise, weights, sampled.low, sampled.high
    )


def total_cost(states: Tensor, cost: Tensor, ends: Ends) -> tuple[Tensor, Tensor]:
    """Add the cost of the last states.

    Of rollouts on M fields the cost is the CVaR over them; those that have stopped have
    paid all that there is to pay.

    Returns:
        Cost of the samples, shape [B, K], and on each field, shape [B, M, K].
    """
    padded_ground, target, grid, objective, fields, level, going, to_go = ends
    ground = grid.lookup(padded_ground, states[..., 0], states[..., 1])
    if to_go is None:
        last = terminal_cost(objective, states, ground, target)
    else:
        # All fields of an episode have one map of costs.
        together = states.unflatten(0, (-1, fields)).flatten(1, 2)
        paths = astar.cost_at(grid, to_go, together[..., 0], together[..., 1])
        last = paths.view_as(cost) + PENALTY * (ground <= 0)
    cost = cost + (last if going is None else torch.where(going, last, 0))
    each = cost.unflatten(0, (-1, fields))
    return tail_cost(each, level) if fields > 1 else cost, each


def cost_spread(
    cost: Tensor, each: Tensor | None = None, stopped: Tensor | None = None
) -> Tensor:
    """How far the costs of samples lie above the least, on average: the unit of the
    relative temperature.

    Samples that pay the penalty of ground that is not free for more steps than the best
    does, of all fields together,
    are left out: else the temperature near such ground would be that of the penalty,
    and all ways over free ground would count alike. Steps are told by the cost on each
    field, in penalties, so J itself should spread by less than half of one, as the
    penalty of such ground asks too. Left out for the same reason are samples that stop
    for good on more fields than the best does.

    Args:
        cost: shape [B, K].
        each: on each field, shape [B, M, K]; None where that is the cost itself.
        stopped: on how many fields a sample stops, shape [B, K]; None where none does.

    Returns:
        More than 0, shape [B, 1].
    """
    each, best = (
        cost[:, None] if each is None else each,
        cost.argmin(dim=1, keepdim=True),
    )
    more = each - each.gather(2, best[:, None].expand(-1, each.shape[1], -1))
    counted = (more / PENALTY + 0.5).floor().sum(1) <= 0
    if stopped is not None:
        counted = counted & (stopped <= stopped.gather(1, best))
    excess = cost - cost.amin(dim=1, keepdim=True)
    spread = torch.where(counted, excess, 0).sum(dim=1, keepdim=True) / counted.sum(
        dim=1, keepdim=True
    )
    return spread.clamp(min=_LEAST_SPREAD)


def average(
    mean: Tensor, noise: Tensor, weights: Tensor, low: Tensor, high: Tensor
) -> Tensor:
    """Moves the mean by the noise as drawn, weighed by w [B, K]: clip(u + Σ w·ε), shape
    [B, T, A].
    """
    return torch.clamp(mean + (noise * weights[:, None, None]).sum(-1), low, high)


def _drawn(
    problem: Problem,
    state: Tensor,
    updated: Tensor,
    mean: Tensor,
    noise: Tensor,
    weights: Tensor,
) -> dict[str, Tensor]:
    """The path of the updated mean, and those of the best samples about the mean
    before.
    """
    best = weights.topk(min(_DRAWN_SAMPLES, weights.shape[1]), dim=1).indices
    samples = perturb(
        mean[..., None], noise[..., best].movedim(2, 0), *problem.action_bounds
    )
    paths = rollout_path(
        problem, state, torch.cat((updated[..., None], samples), dim=3)
    )
    return {"path": paths[:, 0], "samples": paths[:, 1:]}
