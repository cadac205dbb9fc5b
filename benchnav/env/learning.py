"""What the robots of an environment know of the ground, and how they learn on their way.

As in an evaluation: sensors sense at each step, and the belief is told what was sensed every `replan_every_s` of its
episode. Episodes of a batch begin at different times. Letters in shapes: B episodes, M of them, S state dimensions,
H×W cells.
"""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from benchnav.core.batch import Batch, map_tensors
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.terrain import Terrain
from benchnav.env.view import Known, spread_of
from benchnav.models.base import TraversabilityModel, predict
from benchnav.models.predictor import Clairvoyant
from benchnav.planning import risk
from benchnav.planning.sensing.belief import Belief, Law
from benchnav.planning.sensing.sensor import Moment, Sensed, Sensor

_MOST_KEPT = 256  # predictions of maps, of about half a megabyte each

Value = TypeVar("Value", bound=Batch)


@dataclass(frozen=True, kw_only=True)
class Parts:
    """What decides what is known.

    Args:
        sensor: of what ground looks like.
        ground: of λ.
        model: predicts λ from what was seen.
        belief: what is made of what is sensed.
        measure: the risk measure that gives λ̂.
        law: how λ hangs together.
        every: steps between two updates of the belief.
    """

    sensor: Sensor
    ground: Sensor
    model: TraversabilityModel
    belief: Belief[Any]
    measure: risk.RiskMeasure
    law: Law
    every: int


@dataclass(frozen=True, kw_only=True)
class _First(Batch):
    """What is known of maps before a robot set out on them."""

    prior: TraversabilityDistribution
    known: Known


@dataclass(frozen=True, kw_only=True)
class _Episodes(Batch):
    """What B robots know, and what their sensors are given.

    Args:
        terrain: the truth.
        known: what a policy is told.
        belief: state of the belief.
        sensed: since the last update.
    """

    terrain: Terrain
    known: Known
    belief: Any
    sensed: Sensed


class Learner:
    """What the robots of B sub-environments know, from their first step to their last; a stateful shell.

    Args:
        parts: what decides it.
    """

    def __init__(self, parts: Parts) -> None:
        """Knows nothing of any episode."""
        self._parts = parts
        self._kept: OrderedDict[int, _First] = OrderedDict()
        self._now: _Episodes | None = None
        self._keys: list[int] = []

    @property
    def known(self) -> Known:
        """What all robots know now."""
        return self._episodes.known

    @property
    def _episodes(self) -> _Episodes:
        assert self._now is not None, "no episode has begun"
        return self._now

    def begin(
        self,
        members: Tensor,
        maps: Sequence[int],
        terrain: Terrain,
        field: Tensor | None,
        keys: Sequence[int],
    ) -> None:
        """Begins new episodes in some sub-environments; all of them at first.

        Args:
            members: which, int64, shape [M].
            maps: numbers of their maps.
            terrain: the maps, M of them.
            field: λ of every cell in these episodes, shape [M, H, W]; None where it is drawn anew at each step.
            keys: a stream key of each episode for the sensors' noise.
        """
        parts, each = self._parts, range(len(members))
        first = _join([self._first(maps[i], terrain.select(torch.tensor([i])), _part(field, i)) for i in each])
        new = _Episodes(
            terrain=terrain,
            known=first.known,
            belief=parts.belief.init(first.prior, parts.law),
            sensed=_nothing(first.known.risk_map),
        )
        if self._now is None or len(members) == len(self._keys):
            self._now, self._keys = new, list(keys)
            return
        self._now = put(self._now, members, new)
        for member, key in zip(members.tolist(), keys, strict=True):
            self._keys[member] = key

    def learn(self, step: Tensor, state: Tensor, field: Tensor | None, which: Tensor) -> None:
        """Senses in some sub-environments, and updates the belief in those of them where that is due.

        Args:
            step: steps that each episode has taken, int64, shape [B].
            state: where the robots are, shape [B, S].
            field: λ of every cell, shape [B, H, W]; None where it is drawn anew at each step.
            which: bool, shape [B].
        """
        if field is None or not self._parts.belief.learns:
            return
        now, ground = self._episodes, self._parts.ground
        given = ground.sense(now.terrain, field, state.clone(), Moment(self._keys, step.tolist()))
        new, kept = given.mask & which[:, None, None], now.sensed
        sensed = Sensed(
            traversability=torch.where(new, given.traversability, kept.traversability),
            std=torch.where(new, given.std, kept.std),
        )
        self._now = replace(now, sensed=sensed)
        due = which & (step % self._parts.every == 0)
        if bool((sensed.mask & due[:, None, None]).any()):
            self._update(due[:, None, None])

    def _update(self, due: Tensor) -> None:
        """Tells the belief what was sensed in some episodes, bool [B, 1, 1], and infers what is known by it."""
        parts, now = self._parts, self._episodes
        told, left = _only(now.sensed, due), _only(now.sensed, ~due)
        # The whole batch, since to take states apart and to join them again costs more than the update.
        state = parts.belief.update(now.belief, told)
        changed = parts.belief.changed(now.belief, state)
        risk_map, spread = now.known.risk_map, now.known.spread
        if bool(changed.any()):
            believed = parts.belief.at(state, changed)
            values = risk.apply(parts.measure, believed)[0], spread_of(believed)[0]
            risk_map, spread = (
                old.clone().index_put((changed,), new.to(old.dtype))
                for old, new in zip((risk_map, spread), values, strict=True)
            )
        known = replace(now.known, risk_map=risk_map, spread=spread)
        self._now = replace(now, belief=state, known=known, sensed=left)

    def _first(self, number: int, terrain: Terrain, field: Tensor | None) -> _First:
        """What is known of a map at first; kept, but of the clairvoyant's λ."""
        if field is not None and isinstance(self._parts.model, Clairvoyant):
            return self._predicted(replace(terrain, traversability=field))
        if number not in self._kept:
            self._kept[number] = self._predicted(terrain)
            if len(self._kept) > _MOST_KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(number)
        return self._kept[number]

    def _predicted(self, terrain: Terrain) -> _First:
        prior = predict(self._parts.model, terrain)
        known = Known(
            risk_map=risk.apply(self._parts.measure, prior),
            spread=spread_of(prior),
            elevation_m=terrain.elevation_m,
            seen=torch.ones_like(terrain.elevation_m, dtype=torch.bool),
        )
        return _First(prior=prior, known=known)


def put(whole: Value, members: Tensor, part: Value) -> Value:
    """Puts some episodes into a batch, in the places of others.

    Args:
        whole: of B episodes; it is not changed.
        members: whose places are taken, int64, shape [M].
        part: of M episodes.
    """
    return map_tensors(whole, lambda old, new: old.index_copy(0, members, new), part)


def _join(parts: Sequence[Value]) -> Value:
    """Batches one after another."""
    first, *rest = parts
    join: Callable[..., Tensor] = lambda *values: torch.cat(values)  # noqa: E731
    return map_tensors(first, join, *rest)


def _part(field: Tensor | None, member: int) -> Tensor | None:
    return None if field is None else field[member : member + 1]


def _only(sensed: Sensed, which: Tensor) -> Sensed:
    """What was sensed in some episodes, bool, shape [B, 1, 1], and nothing in the others."""
    return replace(sensed, traversability=sensed.traversability.masked_fill(~which, torch.nan))


def _nothing(like: Tensor) -> Sensed:
    """Nothing that was sensed, on maps of a shape."""
    nothing = torch.full_like(like, torch.nan)
    return Sensed(traversability=nothing, std=torch.ones_like(nothing))
