"""What is believed of λ: the base class of beliefs, the law of the ground that they are
told, and the static one.

A belief begins with a model's prediction and the law of the ground, is told what is
sensed, and gives the distribution
of λ in each cell. It is pure: what it knows is in a state that it is given and gives
back.
Letters in shapes: B episodes, H×W cells, M drawn fields.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, ClassVar, Generic, TypeVar

import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.batch import Batch
from benchnav.core.copula import correlations
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import expect
from benchnav.core.grid import Grid
from benchnav.core.ground import GroundStatistics
from benchnav.core.specified import Specified
from benchnav.planning.sensing.score_table import scores_of, value_at
from benchnav.planning.sensing.sensor import Sensed

State = TypeVar("State", bound=Batch)


@dataclass(frozen=True, kw_only=True)
class Law:
    """Covariance model of the λ field.

    Args:
        grid: size and resolution of the maps.
        correlation_m: ℓ: normal scores at distance d have the correlation exp(−d²/2ℓ²);
            0 where every cell is for itself.
        nugget: share of the variance of a cell's normal score that is its own and no
            neighbour's, in [0, 1): 0 where the prediction is each cell's true
            distribution. A model's errors make neighbours less alike than λ is.
        statistics: of the training maps; None where nothing needs them.
        class_names: of the prediction's classes, in the order of their ids; empty where
            it tells none.
    """

    grid: Grid
    correlation_m: float
    nugget: float = 0.0
    statistics: GroundStatistics | None = None
    class_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuses lengths that are none."""
        expect(
            0 <= self.correlation_m < float("inf"),
            f"`correlation_m` ≥ 0 and finite, got {self.correlation_m}.",
        )
        expect(0 <= self.nugget < 1, f"`nugget` in [0, 1), got {self.nugget}.")

    @property
    def correlation_cells(self) -> float:
        """ℓ in cells."""
        return self.correlation_m / self.grid.resolution_m


class Belief(Specified, ABC, Generic[State]):
    """Turns what was sensed into the distribution of λ: the base class of the parts of
    kind `belief`.

    Attributes:
        learns: whether what is sensed of λ changes what is believed; one that does not
            is told new predictions alone.
        needs_statistics: whether `Law.statistics` have to be there.
    """

    learns: ClassVar[bool] = True
    needs_statistics: ClassVar[bool] = False

    @abstractmethod
    def init(self, prior: TraversabilityDistribution, law: Law) -> State:
        """Return the initial belief state.

        Args:
            prior: the model's prediction, shape [B, H, W].
            law: the covariance model.
        """

    @abstractmethod
    def update(
        self,
        state: State,
        sensed: Sensed,
        prior: TraversabilityDistribution | None = None,
    ) -> State:
        """What is known when more was sensed.

        Args:
            state: what was known; it is not changed.
            sensed: of the same episodes.
            prior: the model's new prediction, where what it sees has changed.
        """

    @abstractmethod
    def distribution(self, state: State) -> TraversabilityDistribution:
        """What is believed of λ, shape [B, H, W]."""

    def at(self, state: State, cells: Tensor) -> TraversabilityDistribution:
        """What is believed of some cells, as a map of one row, [1, N].

        Args:
            state: what is known.
            cells: which of them, bool, shape [B, H, W].
        """
        return self.distribution(state).at(cells)

    def changed(self, before: State, after: State) -> Tensor:
        """Return a mask of cells whose belief changed, bool, shape [B, H, W]; all of
        them if that is not known.
        """
        found = self.distribution(after)
        return torch.ones(found.shape, dtype=torch.bool, device=found.device)

    @abstractmethod
    def sample_fields(self, state: State, count: int, keys: Sequence[int]) -> Tensor:
        """Draws fields of λ, whose cells hang together as what is believed has them.

        Args:
            state: what is known.
            count: M.
            keys: a stream key of each episode, B of them, so that its fields do not
                depend on the others.

        Returns:
            λ in [0, 1], shape [B, M, H, W].
        """

    def sample_cells(
        self, state: State, count: int, keys: Sequence[int], cells: Tensor
    ) -> Tensor:
        """Draws the fields of `sample_fields` where some cells alone are asked for;
        what others hold means nothing.

        Args:
            state: what is known.
            count: M.
            keys: a stream key of each episode.
            cells: which are asked for, bool, shape [B, H, W].
        """
        return self.sample_fields(state, count, keys)

    def select(self, state: State, members: Tensor) -> State:
        """Keeps some episodes, by index, int64."""
        return state.select(members)

    def put(self, state: State, members: Tensor, others: State) -> State:
        """Puts episodes in the places of others.

        Args:
            state: of B episodes; it is not changed.
            members: whose places are taken, int64, shape [M].
            others: of M episodes, under the same law.
        """
        return state.put(members, others)


@dataclass(frozen=True)
class Fields:
    """Draws whole fields of λ from what is believed.

    Args:
        belief: whose state it is.
        state: of B episodes.
        names: number of each episode, by which its fields are drawn, B of them.
    """

    belief: Belief[Any]
    state: Any
    names: tuple[int, ...]

    def sample(self, count: int, key: int, cells: Tensor | None = None) -> Tensor:
        """Draws `count` fields of each episode, shape [B, M, H, W], by a root key; see
        `Problem.sample_fields`.
        """
        keys = [rng.stream_key(key, "fields", name) for name in self.names]
        if cells is None:
            return self.belief.sample_fields(self.state, count, keys)
        return self.belief.sample_cells(self.state, count, keys, cells)

    def select(self, members: Tensor) -> "Fields":
        """Keeps some episodes, by index, int64."""
        names = tuple(self.names[place] for place in members.tolist())
        return Fields(self.belief, self.belief.select(self.state, members), names)


@dataclass(frozen=True, kw_only=True)
class Predicted(Batch):
    """What is known before anything was sensed; all that the static belief knows.

    Args:
        prior: the model's prediction, shape [B, H, W].
        law: how λ hangs together.
    """

    prior: TraversabilityDistribution
    law: Law

    def fields(self, scores: Tensor, cells: Tensor | None = None) -> Tensor:
        """λ of the ranks that normal scores have in the prediction, shape [B, M, H, W]
        of both.

        Where quantiles take long λ is linear in the score between the values of
        `score_table`, which are exact, and looked up in some cells alone, bool [B, H,
        W], where they are given.
        """
        if self._rows is None:
            return fields_of(self.prior, scores)
        scores = scores.to(self._rows)
        found = torch.zeros_like(scores)
        for place, rows in enumerate(self._rows):
            asked: Any = ... if cells is None else cells[place]
            wanted = scores[place][:, asked].movedim(0, -1)
            found[place][:, asked] = value_at(rows[asked], wanted).movedim(-1, 0)
        return found.to(self.prior.dtype)

    @cached_property
    def _rows(self) -> Tensor | None:
        """Scores of the values of each cell, float32, shape [B, H, W, K]; None where
        they are not needed.
        """
        if not self.prior.searched:
            return None
        every = torch.ones(self.prior.shape, dtype=torch.bool, device=self.prior.device)
        return scores_of(self.prior.at(every)).view(*self.prior.shape, -1)


@dataclass(frozen=True)
class Static(Belief[Predicted]):
    """The model's prediction; what is sensed on the way is ignored.

    Args:
        correlated: fields that are drawn have the law's correlation; else every cell is
            drawn for itself.
    """

    learns: ClassVar[bool] = False

    correlated: bool = True

    def init(self, prior: TraversabilityDistribution, law: Law) -> Predicted:
        """Keeps the prediction."""
        return Predicted(prior=prior, law=law)

    def update(
        self,
        state: Predicted,
        sensed: Sensed,
        prior: TraversabilityDistribution | None = None,
    ) -> Predicted:
        """Takes a new prediction where there is one."""
        return state if prior is None else Predicted(prior=prior, law=state.law)

    def distribution(self, state: Predicted) -> TraversabilityDistribution:
        """The prediction."""
        return state.prior

    def changed(self, before: Predicted, after: Predicted) -> Tensor:
        """Cells whose prediction is another."""
        return before.prior.differs(after.prior)

    def sample_fields(
        self, state: Predicted, count: int, keys: Sequence[int]
    ) -> Tensor:
        """Draws fields with the prediction's marginals."""
        return state.fields(self._scores(state, count, keys))

    def sample_cells(
        self, state: Predicted, count: int, keys: Sequence[int], cells: Tensor
    ) -> Tensor:
        """Draws them, of some cells alone."""
        return state.fields(self._scores(state, count, keys), cells)

    def _scores(self, state: Predicted, count: int, keys: Sequence[int]) -> Tensor:
        law = state.law if self.correlated else replace(state.law, correlation_m=0.0)
        return draw_scores(law, count, keys)


def draw_scores(law: Law, count: int, keys: Sequence[int]) -> Tensor:
    """Draws normal scores that hang together as those of the world do, float32, shape
    [B, M, H, W].

    As two cells are correlated by the product over both axes, white noise passes a root
    of either axis' correlations.

    Args:
        law: how they hang together.
        count: M; the first of more fields are those of fewer.
        keys: a stream key of each episode, B of them.
    """
    # An episode at a time: the last bits of a product depend on how many are in it.
    return torch.stack([_scores_of_one(law, count, key) for key in keys])


def _scores_of_one(law: Law, count: int, key: int) -> Tensor:
    """Those of an episode, shape [M, H, W]."""
    drawn = _white(key, count, law.grid.shape)
    if law.correlation_m:
        down, across = (_root(size, law.correlation_cells) for size in law.grid.shape)
        drawn = down @ drawn @ across
    if law.nugget:
        own = _white(rng.stream_key(key, "nugget"), count, law.grid.shape)
        drawn = math.sqrt(1 - law.nugget) * drawn + math.sqrt(law.nugget) * own
    return drawn


def _white(key: int, count: int, shape: tuple[int, int]) -> Tensor:
    """Standard normals, float32, shape [M, H, W]."""
    numbers = count * math.prod(shape)
    # PyTorch draws sixteen at a time, and what is left over otherwise.
    whole = -(-numbers // 16) * 16
    return torch.randn(whole, generator=rng.generator(key))[:numbers].view(
        count, *shape
    )


@lru_cache(maxsize=64)
def _root(size: int, correlation_cells: float) -> Tensor:
    """The symmetric root of the correlations along one axis, float32, shape [size,
    size].
    """
    along = torch.from_numpy(correlations(size, correlation_cells))
    place = torch.arange(size)
    values, vectors = torch.linalg.eigh(along[(place[:, None] - place).abs()])
    return ((vectors * values.clamp(min=0).sqrt()) @ vectors.T).float()


def fields_of(distribution: TraversabilityDistribution, scores: Tensor) -> Tensor:
    """λ of the ranks that normal scores have, shape [B, M, H, W].

    Args:
        distribution: of λ, shape [B, H, W].
        scores: shape [B, M, H, W].
    """
    scores = scores.to(device=distribution.device, dtype=distribution.dtype)
    return torch.stack(
        [distribution.from_normal(each) for each in scores.unbind(1)], dim=1
    )
