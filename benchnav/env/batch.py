"""Sub-environments of `benchnav/OffRoad-v0`, stepped as one batch.

Letters in shapes: B sub-environments, H×W cells, S state and A action dimensions.
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
from benchnav.core.batch import map_tensors
from benchnav.core.errors import expect
from benchnav.datagen.files.find import find_dataset
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.env import guard
from benchnav.planning.free_space import Rules
from benchnav.planning.objective import GoalDistance, Objective, distance
from benchnav.planning.problem import Task, heading_to
from benchnav.planning.robots import Robot
from benchnav.planning.world.outcome import Outcome
from benchnav.planning.world.realisation import check_traversability
from benchnav.planning.world.simulation import Simulation, SimulationState
from benchnav.planning.world.tracks import check_backend, create_simulation
from benchnav.planning.world.world import Endpoints, World, read_world

SUCCESS_REWARD = 10.0
LOST_REWARD = -10.0
TIME_REWARD_PER_S = -0.1
_LOST = (
    Outcome.OUT_OF_BOUNDS,
    Outcome.IMMOBILISED,
    Outcome.ROLLOVER,
    Outcome.MODEL_ERROR,
)

Observations = dict[str, np.ndarray]
AnyPart = str | Mapping[str, Any] | registry.Part


class EnvBatch:
    """B sub-environments as one batch; a stateful shell over `Simulation`.

    See `OffRoadEnv` for actions, observations and rewards.

    Args:
        size: B.
        data: path or id of a dataset.
        split: split of the dataset. If empty, `train`; without a split `train`, the
            first split, with a warning.
        robot: name or mapping of a registered robot, or a robot.
        objective: name or mapping of an objective, or an objective. If empty, the
            shaped reward.
        world: name of a preset, a mapping of changes to a preset, or a world. If
            empty, the preset `paper`, with a warning.
        goal_radius_m: distance within which the goal is reached, in metres.
    """

    def __init__(
        self,
        size: int,
        data: str | Path = "paper-v1",
        split: str = "",
        robot: AnyPart | Robot = "unicycle",
        objective: AnyPart | Objective = "",
        world: str | Mapping[str, Any] | World = "",
        goal_radius_m: float = 1.0,
    ) -> None:
        """Load the maps of the split.

        Raises:
            ConfigError: If a layer of the dataset is named `state` or `goal`, or
                `world` needs a time budget or stored λ that the maps do not have.
        """
        guard.limit_threads()
        guard.warn_of_default_world(world)
        if not isinstance(world, World):
            world = read_world(world or "paper")[0]
        robot_model: Any = registry.take("robot", robot)
        footprint = robot_model.footprint
        radius_m = 0.0 if footprint is None else footprint.radius_m
        self._world = world.with_clearance(radius_m)
        self._objective: Any = None
        if objective:
            self._objective = registry.take(
                "objective", objective, robot=robot_model, goal_radius_m=goal_radius_m
            )
        self._task = Task(
            robot=robot_model,
            objective=self._objective or GoalDistance(),
            rules=Rules(goal_radius_m=goal_radius_m),
        )
        dataset = TerrainDataset(find_dataset(data))
        self._dataset = dataset
        if not split:
            names = list(dataset.splits)
            split = "train" if "train" in names else names[0]
            if split != "train":
                guard.warn(
                    f"{dataset.path} has no split 'train'; its split {split!r} is used."
                )
        self._maps = dataset.terrain(split)
        clashes = {"state", "goal"} & set(self._maps.layers)
        expect(
            not clashes,
            "layers with other names than the observations 'state' and 'goal', got "
            f"{sorted(clashes)} in {dataset.path}. Rename these layers.",
        )
        stored = dataset.read(split, fields=["start_m", "goal_m", "reference_time_s"])
        places = {name: torch.from_numpy(values) for name, values in stored.items()}
        self._places = Endpoints(**places)
        # These calls raise for an unsuitable world here instead of in the first reset.
        self._world.budget_s(self._places.reference_time_s, robot_model.top_speed_mps)
        check_traversability(self._maps, self._world)
        check_backend(self._task, self._world, self._maps.grid)
        self._map = np.zeros(size, dtype=np.int64)
        self._noise_seed = np.zeros(size, dtype=np.int64)
        self._simulation: Simulation | None = None
        self._now: SimulationState | None = None
        low = np.float32(robot_model.action_low)
        high = np.float32(robot_model.action_high)
        self.action_space = spaces.Box(low, high)
        self.observation_space = self._observation_space()

    @property
    def maps(self) -> int:
        """Number of maps of the split."""
        return len(self._maps)

    def reset(
        self,
        generators: Sequence[np.random.Generator],
        chosen: np.ndarray,
        map_index: int | None,
    ) -> None:
        """Start new episodes in some sub-environments.

        Args:
            generators: random generators of the sub-environments, length B.
            chosen: mask of sub-environments that start, bool, shape [B].
            map_index: index of the map of all these sub-environments; if None, a map is
                drawn for each sub-environment.
        """
        guard.limit_threads()
        members = np.flatnonzero(chosen)
        for i in members.tolist():
            generator = generators[i]
            # A map is drawn even if one is given, so that the noise seed is the same.
            drawn = generator.integers(len(self._maps))
            self._map[i] = drawn if map_index is None else map_index
            self._noise_seed[i] = generator.integers(2**48)
        maps = torch.from_numpy(self._map[members])
        # Tensors created in inference mode could not be changed in place later.
        with torch.inference_mode(False):
            places = self._places.select(maps)
            new_simulation = create_simulation(
                self._maps.select(maps),
                self._task,
                self._world,
                places,
                rng.stream_key(0, "environment"),
                self._noise_seed[members].tolist(),
            )
            start_m = self._world.starts_m(places.start_m)
            pose = heading_to(start_m, places.goal_m)
            initial_state = self._task.robot.initial_state(pose)
            start = new_simulation.init(initial_state)
        all_start = len(members) == len(chosen)
        if self._simulation is None or self._now is None or all_start:
            self._simulation = new_simulation
            self._now = start
            return
        # Only the new episodes are replaced; all others keep their maps and noise.
        indices = torch.from_numpy(members)
        self._simulation.exchange_(indices, new_simulation)

        def put(now: Tensor, new: Tensor) -> Tensor:
            return now.index_copy(0, indices, new)

        self._now = map_tensors(self._now, put, start)

    def read_actions(
        self, actions: np.ndarray, hold: np.ndarray | None = None
    ) -> np.ndarray:
        """Return actions as float32, clipped to the bounds, without side effects.

        Args:
            actions: actions of the sub-environments, shape [B, A].
            hold: mask of sub-environments whose actions are ignored, bool, shape [B];
                by default, all actions are used.

        Raises:
            ConfigError: If the actions are not real numbers, have a wrong shape, or are
                not finite.
            ResetNeeded: If no episode has begun.
        """
        self._current()
        numbers = guard.read_numbers(actions)
        space = self.action_space
        expected_shape = (len(self._map), *space.shape)
        expect(
            numbers.shape == expected_shape,
            f"actions of shape {list(expected_shape)}, got {list(numbers.shape)}.",
        )
        acting = np.ones(len(numbers), dtype=bool) if hold is None else ~hold
        guard.check_actions(numbers, acting)
        return numbers.clip(space.low, space.high)

    def step(
        self, actions: np.ndarray, hold: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Take a time step in all sub-environments except those in `hold`.

        Args:
            actions: actions of the sub-environments, shape [B, A]; see `read_actions`.
            hold: mask of sub-environments that take no step, bool, shape [B]; by
                default, all take a step.

        Returns:
            Reward (float64), terminated (bool), truncated (bool), and observed λ
            (float32), each of shape [B].

        Raises:
            ConfigError: If the actions have a wrong shape, or are not finite.
            ResetNeeded: If an episode has ended, or none has begun.
        """
        guard.limit_threads()
        commanded = self.read_actions(actions, hold)
        simulation, now = self._current()
        waits = torch.zeros_like(now.running)
        if hold is not None:
            waits = torch.from_numpy(hold)
        has_ended = ~now.running & ~waits
        if bool(has_ended.any()):
            raise gymnasium.error.ResetNeeded(
                "The episode has ended. Call reset() before the next step()."
            )
        action = self._command(torch.from_numpy(commanded))
        after, traversability = simulation.step(now, action)

        def merge(old: Tensor, new: Tensor) -> Tensor:
            mask = waits[:, None] if new.ndim > 1 else waits
            return torch.where(mask, old, new)

        self._now = map_tensors(now, merge, after)
        reward = self._reward(now, self._now, action, traversability)
        outcome = self._now.outcome
        terminated = (outcome == Outcome.SUCCESS) | _is_lost(outcome)
        truncated = outcome == Outcome.TIMEOUT
        reward = torch.where(waits, 0.0, reward).double()
        observed = torch.where(waits, 1.0, traversability)
        return reward.numpy(), terminated.numpy(), truncated.numpy(), observed.numpy()

    def observe(
        self, traversability: np.ndarray | None = None
    ) -> tuple[Observations, Observations]:
        """Return observations and diagnostics of all sub-environments.

        Args:
            traversability: λ observed in the last step, shape [B]; if None, it is 1.

        Returns:
            Two dictionaries of arrays, whose first dimension is B.
        """
        _, now = self._current()
        maps = self._maps
        observations = {
            "state": now.state.numpy().copy(),
            "goal": self._goal_m().numpy(),
            "rgb": maps.rgb[self._map].numpy(),
            "elevation_m": maps.elevation_m[self._map].numpy(),
            "slope_deg": maps.slope_deg[self._map].numpy(),
        }
        for name, layer in maps.layers.items():
            observations[name] = layer[self._map].nan_to_num().numpy()
        return observations, self._diagnose(traversability)

    def _diagnose(self, traversability: np.ndarray | None) -> Observations:
        """Return diagnostics of all sub-environments; see `observe`."""
        _, now = self._current()
        if traversability is None:
            traversability = np.ones(len(self._map), np.float32)
        is_success = now.outcome == Outcome.SUCCESS
        return {
            "map": self._map.copy(),
            "outcome": now.outcome.numpy().copy(),
            "is_success": is_success.numpy(),
            "traversability": traversability,
            "distance_m": self._distance_m(now).numpy(),
        }

    def _command(self, action: Tensor) -> Tensor:
        """Return the robots' commands for actions within the bounds, shape [B, A]."""
        return action

    def _reward(
        self,
        before: SimulationState,
        now: SimulationState,
        action: Tensor,
        traversability: Tensor,
    ) -> Tensor:
        """Return the shaped reward, or minus the stage cost of J, shape [B]."""
        simulation, _ = self._current()
        is_lost = _is_lost(now.outcome)
        if self._objective is None:
            progress_m = self._distance_m(before) - self._distance_m(now)
            reward = progress_m + TIME_REWARD_PER_S * self._task.robot.dt_s
            is_success = now.outcome == Outcome.SUCCESS
            return reward + SUCCESS_REWARD * is_success + LOST_REWARD * is_lost
        cost: Tensor = self._objective.stage(
            before.state, action, traversability, self._goal_m()
        )
        # The cost of the remaining steps is added, since otherwise losing the robot
        # would be the cheapest end of a costly episode.
        remaining_steps = (simulation.steps - now.step) * is_lost
        return -cost * (1 + remaining_steps)

    def _observation_space(self) -> spaces.Dict:
        shape = self._maps.grid.shape
        initial_state = self._task.robot.initial_state(torch.zeros(1, 3))
        states = initial_state.shape[1]
        boxes: dict[str, spaces.Space[Any]] = {
            "state": _unbounded((states,)),
            "goal": _unbounded((2,)),
            "rgb": spaces.Box(0, 255, (3, *shape), np.uint8),
            "elevation_m": _unbounded(shape),
            "slope_deg": spaces.Box(0, 90, shape, np.float32),
        }
        for name in self._maps.layers:
            boxes[name] = _unbounded(shape)
        return spaces.Dict(boxes)

    def _current(self) -> tuple[Simulation, SimulationState]:
        if self._simulation is None or self._now is None:
            raise gymnasium.error.ResetNeeded("Call reset() before step().")
        return self._simulation, self._now

    def _goal_m(self) -> Tensor:
        return self._places.goal_m[self._map]

    def _distance_m(self, now: SimulationState) -> Tensor:
        return distance(now.state, self._goal_m())


def _unbounded(shape: tuple[int, ...]) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, shape, np.float32)


def _is_lost(outcome: Tensor) -> Tensor:
    """Return a mask of robots that cannot drive on, whatever is commanded."""
    is_lost = torch.zeros_like(outcome, dtype=torch.bool)
    for end in _LOST:
        is_lost |= outcome == end
    return is_lost
