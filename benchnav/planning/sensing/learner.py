"""Updates of robots' knowledge during an episode: sense, predict, infer λ, apply risk.

Letters in shapes: B episodes, S state dimensions, H×W cells, N cells of all maps
together.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from benchnav.core.batch import map_tensors
from benchnav.core.chosen import choose
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import expect
from benchnav.core.ground import GroundStatistics
from benchnav.core.terrain import Observation, Terrain
from benchnav.planning import risk
from benchnav.planning.free_space import Rules
from benchnav.planning.sensing.appearance import Memory, model_input, remember
from benchnav.planning.sensing.belief import Belief, CovarianceModel
from benchnav.planning.sensing.knowledge import (
    Knowledge,
    Truth,
    call_user_code,
    check_map,
    no_measurement,
    prior_of_unobserved,
)
from benchnav.planning.sensing.sensor import (
    Appearance,
    Measurement,
    NoiseKey,
    Sensor,
)
from benchnav.planning.world.outcome import Outcome

Predict = Callable[[Terrain, Observation], TraversabilityDistribution]
"""Function that returns a prediction for terrain, with its current λ, and an observation.

Only privileged models use the terrain.
"""


@dataclass(frozen=True, kw_only=True)
class Learner:
    """Parts that update the knowledge of robots.

    Args:
        sensor: appearance sensor.
        ground: traversability sensor.
        belief: belief about λ.
        covariance: covariance model of the λ field.
        measure: risk measure that returns λ̂.
        rules: rules of free space and of unobserved terrain.
        predict: the model; not called if the sensor observes the whole map.
        keeps_spread: whether the belief's spread is stored with λ̂, for policies.
    """

    sensor: Sensor
    ground: Sensor
    belief: Belief[Any]
    covariance: CovarianceModel
    measure: risk.RiskFunction
    rules: Rules
    predict: Predict
    keeps_spread: bool = False

    @property
    def statistics(self) -> GroundStatistics:
        """Statistics of the training maps, which unobserved terrain needs.

        Raises:
            ConfigError: If the covariance model has no statistics.
        """
        expect(
            self.covariance.statistics is not None,
            "`CovarianceModel.statistics` for a sensor that does not observe the whole "
            "map, got None. Use a model that has terrain statistics, or the sensor "
            "'full'.",
        )
        assert self.covariance.statistics is not None
        return self.covariance.statistics

    def begin(
        self,
        truth: Truth,
        robot_state: Tensor,
        prediction: TraversabilityDistribution | None,
    ) -> Knowledge:
        """Return the knowledge at the start: observed appearance, no measured λ.

        Args:
            truth: true state at the start, for the sensor and privileged models.
            robot_state: robot states, shape [B, S].
            prediction: prediction of the whole map if the sensor observes it at the
                start; else None.

        Raises:
            KnowledgeError: If the sensor, the model, the belief or the risk measure
                raises, or returns an invalid value.
        """
        memory = None
        seen = None
        observation = truth.terrain.observe()
        if not self.sensor.sees_all:
            noise_key = NoiseKey(truth.keys, 0)
            first = self._measurement(self.sensor, truth, robot_state, noise_key)
            assert first.appearance is not None
            memory = remember(Memory.empty(observation), first.appearance)
            seen = memory.seen
            observation, prediction = self._predict(memory, truth)
        assert prediction is not None
        belief_state = self.believe(prediction)
        risk_map, spread = self._measured(prediction)
        device = robot_state.device
        no_episodes = torch.zeros(len(robot_state), dtype=torch.bool, device=device)
        no_cells = torch.zeros_like(truth.field, dtype=torch.bool)
        return Knowledge(
            memory=memory,
            has_new_appearance=no_episodes,
            sensed=no_measurement(truth.field),
            ever_sensed=no_cells,
            footprint=no_cells.clone(),
            observation=observation,
            belief_state=belief_state,
            risk_map=risk_map,
            spread=spread,
            free=self.rules.free(risk_map, prediction, seen),
        )

    def believe(self, prediction: TraversabilityDistribution) -> Any:
        """Return the initial belief state, which follows from a prediction.

        Raises:
            KnowledgeError: If the belief raises.
        """
        # A custom belief may modify its input.
        prior = prediction.clone()
        return call_user_code(
            Outcome.BELIEF_ERROR, lambda: self.belief.init(prior, self.covariance)
        )

    def sense(
        self,
        knowledge: Knowledge,
        truth: Truth,
        robot_state: Tensor,
        step: int | Sequence[int],
        observes: Tensor,
        measures: Tensor,
    ) -> Knowledge:
        """Return the knowledge with the observations of a step added.

        λ is measured only for a belief that learns. Appearance is usually observed only
        before an update, since an observation in each step would take far longer and
        add little.

        Args:
            knowledge: current knowledge; it is not changed.
            truth: true state in this step.
            robot_state: robot states, shape [B, S].
            step: number of steps taken so far, one integer or one per episode.
            observes: mask of episodes that use the appearance sensor, bool, shape [B].
            measures: mask of episodes that use the sensor of λ, bool, shape [B].

        Returns:
            Knowledge of B episodes.

        Raises:
            KnowledgeError: If a sensor raises, or returns an invalid measurement.
        """
        noise_key = NoiseKey(truth.keys, step)
        no_cells = torch.zeros_like(knowledge.footprint)
        knowledge = replace(knowledge, footprint=no_cells)
        measures = measures & self.belief.learns
        for sensor, in_use in ((self.sensor, observes), (self.ground, measures)):
            if sensor.sees_all or not bool(in_use.any()):
                continue
            new = self._measurement(sensor, truth, robot_state, noise_key)
            knowledge = _with_traversability(knowledge, new, in_use)
            if new.appearance is not None and knowledge.memory is not None:
                memory = knowledge.memory
                knowledge = _with_appearance(knowledge, memory, new.appearance, in_use)
        return knowledge

    def update(self, knowledge: Knowledge, truth: Truth) -> tuple[Knowledge, Tensor]:
        """Update prediction, belief, λ̂ and free mask with new observations.

        Args:
            knowledge: current knowledge; it is not changed.
            truth: true state in this step, for privileged models.

        Returns:
            The new knowledge, and a mask of cells whose belief changed, bool, shape
            [B, H, W].

        Raises:
            KnowledgeError: If the model, the belief or the risk measure raises, or
                returns an invalid value.
        """
        has_new_appearance = bool(knowledge.has_new_appearance.any())
        if not has_new_appearance and not bool(knowledge.sensed.mask.any()):
            return knowledge, torch.zeros_like(knowledge.free)
        before = knowledge.belief_state
        observation = knowledge.observation
        prior = None
        if has_new_appearance and knowledge.memory is not None:
            observation, prior = self._predict(knowledge.memory, truth)
        after = call_user_code(
            Outcome.BELIEF_ERROR,
            lambda: self.belief.update(before, knowledge.sensed, prior),
        )

        def changed_cells() -> Tensor:
            cells = self.belief.changed(before, after)
            check_map("cells from `changed`", cells, torch.bool, knowledge.free)
            return cells

        changed = call_user_code(Outcome.BELIEF_ERROR, changed_cells)
        knowledge = replace(
            knowledge,
            has_new_appearance=torch.zeros_like(knowledge.has_new_appearance),
            sensed=no_measurement(knowledge.risk_map),
            observation=observation,
            belief_state=after,
        )
        if bool(changed.any()):
            knowledge = self._inferred(knowledge, changed)
        return knowledge, changed

    def at(self, knowledge: Knowledge, cells: Tensor) -> TraversabilityDistribution:
        """Return the distribution of λ in N cells, as a map of one row, [1, N].

        Args:
            knowledge: current knowledge.
            cells: mask of the N cells, bool, shape [B, H, W].

        Raises:
            KnowledgeError: If the belief raises, or returns an invalid value.
        """
        expected_shape = (1, int(cells.sum()))

        def believe() -> TraversabilityDistribution:
            believed = self.belief.at(knowledge.belief_state, cells)
            shape = believed.shape
            expect(
                shape == expected_shape,
                "`at` of the belief to return a distribution of shape "
                f"{list(expected_shape)}, got shape {list(shape)}.",
            )
            return believed

        return call_user_code(Outcome.BELIEF_ERROR, believe)

    def distribution(self, knowledge: Knowledge) -> TraversabilityDistribution:
        """Return the distribution of λ, shape [B, H, W].

        Raises:
            KnowledgeError: If the belief raises, or returns an invalid value.
        """

        def believe() -> TraversabilityDistribution:
            believed = self.belief.distribution(knowledge.belief_state)
            expected_shape = tuple(knowledge.free.shape)
            shape = getattr(believed, "shape", type(believed).__name__)
            expect(
                shape == expected_shape,
                "`distribution` of the belief to return a distribution of shape "
                f"{list(expected_shape)}, got {shape}.",
            )
            return believed

        return call_user_code(Outcome.BELIEF_ERROR, believe)

    def select(self, knowledge: Knowledge, members: Tensor) -> Knowledge:
        """Return the knowledge in the episodes at these indices (int64).

        Raises:
            KnowledgeError: If the belief raises.
        """
        belief_state = call_user_code(
            Outcome.BELIEF_ERROR,
            lambda: self.belief.select(knowledge.belief_state, members),
        )
        others = replace(knowledge, belief_state=None).select(members)
        return replace(others, belief_state=belief_state)

    def put(
        self, knowledge: Knowledge, members: Tensor, others: Knowledge
    ) -> Knowledge:
        """Return the knowledge with the episodes at these indices (int64) replaced.

        Raises:
            KnowledgeError: If the belief raises.
        """
        belief_state = call_user_code(
            Outcome.BELIEF_ERROR,
            lambda: self.belief.put(
                knowledge.belief_state, members, others.belief_state
            ),
        )
        without_state = replace(knowledge, belief_state=None)
        merged = without_state.put(members, replace(others, belief_state=None))
        return replace(merged, belief_state=belief_state)

    def _inferred(self, knowledge: Knowledge, changed: Tensor) -> Knowledge:
        """Return the knowledge with λ̂ and the free mask of changed cells updated."""
        believed = self.at(knowledge, changed)
        # A risk measure receives a batch of maps, [1, 1, N].
        batch = map_tensors(believed, lambda values: values[None])
        risk_map, spread = self._measured(batch)
        seen = None
        if knowledge.memory is not None:
            seen = knowledge.memory.seen[changed][None]
        free = call_user_code(
            Outcome.BELIEF_ERROR, lambda: self.rules.free(risk_map[0], believed, seen)
        )
        new_risk = risk_map.flatten().to(knowledge.risk_map.dtype)
        all_risk = knowledge.risk_map.index_put((changed,), new_risk)
        all_free = knowledge.free.index_put((changed,), free[0])
        updated = replace(knowledge, risk_map=all_risk, free=all_free)
        if knowledge.spread is None or spread is None:
            return updated
        new_spread = spread.flatten().to(knowledge.spread.dtype)
        all_spread = knowledge.spread.index_put((changed,), new_spread)
        return replace(updated, spread=all_spread)

    def _measured(
        self, believed: TraversabilityDistribution
    ) -> tuple[Tensor, Tensor | None]:
        """Return λ̂ and the spread of a batch of maps; None if spread is not stored."""

        def measure() -> tuple[Tensor, Tensor | None]:
            risk_map = risk.apply(self.measure, believed)
            spread = believed.spread() if self.keeps_spread else None
            return risk_map, spread

        return call_user_code(Outcome.MODEL_ERROR, measure)

    def _predict(
        self, memory: Memory, truth: Truth
    ) -> tuple[Observation, TraversabilityDistribution]:
        """Return the model's input and the prediction.

        In unobserved cells, the prediction is what `rules.unseen` assumes.
        """
        statistics = self.statistics
        observation = model_input(memory, statistics.layer_means)
        terrain = replace(truth.terrain, traversability=truth.field)
        predicted = call_user_code(
            Outcome.MODEL_ERROR, lambda: self.predict(terrain, observation)
        )
        seen = memory.seen
        unseen = prior_of_unobserved(
            statistics, self.rules.unseen, seen.shape, truth.field
        )
        return observation, choose(seen, predicted, unseen)

    def _measurement(
        self, sensor: Sensor, truth: Truth, robot_state: Tensor, noise_key: NoiseKey
    ) -> Measurement:
        """Return a sensor's measurement after validation."""

        def sense() -> Measurement:
            terrain = truth.terrain
            field = truth.field
            state = robot_state
            # A custom sensor may modify its inputs; sensors of this package do not.
            if not type(sensor).__module__.startswith("benchnav."):
                terrain = terrain.clone()
                field = field.clone()
                state = state.clone()
            measurement = sensor.sense(terrain, field, state, noise_key)
            _check_measurement(measurement, truth.field)
            expect(
                sensor is not self.sensor or measurement.appearance is not None,
                "`Measurement.appearance` from an appearance sensor, got None. If the "
                "sensor measures traversability, list it under `grounds`.",
            )
            return measurement

        return call_user_code(Outcome.SENSOR_ERROR, sense)


def _with_traversability(
    knowledge: Knowledge, new: Measurement, in_use: Tensor
) -> Knowledge:
    """Add λ measured in the episodes that use the sensor (mask, bool, shape [B])."""
    mask = new.mask & in_use[:, None, None]
    before = knowledge.sensed
    traversability = torch.where(mask, new.traversability, before.traversability)
    std = torch.where(mask, new.std, before.std)
    sensed = Measurement(traversability=traversability, std=std)
    return replace(
        knowledge,
        sensed=sensed,
        ever_sensed=knowledge.ever_sensed | mask,
        footprint=knowledge.footprint | mask,
    )


def _with_appearance(
    knowledge: Knowledge, memory: Memory, new: Appearance, in_use: Tensor
) -> Knowledge:
    """Add appearance observed in the episodes that use the sensor (mask, bool, [B])."""
    seen = new.seen & in_use[:, None, None]
    new_memory = remember(memory, replace(new, seen=seen))
    # The noise level changes if a cell is observed first, or with less noise.
    is_better = new_memory.noise_level != memory.noise_level
    is_new = is_better.flatten(1).any(1)
    return replace(
        knowledge,
        memory=new_memory,
        has_new_appearance=knowledge.has_new_appearance | is_new,
        footprint=knowledge.footprint | seen,
    )


def _check_measurement(measurement: Any, like: Tensor) -> None:
    """Check a sensor's measurement.

    Args:
        measurement: result of `Sensor.sense`; any type.
        like: map of the expected dtype, shape and device.

    Raises:
        ConfigError: If its type, dtype, shape, device or values are invalid.
    """
    expect(
        isinstance(measurement, Measurement),
        f"a Measurement from `sense`, got {type(measurement).__name__}.",
    )
    dtype = like.dtype
    traversability = measurement.traversability
    check_map("`Measurement.traversability`", traversability, dtype, like)
    check_map("`Measurement.std`", measurement.std, dtype, like)
    values = traversability[measurement.mask]
    is_valid = (values >= 0) & (values <= 1)
    expect(
        bool(is_valid.all()),
        "`Measurement.traversability` in [0, 1] in measured cells, got other values. "
        "Return NaN in cells that are not measured.",
    )
    appearance = measurement.appearance
    if appearance is not None:
        check_map("`Appearance.seen`", appearance.seen, torch.bool, like)
        check_map("`Appearance.noise_level`", appearance.noise_level, dtype, like)
