"""What the robots of an environment know of the ground, and how they learn on their way.

A shell over `benchnav.planning.sensing.knowledge`, by which robots learn in evaluations too: sensors sense at each
step, and what is known is updated every `replan_every_s` of an episode. Here episodes begin at different times. Letters
in shapes: B episodes, M of them, S state dimensions, H×W cells.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from benchnav.core.batch import Batch, map_tensors
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.terrain import Observation
from benchnav.env.view import Known, spread_of
from benchnav.models.base import PrivilegedModel, TraversabilityModel, predict_observation
from benchnav.planning.sensing.knowledge import Knowledge, Learner, Predict, Truth
from benchnav.planning.sensing.sensor import Sensed

_MOST_KEPT = 128  # maps, of up to two megabytes each

Value = TypeVar("Value", bound=Batch)


@dataclass(frozen=True, kw_only=True)
class _Known(Batch):
    """What is known in some episodes, and the spread of what is believed, shape [B, H, W]."""

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
        self._learner, self._every = learner, every
        self._senses = learner.belief.learns or not learner.sensor.sees_all
        self._alike = alike and learner.sensor.sees_all
        self._kept: OrderedDict[int, _Known] = OrderedDict()  # of maps, before a robot set out on them
        self._now: _Known | None = None
        self._truth: Truth | None = None

    @property
    def known(self) -> Known:
        """What all robots know now, as policies are told it."""
        knowledge = self._current.knowledge
        return Known(
            risk_map=knowledge.risk_map,
            spread=self._current.spread,
            elevation_m=knowledge.observation.elevation_m,
            seen=knowledge.seen,
        )

    @property
    def _current(self) -> _Known:
        assert self._now is not None, "no episode has begun"
        return self._now

    def begin(self, members: Tensor, maps: Sequence[int], truth: Truth, state: Tensor) -> None:
        """Begins new episodes in some sub-environments; in all of them at first.

        Args:
            members: which, int64, shape [M].
            maps: numbers of their maps.
            truth: of these episodes.
            state: where the robots are, shape [M, S].
        """
        if self._alike:
            own = [torch.tensor([place]) for place in range(len(maps))]
            first = [
                self._of_map(number, truth.select(place), state[place])
                for number, place in zip(maps, own, strict=True)
            ]
            new = map_tensors(first[0], lambda *values: torch.cat(values), *first[1:])
        else:
            new = self._begun(truth, state)
        whole = self._now is None or len(members) == len(self._current.spread)
        self._now = new if whole else _put(self._current, members, new)
        if self._senses:
            self._truth = truth if whole or self._truth is None else _put_truth(self._truth, members, truth)

    def learn(self, step: Tensor, state: Tensor, field: Tensor, which: Tensor) -> None:
        """Senses in some sub-environments, and updates what is known in those of them where that is due.

        Args:
            step: steps that each episode has taken, int64, shape [B].
            state: where the robots are, shape [B, S].
            field: λ of every cell, shape [B, H, W].
            which: bool, shape [B].
        """
        if self._truth is None:
            return
        truth, before = replace(self._truth, field=field), self._current.knowledge
        after = self._learner.sense(before, truth, state, step.tolist())
        # Others have sensed in this step before, or have ended.
        sensed = map_tensors(
            after.sensed, lambda new, old: torch.where(which[:, None, None], new, old), before.sensed
        )
        self._now = replace(self._current, knowledge=replace(after, sensed=sensed))
        due = which & (step % self._every == 0)
        if bool(due.any()):
            self._update(due, truth)

    def _update(self, due: Tensor, truth: Truth) -> None:
        """Updates what is known in some episodes, bool [B]."""
        learner, now = self._learner, self._current
        news = now.knowledge.news & due
        if bool(news.any()):
            # Taken apart, since a prediction costs more than that.
            members = news.nonzero()[:, 0]
            known = learner.select(now.knowledge, members)
            part = _Known(knowledge=known, spread=now.spread.index_select(0, members))
            now = _put(now, members, self._updated(part, truth.select(members)))
        told = (due & ~news)[:, None, None]
        sensed, news = now.knowledge.sensed, now.knowledge.news
        if bool((sensed.mask & told).any()):
            # As a whole, since to take it apart costs more than the update.
            part = replace(
                now,
                knowledge=replace(now.knowledge, sensed=_only(sensed, told), news=torch.zeros_like(news)),
            )
            now = self._updated(part, truth)
            now = replace(now, knowledge=replace(now.knowledge, sensed=_only(sensed, ~told), news=news))
        self._now = now

    def _updated(self, now: _Known, truth: Truth) -> _Known:
        knowledge, changed = self._learner.update(now.knowledge, truth)
        spread = now.spread
        if bool(changed.any()):
            new = spread_of(self._learner.at(knowledge, changed))[0]
            spread = spread.index_put((changed,), new.to(spread.dtype))
        return _Known(knowledge=knowledge, spread=spread)

    def _of_map(self, number: int, truth: Truth, state: Tensor) -> _Known:
        """What is known at first of a map that is seen as a whole; it does not depend on the episode."""
        if number not in self._kept:
            self._kept[number] = self._begun(truth, state)
            if len(self._kept) > _MOST_KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(number)
        return self._kept[number]

    def _begun(self, truth: Truth, state: Tensor) -> _Known:
        learner = self._learner
        prediction = learner.predict(truth.terrain.observe(), truth) if learner.sensor.sees_all else None
        knowledge = learner.begin(truth, state, prediction)
        return _Known(knowledge=knowledge, spread=spread_of(learner.distribution(knowledge)))


def predict_with(model: TraversabilityModel) -> Predict:
    """How a model predicts from what was seen; privileged ones from the truth, λ of the episode included."""

    def predict(observation: Observation, truth: Truth) -> TraversabilityDistribution:
        if isinstance(model, PrivilegedModel):
            return model.predict_terrain(replace(truth.terrain, traversability=truth.field))
        return predict_observation(model, observation)

    return predict


def _only(sensed: Sensed, which: Tensor) -> Sensed:
    """What was sensed in some episodes, bool, shape [B, 1, 1], and nothing in the others."""
    return replace(sensed, traversability=sensed.traversability.masked_fill(~which, torch.nan))


def _put(whole: Value, members: Tensor, part: Value) -> Value:
    """Puts some episodes, by index, in the places of others."""
    return map_tensors(whole, lambda old, new: old.index_copy(0, members, new), part)


def _put_truth(whole: Truth, members: Tensor, part: Truth) -> Truth:
    keys = list(whole.keys)
    for member, key in zip(members.tolist(), part.keys, strict=True):
        keys[member] = key
    return replace(_put(whole, members, part), keys=tuple(keys))
