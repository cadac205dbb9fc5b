"""What the robots of an environment know of the ground, and how they learn on their
way.

A shell over `benchnav.planning.sensing.knowledge`, by which robots learn in evaluations
too: λ is sensed at each step, and what is known is updated every `replan_every_s` of an
episode. Here episodes begin at different times. Letters
in shapes: B episodes, M of them, S state dimensions, H×W cells, N cells of all maps
together.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchnav.core.batch import Batch, map_tensors
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.env.view import Known
from benchnav.planning.sensing.knowledge import Knowledge, Learner, Truth
from benchnav.planning.sensing.sensor import Sensed

_MOST_KEPT = 256  # maps, of up to a megabyte each


@dataclass(frozen=True, kw_only=True)
class _First(Batch):
    """What is known of whole maps before a robot set out: the prediction, and all but
    the belief.
    """

    prior: TraversabilityDistribution
    knowledge: Knowledge


class Experience:
    """What the robots of B sub-environments know, from their first step to their last;
    a stateful shell.

    Args:
        learner: how they learn.
        every: steps between two updates of what is known.
        alike: the prediction of a whole map is the same in each of its episodes.
    """

    def __init__(self, learner: Learner, every: int, alike: bool) -> None:
        """Knows nothing of any episode."""
        self._learner, self._every = learner, every
        self._senses = learner.belief.learns or not learner.sensor.sees_all
        self._alike = alike and learner.sensor.sees_all
        self._kept: OrderedDict[int, _First] = OrderedDict()
        self._knowledge: Knowledge | None = None
        self._truth: Truth | None = None

    @property
    def known(self) -> Known:
        """What all robots know now, as policies are told it."""
        knowledge = self._current()
        assert knowledge.spread is not None
        return Known(
            risk_map=knowledge.risk_map,
            spread=knowledge.spread,
            elevation_m=knowledge.observation.elevation_m,
            seen=knowledge.seen,
        )

    def begin(
        self, members: Tensor, maps: Sequence[int], truth: Truth, state: Tensor
    ) -> None:
        """Begins new episodes in some sub-environments; in all of them at first.

        Args:
            members: which, int64, shape [M].
            maps: numbers of their maps.
            truth: of these episodes.
            state: where the robots are, shape [M, S].
        """
        knowledge = (
            self._begun_on(maps, truth, state)
            if self._alike
            else self._begun(truth, state)
        )
        if self._knowledge is None or len(members) == len(self._knowledge.free):
            self._knowledge, self._truth = knowledge, truth
            return
        self._knowledge = self._learner.put(self._knowledge, members, knowledge)
        if self._senses and self._truth is not None:
            self._truth = self._truth.put(members, truth)

    def learn(self, step: Tensor, state: Tensor, field: Tensor, which: Tensor) -> None:
        """Senses in some sub-environments, and updates what is known in those of them
        where that is due.

        Args:
            step: steps that each episode has taken, int64, shape [B].
            state: where the robots are, shape [B, S].
            field: λ of every cell, shape [B, H, W].
            which: bool, shape [B].
        """
        if not self._senses or self._truth is None:
            return
        truth = replace(self._truth, field=field)
        due = which & (step % self._every == 0)
        self._knowledge = self._learner.sense(
            self._current(), truth, state, step.tolist(), due, which
        )
        if bool(due.any()):
            self._update(due, truth)

    def _update(self, due: Tensor, truth: Truth) -> None:
        """Updates what is known in some episodes, bool [B]."""
        learner, now = self._learner, self._current()
        news = now.news & due
        if bool(news.any()):
            # Taken apart, since a prediction costs more than that.
            members = news.nonzero()[:, 0]
            part, _ = learner.update(
                learner.select(now, members), truth.select(members)
            )
            now = learner.put(now, members, part)
        told = (due & ~news)[:, None, None]
        sensed, news = now.sensed, now.news
        if bool((sensed.mask & told).any()):
            # As a whole, since to take it apart costs more than the update.
            now = replace(now, sensed=_only(sensed, told), news=torch.zeros_like(news))
            now, _ = learner.update(now, truth)
            now = replace(now, sensed=_only(sensed, ~told), news=news)
        self._knowledge = now

    def _begun_on(self, maps: Sequence[int], truth: Truth, state: Tensor) -> Knowledge:
        """What is known at the start of maps that are seen as a whole; kept, since no
        episode changes it.
        """
        every = []
        for place, number in enumerate(maps):
            if number not in self._kept:
                own = torch.tensor([place])
                knowledge = self._begun(truth.select(own), state[own])
                prior = self._learner.distribution(knowledge)
                self._kept[number] = _First(
                    prior=prior, knowledge=replace(knowledge, believed=None)
                )
            self._kept.move_to_end(number)
            every.append(self._kept[number])
        while len(self._kept) > _MOST_KEPT:
            self._kept.popitem(last=False)
        first, *rest = every
        joined = map_tensors(first, lambda *values: torch.cat(values), *rest)
        return replace(joined.knowledge, believed=self._learner.believe(joined.prior))

    def _begun(self, truth: Truth, state: Tensor) -> Knowledge:
        """What is known at the start."""
        learner, prediction = self._learner, None
        if learner.sensor.sees_all:
            terrain = replace(truth.terrain, traversability=truth.field)
            prediction = learner.predict(terrain, terrain.observe())
        return learner.begin(truth, state, prediction)

    def _current(self) -> Knowledge:
        assert self._knowledge is not None, "no episode has begun"
        return self._knowledge


def _only(sensed: Sensed, which: Tensor) -> Sensed:
    """What was sensed in some episodes, bool, shape [B, 1, 1], and nothing in the
    others.
    """
    return replace(
        sensed, traversability=sensed.traversability.masked_fill(~which, torch.nan)
    )
