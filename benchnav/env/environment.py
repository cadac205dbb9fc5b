"""The Gymnasium environment `benchnav/OffRoad-v0`, single and vectorised, and what all versions share.

Observations hold what a robot may know: where it is, its goal, and the paper's Observation of the map;
never the truth. Letters in shapes: B sub-environments, H×W cells, S state and A action dimensions.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
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
from benchnav.planning.world.world import Places, World, read_world

SUCCESS_REWARD = 10.0
LOST_REWARD = -10.0
TIME_REWARD_PER_S = -0.1

Observations = dict[str, np.ndarray]
AnyPart = str | Mapping[str, Any] | registry.Part


class OffRoadEnv(gymnasium.Env[Any, np.ndarray]):
    """Drive to the goal over terrain of uncertain traversability.

    ## Arguments
    Of `gymnasium.make("benchnav/OffRoad-v0", …)`; `make_vec` takes the same, and `num_envs`.

    | argument        | default       | meaning                                                              |
    |-----------------|---------------|----------------------------------------------------------------------|
    | `data`          | `"paper-v1"`  | path or id of a dataset                                              |
    | `split`         | `""`          | which of its splits; empty for `train`, else its first, with a warning |
    | `robot`         | `"unicycle"`  | F: a name, `file.py:Name`, `{"part": NAME, "options": {…}}`, or a robot |
    | `objective`     | `""`          | J, likewise; empty for the shaped reward                             |
    | `world`         | `"paper"`     | what λ does: `"paper"`, `"stakes"`, or changes to one of them        |
    | `goal_radius_m` | `1.0`         | a robot this near to its goal has arrived                            |

    ## Action space
    A `Box` of the robot's bounds, float32. The unicycle's is `Box([0, -1], [1, 1], (2,))`: linear velocity
    v in m/s and angular velocity ω in rad/s, as commanded. Actions beyond the bounds are clipped. The
    traversability λ of the cell under the robot scales the motion. A step takes the robot's `dt_s`, 0.1 s.

    ## Observation space
    A `Dict` of

    | key           | dtype   | shape     | meaning                                                       |
    |---------------|---------|-----------|---------------------------------------------------------------|
    | `state`       | float32 | (S,)      | x, y in metres, heading θ in radians, and what the robot adds |
    | `goal`        | float32 | (2,)      | x, y in metres                                                |
    | `rgb`         | uint8   | (3, H, W) | top-down colour image                                         |
    | `elevation_m` | float32 | (H, W)    | elevation                                                     |
    | `slope_deg`   | float32 | (H, W)    | slope by Horn's method                                        |

    and, where the dataset has layers, one key a layer by its name, such as `vegetation_m`: float32, (H, W), 0 where
    nothing is known.

    S is 3 for the unicycle and the bicycle, 5 for the differential drive, whose velocities v and ω follow.

    ## Reward
    Without `objective`: metres gained toward the goal, −0.1 a second, +10 on arrival and −10 off the map or
    where the ground immobilises the robot for good. With one: minus its stage cost, read at the state before the
    step and the observed λ there. A step that loses the robot in one of these ways costs as much again for each
    step that is left, as if the robot stood there until T.

    ## World
    `"paper"`: λ is drawn anew at each step, low λ ends nothing, T = 100 s. `"stakes"`: λ is drawn once an
    episode as a correlated field; 2 s on λ under 0.1 end it; T is 3 × the map's reference time at top speed.
    Changes are given as a mapping, such as `{"preset": "stakes", "correlation_m": 2.0}`,
    `{"noise": "stored", "time_budget_s": 60.0}` or `{"preset": "stakes", "immobile": None}`; see
    `benchnav.planning.world.world.World`.

    ## Start and end
    An episode starts at the start of a map of the split, drawn at random or given by
    `options={"map": i}`, heading at the goal. It terminates at the goal, off the map, or
    where the world says that the ground immobilises the robot for good; and is truncated after T.

    ## Info

    | key              | type  | meaning                                                           |
    |------------------|-------|-------------------------------------------------------------------|
    | `map`            | int   | number of the map in its split                                    |
    | `outcome`        | str   | `running`, `success`, `timeout`, `immobilised` or `out_of_bounds` |
    | `is_success`     | bool  | the goal was reached                                              |
    | `traversability` | float | observed λ in the step; 1 after a reset                           |
    | `distance_m`     | float | to the goal                                                       |

    ## Version history
    * v0 of benchnav 0.9: layers of the dataset.
    * v0 of benchnav 0.3: `world` in place of `noise` and `time_budget_s`.
    * v0 of benchnav 0.2: `robot` in place of `dynamics`; `objective`, `goal_radius_m` and `is_success` are
      new; `split` is `train` by default, was `test/std`; `noise` "stored", was "frozen".
    * v0 of benchnav 0.1: first version.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - the base class's contract
    _batch: "EnvBatch"

    def __init__(self, render_mode: str | None = None, **arguments: Any) -> None:
        """Loads the maps of the split; see the class."""
        guard.check_render_mode(render_mode, self.metadata["render_modes"])
        self._batch = self._make_batch(1, **arguments)
        self.observation_space = self._batch.observation_space
        self.action_space = self._batch.action_space

    @staticmethod
    def _make_batch(size: int, **arguments: Any) -> "EnvBatch":
        return EnvBatch(size, **arguments)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Starts an episode; see the class."""
        map_index = guard.read_options(options, ("map",), self._batch.maps).get("map")
        super().reset(seed=seed)
        self._batch.reset([self.np_random], np.array([True]), map_index)
        return _only(*self._batch.observe())

    def step(self, action: np.ndarray) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Takes one time step; see the class."""
        reward, terminated, truncated, met = self._batch.step(np.asarray(action)[None])
        observation, info = _only(*self._batch.observe(met))
        return observation, reward.item(), terminated.item(), truncated.item(), info


class OffRoadVectorEnv(VectorEnv[Any, np.ndarray, np.ndarray]):
    """Many `OffRoadEnv` stepped as one batch, with next-step autoreset.

    Sub-environment i seeded with s is the single environment seeded with s + i. `info` holds arrays; its
    `outcome` is a number, see `benchnav.planning.world.outcome.Outcome`. Arguments, spaces and rewards are
    those of `OffRoadEnv`.

    Args:
        num_envs: how many.
        arguments: those of `OffRoadEnv`.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}  # noqa: RUF012
    _batch: "EnvBatch"

    def __init__(self, num_envs: int = 1, render_mode: str | None = None, **arguments: Any) -> None:
        """Loads the maps of the split; see the class."""
        guard.check_render_mode(render_mode, self.metadata["render_modes"])
        self.num_envs = num_envs
        self._batch = self._make_batch(num_envs, **arguments)
        self.single_observation_space = self._batch.observation_space
        self.single_action_space = self._batch.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators: list[np.random.Generator] = []
        self._ended = np.zeros(num_envs, dtype=bool)

    @staticmethod
    def _make_batch(size: int, **arguments: Any) -> "EnvBatch":
        return EnvBatch(size, **arguments)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Starts an episode in each sub-environment, or in those of `options={"reset_mask": …}`, bool [B]."""
        given = guard.read_options(options, ("map", "reset_mask"), self._batch.maps)
        every = np.ones(self.num_envs, dtype=bool)
        chosen = np.asarray(given.get("reset_mask", every))
        fits = chosen.shape == every.shape and chosen.dtype == bool and chosen.any()
        expect(fits, f"option `reset_mask` as bool of shape [{len(every)}], at least one true, got {chosen}.")
        if not self._generators and not chosen.all():
            raise gymnasium.error.ResetNeeded("Call reset() of all sub-environments before that of some.")
        if seed is not None or not self._generators:
            _, root = seeding.np_random(seed)
            fresh = [seeding.np_random(root + i)[0] for i in range(self.num_envs)]
            self._generators = [
                new if anew else old
                for new, old, anew in zip(fresh, self._generators or fresh, chosen, strict=True)
            ]
        self._batch.reset(self._generators, chosen, given.get("map"))
        self._ended = self._ended & ~chosen
        return self._batch.observe()

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observations, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Takes one time step, or starts anew where the last one ended an episode."""
        again = self._ended
        if again.any():
            self._batch.reset(self._generators, again, None)
        reward, terminated, truncated, met = self._batch.step(actions, hold=again)
        self._ended = terminated | truncated
        observations, info = self._batch.observe(met)
        return observations, reward, terminated, truncated, info


def _only(observations: Observations, info: Observations) -> tuple[Observations, dict[str, Any]]:
    """What there is of the one sub-environment of a batch; its outcome by name."""
    diagnostics = {name: values[0].item() for name, values in info.items()}
    diagnostics["outcome"] = Outcome(diagnostics["outcome"]).name.lower()
    return {name: values[0] for name, values in observations.items()}, diagnostics


class EnvBatch:
    """B sub-environments as one batch, a stateful shell over the Simulation; see `OffRoadEnv` for what they are.

    Args:
        size: B.
        data: path or id of a dataset.
        split: which of its splits; empty for `train`, else the first.
        robot: name or mapping of a registered robot, or one itself.
        objective: likewise of an objective; empty for the shaped reward.
        world: what λ does: a preset by name, a mapping of changes to one, or a world itself; if empty, the paper's,
            with a warning.
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
        self._world = world if isinstance(world, World) else read_world(world or "paper")[0]
        made: Any = registry.take("robot", robot)
        self._objective: Any = None
        if objective:
            self._objective = registry.take("objective", objective, robot=made, goal_radius_m=goal_radius_m)
        rules = Rules(goal_radius_m=goal_radius_m)
        self._task = Task(robot=made, objective=self._objective or GoalDistance(), rules=rules)
        dataset = self._dataset = TerrainDataset(find_dataset(data))
        if not split:
            split = "train" if "train" in dataset.splits else next(iter(dataset.splits))
            if split != "train":
                guard.warn(f"{dataset.path} has no split 'train'; its split {split!r} is taken.")
        self._maps = dataset.terrain(split)
        taken = {"state", "goal"} & set(self._maps.layers)
        expect(
            not taken, f"layers that are not called 'state' or 'goal', got {sorted(taken)} in {dataset.path}."
        )
        places = dataset.read(split, fields=["start_m", "goal_m", "reference_time_s"])
        self._places = Places(**{name: torch.from_numpy(values) for name, values in places.items()})
        # To be refused at once.
        self._world.budget_s(self._places.reference_time_s, made.top_speed_mps)
        check_known(self._maps, self._world)
        self._map = np.zeros(size, dtype=np.int64)
        self._noise_seed = np.zeros(size, dtype=np.int64)
        self._simulation: Simulation | None = None
        self._now: SimulationState | None = None
        self.action_space = spaces.Box(np.float32(made.action_low), np.float32(made.action_high))
        self.observation_space = self._observation_space()

    @property
    def maps(self) -> int:
        """How many maps the split has."""
        return len(self._maps)

    def reset(
        self, generators: Sequence[np.random.Generator], chosen: np.ndarray, map_index: int | None
    ) -> None:
        """Starts new episodes in the chosen sub-environments, bool, shape [B]; maps are drawn if not given."""
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
        # Only what began anew is built: the others keep their maps and noise.
        index = torch.from_numpy(members)
        self._simulation.exchange_(index, fresh)
        self._now = map_tensors(self._now, lambda now, new: now.index_copy(0, index, new), start)

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
            ConfigError: the actions are of another shape, or not finite.
            ResetNeeded: an episode has ended, or none has begun.
        """
        guard.limit_threads()
        simulation, now = self._current()
        given, space = np.asarray(actions, np.float32), self.action_space
        expected = (len(self._map), *space.shape)
        expect(given.shape == expected, f"actions of shape {list(expected)}, got {list(given.shape)}.")
        waits = torch.zeros_like(now.running) if hold is None else torch.from_numpy(hold)
        guard.check_actions(given, ~waits.numpy())
        if bool((~now.running & ~waits).any()):
            raise gymnasium.error.ResetNeeded("The episode has ended. Call reset() before the next step().")
        action = self._command(torch.from_numpy(given.clip(space.low, space.high)))
        moved, met = simulation.step(now, action)
        self._now = map_tensors(
            now, lambda old, new: torch.where(waits[:, None] if new.ndim > 1 else waits, old, new), moved
        )
        outcome = self._now.outcome
        return (
            torch.where(waits, 0.0, self._reward(now, self._now, action, met)).double().numpy(),
            ((outcome == Outcome.SUCCESS) | _lost(outcome)).numpy(),
            (outcome == Outcome.TIMEOUT).numpy(),
            torch.where(waits, 1.0, met).numpy(),
        )

    def observe(self, met: np.ndarray | None = None) -> tuple[Observations, Observations]:
        """What the robots see, and diagnostics with the observed λ, 1 if not given; each array begins with B."""
        _, now = self._current()
        seen = {
            "state": now.state.numpy().copy(),
            "goal": self._goal_m().numpy(),
            "rgb": self._maps.rgb[self._map].numpy(),
            "elevation_m": self._maps.elevation_m[self._map].numpy(),
            "slope_deg": self._maps.slope_deg[self._map].numpy(),
            **{name: layer[self._map].nan_to_num().numpy() for name, layer in self._maps.layers.items()},
        }
        return seen, self._diagnose(met)

    def _diagnose(self, met: np.ndarray | None) -> Observations:
        """Diagnostics with the observed λ, 1 if not given."""
        _, now = self._current()
        return {
            "map": self._map.copy(),
            "outcome": now.outcome.numpy().copy(),
            "is_success": (now.outcome == Outcome.SUCCESS).numpy(),
            "traversability": np.ones(len(self._map), np.float32) if met is None else met,
            "distance_m": self._distance_m(now).numpy(),
        }

    def _command(self, action: Tensor) -> Tensor:
        """What the robots are commanded by actions within the bounds, both of shape [B, A]."""
        return action

    def _reward(self, before: SimulationState, now: SimulationState, action: Tensor, met: Tensor) -> Tensor:
        """Progress less time, and a prize or fine at the end; or minus J's stage cost; shape [B]."""
        simulation, _ = self._current()
        lost = _lost(now.outcome)
        if self._objective is None:
            gained_m = self._distance_m(before) - self._distance_m(now)
            driven = gained_m + TIME_REWARD_PER_S * self._task.robot.dt_s
            return driven + SUCCESS_REWARD * (now.outcome == Outcome.SUCCESS) + LOST_REWARD * lost
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
