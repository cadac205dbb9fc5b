"""Gymnasium environment `benchnav/OffRoad-v0`, single and vectorised.

It is the base of all later versions. Observations contain the robot's state, its goal
and all layers of the map; they never contain the truth.
Letters in shapes: B sub-environments, H×W cells, S state and A action dimensions.
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from benchnav.core.errors import expect
from benchnav.env import guard
from benchnav.env.batch import EnvBatch, Observations
from benchnav.planning.world.outcome import Outcome


class OffRoadEnv(gymnasium.Env[Any, np.ndarray]):
    """Partially observed task: drive to the goal over terrain of uncertain λ.

    λ is traversability.

    ## Arguments
    These are the arguments of `gymnasium.make("benchnav/OffRoad-v0", …)`. `make_vec`
    takes the same arguments, and `num_envs`.

    | argument        | default      | meaning                                                                 |
    |-----------------|--------------|-------------------------------------------------------------------------|
    | `data`          | `"paper-v1"` | path or id of a dataset                                                 |
    | `split`         | `""`         | split; if empty, `train`; without it, the first split, with a warning   |
    | `robot`         | `"unicycle"` | F: a name, `file.py:Name`, `{"part": NAME, "options": {…}}`, or a robot |
    | `objective`     | `""`         | J, likewise; if empty, the shaped reward                                |
    | `world`         | `""`         | dynamics of λ: `"paper"` (default, warns), `"stakes"`, or changes       |
    | `goal_radius_m` | `1.0`        | distance within which the goal is reached [m]                           |

    ## Action space
    A `Box` of the robot's bounds, float32. The unicycle's is `Box([0, -1], [1, 1],
    (2,))`: linear velocity v in m/s and angular velocity ω in rad/s, as commanded.
    Actions beyond the bounds are clipped; NaN and infinite ones raise `ConfigError`.
    The traversability λ of the cell under the robot scales the motion. A step takes the
    robot's `dt_s`, 0.1 s.

    ## Observation space
    A `Dict` of

    | key           | dtype   | shape     | meaning                                                       |
    |---------------|---------|-----------|---------------------------------------------------------------|
    | `state`       | float32 | (S,)      | x, y in metres, heading θ in radians, and what the robot adds |
    | `goal`        | float32 | (2,)      | x, y in metres                                                |
    | `rgb`         | uint8   | (3, H, W) | top-down colour image                                         |
    | `elevation_m` | float32 | (H, W)    | elevation                                                     |
    | `slope_deg`   | float32 | (H, W)    | slope by Horn's method                                        |

    and, if the dataset has layers, one key per layer by its name, such as
    `vegetation_m`: float32, (H, W), 0 where the layer is missing.

    S is 3 for the unicycle and the bicycle, and 5 for the differential drive, which
    adds its velocities v and ω.

    The episode is partially observed. The following are hidden: λ of all cells, λ
    observed in the last step, the terrain class, the true distribution of λ, the dwell
    time on immobilising terrain, the time since the start, and T.

    ## Reward
    Without `objective`: the progress toward the goal in metres, −0.1 per second, +10 at
    the goal, and −10 if the robot leaves the map or is immobilised for good. With
    `objective`: minus the stage cost at the state before the step and the λ observed
    there. If the robot leaves the map or is immobilised for good, the step's cost is
    added once more for each step that remains until T.

    ## World
    `"paper"`: λ is resampled at each step, low λ ends no episode, T = 100 s.
    `"stakes"`: λ is drawn once per episode as a correlated field; 2 s on λ below 0.1
    end the episode; T is 3 × the map's reference time at top speed. Pass changes as a
    mapping, such as `{"preset": "stakes", "correlation_m": 2.0}`, `{"noise": "stored",
    "time_budget_s": 60.0}` or `{"preset": "stakes", "immobile": None}`; see
    `benchnav.planning.world.world.World`.

    ## Start and end
    An episode begins at the start of a map of the split, facing the goal. The map is
    drawn at random, or given by `options={"map": i}`. The episode terminates when the
    robot reaches the goal, leaves the map or is immobilised for good; it is truncated
    after T. A step after the end raises `gymnasium.error.ResetNeeded`. Unknown options,
    and a `map` that is not the index of a map, raise `ConfigError`.

    ## Info

    | key              | type  | meaning                                                           |
    |------------------|-------|-------------------------------------------------------------------|
    | `map`            | int   | index of the map in its split                                     |
    | `outcome`        | str   | `running`, `success`, `timeout`, `immobilised` or `out_of_bounds` |
    | `is_success`     | bool  | the goal was reached                                              |
    | `traversability` | float | observed λ in the step; 1 after a reset                           |
    | `distance_m`     | float | distance to the goal                                              |

    ## Version history
    * v0 of benchnav 0.9: layers of the dataset.
    * v0 of benchnav 0.3: `world` instead of `noise` and `time_budget_s`.
    * v0 of benchnav 0.2: `robot` instead of `dynamics`; `objective`, `goal_radius_m`
      and `is_success` are new; `split` is `train` by default, was `test/std`; `noise`
      "stored", was "frozen".
    * v0 of benchnav 0.1: first version.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - the base class's contract
    _batch: "EnvBatch"

    def __init__(self, render_mode: str | None = None, **arguments: Any) -> None:
        """Load the maps of the split; see the class."""
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
        """Start an episode; see the class."""
        checked = guard.read_options(options, ("map",), self._batch.maps)
        super().reset(seed=seed)
        self._batch.reset([self.np_random], np.array([True]), checked.get("map"))
        return _only(*self._batch.observe())

    def step(
        self, action: np.ndarray
    ) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Take one time step; see the class."""
        numbers = guard.read_numbers(action, self.action_space.shape)
        result = self._batch.step(numbers[None])
        reward, terminated, truncated, traversability = result
        observation, info = _only(*self._batch.observe(traversability))
        return observation, reward.item(), terminated.item(), truncated.item(), info


class OffRoadVectorEnv(VectorEnv[Any, np.ndarray, np.ndarray]):
    """Batch of `OffRoadEnv`, with next-step autoreset.

    Sub-environment i seeded with s equals the single environment seeded with s + i.
    `info` contains arrays; its `outcome` is an integer, see
    `benchnav.planning.world.outcome.Outcome`. Arguments, spaces and rewards are as in
    `OffRoadEnv`.

    Args:
        num_envs: number of sub-environments.
        arguments: arguments of `OffRoadEnv`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "autoreset_mode": AutoresetMode.NEXT_STEP,
        "render_modes": [],
    }
    _batch: "EnvBatch"

    def __init__(
        self, num_envs: int = 1, render_mode: str | None = None, **arguments: Any
    ) -> None:
        """Load the maps of the split; see the class."""
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
        """Start an episode in all sub-environments, or in some.

        Args:
            seed: seed of the sub-environments that start; if None, their generators
                continue.
            options: `map`, the index of a map; and `reset_mask`, a mask of the
                sub-environments that start, bool, shape [B]. By default, all start.

        Raises:
            ConfigError: If an option is unknown or invalid.
            ResetNeeded: If the first reset does not include all sub-environments.
        """
        options = guard.read_options(options, ("map", "reset_mask"), self._batch.maps)
        default = np.ones(self.num_envs, dtype=bool)
        chosen = np.asarray(options.get("reset_mask", default))
        is_mask = chosen.shape == default.shape and chosen.dtype == bool
        expect(
            is_mask and chosen.any(),
            f"option `reset_mask` as bool of shape [{self.num_envs}] with at least one "
            f"True, got {chosen}.",
        )
        if not self._generators and not chosen.all():
            raise gymnasium.error.ResetNeeded(
                "Call reset() without `reset_mask` first."
            )
        if seed is not None or not self._generators:
            _, root = seeding.np_random(seed)
            generators = []
            for i in range(self.num_envs):
                generator, _ = seeding.np_random(root + i)
                generators.append(generator)
            for i in np.flatnonzero(~chosen).tolist():
                generators[i] = self._generators[i]
            self._generators = generators
        self._batch.reset(self._generators, chosen, options.get("map"))
        self._ended = self._ended & ~chosen
        return self._batch.observe()

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observations, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one time step; sub-environments whose episode has ended reset instead.

        Raises:
            ConfigError: If the actions are invalid. Then no episode is reset.
            ResetNeeded: If no episode has begun.
        """
        ended = self._ended
        actions = self._batch.read_actions(actions, ended)
        if ended.any():
            self._batch.reset(self._generators, ended, None)
        reward, terminated, truncated, traversability = self._batch.step(
            actions, hold=ended
        )
        self._ended = terminated | truncated
        observations, info = self._batch.observe(traversability)
        return observations, reward, terminated, truncated, info


def _only(
    observations: Observations, info: Observations
) -> tuple[Observations, dict[str, Any]]:
    """Return observation and info of the only episode, with the outcome's name."""
    observation = {name: values[0] for name, values in observations.items()}
    diagnostics = {name: values[0].item() for name, values in info.items()}
    outcome = Outcome(diagnostics["outcome"])
    diagnostics["outcome"] = outcome.name.lower()
    return observation, diagnostics
