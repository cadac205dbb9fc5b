"""Beliefs about λ: base class, covariance model of the λ field, and static belief.

A belief starts from a model's prediction and the covariance model, is updated with
measurements, and returns the distribution of λ in each cell. It is pure: its methods
receive and return a state, which contains all information from measurements.
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
from benchnav.planning.sensing.sensor import Measurement

State = TypeVar("State", bound=Batch)


@dataclass(frozen=True, kw_only=True)
class CovarianceModel:
    """Covariance model of the λ field.

    Args:
        grid: size and resolution of the maps.
        correlation_m: ℓ in metres; normal scores at distance d have the correlation
            exp(−d²/2ℓ²). If it is 0, cells are independent.
        nugget: fraction of the variance of a cell's normal score that is independent of
            all other cells, in [0, 1). It is 0 if the prediction is each cell's true
            distribution. It is above 0 for a model whose errors reduce the correlation
            between neighbours.
        statistics: statistics of the training maps; None if no part needs them.
        class_names: names of the prediction's classes, in the order of their ids; empty
            if it has no classes.
    """

    grid: Grid
    correlation_m: float
    nugget: float = 0.0
    statistics: GroundStatistics | None = None
    class_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Validate the correlation length and the nugget."""
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
    """Base class of beliefs (parts of kind `belief`), which infer λ from measurements.

    Attributes:
        learns: whether measured λ changes the belief. If False, the belief receives no
            measurements, only new predictions.
        needs_statistics: whether `CovarianceModel.statistics` is required.
    """

    learns: ClassVar[bool] = True
    needs_statistics: ClassVar[bool] = False

    @abstractmethod
    def init(
        self, prior: TraversabilityDistribution, covariance: CovarianceModel
    ) -> State:
        """Return the initial belief state.

        Args:
            prior: the model's prediction, shape [B, H, W].
            covariance: the covariance model.
        """

    @abstractmethod
    def update(
        self,
        state: State,
        sensed: Measurement,
        prior: TraversabilityDistribution | None = None,
    ) -> State:
        """Return the belief state after new measurements.

        Args:
            state: state before the update; it is not changed.
            sensed: measured λ in the same episodes.
            prior: the model's new prediction; None if the model's input is unchanged.
        """

    @abstractmethod
    def distribution(self, state: State) -> TraversabilityDistribution:
        """Return the distribution of λ, shape [B, H, W]."""

    def at(self, state: State, cells: Tensor) -> TraversabilityDistribution:
        """Return the distribution of λ in N cells, as a map of one row, [1, N].

        Args:
            state: belief state.
            cells: mask of the N cells, bool, shape [B, H, W].
        """
        return self.distribution(state).at(cells)

    def changed(self, before: State, after: State) -> Tensor:
        """Return a mask of cells whose belief changed, bool, shape [B, H, W].

        The base class returns a mask of all cells.

        Args:
            before: belief state before the update.
            after: belief state after the update.
        """
        belief = self.distribution(after)
        return torch.ones(belief.shape, dtype=torch.bool, device=belief.device)

    @abstractmethod
    def sample_fields(self, state: State, count: int, keys: Sequence[int]) -> Tensor:
        """Draw joint samples of the λ field from the belief.

        Args:
            state: belief state.
            count: M, number of fields per episode.
            keys: stream key of each episode, length B. The fields of an episode may
                depend on no other episode.

        Returns:
            λ in [0, 1], shape [B, M, H, W].
        """

    def sample_cells(
        self, state: State, count: int, keys: Sequence[int], cells: Tensor
    ) -> Tensor:
        """Draw the fields of `sample_fields` in some cells; other cells are undefined.

        Args:
            state: belief state.
            count: M, number of fields per episode.
            keys: stream key of each episode, length B.
            cells: mask of the requested cells, bool, shape [B, H, W].
        """
        return self.sample_fields(state, count, keys)

    def select(self, state: State, members: Tensor) -> State:
        """Return the belief state of the episodes at these indices (int64)."""
        return state.select(members)

    def put(self, state: State, members: Tensor, others: State) -> State:
        """Return the belief state with some episodes replaced.

        Args:
            state: belief state of B episodes; it is not changed.
            members: indices of the episodes to replace, int64.
            others: belief state of the new episodes, one per index, under the same
                covariance model.
        """
        return state.put(members, others)


@dataclass(frozen=True)
class Fields:
    """Source of joint samples of the λ field, drawn from a belief.

    Args:
        belief: the belief.
        state: state of the belief in B episodes.
        indices: integers that identify the random stream of each episode, length B.
    """

    belief: Belief[Any]
    state: Any
    indices: tuple[int, ...]

    def sample(self, count: int, key: int, cells: Tensor | None = None) -> Tensor:
        """Draw fields of each episode, shape [B, M, H, W].

        Args:
            count: M, number of fields per episode.
            key: root key of the random streams; see `Problem.sample_fields`.
            cells: mask of the requested cells, bool, shape [B, H, W]; None for all
                cells.
        """
        keys = [rng.stream_key(key, "fields", index) for index in self.indices]
        if cells is None:
            return self.belief.sample_fields(self.state, count, keys)
        return self.belief.sample_cells(self.state, count, keys, cells)

    def select(self, members: Tensor) -> "Fields":
        """Return the source of the episodes at these indices (int64)."""
        state = self.belief.select(self.state, members)
        indices = tuple(self.indices[index] for index in members.tolist())
        return Fields(self.belief, state, indices)


@dataclass(frozen=True, kw_only=True)
class Predicted(Batch):
    """A prediction and its covariance model: the state of the static belief.

    Args:
        prior: the model's prediction, shape [B, H, W].
        covariance: covariance model of the λ field.
    """

    prior: TraversabilityDistribution
    covariance: CovarianceModel

    def fields(self, scores: Tensor, cells: Tensor | None = None) -> Tensor:
        """Return the λ at normal scores under the prediction, shape [B, M, H, W].

        If the prediction's quantile function is slow, λ is exact at the values of
        `score_table` and linear in the score between them.

        Args:
            scores: normal scores, shape [B, M, H, W].
            cells: mask of the requested cells, bool, shape [B, H, W]; None for all
                cells.
        """
        if self._score_rows is None:
            return fields_of(self.prior, scores)
        scores = scores.to(self._score_rows)
        fields = torch.zeros_like(scores)
        for episode, rows in enumerate(self._score_rows):
            mask: Any = ... if cells is None else cells[episode]
            cell_scores = scores[episode][:, mask].movedim(0, -1)
            cell_values = value_at(rows[mask], cell_scores)
            fields[episode][:, mask] = cell_values.movedim(-1, 0)
        return fields.to(self.prior.dtype)

    @cached_property
    def _score_rows(self) -> Tensor | None:
        """Scores of the K values of `score_table`, float32, shape [B, H, W, K].

        None if the prediction's quantile function is fast.
        """
        prior = self.prior
        if not prior.searched:
            return None
        all_cells = torch.ones(prior.shape, dtype=torch.bool, device=prior.device)
        scores = scores_of(prior.at(all_cells))
        return scores.view(*prior.shape, -1)


@dataclass(frozen=True)
class Static(Belief[Predicted]):
    """Belief that equals the model's prediction and ignores measured λ.

    Args:
        correlated: whether drawn fields have the correlations of the covariance model.
            If False, their cells are independent.
    """

    learns: ClassVar[bool] = False

    correlated: bool = True

    def init(
        self, prior: TraversabilityDistribution, covariance: CovarianceModel
    ) -> Predicted:
        """Return the prediction as the belief state."""
        return Predicted(prior=prior, covariance=covariance)

    def update(
        self,
        state: Predicted,
        sensed: Measurement,
        prior: TraversabilityDistribution | None = None,
    ) -> Predicted:
        """Return the state with the new prediction, if there is one."""
        if prior is None:
            return state
        return Predicted(prior=prior, covariance=state.covariance)

    def distribution(self, state: Predicted) -> TraversabilityDistribution:
        """Return the prediction."""
        return state.prior

    def changed(self, before: Predicted, after: Predicted) -> Tensor:
        """Return a mask of cells whose prediction changed, bool, shape [B, H, W]."""
        return before.prior.differs(after.prior)

    def sample_fields(
        self, state: Predicted, count: int, keys: Sequence[int]
    ) -> Tensor:
        """Draw fields with the prediction's marginals."""
        return state.fields(self._scores(state, count, keys))

    def sample_cells(
        self, state: Predicted, count: int, keys: Sequence[int], cells: Tensor
    ) -> Tensor:
        """Draw fields with the prediction's marginals in some cells."""
        return state.fields(self._scores(state, count, keys), cells)

    def _scores(self, state: Predicted, count: int, keys: Sequence[int]) -> Tensor:
        covariance = state.covariance
        if not self.correlated:
            covariance = replace(covariance, correlation_m=0.0)
        return draw_scores(covariance, count, keys)


def draw_scores(covariance: CovarianceModel, count: int, keys: Sequence[int]) -> Tensor:
    """Draw correlated normal scores, float32, shape [B, M, H, W].

    The correlation of two cells is the product of a correlation along the rows and one
    along the columns. Hence white noise is multiplied by the square root of the
    correlation matrix of each axis.

    Args:
        covariance: covariance model of the scores.
        count: M, number of fields per episode; the first fields do not depend on it.
        keys: stream key of each episode, length B.
    """
    # Episodes are drawn one by one, since rounding depends on the size of a batch.
    return torch.stack([_scores_of_episode(covariance, count, key) for key in keys])


def _scores_of_episode(covariance: CovarianceModel, count: int, key: int) -> Tensor:
    """Return normal scores of one episode, float32, shape [M, H, W]."""
    shape = covariance.grid.shape
    scores = _white_noise(key, count, shape)
    if covariance.correlation_m:
        row_root, column_root = (
            _correlation_root(size, covariance.correlation_cells) for size in shape
        )
        scores = row_root @ scores @ column_root
    nugget = covariance.nugget
    if nugget:
        nugget_noise = _white_noise(rng.stream_key(key, "nugget"), count, shape)
        scores = math.sqrt(1 - nugget) * scores + math.sqrt(nugget) * nugget_noise
    return scores


def _white_noise(key: int, count: int, shape: tuple[int, int]) -> Tensor:
    """Return standard normals, float32, shape [M, H, W]."""
    n_numbers = count * math.prod(shape)
    # PyTorch draws sixteen numbers at a time, and a remainder by another method.
    n_drawn = -(-n_numbers // 16) * 16
    numbers = torch.randn(n_drawn, generator=rng.generator(key))[:n_numbers]
    return numbers.view(count, *shape)


@lru_cache(maxsize=64)
def _correlation_root(size: int, correlation_cells: float) -> Tensor:
    """Return the symmetric square root of the correlation matrix along one axis.

    Args:
        size: number of cells along the axis.
        correlation_cells: ℓ in cells.

    Returns:
        Float32, shape [size, size].
    """
    along = torch.from_numpy(correlations(size, correlation_cells))
    index = torch.arange(size)
    distance = (index[:, None] - index).abs()
    values, vectors = torch.linalg.eigh(along[distance])
    scaled = vectors * values.clamp(min=0).sqrt()
    return (scaled @ vectors.T).float()


def fields_of(distribution: TraversabilityDistribution, scores: Tensor) -> Tensor:
    """Return the λ at normal scores, shape [B, M, H, W].

    Args:
        distribution: distribution of λ, shape [B, H, W].
        scores: normal scores, shape [B, M, H, W].
    """
    scores = scores.to(device=distribution.device, dtype=distribution.dtype)
    fields = [
        distribution.from_normal(field_scores) for field_scores in scores.unbind(1)
    ]
    return torch.stack(fields, dim=1)
