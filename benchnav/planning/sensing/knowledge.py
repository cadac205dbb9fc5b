"""What robots know of their maps: what was seen and sensed, what is believed, and the
λ̂ and free ground that follow.

For a belief that learns λ is sensed at each step. Now and then the robot looks, and the
belief is updated, after a new prediction where more was seen. A `Learner` holds how
that is done, a `Knowledge` what is known by now; only sensors are given the `Truth`.
Letters in shapes: B episodes, S state dimensions, H×W cells, N cells of all maps
together.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.batch import Batch, find_tensor_fault, map_tensors
from benchnav.core.chosen import choose
from benchnav.core.device import GPU_FAULTS
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import BenchnavError, ConfigError, expect
from benchnav.core.ground import GroundStatistics
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.settings import fault
from benchnav.core.terrain import Observation, Terrain
from benchnav.planning import risk
from benchnav.planning.free_space import Rules
from benchnav.planning.sensing.appearance import Memory, masked, remember
from benchnav.planning.sensing.belief import Belief, Law
from benchnav.planning.sensing.sensor import Moment, Sensed, Sensor
from benchnav.planning.world.outcome import Outcome

_PESSIMISTIC = 0.8  # level of the CVaR that is believed of unseen ground

Predict = Callable[[Terrain, Observation], TraversabilityDistribution]
"""Predicts from what was seen; the terrain, with λ as it is now, is for privileged
models alone.
"""

Result = TypeVar("Result")


class KnowledgeError(BenchnavError):
    """A sensor, a belief, a model or a risk measure raised on the way; the cause says
    what.
    """

    def __init__(self, message: str, outcome: Outcome) -> None:
        """Keeps how the episodes end for it."""
        super().__init__(message)
        self.outcome = outcome


@dataclass(frozen=True, kw_only=True)
class Truth(Batch):
    """What sensors alone are given.

    Args:
        terrain: the true maps, B of them.
        field: λ of every cell as it is now, shape [B, H, W].
        keys: a stream key of each episode for the sensors' noise, B of them.
    """

    terrain: Terrain
    field: Tensor
    keys: tuple[int, ...]

    def select(self, members: Tensor) -> "Truth":
        """Keeps some episodes, by index, int64."""
        return replace(
            super().select(members),
            keys=tuple(self.keys[place] for place in members.tolist()),
        )

    def put(self, members: Tensor, others: "Truth") -> "Truth":
        """Puts episodes in the places of others, by index, int64."""
        keys = dict(enumerate(self.keys)) | dict(
            zip(members.tolist(), others.keys, strict=True)
        )
        return replace(super().put(members, others), keys=tuple(keys.values()))


@dataclass(frozen=True, kw_only=True)
class Knowledge(Batch):
    """What is known in B episodes.

    Args:
        memory: of what was seen; None where the whole map was seen at the start.
        news: episodes in which more was seen, or better, than the prediction knows of,
            bool, shape [B].
        sensed: of λ, since the belief was updated; of two looks at a cell the later.
        ever_sensed: cells whose λ was sensed, bool, shape [B, H, W].
        reached: cells that sensors told of in the last step, bool, shape [B, H, W].
        observation: what the model was given.
        believed: the state of the belief.
        risk_map: λ̂, shape [B, H, W].
        spread: of what is believed (`TraversabilityDistribution.spread`), shape [B, H,
            W]; None where it is not kept.
        free: free ground, without that at the goal, bool, shape [B, H, W].
    """

    memory: Memory | None
    news: Tensor
    sensed: Sensed
    ever_sensed: Tensor
    reached: Tensor
    observation: Observation
    believed: Any
    risk_map: Tensor
    spread: Tensor | None
    free: Tensor

    @property
    def seen(self) -> Tensor:
        """Cells that were seen, bool, shape [B, H, W]."""
        return torch.ones_like(self.free) if self.memory is None else self.memory.seen


@dataclass(frozen=True, kw_only=True)
class Learner:
    """How robots learn.

    Args:
        sensor: of appearance.
        ground: of λ.
        belief: what is made of what is sensed.
        law: how λ hangs together.
        measure: the risk measure that gives λ̂.
        rules: free space, and what is believed of unseen ground.
        predict: the model; not needed where the sensor sees all.
        keeps_spread: keeps the spread of what is believed beside λ̂, for policies.
    """

    sensor: Sensor
    ground: Sensor
    belief: Belief[Any]
    law: Law
    measure: risk.RiskFunction
    rules: Rules
    predict: Predict
    keeps_spread: bool = False

    @property
    def statistics(self) -> GroundStatistics:
        """Of the training maps, without which nothing is known of unseen ground.

        Raises:
            ConfigError: there are none.
        """
        expect(
            self.law.statistics is not None,
            "`Law.statistics` for a robot that does not see all, got None.",
        )
        assert self.law.statistics is not None
        return self.law.statistics

    def begin(
        self,
        truth: Truth,
        robot_state: Tensor,
        prediction: TraversabilityDistribution | None,
    ) -> Knowledge:
        """What is known when robots set out: what is seen from the start, and nothing
        of λ.

        Args:
            truth: for the sensor and for privileged models.
            robot_state: shape [B, S].
            prediction: of the whole map, where the sensor sees all; None elsewhere.

        Raises:
            KnowledgeError: the sensor, the model, the belief or the risk measure
                raised, or gave what is none.
        """
        memory, observation = None, truth.terrain.observe()
        if not self.sensor.sees_all:
            first = self._look(self.sensor, truth, robot_state, Moment(truth.keys, 0))
            assert first.appearance is not None
            memory = remember(Memory.none(observation), first.appearance)
            observation, prediction = self._predict(memory, truth)
        assert prediction is not None
        prior = prediction
        believed = self.believe(prior)
        risk_map, spread = self._measured(prior)
        seen = None if memory is None else memory.seen
        return Knowledge(
            memory=memory,
            news=torch.zeros(
                len(robot_state), dtype=torch.bool, device=robot_state.device
            ),
            sensed=nothing_sensed(truth.field),
            ever_sensed=torch.zeros_like(truth.field, dtype=torch.bool),
            reached=torch.zeros_like(truth.field, dtype=torch.bool),
            observation=observation,
            believed=believed,
            risk_map=risk_map,
            spread=spread,
            free=self.rules.free(risk_map, prior, seen),
        )

    def believe(self, prediction: TraversabilityDistribution) -> Any:
        """The state of the belief by a prediction alone.

        Raises:
            KnowledgeError: the belief raised.
        """
        return call(
            Outcome.BELIEF_ERROR, lambda: self.belief.init(prediction.clone(), self.law)
        )

    def sense(
        self,
        known: Knowledge,
        truth: Truth,
        robot_state: Tensor,
        step: int | Sequence[int],
        looks: Tensor,
        feels: Tensor,
    ) -> Knowledge:
        """Adds what is sensed in a step, and what is seen where a robot looks.

        To look at each step tells hardly more than to look when what is known is
        updated, and takes far longer. A belief that does not learn is told no λ.

        Args:
            known: by now; not changed.
            truth: as it is in this step.
            robot_state: shape [B, S].
            step: steps taken so far, in all episodes or in each, B of them.
            looks: in which episodes the sensor of appearance is asked, bool, shape [B].
            feels: in which episodes that of the ground is asked, bool, shape [B].

        Returns:
            What is known, of B episodes.

        Raises:
            KnowledgeError: a sensor raised, or gave what is none.
        """
        moment = Moment(truth.keys, step)
        known = replace(known, reached=torch.zeros_like(known.reached))
        for sensor, asked in (
            (self.sensor, looks),
            (self.ground, feels & self.belief.learns),
        ):
            if sensor.sees_all or not bool(asked.any()):
                continue
            new, told = (
                self._look(sensor, truth, robot_state, moment),
                asked[:, None, None],
            )
            mask, before = new.mask & told, known.sensed
            known = replace(
                known,
                sensed=Sensed(
                    traversability=torch.where(
                        mask, new.traversability, before.traversability
                    ),
                    std=torch.where(mask, new.std, before.std),
                ),
                ever_sensed=known.ever_sensed | mask,
                reached=known.reached | mask,
            )
            if new.appearance is not None and known.memory is not None:
                appearance = replace(new.appearance, seen=new.appearance.seen & told)
                memory = remember(known.memory, appearance)
                # A cell that is seen for the first time, or better than before.
                more = (memory.doubt != known.memory.doubt).flatten(1).any(1)
                reached = known.reached | appearance.seen
                known = replace(
                    known, memory=memory, news=known.news | more, reached=reached
                )
        return known

    def update(self, known: Knowledge, truth: Truth) -> tuple[Knowledge, Tensor]:
        """Updates prediction, belief, λ̂ and free ground with what was seen and sensed
        since.

        Args:
            known: by now; not changed.
            truth: for privileged models alone.

        Returns:
            What is known, and the cells of which something else is believed than
            before, bool, shape [B, H, W].

        Raises:
            KnowledgeError: the model, the belief or the risk measure raised, or gave
                what is none.
        """
        news = bool(known.news.any())
        if not news and not bool(known.sensed.mask.any()):
            return known, torch.zeros_like(known.free)
        before, observation, prior = known.believed, known.observation, None
        if news and known.memory is not None:
            observation, prior = self._predict(known.memory, truth)
        after = call(
            Outcome.BELIEF_ERROR,
            lambda: self.belief.update(before, known.sensed, prior),
        )
        changed = call(
            Outcome.BELIEF_ERROR,
            lambda: self._checked_cells(self.belief.changed(before, after), known),
        )
        known = replace(
            known,
            news=torch.zeros_like(known.news),
            sensed=nothing_sensed(known.risk_map),
            observation=observation,
            believed=after,
        )
        return (
            self._inferred(known, changed) if bool(changed.any()) else known
        ), changed

    def at(self, known: Knowledge, cells: Tensor) -> TraversabilityDistribution:
        """What is believed of some cells, bool [B, H, W], as a map of one row, [1, N].

        Raises:
            KnowledgeError: the belief raised, or gave what is none.
        """
        wanted = (1, int(cells.sum()))

        def believe() -> TraversabilityDistribution:
            believed = self.belief.at(known.believed, cells)
            expect(
                believed.shape == wanted,
                f"a distribution of shape {list(wanted)} from `at`, got "
                f"{list(believed.shape)}.",
            )
            return believed

        return call(Outcome.BELIEF_ERROR, believe)

    def distribution(self, known: Knowledge) -> TraversabilityDistribution:
        """What is believed, shape [B, H, W].

        Raises:
            KnowledgeError: the belief raised, or gave what is none.
        """

        def believe() -> TraversabilityDistribution:
            believed = self.belief.distribution(known.believed)
            wanted, got = (
                tuple(known.free.shape),
                getattr(believed, "shape", type(believed).__name__),
            )
            expect(
                got == wanted,
                f"a distribution of shape {list(wanted)} from `distribution`, got "
                f"{got}.",
            )
            return believed

        return call(Outcome.BELIEF_ERROR, believe)

    def select(self, known: Knowledge, members: Tensor) -> Knowledge:
        """Keeps some episodes, by index, int64.

        Raises:
            KnowledgeError: the belief raised.
        """
        believed = call(
            Outcome.BELIEF_ERROR, lambda: self.belief.select(known.believed, members)
        )
        return replace(replace(known, believed=None).select(members), believed=believed)

    def put(self, known: Knowledge, members: Tensor, others: Knowledge) -> Knowledge:
        """Puts episodes in the places of others, by index, int64.

        Raises:
            KnowledgeError: the belief raised.
        """
        believed = call(
            Outcome.BELIEF_ERROR,
            lambda: self.belief.put(known.believed, members, others.believed),
        )
        whole, part = (replace(each, believed=None) for each in (known, others))
        return replace(whole.put(members, part), believed=believed)

    def _inferred(self, known: Knowledge, changed: Tensor) -> Knowledge:
        """Tells λ̂ and what is free of the cells of which something else is believed."""
        believed = self.at(known, changed)
        # a batch, as measures are given
        one = map_tensors(believed, lambda values: values[None])
        found, spread = self._measured(one)
        seen = None if known.memory is None else known.memory.seen[changed][None]
        free = call(
            Outcome.BELIEF_ERROR, lambda: self.rules.free(found[0], believed, seen)
        )
        told = replace(
            known,
            risk_map=known.risk_map.index_put(
                (changed,), found.flatten().to(known.risk_map.dtype)
            ),
            free=known.free.index_put((changed,), free[0]),
        )
        if known.spread is None or spread is None:
            return told
        return replace(
            told,
            spread=known.spread.index_put(
                (changed,), spread.flatten().to(known.spread.dtype)
            ),
        )

    def _measured(
        self, believed: TraversabilityDistribution
    ) -> tuple[Tensor, Tensor | None]:
        """λ̂ and, where it is kept, the spread, of a batch of maps."""

        def measure() -> tuple[Tensor, Tensor | None]:
            return risk.apply(
                self.measure, believed
            ), believed.spread() if self.keeps_spread else None

        return call(Outcome.MODEL_ERROR, measure)

    def _predict(
        self, memory: Memory, truth: Truth
    ) -> tuple[Observation, TraversabilityDistribution]:
        """What a model is given of what was seen, and what it makes of it; elsewhere
        what `rules.unseen` says.
        """
        statistics = self.statistics
        observation = masked(memory, statistics.layer_means)
        terrain = replace(truth.terrain, traversability=truth.field)
        predicted = call(
            Outcome.MODEL_ERROR, lambda: self.predict(terrain, observation)
        )
        unseen = unseen_ground(
            statistics, self.rules.unseen, memory.seen.shape, truth.field
        )
        return observation, choose(memory.seen, predicted, unseen)

    def _look(
        self, sensor: Sensor, truth: Truth, robot_state: Tensor, moment: Moment
    ) -> Sensed:
        def look() -> Sensed:
            given = truth.terrain, truth.field, robot_state
            # Our own change nothing that they are given.
            if not type(sensor).__module__.startswith("benchnav."):
                given = truth.terrain.clone(), truth.field.clone(), robot_state.clone()
            found = self._checked(sensor.sense(*given, moment), truth.field)
            expect(
                sensor is not self.sensor or found.appearance is not None,
                "`Sensed.appearance` from a sensor of appearance, got none. List λ "
                "sensors under `grounds`.",
            )
            return found

        return call(Outcome.SENSOR_ERROR, look)

    def _checked(self, sensed: Any, like: Tensor) -> Sensed:
        """What a sensor said, where it is what a sensor may say."""
        expect(
            isinstance(sensed, Sensed),
            f"a Sensed from `sense`, got {type(sensed).__name__}.",
        )
        for name in ("traversability", "std"):
            check_map(f"`Sensed.{name}`", getattr(sensed, name), like.dtype, like)
        found = sensed.traversability[sensed.mask]
        expect(
            bool(((found >= 0) & (found <= 1)).all()),
            "`Sensed.traversability` in [0, 1], or NaN.",
        )
        if sensed.appearance is not None:
            check_map("`Appearance.seen`", sensed.appearance.seen, torch.bool, like)
            check_map("`Appearance.doubt`", sensed.appearance.doubt, like.dtype, like)
        return sensed

    def _checked_cells(self, cells: Any, known: Knowledge) -> Tensor:
        check_map("cells from `changed`", cells, torch.bool, known.free)
        return cells


def unseen_ground(
    statistics: GroundStatistics, unseen: str, shape: torch.Size, like: Tensor
) -> TraversabilityMixture:
    """What is believed of ground that was not seen.

    Args:
        statistics: of the training maps.
        unseen: of `Rules`.
        shape: [B, H, W].
        like: gives dtype and device.
    """
    prior = statistics.mixture(shape, like)
    if unseen == "prior":
        return prior
    value = 1.0
    if unseen == "pessimistic":
        value = float(statistics.mixture((1, 1, 1), like.double()).cvar(_PESSIMISTIC))
    means = torch.full_like(prior.means[:, :1], value)
    return TraversabilityMixture(torch.ones_like(means), means, torch.zeros_like(means))


def nothing_sensed(like: Tensor) -> Sensed:
    """No λ of any cell of maps, shape [B, H, W]."""
    nothing = torch.full_like(like, torch.nan)
    return Sensed(traversability=nothing, std=torch.ones_like(nothing))


def sensor_keys(noise_key: int, maps: Any) -> tuple[int, ...]:
    """Stream keys of the sensors' noise, by the root key of a world's noise and the
    names of its episodes.
    """
    return tuple(rng.stream_key(noise_key, "sensor", int(name)) for name in maps)


def check_map(what: str, values: Any, dtype: torch.dtype, like: Tensor) -> None:
    """Check a tensor's dtype, shape and device."""
    if wrong := find_tensor_fault(what, values, dtype, tuple(like.shape), like.device):
        raise ConfigError(wrong)


def call(outcome: Outcome, work: Callable[[], Result]) -> Result:
    """Call user code; convert its exceptions.

    Raises:
        KnowledgeError: it failed, and episodes end with this outcome for it.
    """
    try:
        return work()
    except GPU_FAULTS:
        raise
    except (Exception, SystemExit) as error:
        raise KnowledgeError(fault(error), outcome) from error
