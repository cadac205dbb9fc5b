"""Sub-environments of `benchnav/OffRoad-v1`, stepped as one batch.

Letters in shapes: B sub-environments, H×W cells of the map, N×N cells of the crop, S
state and A action dimensions.
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
from benchnav.planning.sensing.belief import Belief, CovarianceModel
from benchnav.planning.sensing.knowledge import Truth, sensor_keys
from benchnav.planning.sensing.learner import Learner
from benchnav.planning.sensing.sensor import Sensor
from benchnav.planning.world.outcome import Outcome

if TYPE_CHECKING:
    from benchnav.env.picture import Picture


@dataclass(frozen=True, kw_only=True)
class Perception:
    """Options of sensing, prediction, belief, observations and actions.

    See `EgocentricEnv`.

    Args:
        sensor: appearance sensor.
        ground: traversability sensor.
        model: model that predicts λ. If empty, `oracle`, with a warning.
        risk: risk measure of λ̂.
        belief: update of the prediction by measured λ.
        unseen: belief of unobserved terrain.
        replan_every_s: time between two updates of the knowledge, in seconds.
        crop_cells: N, number of rows and of columns of the crop, ≥ 2.
        crop_behind: fraction of the crop's length that is behind the robot, in [0, 1).
        normalised_actions: whether actions are in [−1, 1].
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
    """B sub-environments as one batch; see `EgocentricEnv`.

    Args:
        size: B.
        drawn: whether to store the data of pictures.
        arguments: fields of `Perception`, and arguments of `EnvBatch`.
    """

    def __init__(self, size: int, *, drawn: bool = False, **arguments: Any) -> None:
        """Load the maps of the split, and the model.

        Raises:
            ConfigError: If an argument is invalid, or the world resamples λ at each
                step but the belief learns or the model is `clairvoyant`.
        """
        options = {}
        for field in fields(Perception):
            if field.name in arguments:
                options[field.name] = arguments.pop(field.name)
        perception = Perception(**options)
        self.view = View(cells=perception.crop_cells, behind=perception.crop_behind)
        super().__init__(size, **arguments)
        rules = replace(
            self._task.rules,
            unseen=perception.unseen,
            replan_every_s=perception.replan_every_s,
        )
        self._task = replace(self._task, rules=rules)
        model = perception.model
        if isinstance(model, str) and not model:
            guard.warn_of_default_model()
            model = "oracle"
        predictor: Any = model
        if not isinstance(model, TraversabilityModel):
            predictor = load_model(model)
        mismatch = class_mismatch(predictor, self._dataset.recipe)
        if mismatch:
            guard.warn(f"{mismatch}.")
        sensor: Any = registry.take("sensor", perception.sensor)
        belief: Any = registry.take("belief", perception.belief)
        is_clairvoyant = isinstance(predictor, Clairvoyant)
        needs_fixed_field = belief.learns or is_clairvoyant
        has_fixed_field = self._world.noise != "resampled"
        expect(
            has_fixed_field or not needs_fixed_field,
            "a world of fixed λ for the model 'clairvoyant' or a belief that learns, "
            "got `noise` 'resampled'. Pass world='stakes'.",
        )
        statistics = None
        if not sensor.sees_all or belief.needs_statistics:
            source: Any = "oracle" if predictor is model else model
            statistics = find_ground_statistics(source, self._dataset)
        measure = perception.risk
        if not callable(measure):
            measure = registry.make("risk", measure)
        ground: Any = registry.take("ground", perception.ground)
        learner = Learner(
            sensor=sensor,
            ground=ground.mounted(self._task.robot),
            belief=belief,
            covariance=self._covariance(predictor, statistics),
            measure=measure,
            rules=rules,
            predict=partial(predict, predictor),
            keeps_spread=True,
        )
        update_steps = steps_in(perception.replan_every_s, self._task.robot.dt_s)
        self._experience = Experience(
            self._task, learner, update_steps, is_cacheable=not is_clairvoyant
        )
        self._bounds: tuple[Tensor, Tensor] | None = None
        if perception.normalised_actions:
            low = torch.from_numpy(self.action_space.low.copy())
            high = torch.from_numpy(self.action_space.high.copy())
            self._bounds = (low, high)
            shape = self.action_space.shape
            self.action_space = spaces.Box(-1.0, 1.0, shape, np.float32)
        self._observed = np.ones(size, np.float32)
        self._picture = _make_picture(self._maps.grid) if drawn else None
        self._tracks: list[list[np.ndarray]] = [[] for _ in range(size)]

    def reset(
        self,
        generators: Sequence[np.random.Generator],
        chosen: np.ndarray,
        map_index: int | None,
    ) -> None:
        """Start new episodes in some sub-environments; see `EnvBatch`."""
        super().reset(generators, chosen, map_index)
        _, now = self._current()
        members = torch.from_numpy(np.flatnonzero(chosen))
        field = self._field()
        maps = torch.from_numpy(self._map[chosen])
        seeds = self._noise_seed[chosen]
        is_sensing = torch.from_numpy(chosen)
        root_key = rng.stream_key(0, "environment")
        with torch.inference_mode(False), torch.no_grad():
            truth = Truth(
                terrain=self._maps.select(maps),
                field=field[members],
                keys=sensor_keys(root_key, seeds.tolist()),
            )
            self._experience.begin(members, maps.tolist(), truth, now.state[members])
            self._experience.learn(now.step, now.state, field, is_sensing)
        for member in np.flatnonzero(chosen):
            self._tracks[member] = []
        self._extend_tracks(chosen)

    def step(
        self, actions: np.ndarray, hold: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Take a time step in all sub-environments except those in `hold`, and sense.

        See `EnvBatch`.
        """
        _, before = self._current()
        result = super().step(actions, hold)
        _, now = self._current()
        has_stepped = now.step > before.step
        field = self._field()
        with torch.inference_mode(False), torch.no_grad():
            self._experience.learn(now.step, now.state, field, has_stepped)
        self._extend_tracks(has_stepped.numpy())
        return result

    def observe(
        self, traversability: np.ndarray | None = None
    ) -> tuple[Observations, Observations]:
        """Return crops, state vectors and diagnostics; see `EnvBatch`."""
        simulation, now = self._current()
        info = self._diagnose(traversability)
        self._observed = info["traversability"]
        time_s = now.step * self._task.robot.dt_s
        time_left = 1 - time_s / simulation.time_budget_s
        tensors = self.view.observe(
            self._maps.grid,
            self._experience.map_knowledge,
            now.state,
            self._goal_m(),
            torch.from_numpy(self._observed),
            time_left,
        )
        observations = {name: values.numpy() for name, values in tensors.items()}
        return observations, info

    def draw(self, member: int) -> np.ndarray:
        """Return the image of a sub-environment, uint8, shape [480, 640, 3]."""
        from benchnav.env.picture import Scene

        _, now = self._current()
        assert self._picture is not None, "created without a render mode"
        indices = torch.tensor([member])
        knowledge = self._experience.map_knowledge.select(indices)
        state = now.state[indices]
        grid = self._maps.grid
        map_index = int(self._map[member])
        crops = self.view.crop(grid, knowledge, state)
        corners_m = self.view.corners_m(grid, state)
        n_steps = int(now.step[member])
        outcome = Outcome(int(now.outcome[member]))
        scene = Scene(
            rgb=self._maps.rgb[map_index].numpy(),
            seen=knowledge.seen[0].numpy(),
            crop=crops[0].numpy(),
            corners_m=corners_m[0].numpy(),
            behind=self.view.behind,
            state=state[0].numpy(),
            goal_m=self._goal_m()[member].numpy(),
            track=np.array(self._tracks[member]),
            time_s=n_steps * self._task.robot.dt_s,
            observed=float(self._observed[member]),
            outcome=outcome.name.lower(),
        )
        return self._picture.draw(scene)

    def _covariance(
        self, model: TraversabilityModel, statistics: GroundStatistics | None
    ) -> CovarianceModel:
        """Return the covariance model of the λ field."""
        recipe = self._dataset.recipe
        correlation_m = self._world.correlation_m
        if self._world.noise == "stored":
            correlation_m = recipe.correlation_m
        class_names = tuple(item.name for item in recipe.classes)
        return CovarianceModel(
            grid=self._maps.grid,
            correlation_m=correlation_m,
            nugget=nugget_of(model),
            statistics=statistics,
            class_names=model.class_names or class_names,
        )

    def _field(self) -> Tensor:
        """Return the λ field that sensors receive, shape [B, H, W].

        If λ is resampled at each step, sensors of λ are not used, and the stored λ of
        the maps is returned.
        """
        simulation, _ = self._current()
        if simulation.field is None:
            return self._maps.traversability[self._map]
        return simulation.field

    def _command(self, action: Tensor) -> Tensor:
        if self._bounds is None:
            return action
        low, high = self._bounds
        return low + (action + 1) / 2 * (high - low)

    def _extend_tracks(self, chosen: np.ndarray) -> None:
        """Append the positions of the chosen robots (mask, bool, [B]) to their tracks."""
        if self._picture is None:
            return
        _, now = self._current()
        for member in np.flatnonzero(chosen):
            position = now.state[member, :2].numpy().copy()
            self._tracks[member].append(position)

    def _observation_space(self) -> spaces.Dict:
        cells = self.view.cells
        initial_state = self._task.robot.initial_state(torch.zeros(1, 3))
        crop_low = np.zeros((len(CHANNELS), cells, cells), np.float32)
        crop_low[CHANNELS.index("rise")] = -1
        crop_high = np.ones_like(crop_low)
        low, high = bounds(initial_state.shape[1])
        state_low = np.array(low, np.float32)
        state_high = np.array(high, np.float32)
        crop = spaces.Box(crop_low, crop_high, dtype=np.float32)
        state = spaces.Box(state_low, state_high, dtype=np.float32)
        return spaces.Dict({"crop": crop, "state": state})


def _make_picture(grid: Grid) -> "Picture":
    # Matplotlib is imported here, since it takes longer than all other imports.
    from benchnav.env.picture import Picture

    return Picture(grid)
