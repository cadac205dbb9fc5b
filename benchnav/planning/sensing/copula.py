"""The copula belief: observed λ conditions the Gaussian field behind the world's λ.

The normal score of a cell's λ is Φ⁻¹(F(λ)), where F is the cell's predicted CDF. It is
a number, or an interval if λ is at an atom, such as 0 or 1. The scores of all cells are
a correlated Gaussian field (`benchnav.core.copula`), which is conditioned on the
observed scores (`gaussian`). If the prediction is the true distribution of each cell,
the result is the posterior under the covariance model, up to four approximations:
expectation propagation for intervals; limited distances (`conditioning`); a lattice of
cells if there are many observations (`lattice`); and no correction for fields without a
feasible path, which worlds reject. A model's prediction also approximates the marginals.

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
    draw_scores,
)
from benchnav.planning.sensing.conditioning import (
    MEDIAN_M,
    MIN_OBSERVATIONS,
    condition_maps,
    estimate_length,
    nearest,
)
from benchnav.planning.sensing.copula_state import (
    CopulaState,
    add_measurement,
    with_prior,
)
from benchnav.planning.sensing.gaussian import Field
from benchnav.planning.sensing.score_table import ScoreTable, TabulatedDistribution
from benchnav.planning.sensing.sensor import Measurement

_NO_TERM = 1e-12  # precision below which a term is ignored
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
_CONDITIONED = ("field", "estimated_from", *_MAPS[4:])


@dataclass(frozen=True)
class Copula(Belief[CopulaState]):
    """Belief that updates cells near measurements of λ, by spatial correlation.

    Args:
        correlation_m: assumed ℓ in metres, ≥ 0; `world` for the ℓ of the world, which
            is privileged; or `estimated` for an estimate from each episode's
            observations. The estimate is the mode of the posterior of log ℓ. The prior
            of log ℓ is normal, with median ln 1.5 m and standard deviation ln 2. ℓ is
            1.5 m at first, and is estimated at 8, 16, 32, … observations until the
            window is full.
        window: maximum number of observations in an estimate of ℓ, ≥ 1; the
            observations nearest to changed observations are used. If an update has more
            observations and ℓ is four cells or more, the field is approximated by a
            lattice of cells (`lattice`).
        nugget: fraction of the variance of a cell's score that is independent of all
            other cells, in [0, 1); None for the nugget of the covariance model.
    """

    correlation_m: float | Literal["world", "estimated"] = "world"
    window: int = 256
    nugget: float | None = None

    def __post_init__(self) -> None:
        """Validate the correlation length, the window and the nugget."""
        length = self.correlation_m
        is_valid = length in ("world", "estimated")
        if not isinstance(length, str):
            is_valid = 0 <= length < math.inf
        expect(
            is_valid,
            "`correlation_m` to be a finite number ≥ 0, 'world' or 'estimated', got "
            f"{length!r}.",
        )
        expect(self.window >= 1, f"`window` ≥ 1, got {self.window}.")
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
        no_observations = zeros[:, 0, 0].long()
        field = Field.of(grid.shape, lengths, prior.device, covariance.nugget)
        return CopulaState(
            prior=prior,
            table=ScoreTable.empty(prior),
            covariance=covariance,
            field=field,
            estimated_from=no_observations,
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

        Repeated measurements of a cell are averaged if their scores are numbers. If
        they are intervals, the least noisy one is used. A new prediction replaces the
        old one in cells where its parameters differ by more than 10⁻³.
        """
        updated = state
        new_prior = torch.zeros_like(state.observed)
        if prior is not None:
            updated, new_prior = with_prior(state, prior)
        updated, changed = add_measurement(updated, sensed)
        conditioned = self.learn(updated, changed | (new_prior & updated.observed))
        is_changed = new_prior | _score_changed(state, conditioned)
        return replace(
            conditioned,
            table=conditioned.table.with_rows(conditioned.prior, is_changed),
        )

    def learn(self, state: CopulaState, changed: Tensor) -> CopulaState:
        """Return the state with cells near changed observations conditioned.

        Args:
            state: state with the observations; it is not changed.
            changed: mask of observations on which the state is not yet conditioned,
                bool, shape [B, H, W].
        """
        has_changed = changed.flatten(1).any(1)
        episodes = has_changed.nonzero()[:, 0].tolist()
        if not episodes:
            return state
        # Such small systems are solved quickest on the CPU.
        maps = {name: getattr(state, name).to("cpu") for name in _MAPS}
        host = replace(state, **maps)
        copies = {name: getattr(host, name).clone().to("cpu") for name in _CONDITIONED}
        host = replace(host, **copies)
        changed_by_episode = changed[episodes].cpu().numpy()
        for index, episode in enumerate(episodes):
            self._condition_episode(host, episode, changed_by_episode[index])
        conditioned = {
            name: getattr(host, name).to(changed.device) for name in _CONDITIONED
        }
        return replace(state, **conditioned)

    def _condition_episode(
        self, state: CopulaState, episode: int, changed: ndarray
    ) -> None:
        """Condition one episode on its observations, in place.

        Episodes are conditioned one by one, since their numbers of observations differ
        and no episode may depend on another episode.

        Args:
            state: state of all episodes, on the CPU; it is changed.
            episode: index of the episode.
            changed: mask of its changed observations, bool, shape [H, W].
        """
        maps = {name: getattr(state, name)[episode].numpy() for name in _MAPS}
        observed = ~np.isnan(maps["value"])
        n_observed = int(observed.sum())
        n_at_estimate = int(state.estimated_from[episode])
        has_doubled = max(MIN_OBSERVATIONS, 2 * n_at_estimate) <= n_observed
        may_estimate = self.correlation_m == "estimated" and n_at_estimate < self.window
        if may_estimate and has_doubled:
            state.estimated_from[episode] = n_observed
            row, column = nearest(observed, changed, self.window)
            row = row[: self.window]
            column = column[: self.window]
            covariance = state.covariance
            length = estimate_length(covariance, maps, row, column)
            if length != float(state.field.length[episode]):
                shape = covariance.grid.shape
                field = Field.of(shape, [length], "cpu", covariance.nugget)
                state.field.write(episode, field)
                # Under the new ℓ, the prior is conditioned on all observations again.
                maps["mean"][:] = 0
                maps["std"][:] = 1
                maps["skew"][:] = 0
                changed = observed
        condition_maps(state.field, episode, maps, changed, self.window)

    def distribution(self, state: CopulaState) -> TraversabilityDistribution:
        """Return the distribution of λ given all observations, shape [B, H, W]."""
        dtype = state.prior.dtype
        mean = state.mean.to(dtype)
        std = state.std.to(dtype)
        return ConditionedDistribution(state.prior, mean, std, state.skew.to(dtype))

    def at(self, state: CopulaState, cells: Tensor) -> TabulatedDistribution:
        """Return the belief in some cells, from a table of scores; see `Belief`.

        This is far faster than `distribution`. The two λ̂ differ by less than 0.01.
        """
        table = state.table.with_rows(state.prior, cells)
        mean = state.mean[cells]
        std = state.std[cells]
        below = table.below(cells, mean, std, state.skew[cells])
        return TabulatedDistribution(below.T[:, None].to(state.prior.dtype))

    def changed(self, before: CopulaState, after: CopulaState) -> Tensor:
        """Return a mask of cells whose score or prediction changed."""
        is_changed = _score_changed(before, after)
        if before.prior is after.prior:
            return is_changed
        return is_changed | before.prior.differs(after.prior)

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

        Fields are drawn from the covariance model and then corrected by the
        observations.
        """
        return state.fields(self.sample_scores(state, count, keys))

    def sample_scores(
        self, state: CopulaState, count: int, keys: Sequence[int]
    ) -> Tensor:
        """Return normal scores of the fields of `sample_fields`, shape [B, M, H, W]."""
        scores = []
        for episode, key in enumerate(keys):
            scores.append(self._sample_episode(state, episode, count, key))
        mean = state.mean[:, None]
        std = state.std[:, None]
        normal = (torch.stack(scores) - mean) / std.clamp(min=_NO_TERM)
        skewed_normal = skewed(normal, state.skew[:, None])
        return mean + std * skewed_normal

    def _sample_episode(
        self, state: CopulaState, episode: int, count: int, key: int
    ) -> Tensor:
        """Return Gaussian scores of one episode by Matheron's rule, shape [M, H, W]."""
        grid = state.covariance.grid
        device = state.mean.device
        length_m = float(state.field.length[episode]) * grid.resolution_m
        covariance = replace(state.covariance, correlation_m=length_m)
        scores = draw_scores(covariance, count, [key])[0]
        scores = scores.to(device).double()
        has_term = state.precision[episode] > _NO_TERM
        row, column = has_term.nonzero(as_tuple=True)
        if len(row) == 0:
            return scores
        precision = state.precision[episode, row, column]
        shift = state.shift[episode, row, column]
        noise_key = rng.stream_key(key, "observations")
        noise_model = replace(covariance, correlation_m=0.0, nugget=0.0)
        noise = draw_scores(noise_model, count, [noise_key])[0]
        noise = noise.to(scores)[:, row, column] / precision.sqrt()
        term_mean = shift / precision
        residual = term_mean - scores[:, row, column] - noise
        row_offsets = row[:, None] - row
        column_offsets = column[:, None] - column
        noisy_covariance = state.field.covariance(episode, row_offsets, column_offsets)
        noisy_covariance.diagonal().add_(1 / precision)
        factor = torch.linalg.cholesky(noisy_covariance)
        weights = torch.cholesky_solve(residual.T, factor)
        rows = torch.arange(grid.height, device=device)[:, None]
        columns = torch.arange(grid.width, device=device)
        row_offsets = row[:, None, None] - rows
        column_offsets = column[:, None, None] - columns
        map_covariance = state.field.covariance(episode, row_offsets, column_offsets)
        correction = (map_covariance.flatten(1).T @ weights).T
        scores += correction.view_as(scores)
        return scores


def _score_changed(before: CopulaState, after: CopulaState) -> Tensor:
    """Return a mask of cells whose posterior score changed, bool, shape [B, H, W]."""
    is_changed = before.mean != after.mean
    is_changed = is_changed | (before.std != after.std)
    return is_changed | (before.skew != after.skew)
