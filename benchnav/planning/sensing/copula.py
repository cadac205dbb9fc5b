"""The copula belief: observed λ conditions the Gaussian field behind the world's λ.

A cell's λ has a rank in its own predicted distribution. The normal score of the rank is
a number, or an interval where the distribution has an atom, as at 0 and 1. The scores
of all cells are a correlated Gaussian field (`benchnav.core.copula`), which is
conditioned on the observed scores (`gaussian`). With the true distribution of each cell
this is the posterior under the covariance model, up to four approximations: expectation
propagation for intervals, limited distances (`conditioning`), the lattice that replaces many
observations (`lattice`), and the rejection of draws without a feasible path. With a
model's prediction the marginals are an approximation too.

λ that is impossible under a prediction is moved to the nearest possible value,
`_MAX_SCORE` standard deviations off.
Letters in shapes: B episodes, H×W cells, N observations, R×C cells of a block, K values
of λ.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from benchnav.core import rng
from benchnav.core.conditioned import ConditionedDistribution, skewed
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import expect
from benchnav.planning.sensing.belief import (
    Belief,
    CovarianceModel,
    Predicted,
    draw_scores,
)
from benchnav.planning.sensing.conditioning import (
    MEDIAN_M,
    MIN_OBSERVATIONS,
    condition_maps,
    estimate_length,
    nearest,
)
from benchnav.planning.sensing.gaussian import Field
from benchnav.planning.sensing.score_table import ScoreTable, TabulatedDistribution
from benchnav.planning.sensing.sensor import MIN_STD, Measurement

_SAME_SCORE, _SAME_STD = 1e-6, 0.99  # a repeated measurement within these is ignored
_MAX_SCORE = 6.0
_NO_TERM = 1e-12  # precision below which a term is ignored
_SAME_PREDICTION = 1e-3  # of its parameters; λ̂ is then the same within about as much
_MAPS = (
    "value",
    "lower",
    "upper",
    "noise_std",
    "precision",
    "shift",
    "mean",
    "std",
    "skew",
)
_LEARNT = ("field", "estimated_from", *_MAPS[4:])


@dataclass(frozen=True, kw_only=True)
class CopulaState(Predicted):
    """State of the copula belief; maps of observations are NaN if not observed.

    Args:
        table: scores of λ under the prediction, of the cells whose belief differs from
            it.
        field: correlations of the scores, of B fields.
        estimated_from: number of observations in the estimate of ℓ; 0 without one,
            int64, shape [B].
        value: observed λ, of several measurements the average, float64, shape
            [B, H, W].
        lower: minimum observed score of each cell, float64, shape [B, H, W].
        upper: maximum observed score; for a number, equal to the minimum, shape
            [B, H, W].
        noise_std: standard deviation of the noise of the observed score, shape
            [B, H, W].
        precision: precision of the Gaussian term of the observation; 0 without one,
            shape [B, H, W].
        shift: precision times mean of the term, shape [B, H, W].
        mean: posterior mean of the score, shape [B, H, W].
        std: posterior standard deviation of the score, shape [B, H, W].
        skew: posterior skewness of the score, shape [B, H, W].
    """

    table: ScoreTable
    field: Field
    estimated_from: Tensor
    value: Tensor
    lower: Tensor
    upper: Tensor
    noise_std: Tensor
    precision: Tensor
    shift: Tensor
    mean: Tensor
    std: Tensor
    skew: Tensor

    @property
    def observed(self) -> Tensor:
        """Mask of observed cells, bool, shape [B, H, W]."""
        return ~self.value.isnan()


@dataclass(frozen=True)
class Copula(Belief[CopulaState]):
    """Belief that updates cells near measurements of λ, by spatial correlation.

    Args:
        correlation_m: assumed ℓ in metres; `world`, that of the world, which is
            privileged; or `estimated` in each episode from its observations. The
            estimate is the mode of the posterior of log ℓ under a log-normal prior of
            median 1.5 m and standard deviation ln 2. It is computed from 8, 16, 32, …
            observations on, until the window is full; before, ℓ is the median.
        window: maximum number of observations in an estimate of ℓ, those nearest to
            changed ones. If more are near, and ℓ is four cells or more, an update
            solves for a lattice of cells (`lattice`).
        nugget: fraction of the variance of a cell's score that is independent of all
            other cells; None for that of the covariance model.
    """

    correlation_m: float | Literal["world", "estimated"] = "world"
    window: int = 256
    nugget: float | None = None

    def __post_init__(self) -> None:
        """Validate the correlation length, the window and the nugget."""
        length = self.correlation_m
        expect(
            length in ("world", "estimated")
            if isinstance(length, str)
            else 0 <= length < math.inf,
            f"`correlation_m` ≥ 0 and finite, 'world' or 'estimated', got {length!r}.",
        )
        expect(self.window >= 1, f"`window` of at least 1, got {self.window}.")
        expect(
            self.nugget is None or 0 <= self.nugget < 1,
            f"`nugget` in [0, 1), got {self.nugget}.",
        )

    def init(
        self, prior: TraversabilityDistribution, covariance: CovarianceModel
    ) -> CopulaState:
        """Return the state without observations."""
        if self.correlation_m == "world":
            length_m = covariance.correlation_m
        elif self.correlation_m == "estimated":
            length_m = MEDIAN_M
        else:
            length_m = self.correlation_m
        if self.nugget is not None:
            covariance = replace(covariance, nugget=self.nugget)
        grid = covariance.grid
        lengths = [length_m / grid.resolution_m] * prior.shape[0]
        zeros = torch.zeros(prior.shape, dtype=torch.float64, device=prior.device)
        unobserved = torch.full_like(zeros, torch.nan)
        field = Field.of(grid.shape, lengths, prior.device, covariance.nugget)
        return CopulaState(
            prior=prior,
            table=ScoreTable.empty(prior),
            covariance=covariance,
            field=field,
            estimated_from=zeros[:, 0, 0].long(),
            value=unobserved,
            lower=unobserved,
            upper=unobserved,
            noise_std=unobserved,
            precision=zeros,
            shift=zeros,
            mean=zeros,
            std=torch.ones_like(zeros),
            skew=zeros,
        )

    def update(
        self,
        state: CopulaState,
        sensed: Measurement,
        prior: TraversabilityDistribution | None = None,
    ) -> CopulaState:
        """Condition cells near new observations.

        Measurements of a number are averaged; of measurements of an interval the least
        noisy one is used. A new prediction replaces the old one in cells whose
        parameters differ by more than 10⁻³.
        """
        noted = state
        new_prior = torch.zeros_like(state.observed)
        if prior is not None:
            noted, new_prior = with_prior(state, prior)
        noted, changed = note(noted, sensed)
        learnt = self.learn(noted, changed | (new_prior & noted.observed))
        moved = new_prior | _moved(state, learnt)
        return replace(learnt, table=learnt.table.having(learnt.prior, moved))

    def learn(self, noted: CopulaState, changed: Tensor) -> CopulaState:
        """Condition cells near changed observations.

        Args:
            noted: state with the observations; it is not changed.
            changed: mask of observations not yet conditioned on, bool, shape [B, H, W].
        """
        members = changed.flatten(1).any(1).nonzero()[:, 0].tolist()
        if not members:
            return noted
        # On the host, where such small systems are solved quickest.
        maps = {name: getattr(noted, name).to("cpu") for name in _MAPS}
        host = replace(noted, **maps)
        written = {name: getattr(host, name).clone().to("cpu") for name in _LEARNT}
        host = replace(host, **written)
        new = changed[members].cpu().numpy()
        for index, member in enumerate(members):
            self._learn(host, member, new[index])
        learnt = {name: getattr(host, name).to(changed.device) for name in _LEARNT}
        return replace(noted, **learnt)

    def _learn(self, state: CopulaState, member: int, new: ndarray) -> None:
        """Condition one episode on its observations; writes into the state.

        Episodes are conditioned one by one, since each has another number of
        observations, and must not depend on the others.
        """
        maps = {name: getattr(state, name)[member].numpy() for name in _MAPS}
        observed = ~np.isnan(maps["value"])
        count = int(observed.sum())
        before = int(state.estimated_from[member])
        has_doubled = max(MIN_OBSERVATIONS, 2 * before) <= count
        may_estimate = self.correlation_m == "estimated" and before < self.window
        if may_estimate and has_doubled:
            state.estimated_from[member] = count
            row, column = nearest(observed, new, self.window)
            length = estimate_length(
                state.covariance, maps, row[: self.window], column[: self.window]
            )
            if length != float(state.field.length[member]):
                shape = state.covariance.grid.shape
                field = Field.of(shape, [length], "cpu", state.covariance.nugget)
                state.field.write(member, field)
                maps["mean"][:], maps["std"][:], maps["skew"][:] = 0, 1, 0
                new = observed
        condition_maps(state.field, member, maps, new, self.window)

    def distribution(self, state: CopulaState) -> TraversabilityDistribution:
        """Return the distribution of λ given all observations, shape [B, H, W]."""
        dtype = state.prior.dtype
        moments = (state.mean, state.std, state.skew)
        return ConditionedDistribution(
            state.prior, *(values.to(dtype) for values in moments)
        )

    def at(self, state: CopulaState, cells: Tensor) -> TabulatedDistribution:
        """Return the belief in some cells; see `Belief`.

        It is from a table of scores, which is far quicker than `distribution`; λ̂ is
        within 0.01 of it.
        """
        table = state.table.having(state.prior, cells)
        moments = (state.mean[cells], state.std[cells], state.skew[cells])
        below = table.below(cells, *moments)
        return TabulatedDistribution(below.T[:, None].to(state.prior.dtype))

    def changed(self, before: CopulaState, after: CopulaState) -> Tensor:
        """Return a mask of cells whose score or prediction changed."""
        moved = _moved(before, after)
        if before.prior is after.prior:
            return moved
        return moved | before.prior.differs(after.prior)

    def put(
        self, state: CopulaState, members: Tensor, others: CopulaState
    ) -> CopulaState:
        """Replace episodes; see `Belief`."""
        table = state.table.put(members, others.table)
        return replace(state.put(members, others), table=table)

    def sample_fields(
        self, state: CopulaState, count: int, keys: Sequence[int]
    ) -> Tensor:
        """Draw fields given all observations, by Matheron's rule.

        A field of the covariance model is moved to the observations.
        """
        return state.fields(self.sample_scores(state, count, keys))

    def sample_scores(
        self, state: CopulaState, count: int, keys: Sequence[int]
    ) -> Tensor:
        """Return normal scores of the fields of `sample_fields`, shape [B, M, H, W]."""
        grid = state.covariance.grid
        device = state.mean.device
        rows = torch.arange(grid.height, device=device)[:, None]
        columns = torch.arange(grid.width, device=device)
        scores = []
        for member, length in enumerate(state.field.length.tolist()):
            covariance = replace(
                state.covariance, correlation_m=length * grid.resolution_m
            )
            drawn = draw_scores(covariance, count, keys[member : member + 1])[0]
            drawn = drawn.to(device).double()
            scores.append(drawn)
            has_term = state.precision[member] > _NO_TERM
            row, column = has_term.nonzero(as_tuple=True)
            if len(row) == 0:
                continue
            precision = state.precision[member, row, column]
            shift = state.shift[member, row, column]
            noise_keys = [rng.stream_key(keys[member], "observations")]
            white = replace(covariance, correlation_m=0.0, nugget=0.0)
            noise = draw_scores(white, count, noise_keys)[0]
            noise = noise.to(drawn)[:, row, column] / precision.sqrt()
            inner = state.field.covariance(
                member, row[:, None] - row, column[:, None] - column
            )
            inner.diagonal().add_(1 / precision)
            away = (shift / precision - drawn[:, row, column] - noise).T
            weights = torch.cholesky_solve(away, torch.linalg.cholesky(inner))
            across = state.field.covariance(
                member, row[:, None, None] - rows, column[:, None, None] - columns
            )
            drawn += (across.flatten(1).T @ weights).T.view_as(drawn)
        mean = state.mean[:, None]
        std = state.std[:, None]
        normal = (torch.stack(scores) - mean) / std.clamp(min=_NO_TERM)
        return mean + std * skewed(normal, state.skew[:, None])


def _moved(before: CopulaState, after: CopulaState) -> Tensor:
    """Return a mask of cells whose posterior score changed, bool, shape [B, H, W]."""
    moved = before.mean != after.mean
    moved = moved | (before.std != after.std)
    return moved | (before.skew != after.skew)


def with_prior(
    state: CopulaState, prior: TraversabilityDistribution
) -> tuple[CopulaState, Tensor]:
    """Replace the prediction where it differs, and score the observed λ there again.

    Returns:
        The state, and the mask of cells with a new prediction, bool, shape [B, H, W].
    """
    differs = state.prior.differs(prior, _SAME_PREDICTION)
    if not bool(differs.any()):
        return state, differs
    rescored = differs & state.observed
    low, high = scores_at(prior, rescored, state.value[rescored])
    precision, shift = _terms(low, high, state.noise_std[rescored])
    # Other cells keep their prediction, so that small changes do not add up unseen.
    if not bool(differs.all()):
        prior = state.prior.replaced(differs, prior)
    updated = replace(
        state,
        prior=prior,
        table=state.table.without(differs),
        lower=state.lower.index_put((rescored,), low),
        upper=state.upper.index_put((rescored,), high),
        precision=state.precision.index_put((rescored,), precision),
        shift=state.shift.index_put((rescored,), shift),
    )
    return updated, differs


def _terms(low: Tensor, high: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
    """Return precision and shift of the terms of scores; 0 for intervals."""
    is_number = high <= low
    precision = torch.where(is_number, 1 / std.square(), 0.0)
    return precision, torch.where(is_number, precision * low, 0.0)


def scores_at(
    prior: TraversabilityDistribution, cells: Tensor, value: Tensor
) -> tuple[Tensor, Tensor]:
    """Return minimum and maximum scores of observed λ; they differ only at an atom.

    Args:
        prior: the prediction, shape [B, H, W].
        cells: mask of N cells, bool, shape [B, H, W].
        value: observed λ, shape [N].
    """
    values = value[None].to(prior.dtype)
    low, high = (end[0].double() for end in prior.at(cells).to_normal(values))
    is_number = high <= low
    number = low.clamp(-_MAX_SCORE, _MAX_SCORE)
    low = torch.where(is_number, number, low.clamp(max=_MAX_SCORE))
    high = torch.where(is_number, number, high.clamp(min=-_MAX_SCORE))
    return low, high


def note(state: CopulaState, sensed: Measurement) -> tuple[CopulaState, Tensor]:
    """Add a measurement to the observations.

    Returns:
        The state, and the mask of changed observations, bool, shape [B, H, W].
    """
    new = sensed.mask
    if not bool(new.any()):
        return state, new
    value = sensed.traversability[new]
    low, high = scores_at(state.prior, new, value)
    std = sensed.std[new].double().clamp(min=MIN_STD)
    was_low = state.lower[new]
    was_std = state.noise_std[new]
    was_observed = ~was_low.isnan()
    is_number = high <= low
    was_number = state.upper[new] <= was_low
    old_variance = was_std.square()
    weight = old_variance / (old_variance + std.square())
    weight = torch.where(is_number & was_number, weight, 1.0)
    is_average = weight < 1
    score = torch.where(is_average, torch.lerp(was_low, low, weight), low)
    average_std = (weight.sqrt() * std).clamp(min=MIN_STD)
    new_std = torch.where(is_average, average_std, std)
    same_score = (score - was_low).abs() < _SAME_SCORE
    is_repeated = was_number & same_score & (new_std > _SAME_STD * was_std)
    is_sharper = ~was_observed | (~was_number & (std < was_std))
    is_news = torch.where(is_number, ~is_repeated, is_sharper)
    changed = torch.zeros_like(new)
    changed[new] = is_news

    def put(map_values: Tensor, values: Tensor) -> Tensor:
        return map_values.index_put((changed,), values[is_news])

    average = torch.lerp(state.value[new], value.double(), weight)
    new_value = torch.where(is_average, average, value.double())
    score = torch.where(is_number, score, low)
    high = torch.where(is_number, score, high)
    precision, shift = _terms(score, high, new_std)
    noted = replace(
        state,
        value=put(state.value, new_value),
        lower=put(state.lower, score),
        upper=put(state.upper, high),
        noise_std=put(state.noise_std, new_std),
        precision=put(state.precision, precision),
        shift=put(state.shift, shift),
    )
    return noted, changed
