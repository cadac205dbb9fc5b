"""State of the copula belief: observations of λ as normal scores, and the posterior.

λ that is impossible under a prediction counts as the nearest possible value, whose
score is limited to ±`_MAX_SCORE`.
Letters in shapes: B episodes, H×W cells, N observations.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.planning.sensing.belief import Predicted
from benchnav.planning.sensing.gaussian import Field
from benchnav.planning.sensing.score_table import ScoreTable
from benchnav.planning.sensing.sensor import MIN_STD, Measurement

# A repeated measurement is ignored if averaging changes the score by less than
# `_SAME_SCORE` and leaves more than `_SAME_STD` of the noise's standard deviation.
_SAME_SCORE = 1e-6
_SAME_STD = 0.99
_MAX_SCORE = 6.0
_SAME_PREDICTION = 1e-3  # tolerance of parameters; λ̂ changes by about as much


@dataclass(frozen=True, kw_only=True)
class CopulaState(Predicted):
    """State of the copula belief; maps of observations are NaN in unobserved cells.

    Args:
        table: scores of λ under the prediction, for cells whose belief differs from the
            prediction.
        field: correlations of the scores of B episodes.
        estimated_from: number of observations in the estimate of ℓ; 0 without an
            estimate, int64, shape [B].
        value: observed λ, averaged over the measurements of a cell, float64, shape
            [B, H, W].
        lower: minimum observed score of each cell, float64, shape [B, H, W].
        upper: maximum observed score; for a number, equal to the minimum, shape
            [B, H, W].
        noise_std: standard deviation of the noise of the observed score, shape
            [B, H, W].
        precision: precision of the Gaussian term of the observation; 0 without a term,
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


def with_prior(
    state: CopulaState, prior: TraversabilityDistribution
) -> tuple[CopulaState, Tensor]:
    """Replace the prediction where it differs, and recompute observed scores there.

    Args:
        state: state with the old prediction; it is not changed.
        prior: the new prediction, shape [B, H, W].

    Returns:
        The new state, and a mask of cells with a new prediction, bool, shape [B, H, W].
    """
    differs = state.prior.differs(prior, _SAME_PREDICTION)
    if not bool(differs.any()):
        return state, differs
    rescored = differs & state.observed
    value = state.value[rescored]
    low, high = scores_at(prior, rescored, value)
    precision, shift = _terms(low, high, state.noise_std[rescored])
    # Other cells keep their prediction, so that small changes do not accumulate.
    if not bool(differs.all()):
        prior = state.prior.replaced(differs, prior)
    updated = replace(
        state,
        prior=prior,
        table=state.table.without_rows(differs),
        lower=state.lower.index_put((rescored,), low),
        upper=state.upper.index_put((rescored,), high),
        precision=state.precision.index_put((rescored,), precision),
        shift=state.shift.index_put((rescored,), shift),
    )
    return updated, differs


def _terms(low: Tensor, high: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
    """Return precision and shift of the Gaussian terms of scores; 0 for intervals."""
    is_number = high <= low
    precision = torch.where(is_number, 1 / std.square(), 0.0)
    shift = torch.where(is_number, precision * low, 0.0)
    return precision, shift


def scores_at(
    prior: TraversabilityDistribution, cells: Tensor, value: Tensor
) -> tuple[Tensor, Tensor]:
    """Return minimum and maximum scores of observed λ, which differ only at an atom.

    Args:
        prior: the prediction, shape [B, H, W].
        cells: mask of N cells, bool, shape [B, H, W].
        value: observed λ, shape [N].
    """
    values = value[None].to(prior.dtype)
    interval = prior.at(cells).to_normal(values)
    low, high = (ends[0].double() for ends in interval)
    is_number = high <= low
    number = low.clamp(-_MAX_SCORE, _MAX_SCORE)
    low = torch.where(is_number, number, low.clamp(max=_MAX_SCORE))
    high = torch.where(is_number, number, high.clamp(min=-_MAX_SCORE))
    return low, high


def add_measurement(
    state: CopulaState, sensed: Measurement
) -> tuple[CopulaState, Tensor]:
    """Return the state with an added measurement.

    Args:
        state: state before the measurement; it is not changed.
        sensed: measured λ in the same episodes.

    Returns:
        The new state, and a mask of changed observations, bool, shape [B, H, W].
    """
    new = sensed.mask
    if not bool(new.any()):
        return state, new
    value = sensed.traversability[new]
    low, high = scores_at(state.prior, new, value)
    std = sensed.std[new].double().clamp(min=MIN_STD)
    old_low = state.lower[new]
    old_std = state.noise_std[new]
    was_observed = ~old_low.isnan()
    was_number = state.upper[new] <= old_low
    is_number = high <= low
    old_variance = old_std.square()
    weight = old_variance / (old_variance + std.square())
    weight = torch.where(is_number & was_number, weight, 1.0)
    is_average = weight < 1
    average_score = torch.lerp(old_low, low, weight)
    score = torch.where(is_average, average_score, low)
    average_std = (weight.sqrt() * std).clamp(min=MIN_STD)
    new_std = torch.where(is_average, average_std, std)
    same_score = (score - old_low).abs() < _SAME_SCORE
    same_std = new_std > _SAME_STD * old_std
    is_repeated = was_number & same_score & same_std
    is_less_noisy = ~was_number & (std < old_std)
    is_first_or_less_noisy = ~was_observed | is_less_noisy
    is_new = torch.where(is_number, ~is_repeated, is_first_or_less_noisy)
    changed = torch.zeros_like(new)
    changed[new] = is_new

    def put(map_values: Tensor, values: Tensor) -> Tensor:
        return map_values.index_put((changed,), values[is_new])

    value = value.double()
    average = torch.lerp(state.value[new], value, weight)
    new_value = torch.where(is_average, average, value)
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
