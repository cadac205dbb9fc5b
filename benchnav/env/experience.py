"""Knowledge of the robots of an environment, updated during their episodes.

`Experience` is a stateful shell over `benchnav.planning.sensing.learner`, which
evaluations use too. λ is measured at each step; the knowledge is updated every
`replan_every_s` of an episode. Unlike in an evaluation, episodes begin at different
times.
Letters in shapes: B episodes, M selected episodes, S state dimensions, H×W cells.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchnav.core.batch import Batch, map_tensors
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.env.view import MapKnowledge
from benchnav.planning.problem import Task
from benchnav.planning.sensing.knowledge import Knowledge, Truth
from benchnav.planning.sensing.learner import Learner
from benchnav.planning.sensing.sensor import Measurement

_MAX_CACHED = 256  # number of maps, each of up to a megabyte


@dataclass(frozen=True, kw_only=True)
class _Start(Batch):
    """Knowledge of whole maps at the start of an episode.

    Args:
        prior: predicted distribution of λ.
        knowledge: the knowledge without the belief state, which follows from `prior`.
    """

    prior: TraversabilityDistribution
    knowledge: Knowledge


class Experience:
    """Knowledge of the robots of B sub-environments during their episodes.

    Args:
        task: task of the robots, whose footprint inflates λ̂.
        learner: parts that sense, predict and update the belief.
        update_steps: number of steps between two updates of the knowledge.
        is_cacheable: whether the prediction of a whole map is the same in all episodes
            on the map.
    """

    def __init__(
        self, task: Task, learner: Learner, update_steps: int, is_cacheable: bool
    ) -> None:
        """Create the knowledge before the first episode."""
        self._task = task
        self._learner = learner
        self._update_steps = update_steps
        self._senses = learner.belief.learns or not learner.sensor.sees_all
        self._is_cacheable = is_cacheable and learner.sensor.sees_all
        self._cache: OrderedDict[int, _Start] = OrderedDict()
        self._knowledge: Knowledge | None = None
        self._truth: Truth | None = None

    @property
    def map_knowledge(self) -> MapKnowledge:
        """Current knowledge of all robots, as policies receive it."""
        knowledge = self._current()
        assert knowledge.spread is not None
        return MapKnowledge(
            risk_map=self._task.inflate(knowledge.risk_map, knowledge.observation.grid),
            spread=knowledge.spread,
            elevation_m=knowledge.observation.elevation_m,
            seen=knowledge.seen,
        )

    def begin(
        self, members: Tensor, maps: Sequence[int], truth: Truth, state: Tensor
    ) -> None:
        """Begin new episodes in some sub-environments; the first call covers all.

        Args:
            members: indices of the sub-environments, int64, shape [M].
            maps: index of the map of each of these sub-environments, length M.
            truth: true state of the new episodes.
            state: initial states of the robots, shape [M, S].
        """
        knowledge = (
            self._cached_start(maps, truth, state)
            if self._is_cacheable
            else self._start(truth, state)
        )
        if self._knowledge is None or len(members) == len(self._knowledge.free):
            self._knowledge = knowledge
            self._truth = truth
            return
        self._knowledge = self._learner.put(self._knowledge, members, knowledge)
        if self._senses and self._truth is not None:
            self._truth = self._truth.put(members, truth)

    def learn(
        self, step: Tensor, state: Tensor, field: Tensor, is_sensing: Tensor
    ) -> None:
        """Sense in some sub-environments, and update their knowledge if it is due.

        Args:
            step: number of steps that each episode has taken, int64, shape [B].
            state: states of the robots, shape [B, S].
            field: current λ of all cells, shape [B, H, W].
            is_sensing: mask of sub-environments that sense, bool, shape [B].
        """
        if not self._senses or self._truth is None:
            return
        truth = replace(self._truth, field=field)
        due = is_sensing & (step % self._update_steps == 0)
        self._knowledge = self._learner.sense(
            self._current(), truth, state, step.tolist(), due, is_sensing
        )
        if bool(due.any()):
            self._update(due, truth)

    def _update(self, due: Tensor, truth: Truth) -> None:
        """Update the knowledge in the episodes whose update is due.

        Args:
            due: mask of these episodes, bool, shape [B].
            truth: true state in this step.
        """
        learner = self._learner
        now = self._current()
        needs_prediction = now.has_new_appearance & due
        if bool(needs_prediction.any()):
            # Episodes are selected, since predictions for all would take longer.
            members = needs_prediction.nonzero()[:, 0]
            selected = learner.select(now, members)
            updated, _ = learner.update(selected, truth.select(members))
            now = learner.put(now, members, updated)
        needs_update = (due & ~needs_prediction)[:, None, None]
        sensed = now.sensed
        news = now.has_new_appearance
        has_measurements = sensed.mask & needs_update
        if bool(has_measurements.any()):
            # All episodes are updated, since selecting some would take longer.
            no_news = torch.zeros_like(news)
            now = replace(
                now, sensed=_only(sensed, needs_update), has_new_appearance=no_news
            )
            now, _ = learner.update(now, truth)
            now = replace(
                now, sensed=_only(sensed, ~needs_update), has_new_appearance=news
            )
        self._knowledge = now

    def _cached_start(
        self, maps: Sequence[int], truth: Truth, state: Tensor
    ) -> Knowledge:
        """Return the initial knowledge of fully observed maps, from a cache."""
        starts = []
        for index, map_index in enumerate(maps):
            if map_index not in self._cache:
                member = torch.tensor([index])
                knowledge = self._start(truth.select(member), state[member])
                prior = self._learner.distribution(knowledge)
                knowledge = replace(knowledge, belief_state=None)
                self._cache[map_index] = _Start(prior=prior, knowledge=knowledge)
            self._cache.move_to_end(map_index)
            starts.append(self._cache[map_index])
        while len(self._cache) > _MAX_CACHED:
            self._cache.popitem(last=False)
        joined = map_tensors(starts[0], lambda *values: torch.cat(values), *starts[1:])
        belief_state = self._learner.believe(joined.prior)
        return replace(joined.knowledge, belief_state=belief_state)

    def _start(self, truth: Truth, state: Tensor) -> Knowledge:
        """Return the initial knowledge in new episodes."""
        learner = self._learner
        prediction = None
        if learner.sensor.sees_all:
            terrain = replace(truth.terrain, traversability=truth.field)
            prediction = learner.predict(terrain, terrain.observe())
        return learner.begin(truth, state, prediction)

    def _current(self) -> Knowledge:
        assert self._knowledge is not None, "no episode has begun"
        return self._knowledge


def _only(sensed: Measurement, is_selected: Tensor) -> Measurement:
    """Return the measurements of the selected episodes (mask, bool, [B, 1, 1])."""
    traversability = sensed.traversability.masked_fill(~is_selected, torch.nan)
    return replace(sensed, traversability=traversability)
