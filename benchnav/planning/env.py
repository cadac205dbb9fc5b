"""The Gymnasium environment `benchnav/OffRoad-v0`, single and vectorised.

Both are shells over the Simulation, with NumPy at the boundary. Observations hold what a robot may
know: where it is, its goal, and the paper's Observation of the map; never the truth.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from benchnav import rng
from benchnav.datagen.store import TerrainDataset, find_dataset
from benchnav.errors import ConfigError
from benchnav.planning.dynamics import Dynamics, Unicycle
from benchnav.planning.problem import heading_to
from benchnav.planning.simulation import Outcome, Simulation, SimulationConfig, SimulationState

SUCCESS_REWARD = 10.0
OUT_OF_BOUNDS_REWARD = -10.0
TIME_REWARD_PER_S = -0.1

Observations = dict[str, np.ndarray]


class OffRoadEnv(gymnasium.Env[Any, np.ndarray]):
    """Drive to the goal over terrain of uncertain traversability.

    ## Action space
    `Box([0, -1], [1, 1], (2,), float32)`: linear velocity v in m/s and angular velocity ω in rad/s,
    as commanded. The traversability λ of the cell under the robot scales both.

    ## Observation space
    A `Dict` of

    | key           | dtype   | shape     | meaning                                   |
    |---------------|---------|-----------|-------------------------------------------|
    | `state`       | float32 | (3,)      | x, y in metres, heading θ in radians      |
    | `goal`        | float32 | (2,)      | x, y in metres                            |
    | `rgb`         | uint8   | (3, H, W) | top-down colour image                     |
    | `elevation_m` | float32 | (H, W)    | elevation                                 |
    | `slope_deg`   | float32 | (H, W)    | slope by Horn's method                    |

    ## Reward
    Metres gained toward the goal, −0.1 a second, +10 on arrival and −10 off the map.

    ## Start and end
    An episode starts at the start of a map of the split, drawn at random or given by
    `options={"instance": i}`, heading at the goal. It terminates within 1 m of the goal or off the
    map, and is truncated after `time_budget_s`.

    ## Info
    `instance`, `outcome` (name), `traversability` (λ met in the step; 1 after a reset),
    `distance_m` to the goal.

    ## Version history
    * v0: first version.

    Args:
        data: path or id of a dataset.
        split: which of its splits.
        noise: `resampled` at each step, or `frozen` at the map's realised traversability.
        time_budget_s: T.
        dynamics: F; the paper's unicycle when not given.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - the base class's contract

    def __init__(
        self,
        data: str = "paper-v1",
        split: str = "test/std",
        noise: str = "resampled",
        time_budget_s: float = 100.0,
        dynamics: Dynamics | None = None,
    ) -> None:
        """Loads the maps of the split."""
        config = SimulationConfig(noise=noise, time_budget_s=time_budget_s)
        self._batch = _Batch(data, split, config, dynamics or Unicycle(), 1)
        self.observation_space = self._batch.observation_space
        self.action_space = self._batch.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Starts an episode; see the class."""
        super().reset(seed=seed)
        chosen = (options or {}).get("instance")
        self._batch.reset([self.np_random], np.array([True]), chosen)
        return _first(self._batch.observe()), self._info(np.ones(1, np.float32))

    def step(self, action: np.ndarray) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Takes one time step; see the class."""
        reward, terminated, truncated, met = self._batch.step(np.asarray(action)[None])
        observation = _first(self._batch.observe())
        return observation, float(reward[0]), bool(terminated[0]), bool(truncated[0]), self._info(met)

    def _info(self, met: np.ndarray) -> dict[str, Any]:
        info = {name: values[0].item() for name, values in self._batch.info(met).items()}
        return {**info, "outcome": Outcome(info["outcome"]).name.lower()}


class OffRoadVectorEnv(VectorEnv[Any, np.ndarray, np.ndarray]):
    """Many `OffRoadEnv` stepped as one batch, with next-step autoreset.

    Sub-environment i seeded with s is the single environment seeded with s + i. `info` holds arrays;
    its `outcome` is a number, see `simulation.Outcome`.

    Args:
        num_envs: how many.
        data: path or id of a dataset.
        split: which of its splits.
        noise: `resampled` or `frozen`.
        time_budget_s: T.
        dynamics: F; the paper's unicycle when not given.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        data: str = "paper-v1",
        split: str = "test/std",
        noise: str = "resampled",
        time_budget_s: float = 100.0,
        dynamics: Dynamics | None = None,
    ) -> None:
        """Loads the maps of the split."""
        config = SimulationConfig(noise=noise, time_budget_s=time_budget_s)
        self.num_envs = num_envs
        self._batch = _Batch(data, split, config, dynamics or Unicycle(), num_envs)
        self.single_observation_space = self._batch.observation_space
        self.single_action_space = self._batch.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._generators: list[np.random.Generator] = []
        self._ended = np.ones(num_envs, dtype=bool)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Starts an episode in each sub-environment."""
        if seed is not None or not self._generators:
            _, root = seeding.np_random(seed)
            self._generators = [seeding.np_random(root + i)[0] for i in range(self.num_envs)]
        self._batch.reset(self._generators, np.ones(self.num_envs, bool), (options or {}).get("instance"))
        self._ended = np.zeros(self.num_envs, dtype=bool)
        return self._batch.observe(), self._batch.info(np.ones(self.num_envs, np.float32))

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observations, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Takes one time step, or starts anew where the last one ended an episode."""
        if not self._generators:
            raise gymnasium.error.ResetNeeded("Call reset() before step().")
        again = self._ended
        if again.any():
            self._batch.reset(self._generators, again, None)
        reward, terminated, truncated, met = self._batch.step(actions, hold=again)
        self._ended = terminated | truncated
        return self._batch.observe(), reward, terminated, truncated, self._batch.info(met)


class _Batch:
    """The state of B sub-environments: which maps they are on, and where the robots stand."""

    def __init__(
        self, data: str, split: str, config: SimulationConfig, dynamics: Dynamics, size: int
    ) -> None:
        dataset = TerrainDataset(find_dataset(data))
        self._maps = dataset.terrain(split)
        places = dataset.read(split, fields=["start_m", "goal_m"])
        self._start, self._goal = (torch.from_numpy(places[name]) for name in ("start_m", "goal_m"))
        self._config, self._dynamics = config, dynamics
        self._instance = np.zeros(size, dtype=np.int64)
        self._luck = np.zeros(size, dtype=np.int64)
        self._simulation: Simulation | None = None
        self._now: SimulationState | None = None
        height, width = dataset.grid.shape
        low, high = (np.asarray(b, dtype=np.float32) for b in (dynamics.action_low, dynamics.action_high))
        self.action_space = spaces.Box(low, high)
        self.observation_space = spaces.Dict(
            {
                "state": spaces.Box(-np.inf, np.inf, (3,), np.float32),
                "goal": spaces.Box(-np.inf, np.inf, (2,), np.float32),
                "rgb": spaces.Box(0, 255, (3, height, width), np.uint8),
                "elevation_m": spaces.Box(-np.inf, np.inf, (height, width), np.float32),
                "slope_deg": spaces.Box(0, 90, (height, width), np.float32),
            }
        )

    def reset(
        self, generators: Sequence[np.random.Generator], chosen: np.ndarray, instance: int | None
    ) -> None:
        """Starts new episodes in the chosen sub-environments, bool, shape [B]."""
        if instance is not None and not 0 <= instance < len(self._maps):
            raise ConfigError(f"Expected option `instance` in 0–{len(self._maps) - 1}, got {instance}.")
        for i in np.flatnonzero(chosen).tolist():
            # Both are drawn always, so that naming the map changes nothing else.
            drawn = generators[i].integers(len(self._maps))
            self._instance[i] = drawn if instance is None else instance
            self._luck[i] = generators[i].integers(2**48)
        start = heading_to(self._start[self._instance], self._goal[self._instance])
        self._simulation = Simulation(
            self._maps.select(torch.from_numpy(self._instance)),
            self._dynamics,
            self._goal[self._instance],
            rng.stream_key(0, "environment"),
            self._luck.tolist(),
            self._config,
        )
        fresh = self._simulation.init(start)
        if self._now is not None:
            anew = torch.from_numpy(chosen)
            fresh = SimulationState(
                torch.where(anew[:, None], fresh.state, self._now.state),
                torch.where(anew, fresh.outcome, self._now.outcome),
                torch.where(anew, fresh.step, self._now.step),
            )
        self._now = fresh

    def step(
        self, actions: np.ndarray, hold: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Steps all but those on hold; gives reward, terminated, truncated, λ met, each of shape [B]."""
        simulation, now = self._current()
        held = torch.zeros_like(now.running) if hold is None else torch.from_numpy(hold)
        before = self._distance_m(now)
        moved, met = simulation.step(now, torch.as_tensor(actions, dtype=torch.float32))
        self._now = replace(
            moved,
            state=torch.where(held[:, None], now.state, moved.state),
            outcome=torch.where(held, now.outcome, moved.outcome),
            step=torch.where(held, now.step, moved.step),
        )
        outcome = self._now.outcome
        reward = before - self._distance_m(self._now) + TIME_REWARD_PER_S * self._dynamics.dt_s
        reward = reward + SUCCESS_REWARD * (outcome == Outcome.SUCCESS)
        reward = reward + OUT_OF_BOUNDS_REWARD * (outcome == Outcome.OUT_OF_BOUNDS)
        terminated = (outcome == Outcome.SUCCESS) | (outcome == Outcome.OUT_OF_BOUNDS)
        return (
            torch.where(held, 0.0, reward).double().numpy(),
            terminated.numpy(),
            (outcome == Outcome.TIMEOUT).numpy(),
            torch.where(held, 1.0, met).numpy(),
        )

    def observe(self) -> Observations:
        """What the robots see, each array with a leading dimension B."""
        _, now = self._current()
        return {
            "state": now.state.numpy().copy(),
            "goal": self._goal[self._instance].numpy(),
            "rgb": self._maps.rgb[self._instance].numpy(),
            "elevation_m": self._maps.elevation_m[self._instance].numpy(),
            "slope_deg": self._maps.slope_deg[self._instance].numpy(),
        }

    def info(self, met: np.ndarray) -> dict[str, np.ndarray]:
        """Diagnostics, each of shape [B]."""
        _, now = self._current()
        return {
            "instance": self._instance.copy(),
            "outcome": now.outcome.numpy().copy(),
            "traversability": met,
            "distance_m": self._distance_m(now).numpy(),
        }

    def _current(self) -> tuple[Simulation, SimulationState]:
        if self._simulation is None or self._now is None:
            raise gymnasium.error.ResetNeeded("Call reset() before step().")
        return self._simulation, self._now

    def _distance_m(self, now: SimulationState) -> torch.Tensor:
        return torch.linalg.vector_norm(now.state[:, :2] - self._goal[self._instance], dim=1)


def _first(observations: Observations) -> Observations:
    return {name: values[0] for name, values in observations.items()}
