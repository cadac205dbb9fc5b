"""What the robots of an environment know of the ground, and how they learn on their way.

A shell over `benchnav.planning.sensing.knowledge`, by which robots learn in evaluations too: λ is sensed at each
step, and what is known is updated every `replan_every_s` of an episode. Here episodes begin at different times. Letters
in shapes: B episodes, M of them, S state dimensions, H×W cells, N cells of all maps together.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchnav.core.batch import Batch, map_tensors
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.env.view import Known, spread_of
from benchnav.planning.risk import RiskMeasure
from benchnav.planning.sensing.knowledge import Knowledge, Learner, Truth
from benchnav.planning.sensing.sensor import Sensed

_MOST_KEPT = 256  # maps, of up to a megabyte each


class _Measure:
    """Gives λ̂, and keeps the spread of what it was given: to ask what is believed once more takes as long as all else.

    Args:
        measure: the risk measure.

    Attributes:
        spread: of the last distribution.
    """

    def __init__(self, measure: RiskMeasure) -> None:
        self._measure = measure
        self.spread = torch.empty(0)

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        self.spread = spread_of(distribution)
        return self._measure(distribution)


@dataclass(frozen=True, kw_only=True)
class _First(Batch):
    """What is known of whole maps before a robot set out: prediction, all but the belief, and spread."""

    prior: TraversabilityDistribution
    knowledge: Knowledge
    spread: Tensor


class Experience:
    """What the robots of B sub-environments know, from their first step to their last; a stateful shell.

    Args:
        learner: how they learn.
        every: steps between two updates of what is known.
        alike: the prediction of a whole map is the same in each of its episodes.
    """

    def __init__(self, learner: Learner, every: int, alike: bool) -> None:
        """Knows nothing of any episode."""
        self._measure = _Measure(learner.measure)
        self._learner, self._every = replace(learner, measure=self._measure), every
        self._senses = learner.belief.learns or not learner.sensor.sees_all
        self._alike = alike and learner.sensor.sees_all
        self._kept: OrderedDict[int, _First] = OrderedDict()
        self._knowledge: Knowledge | None = None
        self._spread: Tensor | None = None
        self._truth: Truth | None = None

    @property
    def known(self) -> Known:
        """What all robots know now, as policies are told it."""
        knowledge, spread = self._current()
        return Known(
            risk_map=knowledge.risk_map,
            spread=spread,
            elevation_m=knowledge.observation.elevation_m,
            seen=knowledge.seen,
        )

    def begin(self, members: Tensor, maps: Sequence[int], truth: Truth, state: Tensor) -> None:
        """Begins new episodes in some sub-environments; in all of them at first.

        Args:
            members: which, int64, shape [M].
            maps: numbers of their maps.
            truth: of these episodes.
            state: where the robots are, shape [M, S].
        """
        if self._alike:
            knowledge, spread = self._begun_on(maps, truth, state)
        else:
            knowledge, spread = self._begun(truth, state)
        if self._knowledge is None or self._spread is None or len(members) == len(self._spread):
            self._knowledge, self._spread, self._truth = knowledge, spread, truth
            return
        self._knowledge = self._learner.put(self._knowledge, members, knowledge)
        self._spread = self._spread.index_copy(0, members, spread)
        if self._senses and self._truth is not None:
            self._truth = self._truth.put(members, truth)

    def learn(self, step: Tensor, state: Tensor, field: Tensor, which: Tensor) -> None:
        """Senses in some sub-environments, and updates what is known in those of them where that is due.

        Args:
            step: steps that each episode has taken, int64, shape [B].
            state: where the robots are, shape [B, S].
            field: λ of every cell, shape [B, H, W].
            which: bool, shape [B].
        """
        if not self._senses or self._truth is None:
            return
        truth, (before, _) = replace(self._truth, field=field), self._current()
        due = which & (step % self._every == 0)
        self._knowledge = self._learner.sense(before, truth, state, step.tolist(), due, which)
        if bool(due.any()):
            self._update(due, truth)

    def _update(self, due: Tensor, truth: Truth) -> None:
        """Updates what is known in some episodes, bool [B]."""
        learner, (now, spread) = self._learner, self._current()
        news = now.news & due
        if bool(news.any()):
            # Taken apart, since a prediction costs more than that.
            members = news.nonzero()[:, 0]
            part = self._updated(learner.select(now, members), spread[members], truth.select(members))
            now, spread = learner.put(now, members, part[0]), spread.index_copy(0, members, part[1])
        told = (due & ~news)[:, None, None]
        sensed, news = now.sensed, now.news
        if bool((sensed.mask & told).any()):
            # As a whole, since to take it apart costs more than the update.
            now = replace(now, sensed=_only(sensed, told), news=torch.zeros_like(news))
            now, spread = self._updated(now, spread, truth)
            now = replace(now, sensed=_only(sensed, ~told), news=news)
        self._knowledge, self._spread = now, spread

    def _updated(self, knowledge: Knowledge, spread: Tensor, truth: Truth) -> tuple[Knowledge, Tensor]:
        """Knowledge and spread after an update."""
        knowledge, changed = self._learner.update(knowledge, truth)
        if bool(changed.any()):
            spread = spread.index_put((changed,), self._measure.spread.flatten().to(spread.dtype))
        return knowledge, spread

    def _begun_on(self, maps: Sequence[int], truth: Truth, state: Tensor) -> tuple[Knowledge, Tensor]:
        """Knowledge and spread at the start on maps that are seen as a whole; kept, since no episode changes them."""
        every = []
        for place, number in enumerate(maps):
            if number not in self._kept:
                own = torch.tensor([place])
                knowledge, spread = self._begun(truth.select(own), state[own])
                prior = self._learner.distribution(knowledge)
                knowledge = replace(knowledge, believed=None)
                self._kept[number] = _First(prior=prior, knowledge=knowledge, spread=spread)
            self._kept.move_to_end(number)
            every.append(self._kept[number])
        while len(self._kept) > _MOST_KEPT:
            self._kept.popitem(last=False)
        first, *rest = every
        joined = map_tensors(first, lambda *values: torch.cat(values), *rest)
        believed = self._learner.believe(joined.prior)
        return replace(joined.knowledge, believed=believed), joined.spread

    def _begun(self, truth: Truth, state: Tensor) -> tuple[Knowledge, Tensor]:
        """Knowledge and spread at the start."""
        learner = self._learner
        prediction = None
        if learner.sensor.sees_all:
            terrain = replace(truth.terrain, traversability=truth.field)
            prediction = learner.predict(terrain, terrain.observe())
        knowledge = learner.begin(truth, state, prediction)
        return knowledge, self._measure.spread

    def _current(self) -> tuple[Knowledge, Tensor]:
        assert self._knowledge is not None, "no episode has begun"
        assert self._spread is not None
        return self._knowledge, self._spread


def _only(sensed: Sensed, which: Tensor) -> Sensed:
    """What was sensed in some episodes, bool, shape [B, 1, 1], and nothing in the others."""
    return replace(sensed, traversability=sensed.traversability.masked_fill(~which, torch.nan))
