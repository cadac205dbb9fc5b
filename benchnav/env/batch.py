"""Sub-environments as one batch: which maps they are on, where the robots stand, what a step earns.

A stateful shell over the Simulation, with NumPy at the boundary; the Gymnasium classes in `env` are shells
over this. Letters in shapes: B sub-environments, H×W cells, S state and A action dimensions.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from benchnav.core import registry, rng
from benchnav.core.errors import ConfigError
from benchnav.datagen.files.reader import TerrainDataset, find_dataset
from benchnav.planning.free_space import Rules
from benchnav.planning.objective import GoalDistance, Objective, distance
from benchnav.planning.problem import Task, heading_to, map_tensors
from benchnav.planning.robots import Robot
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.places import Places
from benchnav.planning.world.realisation import check_known
from benchnav.planning.world.simulation import Simulation, SimulationState
from benchnav.planning.world.world import World, read_world

SUCCESS_REWARD = 10.0
LOST_REWARD = -10.0
TIME_REWARD_PER_S = -0.1

Observations = dict[str, np.ndarray]
AnyPart = str | Mapping[str, Any] | registry.Part
AnyWorld = str | Mapping[str, Any] | World


class EnvBatch:
    """B sub-environments; see `env.OffRoadEnv` for what they are.

    Args:
        size: B.
        data: path or id of a dataset.
        split: which of its splits; empty for `train`, else the first.
        robot: name or mapping of a registered robot, or one itself.
        objective: likewise of an objective; empty for the shaped reward.
        world: what λ does: a preset by name, a mapping of changes to one, or a world itself.
        goal_radius_m: a robot this near to its goal has arrived.
    """

    def __init__(
        self,
        size: int,
        data: str | Path,
        split: str,
        robot: AnyPart | Robot,
        objective: AnyPart | Objective,
        world: AnyWorld,
        goal_radius_m: float,
    ) -> None:
        """Loads the maps of the split."""
        self._world = world if isinstance(world, World) else read_world(world)[0]
        made: Any = registry.take("robot", robot)
        rules = Rules(goal_radius_m=goal_radius_m)
        made_for = {"robot": made, "goal_radius_m": goal_radius_m}
        self._objective: Any = registry.take("objective", objective, **made_for) if objective else None
        self._task = Task(robot=made, objective=self._objective or GoalDistance(), rules=rules)
        dataset = TerrainDataset(find_dataset(data))
        split = split or _default_split(dataset)
        self._maps = dataset.terrain(split)
        places = dataset.read(split, fields=["start_m", "goal_m", "reference_time_s"])
        self._places = Places(**{name: torch.from_numpy(values) for name, values in places.items()})
        lacking = int(np.isnan(places["reference_time_s"]).sum())
        if self._world.time_budget_ratio is not None and lacking:
            raise ConfigError(
                f"Expected a reference time on each map of split {split!r} of {dataset.path}, of which this world's "
                f"time budget is a multiple, got none on {lacking} of {len(self._maps)}. Make such maps: "
                f"benchnav-datagen create RECIPE id=NAME splits.{split}.solvable=true; or give a budget: "
                "world={'preset': 'stakes', 'time_budget_s': 60}."
            )
        # To be refused at once.
        self._world.budget_s(self._places.reference_time_s, made.top_speed_mps)
        check_known(self._maps, self._world)
        self._low, self._high = (
            torch.tensor(bound, dtype=torch.float32) for bound in (made.action_low, made.action_high)
        )
        self._map = np.zeros(size, dtype=np.int64)
        self._noise_seed = np.zeros(size, dtype=np.int64)
        self._simulation: Simulation | None = None
        self._now: SimulationState | None = None
        self.action_space = spaces.Box(self._low.numpy(), self._high.numpy())
        self.observation_space = self._observation_space()

    def reset(
        self, generators: Sequence[np.random.Generator], chosen: np.ndarray, map_index: int | None
    ) -> None:
        """Starts new episodes in the chosen sub-environments, bool, shape [B].

        Raises:
            ConfigError: there is no such map.
        """
        if map_index is not None and not 0 <= map_index < len(self._maps):
            raise ConfigError(f"Expected option `map` in 0–{len(self._maps) - 1}, got {map_index}.")
        members = np.flatnonzero(chosen)
        for i in members.tolist():
            # Both are drawn always, so that naming the map changes nothing else.
            drawn = generators[i].integers(len(self._maps))
            self._map[i] = drawn if map_index is None else map_index
            self._noise_seed[i] = generators[i].integers(2**48)
        fresh, start = self._begin(members)
        if self._simulation is None or self._now is None or len(members) == len(chosen):
            self._simulation, self._now = fresh, start
            return
        # Only what began anew is built: the others keep their maps and noise.
        index = torch.from_numpy(members)
        self._simulation.exchange_(index, fresh)
        self._now = map_tensors(lambda now, new: now.index_copy(0, index, new), self._now, start)

    def step(
        self, actions: np.ndarray, hold: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Takes a time step in all sub-environments but those on hold.

        Args:
            actions: shape [B, A]; clipped to the bounds.
            hold: bool, shape [B]; none when not given.

        Returns:
            Reward, terminated, truncated, and observed λ, each of shape [B].

        Raises:
            ConfigError: the actions are of another shape.
        """
        simulation, now = self._current()
        given = torch.as_tensor(actions, dtype=torch.float32)
        expected = [len(self._map), *self._low.shape]
        if list(given.shape) != expected:
            raise ConfigError(f"Expected actions of shape {expected}, got {list(given.shape)}.")
        waits = torch.zeros_like(now.running) if hold is None else torch.from_numpy(hold)
        action = given.clamp(self._low, self._high)
        moved, met = simulation.step(now, action)
        self._now = map_tensors(
            lambda old, new: torch.where(waits[:, None] if new.ndim > 1 else waits, old, new), now, moved
        )
        reward = self._shaped(now) if self._objective is None else self._minus_cost(now, action, met)
        outcome = self._now.outcome
        return (
            torch.where(waits, 0.0, reward).double().numpy(),
            ((outcome == Outcome.SUCCESS) | _lost(outcome)).numpy(),
            (outcome == Outcome.TIMEOUT).numpy(),
            torch.where(waits, 1.0, met).numpy(),
        )

    def observe(self) -> Observations:
        """What the robots see, each array with a leading dimension B."""
        _, now = self._current()
        return {
            "state": now.state.numpy().copy(),
            "goal": self._goal_m().numpy(),
            "rgb": self._maps.rgb[self._map].numpy(),
            "elevation_m": self._maps.elevation_m[self._map].numpy(),
            "slope_deg": self._maps.slope_deg[self._map].numpy(),
        }

    def info(self, met: np.ndarray) -> dict[str, np.ndarray]:
        """Diagnostics, each of shape [B]."""
        _, now = self._current()
        return {
            "map": self._map.copy(),
            "outcome": now.outcome.numpy().copy(),
            "is_success": (now.outcome == Outcome.SUCCESS).numpy(),
            "traversability": met,
            "distance_m": self._distance_m(now).numpy(),
        }

    def _begin(self, members: np.ndarray) -> tuple[Simulation, SimulationState]:
        """A simulation of some sub-environments alone, and its start."""
        maps = torch.from_numpy(self._map[members])
        # What is made under inference mode could not be changed in place outside of it.
        with torch.inference_mode(False):
            places = self._places.select(maps)
            simulation = Simulation(
                self._maps.select(maps),
                self._task,
                self._world,
                places,
                rng.stream_key(0, "environment"),
                self._noise_seed[members].tolist(),
            )
            pose = heading_to(places.start_m, places.goal_m)
            return simulation, simulation.init(self._task.robot.initial_state(pose))

    def _shaped(self, before: SimulationState) -> Tensor:
        """Progress less time, and a prize or fine at the end, shape [B]."""
        _, now = self._current()
        gained_m = self._distance_m(before) - self._distance_m(now)
        driven = gained_m + TIME_REWARD_PER_S * self._task.robot.dt_s
        return driven + SUCCESS_REWARD * (now.outcome == Outcome.SUCCESS) + LOST_REWARD * _lost(now.outcome)

    def _minus_cost(self, before: SimulationState, action: Tensor, met: Tensor) -> Tensor:
        """Minus J's stage cost, shape [B]."""
        simulation, now = self._current()
        cost = self._objective.stage(before.state, action, met, self._goal_m())
        # Else to be lost would be the cheapest way to end a costly episode.
        left_over = (simulation.steps - now.step) * _lost(now.outcome)
        return -cost * (1 + left_over)

    def _observation_space(self) -> spaces.Dict:
        height, width = self._maps.grid.shape
        states = self._task.robot.initial_state(torch.zeros(1, 3)).shape[1]
        return spaces.Dict(
            {
                "state": spaces.Box(-np.inf, np.inf, (states,), np.float32),
                "goal": spaces.Box(-np.inf, np.inf, (2,), np.float32),
                "rgb": spaces.Box(0, 255, (3, height, width), np.uint8),
                "elevation_m": spaces.Box(-np.inf, np.inf, (height, width), np.float32),
                "slope_deg": spaces.Box(0, 90, (height, width), np.float32),
            }
        )

    def _current(self) -> tuple[Simulation, SimulationState]:
        if self._simulation is None or self._now is None:
            raise gymnasium.error.ResetNeeded("Call reset() before step().")
        return self._simulation, self._now

    def _goal_m(self) -> Tensor:
        return self._places.goal_m[self._map]

    def _distance_m(self, now: SimulationState) -> Tensor:
        return distance(now.state, self._goal_m())


def _lost(outcome: Tensor) -> Tensor:
    """Off the map, or held by the ground for good: no later step could mend it."""
    return (outcome == Outcome.OUT_OF_BOUNDS) | (outcome == Outcome.IMMOBILISED)


def _default_split(dataset: TerrainDataset) -> str:
    if "train" in dataset.splits:
        return "train"
    first = next(iter(dataset.splits))
    gymnasium.logger.warn(f"{dataset.path} has no split 'train'; its split {first!r} is taken.")
    return first
