"""The Gymnasium environment `benchnav/OffRoad-v0`, single and vectorised, and what all
versions share.

Observations hold what a robot may know: where it is, its goal, and the paper's
Observation of the map;
never the truth. Letters in shapes: B sub-environments, H×W cells, S state and A action
dimensions.
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
    """Drive to the goal over terrain of uncertain traversability λ; partially observed.

    ## Arguments
    Of `gymnasium.make("benchnav/OffRoad-v0", …)`; `make_vec` takes the same, and
    `num_envs`.

    | argument        | default       | meaning                                                              |
    |-----------------|---------------|----------------------------------------------------------------------|
    | `data`          | `"paper-v1"`  | path or id of a dataset                                              |
    | `split`         | `""`          | which of its splits; empty for `train`, else its first, with a warning |
    | `robot`         | `"unicycle"`  | F: a name, `file.py:Name`, `{"part": NAME, "options": {…}}`, or a robot |
    | `objective`     | `""`          | J, likewise; empty for the shaped reward                             |
    | `world`         | `""`          | what λ does: `"paper"` (default, warns), `"stakes"`, or changes to one |
    | `goal_radius_m` | `1.0`         | a robot this near to its goal has arrived                            |

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

    and, where the dataset has layers, one key a layer by its name, such as
    `vegetation_m`: float32, (H, W), 0 where nothing is known.

    S is 3 for the unicycle and the bicycle, 5 for the differential drive, whose
    velocities v and ω follow.

    The episode is partially observed. Hidden are λ of all cells and the λ met in the
    last step, the class of terrain and the true distribution of λ, the dwell time on
    immobilising terrain, the time since the start, and T.

    ## Reward
    Without `objective`: metres gained toward the goal, −0.1 a second, +10 on arrival
    and −10 off the map or where the ground immobilises the robot for good. With one:
    minus its stage cost, read at the state before the step and the observed λ there. A
    step that loses the robot in one of these ways costs as much again for each step
    that is left, as if the robot stood there until T.

    ## World
    `"paper"`: λ is drawn anew at each step, low λ ends nothing, T = 100 s. `"stakes"`:
    λ is drawn once an episode as a correlated field; 2 s on λ under 0.1 end it; T is 3
    × the map's reference time at top speed. Changes are given as a mapping, such as
    `{"preset": "stakes", "correlation_m": 2.0}`, `{"noise": "stored", "time_budget_s":
    60.0}` or `{"preset": "stakes", "immobile": None}`; see
    `benchnav.planning.world.world.World`.

    ## Start and end
    An episode starts at the start of a map of the split, drawn at random or given by
    `options={"map": i}`, heading at the goal. It terminates at the goal, off the map,
    or where the world says that the ground immobilises the robot for good; and is
    truncated after T. A step after the end raises `gymnasium.error.ResetNeeded`. Other
    options and other types of `map` raise `ConfigError`.

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
    * v0 of benchnav 0.2: `robot` in place of `dynamics`; `objective`, `goal_radius_m`
      and `is_success` are new; `split` is `train` by default, was `test/std`; `noise`
      "stored", was "frozen".
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

    def step(
        self, action: np.ndarray
    ) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Takes one time step; see the class."""
        reward, terminated, truncated, met = self._batch.step(
            guard.read_numbers(action, self.action_space.shape)[None]
        )
        observation, info = _only(*self._batch.observe(met))
        return observation, reward.item(), terminated.item(), truncated.item(), info


class OffRoadVectorEnv(VectorEnv[Any, np.ndarray, np.ndarray]):
    """Many `OffRoadEnv` stepped as one batch, with next-step autoreset.

    Sub-environment i seeded with s is the single environment seeded with s + i. `info`
    holds arrays; its `outcome` is a number, see
    `benchnav.planning.world.outcome.Outcome`. Arguments, spaces and rewards are those
    of `OffRoadEnv`.

    Args:
        num_envs: how many.
        arguments: those of `OffRoadEnv`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "autoreset_mode": AutoresetMode.NEXT_STEP,
        "render_modes": [],
    }
    _batch: "EnvBatch"

    def __init__(
        self, num_envs: int = 1, render_mode: str | None = None, **arguments: Any
    ) -> None:
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
        """Starts an episode in each sub-environment, or in those of
        `options={"reset_mask": …}`, bool [B].
        """
        given = guard.read_options(options, ("map", "reset_mask"), self._batch.maps)
        every = np.ones(self.num_envs, dtype=bool)
        chosen = np.asarray(given.get("reset_mask", every))
        fits = chosen.shape == every.shape and chosen.dtype == bool and chosen.any()
        expect(
            fits,
            f"option `reset_mask` as bool of shape [{len(every)}], at least one true, "
            f"got {chosen}.",
        )
        if not self._generators and not chosen.all():
            raise gymnasium.error.ResetNeeded(
                "Call reset() of all sub-environments before that of some."
            )
        if seed is not None or not self._generators:
            _, root = seeding.np_random(seed)
            fresh = [seeding.np_random(root + i)[0] for i in range(self.num_envs)]
            self._generators = [
                new if anew else old
                for new, old, anew in zip(
                    fresh, self._generators or fresh, chosen, strict=True
                )
            ]
        self._batch.reset(self._generators, chosen, given.get("map"))
        self._ended = self._ended & ~chosen
        return self._batch.observe()

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observations, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one time step, or reset where the last one ended an episode; raise
        before anything is reset.
        """
        ended = self._ended
        actions = self._batch.read_actions(actions, ended)
        if ended.any():
            self._batch.reset(self._generators, ended, None)
        reward, terminated, truncated, met = self._batch.step(actions, hold=ended)
        self._ended = terminated | truncated
        observations, info = self._batch.observe(met)
        return observations, reward, terminated, truncated, info


def _only(
    observations: Observations, info: Observations
) -> tuple[Observations, dict[str, Any]]:
    """What there is of the one sub-environment of a batch; its outcome by name."""
    diagnostics = {name: values[0].item() for name, values in info.items()}
    diagnostics["outcome"] = Outcome(diagnostics["outcome"]).name.lower()
    return {name: values[0] for name, values in observations.items()}, diagnostics
