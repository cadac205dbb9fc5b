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

_MOST_KEPT = 128  # maps, of up to two megabytes each

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
class _Episodes(Batch):
    """What robots know.

    Args:
        known: what a policy is told.
        belief: state of the belief.
    """

    known: Known
    belief: Any


class Learner:
    """What the robots of B sub-environments know, from their first step to their last; a stateful shell.

    Args:
        parts: what decides it.
    """

    def __init__(self, parts: Parts) -> None:
        """Knows nothing of any episode."""
        self._parts = parts
        self._senses = parts.belief.learns
        self._kept: OrderedDict[int, _Episodes] = OrderedDict()  # of maps before a robot set out on them
        self._now: _Episodes | None = None
        # What sensors are given, and what they gave since the last update; None where none is asked.
        self._terrain: Terrain | None = None
        self._sensed: Sensed | None = None
        self._keys: list[int] = []

    @property
    def known(self) -> Known:
        """What all robots know now."""
        assert self._now is not None, "no episode has begun"
        return self._now.known

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
        each = range(len(members))
        new = _join(
            [self._first(maps[i], terrain.select(torch.tensor([i])), _part(field, i)) for i in each]
        )
        if self._now is None or len(members) == len(self._keys):
            self._keys = list(keys)
        for member, key in zip(members.tolist(), keys, strict=True):
            self._keys[member] = key
        self._now = self._with(self._now, members, new)
        if self._senses:
            self._terrain = self._with(self._terrain, members, terrain)
            self._sensed = self._with(self._sensed, members, _nothing(new.known.risk_map))

    def learn(self, step: Tensor, state: Tensor, field: Tensor | None, which: Tensor) -> None:
        """Senses in some sub-environments, and updates the belief in those of them where that is due.

        Args:
            step: steps that each episode has taken, int64, shape [B].
            state: where the robots are, shape [B, S].
            field: λ of every cell, shape [B, H, W]; None where it is drawn anew at each step.
            which: bool, shape [B].
        """
        terrain, kept = self._terrain, self._sensed
        if terrain is None or kept is None or field is None:
            return
        given = self._parts.ground.sense(terrain, field, state.clone(), Moment(self._keys, step.tolist()))
        new = given.mask & which[:, None, None]
        sensed = Sensed(
            traversability=torch.where(new, given.traversability, kept.traversability),
            std=torch.where(new, given.std, kept.std),
        )
        due = (which & (step % self._parts.every == 0))[:, None, None]
        if bool((sensed.mask & due).any()):
            self._update(_only(sensed, due))
            sensed = _only(sensed, ~due)
        self._sensed = sensed

    def _update(self, sensed: Sensed) -> None:
        """Tells the belief what was sensed, and infers what is known by it."""
        parts, now = self._parts, self._now
        assert now is not None
        # The whole batch, since to take states apart and to join them again costs more than the update.
        state = parts.belief.update(now.belief, sensed)
        changed, known = parts.belief.changed(now.belief, state), now.known
        if bool(changed.any()):
            believed = parts.belief.at(state, changed)
            values = risk.apply(parts.measure, believed)[0], spread_of(believed)[0]
            risk_map, spread = (
                old.index_put((changed,), new.to(old.dtype))
                for old, new in zip((known.risk_map, known.spread), values, strict=True)
            )
            known = replace(known, risk_map=risk_map, spread=spread)
        self._now = _Episodes(known=known, belief=state)

    def _first(self, number: int, terrain: Terrain, field: Tensor | None) -> _Episodes:
        """What is known of a map at first; kept, but of the clairvoyant's λ."""
        if field is not None and isinstance(self._parts.model, Clairvoyant):
            return self._predicted(replace(terrain, traversability=field))
        if number not in self._kept:
            self._kept[number] = self._predicted(terrain)
            if len(self._kept) > _MOST_KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(number)
        return self._kept[number]

    def _predicted(self, terrain: Terrain) -> _Episodes:
        parts = self._parts
        prior = predict(parts.model, terrain)
        known = Known(
            risk_map=risk.apply(parts.measure, prior),
            spread=spread_of(prior),
            elevation_m=terrain.elevation_m,
            seen=torch.ones_like(terrain.elevation_m, dtype=torch.bool),
        )
        return _Episodes(known=known, belief=parts.belief.init(prior, parts.law) if self._senses else None)

    def _with(self, whole: Value | None, members: Tensor, part: Value) -> Value:
        """Puts some episodes in the places of others; all of them in place of all."""
        if whole is None or len(members) == len(self._keys):
            return part
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
