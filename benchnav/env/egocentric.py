"""The Gymnasium environment `benchnav/OffRoad-v1`, single and vectorised: a robot that
learns on its way.

Observations hold what the robot knows by now, seen from where it stands; never the
truth. Letters in shapes: B sub-environments, N×N cells of the crop, S state and A
action dimensions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from benchnav.core import registry, rng
from benchnav.core.errors import expect
from benchnav.core.grid import Grid
from benchnav.core.ground import GroundStatistics
from benchnav.env import guard
from benchnav.env.batch import AnyPart, EnvBatch, Observations
from benchnav.env.environment import OffRoadEnv, OffRoadVectorEnv
from benchnav.env.experience import Experience
from benchnav.env.view import CHANNELS, View, bounds
from benchnav.models.base import TraversabilityModel, predict
from benchnav.models.predictor import (
    Clairvoyant,
    class_mismatch,
    find_ground_statistics,
    load_model,
    nugget_of,
)
from benchnav.planning.robots import steps_in
from benchnav.planning.sensing.belief import Belief, Law
from benchnav.planning.sensing.knowledge import Learner, Truth, sensor_keys
from benchnav.planning.sensing.sensor import Sensor
from benchnav.planning.world.outcome import Outcome

if TYPE_CHECKING:
    from benchnav.env.picture import Picture


class EgocentricEnv(OffRoadEnv):
    """Drive to the goal over ground of uncertain traversability λ, by what is known of
    it; partially observed.

    ## Arguments
    Of `gymnasium.make("benchnav/OffRoad-v1", …)`: those of `benchnav/OffRoad-v0`
    (`data`, `split`, `robot`, `objective`, `world`, `goal_radius_m`), and those below;
    `make_vec` takes the same, and `num_envs`. Parts are named
    as in a suite: a name, `name:VALUE`, `file.py:Name`, `{"part": NAME, "options":
        {…}}`, or the part itself.

    | argument             | default     | meaning                                                          |
    |----------------------|-------------|------------------------------------------------------------------|
    | `sensor`             | `"full"`    | what of the ground's looks the robot sees                        |
    | `ground`             | `"contact"` | which λ it senses                                                |
    | `model`              | `""`        | predicts λ from what was seen; empty for `oracle`, with a warning |
    | `risk`               | `"mean"`    | risk measure that gives λ̂                                        |
    | `belief`             | `"static"`  | what is made of sensed λ; `"copula"` learns from it              |
    | `unseen`             | `"prior"`   | what is believed of unseen ground; or `"optimistic"`, `"pessimistic"` |
    | `replan_every_s`     | `0.5`       | time between two updates of what is known                        |
    | `crop_cells`         | `32`        | N: rows and columns of the crop, of the map's cells              |
    | `crop_behind`        | `1/3`       | share of the crop that is behind the robot; 0.5 has it in the middle |
    | `normalised_actions` | `False`     | actions are in [−1, 1], which stands for the robot's bounds      |
    | `render_mode`        | `None`      | `"rgb_array"`, or `"human"` for a window                         |

    `oracle` is privileged: it knows the true distribution of λ in each cell, and fits
    every dataset. For results that a robot could have, name a checkpoint that was
    trained on such maps, such as `model="stakes-v1"`.

    ## Action space
    A `Box` of the robot's bounds, float32, as of v0; with `normalised_actions` a `Box`
    of [−1, 1] whose ends stand for the bounds. Actions beyond it are clipped.

    ## Observation space
    A `Dict` of two keys, float32. `crop`, shape (4, N, N), is the ground around the
    robot, turned with it. The centre of its cell [i, j] is (j + ½)·res −
    `crop_behind`·N·res ahead of the robot and (i + ½)·res − ½·N·res to its left, where
    res is the edge length of the map's cells. Its value is that of the map's cell in
    which this centre lies; all channels are 0 off the map.

    | channel | range    | meaning                                                                      |
    |---------|----------|------------------------------------------------------------------------------|
    | 0       | [0, 1]   | λ̂ that the risk measure gives of what is believed                            |
    | 1       | [0, 1]   | spread: width of the interval from the 16 % to the 84 % quantile of λ        |
    | 2       | [−1, 1]  | elevation less that under the robot, over ½·N·res, clipped; 0 where not seen |
    | 3       | {0, 1}   | known: 1 where the ground was seen                                           |

    `state`, shape (5 + S − 3,), where S is the number of the robot's states (3 for the
    unicycle and the bicycle):

    | place | range   | meaning                                                                       |
    |-------|---------|-------------------------------------------------------------------------------|
    | 0     | [0, 1]  | d / (d + ½·N·res), where d is the distance to the goal                        |
    | 1, 2  | [−1, 1] | cosine and sine of the goal's bearing, 0 straight ahead, positive to the left |
    | 3     | [0, 1]  | λ that the robot observed in the last step; 1 after a reset                   |
    | 4     | [0, 1]  | share of the time budget T that is left                                       |
    | 5 …   | [−1, 1] | what the robot's state has beyond (x, y, θ), such as velocities: x / (1 + \\|x\\|) |

    ## What is hidden
    λ of all cells but what the sensors measure; its true distribution, unless the model
    is privileged; the dwell time on immobilising terrain, after which the episode ends;
    T, of which only the fraction left is observed; the position and heading on the map;
    what is known of terrain beyond the crop; and the time until the next update.

    ## What is known
    As in `benchnav-eval`: a belief that learns has λ sensed at each step. The sensor of
    appearance looks at the start and every `replan_every_s`. Then the model predicts
    from what was seen, the belief is told what was sensed, and λ̂ and spread change.
    The noise of sensors is the episode's own, so that the same seed gives the same. A
    belief that learns from λ, such as `"copula"`, needs a world in which λ stays what
    it is, such as `"stakes"`. What is believed of unseen ground is what the checkpoint
    knows of its training maps; for privileged models it is what the dataset or its
    recipe brings.

    ## Reward, world, start, end and info
    As of `benchnav/OffRoad-v0`, see `OffRoadEnv`.

    ## Rendering
    `render()` gives an image of 640×480 pixels, uint8, shape (480, 640, 3): the map's
    colours, darker where the ground was not seen yet, with path, robot, goal, and the
    outline of the crop; beside it λ̂ and spread as they are observed, the robot looking
    up. With `"human"` it is shown in a window after each reset and step.

    ## Version history
    * v1 of benchnav 0.11: first version.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array", "human"],
        "render_fps": 10,
    }
    _batch: "EgocentricBatch"

    def __init__(self, render_mode: str | None = None, **arguments: Any) -> None:
        """Loads the maps of the split, and the model; see the class."""
        super().__init__(render_mode, **arguments, drawn=render_mode is not None)
        self.render_mode = render_mode
        if not guard.has_display():
            self.metadata = {**self.metadata, "render_modes": ["rgb_array"]}
        self._window = None
        if render_mode == "human":
            from benchnav.env.picture import Window

            self._window = Window()

    @staticmethod
    def _make_batch(size: int, **arguments: Any) -> "EgocentricBatch":
        return EgocentricBatch(size, **arguments)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Starts an episode; see the class."""
        answer = super().reset(seed=seed, options=options)
        self._show()
        return answer

    def step(
        self, action: np.ndarray
    ) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Takes one time step; see the class."""
        answer = super().step(action)
        self._show()
        return answer

    def render(self) -> Any:
        """The image of the last step in `"rgb_array"`; nothing in `"human"`, where it
        is shown already.
        """
        if self.render_mode is None:
            guard.warn(
                'render() draws nothing without `render_mode="rgb_array"` or "human".'
            )
        return self._batch.draw(0) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Closes the window."""
        if self._window is not None:
            self._window.close()

    def _show(self) -> None:
        if self._window is not None:
            self._window.show(self._batch.draw(0))


class EgocentricVectorEnv(OffRoadVectorEnv):
    """Many `EgocentricEnv` stepped as one batch, with next-step autoreset.

    Sub-environment i seeded with s is the single environment seeded with s + i.
    Arguments, spaces and rewards are those of `EgocentricEnv`; `render()` gives an
    image of each sub-environment. `reset(options={"reset_mask": mask})` starts anew
    those of the mask alone, bool, shape [B], which then do not start anew by
    themselves.

    Args:
        num_envs: how many.
        render_mode: `"rgb_array"` or None.
        arguments: those of `EgocentricEnv`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        **OffRoadVectorEnv.metadata,
        "render_modes": ["rgb_array"],
        "render_fps": 10,
    }
    _batch: "EgocentricBatch"

    def __init__(
        self, num_envs: int = 1, render_mode: str | None = None, **arguments: Any
    ) -> None:
        """Loads the maps of the split, and the model; see the class."""
        super().__init__(
            num_envs, render_mode, **arguments, drawn=render_mode is not None
        )
        self.render_mode = render_mode

    @staticmethod
    def _make_batch(size: int, **arguments: Any) -> "EgocentricBatch":
        return EgocentricBatch(size, **arguments)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """An image of each sub-environment, uint8; None without a `render_mode`."""
        if self.render_mode is None:
            return None
        return tuple(self._batch.draw(member) for member in range(self.num_envs))


@dataclass(frozen=True, kw_only=True)
class Perception:
    """What robots perceive, predict and believe, and how observations and actions show
    it; see `EgocentricEnv`.

    Args:
        sensor: what of the ground's looks is seen.
        ground: which λ is sensed.
        model: predicts λ; if empty, `oracle`, with a warning.
        risk: gives λ̂.
        belief: what is made of sensed λ.
        unseen: what is believed of ground that was not seen.
        replan_every_s: time between two updates of what is known.
        crop_cells: N.
        crop_behind: share of the crop that is behind the robot.
        normalised_actions: actions are in [−1, 1].
    """

    sensor: AnyPart | Sensor = "full"
    ground: AnyPart | Sensor = "contact"
    model: AnyPart | TraversabilityModel = ""
    risk: Any = "mean"
    belief: AnyPart | Belief[Any] = "static"
    unseen: str = "prior"
    replan_every_s: float = 0.5
    crop_cells: int = 32
    crop_behind: float = 1 / 3
    normalised_actions: bool = False


class EgocentricBatch(EnvBatch):
    """B sub-environments as one batch; see `EgocentricEnv` for what they are.

    Args:
        size: B.
        drawn: keeps what is needed to draw.
        arguments: fields of `Perception`, and arguments of `EnvBatch`.
    """

    def __init__(self, size: int, *, drawn: bool = False, **arguments: Any) -> None:
        """Loads the maps of the split, and the model."""
        own = {
            each.name: arguments.pop(each.name)
            for each in fields(Perception)
            if each.name in arguments
        }
        perception = Perception(**own)
        self.view = View(cells=perception.crop_cells, behind=perception.crop_behind)
        super().__init__(size, **arguments)
        unseen, replan_every_s = perception.unseen, perception.replan_every_s
        rules = replace(self._task.rules, unseen=unseen, replan_every_s=replan_every_s)
        self._task = replace(self._task, rules=rules)
        model, risk = perception.model, perception.risk
        if isinstance(model, str) and not model:
            guard.warn_of_default_model()
            model = "oracle"
        predictor: Any = (
            model if isinstance(model, TraversabilityModel) else load_model(model)
        )
        if mismatch := class_mismatch(predictor, self._dataset.recipe):
            guard.warn(f"{mismatch}.")
        sees: Any = registry.take("sensor", perception.sensor)
        believes: Any = registry.take("belief", perception.belief)
        clairvoyant = isinstance(predictor, Clairvoyant)
        expect(
            self._world.noise != "resampled" or not (believes.learns or clairvoyant),
            "a world whose λ stays what it is for a belief that learns, and for "
            "`clairvoyant`, got one of `noise` "
            "'resampled'. Take world='stakes'.",
        )
        statistics = None
        if not sees.sees_all or believes.needs_statistics:
            source: Any = "oracle" if isinstance(model, TraversabilityModel) else model
            statistics = find_ground_statistics(source, self._dataset)
        learner = Learner(
            sensor=sees,
            ground=registry.take("ground", perception.ground),
            belief=believes,
            law=self._law(predictor, statistics),
            measure=risk if callable(risk) else registry.make("risk", risk),
            rules=rules,
            predict=partial(predict, predictor),
            keeps_spread=True,
        )
        every = steps_in(replan_every_s, self._task.robot.dt_s)
        self._experience = Experience(learner, every, alike=not clairvoyant)
        self._bounds: tuple[Tensor, Tensor] | None = None
        if perception.normalised_actions:
            self._bounds = (
                torch.from_numpy(self.action_space.low.copy()),
                torch.from_numpy(self.action_space.high.copy()),
            )
            self.action_space = spaces.Box(
                -1.0, 1.0, self.action_space.shape, np.float32
            )
        self._met = np.ones(size, np.float32)
        self._picture = _make_picture(self._maps.grid) if drawn else None
        self._tracks: list[list[np.ndarray]] = [[] for _ in range(size)]

    def reset(
        self,
        generators: Sequence[np.random.Generator],
        chosen: np.ndarray,
        map_index: int | None,
    ) -> None:
        """Starts new episodes in the chosen sub-environments; see `EnvBatch`."""
        super().reset(generators, chosen, map_index)
        _, now = self._current()
        members, field = torch.from_numpy(np.flatnonzero(chosen)), self._field()
        maps, seeds = (
            torch.from_numpy(values[chosen]) for values in (self._map, self._noise_seed)
        )
        with torch.inference_mode(False), torch.no_grad():
            truth = Truth(
                terrain=self._maps.select(maps),
                field=field[members],
                keys=sensor_keys(rng.stream_key(0, "environment"), seeds.tolist()),
            )
            self._experience.begin(members, maps.tolist(), truth, now.state[members])
            self._experience.learn(now.step, now.state, field, torch.from_numpy(chosen))
        self._follow(chosen, anew=True)

    def step(
        self, actions: np.ndarray, hold: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Takes a time step in all sub-environments but those on hold, and senses
        there; see `EnvBatch`.
        """
        _, before = self._current()
        answer = super().step(actions, hold)
        _, now = self._current()
        moved = now.step > before.step
        with torch.inference_mode(False), torch.no_grad():
            self._experience.learn(now.step, now.state, self._field(), moved)
        self._follow(moved.numpy(), anew=False)
        return answer

    def observe(
        self, met: np.ndarray | None = None
    ) -> tuple[Observations, Observations]:
        """What the robots know, seen from where they are, and diagnostics; see
        `EnvBatch`.
        """
        simulation, now = self._current()
        info = self._diagnose(met)
        self._met = info["traversability"]
        seen = self.view.observe(
            self._maps.grid,
            self._experience.known,
            now.state,
            self._goal_m(),
            torch.from_numpy(self._met),
            1 - now.step * self._task.robot.dt_s / simulation.time_budget_s,
        )
        return {name: values.numpy() for name, values in seen.items()}, info

    def draw(self, member: int) -> np.ndarray:
        """The image of a sub-environment, uint8, shape [480, 640, 3]."""
        from benchnav.env.picture import Scene

        _, now = self._current()
        assert self._picture is not None, "made without a render mode"
        own = torch.tensor([member])
        known, state = self._experience.known.select(own), now.state[own]
        grid, at = self._maps.grid, int(self._map[member])
        return self._picture.draw(
            Scene(
                rgb=self._maps.rgb[at].numpy(),
                seen=known.seen[0].numpy(),
                crop=self.view.crop(grid, known, state)[0].numpy(),
                corners_m=self.view.corners_m(grid, state)[0].numpy(),
                behind=self.view.behind,
                state=state[0].numpy(),
                goal_m=self._goal_m()[member].numpy(),
                track=np.array(self._tracks[member]),
                time_s=int(now.step[member]) * self._task.robot.dt_s,
                observed=float(self._met[member]),
                outcome=Outcome(int(now.outcome[member])).name.lower(),
            )
        )

    def _law(
        self, model: TraversabilityModel, statistics: GroundStatistics | None
    ) -> Law:
        """How the λ of the maps hangs together."""
        recipe, world = self._dataset.recipe, self._world
        return Law(
            grid=self._maps.grid,
            correlation_m=recipe.correlation_m
            if world.noise == "stored"
            else world.correlation_m,
            nugget=nugget_of(model),
            statistics=statistics,
            class_names=model.class_names
            or tuple(item.name for item in recipe.classes),
        )

    def _field(self) -> Tensor:
        """λ of every cell, for sensors; where it is drawn anew at each step none is
        sensed, and it means nothing.
        """
        simulation, _ = self._current()
        return (
            self._maps.traversability[self._map]
            if simulation.field is None
            else simulation.field
        )

    def _command(self, action: Tensor) -> Tensor:
        if self._bounds is None:
            return action
        low, high = self._bounds
        return low + (action + 1) / 2 * (high - low)

    def _follow(self, members: np.ndarray, anew: bool) -> None:
        """Keeps where some robots drove, bool [B], for pictures."""
        if self._picture is None:
            return
        _, now = self._current()
        for member in np.flatnonzero(members):
            place = now.state[member, :2].numpy().copy()
            if anew:
                self._tracks[member] = []
            self._tracks[member].append(place)

    def _observation_space(self) -> spaces.Dict:
        cells, states = (
            self.view.cells,
            self._task.robot.initial_state(torch.zeros(1, 3)).shape[1],
        )
        low = np.zeros((len(CHANNELS), cells, cells), np.float32)
        low[CHANNELS.index("rise")] = -1
        least, most = (np.array(ends, np.float32) for ends in bounds(states))
        return spaces.Dict(
            {
                "crop": spaces.Box(low, np.ones_like(low), dtype=np.float32),
                "state": spaces.Box(least, most, dtype=np.float32),
            }
        )


def _make_picture(grid: Grid) -> "Picture":
    # Imported here, since Matplotlib takes longer than all else.
    from benchnav.env.picture import Picture

    return Picture(grid)
