"""State of the belief of look-alike classes: observations under either class.

Letters in shapes: B episodes, H×W cells.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.planning.sensing import copula_state
from benchnav.planning.sensing.copula_state import CopulaState
from benchnav.planning.sensing.sensor import MIN_STD, Measurement
from benchnav.planning.sensing.sites import Evidence
from benchnav.planning.sensing.truncated_normal import interval_moments

# Tolerance of an observed score; labels of a cell are drawn again beyond it.
_SAME_SCORE = 0.05
MIN_PROBABILITY = 1e-9
"""Minimum probability of a class, so that log odds are finite."""


@dataclass(frozen=True, kw_only=True)
class ClassesState(Batch):
    """State of the belief of look-alike classes.

    Args:
        copula: state of the copula belief, with observed scores under the more probable
            class of each cell, and with the prediction under the first class.
        per_class: states with the observations under the first and under the second
            class; their posterior scores are not computed.
        density: log f / φ of the observation under either class, 0 for an interval,
            shape [B, 2, H, W].
        pair: index of each cell's pair, from 1; 0 without a pair, int64, shape
            [B, H, W].
        log_odds: predicted log odds of the first class, float64, shape [B, H, W].
        p_first: posterior probability of the first class under even prior odds,
            float64, shape [B, H, W].
        labels: words of the labels (see `labels`); a set bit is the first class, int64,
            shape [B, H, W].
        sweeps: number of sweeps of each episode, int64, shape [B].
    """

    copula: CopulaState
    per_class: tuple[CopulaState, CopulaState]
    density: Tensor
    pair: Tensor
    log_odds: Tensor
    p_first: Tensor
    labels: Tensor
    sweeps: Tensor

    def probability(self) -> Tensor:
        """Return the posterior probability of the first class, shape [B, H, W].

        It is 1 for cells without a pair.
        """
        posterior = self.log_odds + torch.logit(self.p_first, eps=MIN_PROBABILITY)
        return torch.where(self.pair > 0, torch.sigmoid(posterior), 1.0)


def log_density_ratio(given_class: CopulaState, cells: Tensor, value: Tensor) -> Tensor:
    """Return log f / φ of observed λ under a class.

    Args:
        given_class: observations under the class.
        cells: mask of N cells, bool, shape [B, H, W].
        value: observed λ, shape [N].

    Returns:
        Log of the ratio; 0 for intervals, float64, shape [N].
    """
    low, high = copula_state.scores_at(given_class.prior, cells, value)
    prior = given_class.prior.at(cells)
    values = value[None].double()
    log_prob = prior.log_prob(values)[0].double()
    log_tau = math.log(2 * math.pi)
    log_normal = 0.5 * (low.square() + log_tau)
    return torch.where(high > low, 0.0, log_prob + log_normal)


def add_measurement(
    state: ClassesState, sensed: Measurement
) -> tuple[ClassesState, Tensor]:
    """Return the state with a measurement added to the observations under either class.

    Returns:
        The new state, and a mask of changed observations, bool, shape [B, H, W].
    """
    changed = torch.zeros_like(sensed.mask)
    per_class = []
    density = state.density.clone()
    for class_index, given_class in enumerate(state.per_class):
        with_measurement, is_new = copula_state.add_measurement(given_class, sensed)
        if bool(is_new.any()):
            class_density = density[:, class_index]
            class_density[is_new] = _new_density(
                given_class, sensed, is_new, class_density[is_new]
            )
        per_class.append(with_measurement)
        changed |= is_new
    first, second = per_class
    return replace(state, per_class=(first, second), density=density), changed


def _new_density(
    before: CopulaState, sensed: Measurement, is_new: Tensor, old_density: Tensor
) -> Tensor:
    """Return log f / φ of changed observations under a class, shape [N].

    A repeated number adds its own density, and the normal exponent of its distance from
    the earlier number.
    """
    value = sensed.traversability[is_new]
    std = sensed.std[is_new].double().clamp(min=MIN_STD)
    low, high = copula_state.scores_at(before.prior, is_new, value)
    old_low = before.lower[is_new]
    old_std = before.noise_std[is_new]
    is_repeated = (high <= low) & (old_low >= before.upper[is_new])
    variance = std.square() + old_std.square()
    squared = (low - old_low).square() / variance
    density = log_density_ratio(before, is_new, value)
    total = old_density + density - 0.5 * squared
    return torch.where(is_repeated, total, density)


def rescored_cells(before: ClassesState, after: ClassesState) -> Tensor:
    """Return a mask of observed cells whose scores or pair differ, bool, [B, H, W]."""
    is_rescored = before.pair != after.pair
    for old, new in zip(before.per_class, after.per_class, strict=True):
        for name in ("lower", "upper"):
            old_end = getattr(old, name)
            new_end = getattr(new, name)
            # Equal infinite ends are compared first, since their difference is NaN.
            is_close = (old_end - new_end).abs() <= _SAME_SCORE
            is_rescored |= ~((old_end == new_end) | is_close)
    observed = after.per_class[0].observed
    return is_rescored & observed & (after.pair > 0)


def evidence_of(state: ClassesState) -> Evidence:
    """Return the evidence from which labels are drawn."""
    first, second = state.per_class
    lower = torch.stack((first.lower, second.lower), 1)
    upper = torch.stack((first.upper, second.upper), 1)
    return Evidence(
        field=state.copula.field,
        lower=lower,
        upper=upper,
        noise_std=first.noise_std,
        density=state.density,
        precision=state.copula.precision,
        shift=state.copula.shift,
        pair=state.pair,
        p_first=state.p_first,
        labels=state.labels,
        sweeps=state.sweeps,
    )


def scores_of_likelier_class(state: ClassesState) -> CopulaState:
    """Return the copula state with scores under the more probable class of each cell.

    Intervals that changed have no Gaussian terms yet.
    """
    is_first = state.probability() >= 0.5
    first, second = state.per_class
    before = state.copula
    lower = torch.where(is_first, first.lower, second.lower)
    upper = torch.where(is_first, first.upper, second.upper)
    noise_std = torch.where(is_first, first.noise_std, second.noise_std)
    is_number = upper <= lower
    same_ends = (lower == before.lower) & (upper == before.upper)
    is_same = same_ends & (noise_std == before.noise_std)
    old_precision = torch.where(is_same, before.precision, 0.0)
    precision = torch.where(is_number, 1 / noise_std.square(), old_precision)
    old_shift = torch.where(is_same, before.shift, 0.0)
    shift = torch.where(is_number, precision * lower, old_shift)
    return replace(
        before,
        value=first.value,
        lower=lower,
        upper=upper,
        noise_std=noise_std,
        precision=precision,
        shift=shift,
    )


def moments_of(state: ClassesState) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean, standard deviation and skewness of scores under either class.

    Each has the shape [B, 2, H, W].
    """
    copula = state.copula
    cells = copula.observed & (state.pair > 0)
    means = torch.stack((copula.mean, copula.mean), 1)
    stds = torch.stack((copula.std, copula.std), 1)
    skews = torch.stack((copula.skew, copula.skew), 1)
    if not bool(cells.any()):
        return means, stds, skews
    is_first = state.probability()[cells] >= 0.5
    mean = copula.mean[cells]
    variance = copula.std[cells].square().clamp(min=1e-12)
    # The cavity is the posterior without the cell's own term. Its precision is at least
    # that of the prior, 1.
    cavity_precision = (1 / variance - copula.precision[cells]).clamp(min=1)
    centre = (mean / variance - copula.shift[cells]) / cavity_precision
    cavity = 1 / cavity_precision
    for class_index, given_class in enumerate(state.per_class):
        new_mean, new_std = _moments_given(given_class, cells, centre, cavity)
        # The state's posterior is that under the more probable class.
        is_chosen = is_first == (class_index == 0)
        new_skew = torch.zeros_like(new_std)
        updates = (means, new_mean), (stds, new_std), (skews, new_skew)
        for values, new_values in updates:
            class_values = values[:, class_index]
            old_values = class_values[cells]
            class_values[cells] = torch.where(is_chosen, old_values, new_values)
    return means, stds, skews


def _moments_given(
    given_class: CopulaState, cells: Tensor, centre: Tensor, cavity: Tensor
) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation of scores under a class, each of shape [N].

    Args:
        given_class: observations under the class.
        cells: mask of N observed cells, bool, shape [B, H, W].
        centre: cavity mean, shape [N].
        cavity: cavity variance, shape [N].
    """
    lower = given_class.lower[cells]
    upper = given_class.upper[cells]
    total = cavity + given_class.noise_std[cells].square()
    gain = cavity / total
    is_number = upper <= lower
    # Numbers get a dummy interval here; their moments are replaced below.
    interval_upper = torch.where(is_number, lower + 1, upper)
    intervals = centre, total, lower, interval_upper
    arrays = [values.cpu().numpy() for values in intervals]
    moments = interval_moments(*arrays)
    noisy_mean, noisy_variance = (
        torch.from_numpy(values).to(lower) for values in moments
    )
    noisy_mean = torch.where(is_number, lower, noisy_mean)
    noisy_variance = torch.where(is_number, 0.0, noisy_variance)
    added_variance = gain.square() * noisy_variance
    variance = cavity - cavity * gain + added_variance
    mean = centre + gain * (noisy_mean - centre)
    return mean, variance.sqrt()
