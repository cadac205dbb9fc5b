"""Gymnasium environment `benchnav/OffRoad-v1`, single and vectorised.

The robot updates its knowledge during the episode. Observations contain its current
knowledge, in its own frame; they never contain the truth.
Letters in shapes: B sub-environments, N×N cells of the crop, S state dimensions.
"""

from typing import Any

import numpy as np

from benchnav.env import guard
from benchnav.env.batch import Observations
from benchnav.env.egocentric_batch import EgocentricBatch
from benchnav.env.environment import OffRoadEnv, OffRoadVectorEnv


class EgocentricEnv(OffRoadEnv):
    """Partially observed task: drive to the goal, learning about λ during the episode.

    ## Arguments
    `gymnasium.make("benchnav/OffRoad-v1", …)` takes the arguments of
    `benchnav/OffRoad-v0` (`data`, `split`, `robot`, `objective`, `world`,
    `goal_radius_m`), and the following. `make_vec` takes the same arguments, and
    `num_envs`. A part is passed as in a suite: a name, `name:VALUE`, `file.py:Name`,
    `{"part": NAME, "options": {…}}`, or the part itself.

    | argument             | default     | meaning                                                            |
    |----------------------|-------------|--------------------------------------------------------------------|
    | `sensor`             | `"full"`    | appearance sensor                                                  |
    | `ground`             | `"contact"` | traversability sensor                                              |
    | `model`              | `""`        | model that predicts λ; if empty, `oracle`, with a warning          |
    | `risk`               | `"mean"`    | risk measure of λ̂                                                  |
    | `belief`             | `"static"`  | update of the prediction by measured λ; `"copula"` learns from it  |
    | `unseen`             | `"prior"`   | belief of unobserved terrain; or `"optimistic"`, `"pessimistic"`   |
    | `replan_every_s`     | `0.5`       | time between two updates of the knowledge [s]                      |
    | `crop_cells`         | `32`        | N: rows and columns of the crop, in cells of the map               |
    | `crop_behind`        | `1/3`       | fraction of the crop behind the robot; at 0.5 it is in the middle  |
    | `normalised_actions` | `False`     | whether actions are in [−1, 1], scaled to the robot's bounds       |
    | `render_mode`        | `None`      | `"rgb_array"`, or `"human"` for a window                           |

    `oracle` is privileged: it is given the true distribution of λ in each cell. It
    works on every dataset. For results that a robot can reach, pass a checkpoint that
    was trained on maps of the same kind, such as `model="stakes-v1"`.

    ## Action space
    A `Box` of the robot's bounds, float32, as in v0. With `normalised_actions`, a `Box`
    of [−1, 1], which is scaled to the bounds. Actions beyond it are clipped.

    ## Observation space
    A `Dict` of two keys, float32. `crop`, shape (4, N, N), is the terrain around the
    robot, turned with it. The centre of its cell [i, j] is (j + ½)·res −
    `crop_behind`·N·res ahead of the robot and (i + ½)·res − ½·N·res to its left, where
    res is the edge length of the map's cells. It has the value of the map's cell that
    contains this centre; all channels are 0 off the map.

    | channel | range    | meaning                                                                            |
    |---------|----------|------------------------------------------------------------------------------------|
    | 0       | [0, 1]   | λ̂: risk measure of the belief                                                      |
    | 1       | [0, 1]   | spread: width of the interval from the 16 % to the 84 % quantile of λ              |
    | 2       | [−1, 1]  | elevation relative to the robot's cell, over ½·N·res, clipped; 0 where unobserved  |
    | 3       | {0, 1}   | known: 1 where the terrain was observed                                            |

    `state`, shape (5 + S − 3,), where S is the number of the robot's states (3 for the
    unicycle and the bicycle):

    | index | range   | meaning                                                                       |
    |-------|---------|-------------------------------------------------------------------------------|
    | 0     | [0, 1]  | d / (d + ½·N·res), where d is the distance to the goal                        |
    | 1, 2  | [−1, 1] | cosine and sine of the goal's bearing, 0 straight ahead, positive to the left |
    | 3     | [0, 1]  | λ that the robot observed in the last step; 1 after a reset                   |
    | 4     | [0, 1]  | remaining fraction of the time budget T                                       |
    | 5 …   | [−1, 1] | the robot's state beyond (x, y, θ), such as velocities: x / (1 + \\|x\\|)         |

    ## Hidden quantities
    The following are hidden: λ of all cells that the sensors did not measure; the true
    distribution of λ, unless the model is privileged; the dwell time on immobilising
    terrain, after which the episode ends; T, except for its remaining fraction; the
    robot's position and heading on the map; knowledge of terrain beyond the crop; and
    the time until the next update.

    ## Knowledge
    Knowledge is updated as in `benchnav-eval`. With a belief that learns, λ is sensed
    at each step. The appearance sensor observes at the start and every
    `replan_every_s`. Then the model predicts from its observations, the belief is
    conditioned on the measured λ, and λ̂ and spread change. Each episode has its own
    sensor noise, which follows from the seed. A belief that learns from λ, such as
    `"copula"`, needs a world of fixed λ, such as `"stakes"`. The belief of unobserved
    terrain comes from the checkpoint's training maps. For privileged models, it comes
    from the dataset or its recipe.

    ## Reward, world, start, end and info
    These are as in `benchnav/OffRoad-v0`, see `OffRoadEnv`.

    ## Rendering
    `render()` returns an image of 640×480 pixels, uint8, shape (480, 640, 3). It shows
    the map's colours, darker where the terrain is unobserved, with path, robot, goal
    and the outline of the crop. Next to the map are λ̂ and spread as observed, with the
    robot facing up. With `"human"`, a window shows it after each reset and step.

    ## Version history
    * v1 of benchnav 0.11: first version.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array", "human"],
        "render_fps": 10,
    }
    _batch: EgocentricBatch

    def __init__(self, render_mode: str | None = None, **arguments: Any) -> None:
        """Load the maps of the split, and the model; see the class."""
        super().__init__(render_mode, **arguments, drawn=render_mode is not None)
        self.render_mode = render_mode
        if not guard.has_display():
            self.metadata = {**self.metadata, "render_modes": ["rgb_array"]}
        self._window = None
        if render_mode == "human":
            from benchnav.env.picture import Window

            self._window = Window()

    @staticmethod
    def _make_batch(size: int, **arguments: Any) -> EgocentricBatch:
        return EgocentricBatch(size, **arguments)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode; see the class."""
        result = super().reset(seed=seed, options=options)
        self._show()
        return result

    def step(
        self, action: np.ndarray
    ) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Take one time step; see the class."""
        result = super().step(action)
        self._show()
        return result

    def render(self) -> Any:
        """Return the image of the last step in mode `"rgb_array"`, else None."""
        if self.render_mode is None:
            guard.warn(
                "render() draws no image, since `render_mode` is None. Create the "
                'environment with `render_mode="rgb_array"` or "human".'
            )
        if self.render_mode != "rgb_array":
            return None
        return self._batch.draw(0)

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()

    def _show(self) -> None:
        if self._window is not None:
            self._window.show(self._batch.draw(0))


class EgocentricVectorEnv(OffRoadVectorEnv):
    """Batch of `EgocentricEnv`, with next-step autoreset.

    Sub-environment i seeded with s equals the single environment seeded with s + i.
    Arguments, spaces and rewards are as in `EgocentricEnv`; `render()` returns an image
    of each sub-environment. `reset(options={"reset_mask": mask})` restarts only the
    sub-environments of the mask, bool, shape [B]; the next step does not reset them
    again.

    Args:
        num_envs: number of sub-environments.
        render_mode: `"rgb_array"` or None.
        arguments: arguments of `EgocentricEnv`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        **OffRoadVectorEnv.metadata,
        "render_modes": ["rgb_array"],
        "render_fps": 10,
    }
    _batch: EgocentricBatch

    def __init__(
        self, num_envs: int = 1, render_mode: str | None = None, **arguments: Any
    ) -> None:
        """Load the maps of the split, and the model; see the class."""
        super().__init__(
            num_envs, render_mode, **arguments, drawn=render_mode is not None
        )
        self.render_mode = render_mode

    @staticmethod
    def _make_batch(size: int, **arguments: Any) -> EgocentricBatch:
        return EgocentricBatch(size, **arguments)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return an image of each sub-environment; None without a `render_mode`."""
        if self.render_mode is None:
            return None
        return tuple(self._batch.draw(member) for member in range(self.num_envs))
