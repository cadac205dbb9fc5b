"""Sub-environments stepped as one batch: maps, noise, rewards and observations of
`benchnav/OffRoad-v0`.

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
from benchnav.planning.world.realisation import check_known
from benchnav.planning.world.simulation import Simulation, SimulationState
from benchnav.planning.world.world import Endpoints, World, read_world

SUCCESS_REWARD = 10.0
LOST_REWARD = -10.0
TIME_REWARD_PER_S = -0.1

Observations = dict[str, np.ndarray]
AnyPart = str | Mapping[str, Any] | registry.Part


class EnvBatch:
    """B sub-environments as one batch, a stateful shell over the Simulation; see
    `OffRoadEnv` for what they are.

    Args:
        size: B.
        data: path or id of a dataset.
        split: which of its splits; empty for `train`, else the first.
        robot: name or mapping of a registered robot, or one itself.
        objective: likewise of an objective; empty for the shaped reward.
        world: what λ does: a preset by name, a mapping of changes to one, or a world
            itself; if empty, the paper's, with a warning.
        goal_radius_m: a robot this near to its goal has arrived.
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
        """Loads the maps of the split."""
        guard.limit_threads()
        guard.warn_of_default_world(world)
        self._world = (
            world if isinstance(world, World) else read_world(world or "paper")[0]
        )
        made: Any = registry.take("robot", robot)
        self._objective: Any = None
        if objective:
            self._objective = registry.take(
                "objective", objective, robot=made, goal_radius_m=goal_radius_m
            )
        rules = Rules(goal_radius_m=goal_radius_m)
        self._task = Task(
            robot=made, objective=self._objective or GoalDistance(), rules=rules
        )
        dataset = self._dataset = TerrainDataset(find_dataset(data))
        if not split:
            split = "train" if "train" in dataset.splits else next(iter(dataset.splits))
            if split != "train":
                guard.warn(
                    f"{dataset.path} has no split 'train'; its split {split!r} is "
                    "taken."
                )
        self._maps = dataset.terrain(split)
        taken = {"state", "goal"} & set(self._maps.layers)
        expect(
            not taken,
            f"layers that are not called 'state' or 'goal', got {sorted(taken)} in "
            f"{dataset.path}.",
        )
        places = dataset.read(split, fields=["start_m", "goal_m", "reference_time_s"])
        self._places = Endpoints(
            **{name: torch.from_numpy(values) for name, values in places.items()}
        )
        # To be refused at once.
        self._world.budget_s(self._places.reference_time_s, made.top_speed_mps)
        check_known(self._maps, self._world)
        self._map = np.zeros(size, dtype=np.int64)
        self._noise_seed = np.zeros(size, dtype=np.int64)
        self._simulation: Simulation | None = None
        self._now: SimulationState | None = None
        self.action_space = spaces.Box(
            np.float32(made.action_low), np.float32(made.action_high)
        )
        self.observation_space = self._observation_space()

    @property
    def maps(self) -> int:
        """How many maps the split has."""
        return len(self._maps)

    def reset(
        self,
        generators: Sequence[np.random.Generator],
        chosen: np.ndarray,
        map_index: int | None,
    ) -> None:
        """Starts new episodes in the chosen sub-environments, bool, shape [B]; maps are
        drawn if not given.
        """
        guard.limit_threads()
        members = np.flatnonzero(chosen)
        for i in members.tolist():
            # Both are drawn always, so that naming the map changes nothing else.
            drawn = generators[i].integers(len(self._maps))
            self._map[i] = drawn if map_index is None else map_index
            self._noise_seed[i] = generators[i].integers(2**48)
        maps = torch.from_numpy(self._map[members])
        # What is made under inference mode could not be changed in place outside of it.
        with torch.inference_mode(False):
            places = self._places.select(maps)
            fresh = Simulation(
                self._maps.select(maps),
                self._task,
                self._world,
                places,
                rng.stream_key(0, "environment"),
                self._noise_seed[members].tolist(),
            )
            pose = heading_to(places.start_m, places.goal_m)
            start = fresh.init(self._task.robot.initial_state(pose))
        if self._simulation is None or self._now is None or len(members) == len(chosen):
            self._simulation, self._now = fresh, start
            return
        # Only new episodes are built: the others keep their maps and noise.
        index = torch.from_numpy(members)
        self._simulation.exchange_(index, fresh)
        self._now = map_tensors(
            self._now, lambda now, new: now.index_copy(0, index, new), start
        )

    def read_actions(
        self, actions: np.ndarray, hold: np.ndarray | None = None
    ) -> np.ndarray:
        """Return actions as float32, clipped to the bounds; nothing else is changed.

        Args:
            actions: shape [B, A].
            hold: sub-environments whose actions are not used, bool, shape [B]; none
                when not given.

        Raises:
            ConfigError: If the actions are of another type or shape, or not finite.
            ResetNeeded: If no episode has begun.
        """
        self._current()
        read, space = guard.read_numbers(actions), self.action_space
        expected = (len(self._map), *space.shape)
        expect(
            read.shape == expected,
            f"actions of shape {list(expected)}, got {list(read.shape)}.",
        )
        guard.check_actions(
            read, np.ones(len(read), dtype=bool) if hold is None else ~hold
        )
        return read.clip(space.low, space.high)

    def step(
        self, actions: np.ndarray, hold: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Takes a time step in all sub-environments but those on hold.

        Args:
            actions: shape [B, A], see `read_actions`.
            hold: bool, shape [B]; none when not given.

        Returns:
            Reward, terminated, truncated, and observed λ, each of shape [B].

        Raises:
            ConfigError: If the actions are of another shape, or not finite.
            ResetNeeded: If an episode has ended, or none has begun.
        """
        guard.limit_threads()
        commanded = self.read_actions(actions, hold)
        simulation, now = self._current()
        waits = (
            torch.zeros_like(now.running) if hold is None else torch.from_numpy(hold)
        )
        if bool((~now.running & ~waits).any()):
            raise gymnasium.error.ResetNeeded(
                "The episode has ended. Call reset() before the next step()."
            )
        action = self._command(torch.from_numpy(commanded))
        moved, met = simulation.step(now, action)
        self._now = map_tensors(
            now,
            lambda old, new: torch.where(
                waits[:, None] if new.ndim > 1 else waits, old, new
            ),
            moved,
        )
        outcome = self._now.outcome
        return (
            torch.where(waits, 0.0, self._reward(now, self._now, action, met))
            .double()
            .numpy(),
            ((outcome == Outcome.SUCCESS) | _lost(outcome)).numpy(),
            (outcome == Outcome.TIMEOUT).numpy(),
            torch.where(waits, 1.0, met).numpy(),
        )

    def observe(
        self, met: np.ndarray | None = None
    ) -> tuple[Observations, Observations]:
        """What the robots see, and diagnostics with the observed λ, 1 if not given;
        each array begins with B.
        """
        _, now = self._current()
        seen = {
            "state": now.state.numpy().copy(),
            "goal": self._goal_m().numpy(),
            "rgb": self._maps.rgb[self._map].numpy(),
            "elevation_m": self._maps.elevation_m[self._map].numpy(),
            "slope_deg": self._maps.slope_deg[self._map].numpy(),
            **{
                name: layer[self._map].nan_to_num().numpy()
                for name, layer in self._maps.layers.items()
            },
        }
        return seen, self._diagnose(met)

    def _diagnose(self, met: np.ndarray | None) -> Observations:
        """Diagnostics with the observed λ, 1 if not given."""
        _, now = self._current()
        return {
            "map": self._map.copy(),
            "outcome": now.outcome.numpy().copy(),
            "is_success": (now.outcome == Outcome.SUCCESS).numpy(),
            "traversability": np.ones(len(self._map), np.float32)
            if met is None
            else met,
            "distance_m": self._distance_m(now).numpy(),
        }

    def _command(self, action: Tensor) -> Tensor:
        """What the robots are commanded by actions within the bounds, both of shape [B,
        A].
        """
        return action

    def _reward(
        self, before: SimulationState, now: SimulationState, action: Tensor, met: Tensor
    ) -> Tensor:
        """Progress less time, and a prize or fine at the end; or minus J's stage cost;
        shape [B].
        """
        simulation, _ = self._current()
        lost = _lost(now.outcome)
        if self._objective is None:
            gained_m = self._distance_m(before) - self._distance_m(now)
            driven = gained_m + TIME_REWARD_PER_S * self._task.robot.dt_s
            return (
                driven
                + SUCCESS_REWARD * (now.outcome == Outcome.SUCCESS)
                + LOST_REWARD * lost
            )
        cost: Tensor = self._objective.stage(before.state, action, met, self._goal_m())
        # Else to be lost would be the cheapest way to end a costly episode.
        return -cost * (1 + (simulation.steps - now.step) * lost)

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
                **{
                    name: spaces.Box(-np.inf, np.inf, (height, width), np.float32)
                    for name in self._maps.layers
                },
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
    """Off the map, or immobilised for good: no later step could mend it."""
    return (outcome == Outcome.OUT_OF_BOUNDS) | (outcome == Outcome.IMMOBILISED)
