"""The belief `classes`: observed λ updates the class of look-alike cells, and λ.

Some classes look exactly alike, so that a prediction splits a cell's weight between the
two classes of a pair. Such a cell has a label: the first class or the second. Under
either label, that class has all of the pair's weight in the cell's prediction; the
weights of other classes are unchanged. A cell that may belong to two pairs is assigned
to the heavier pair. Given labels c_i and normal scores z_i = Φ⁻¹(F_i(y_i | c_i)) of
observed λ y_i, the joint density of all observations is

    p(y | c) = N(z; 0, K + noise) · Π_i f_i(y_i | c_i) / φ(z_i),

where F_i and f_i are the predicted CDF and density, φ is the standard normal density
and K is the correlation matrix of the scores. For λ of 0 or 1, the probability of an
interval replaces the density. The labels are a Potts field without an external field
(`labels`). It is sampled given y by 64 chains (`chains`).

The predicted odds of the two classes of a cell enter its posterior odds as a factor,
once. They are not an external field of the chains: a model has already used the cell's
neighbours, and an external field would count this evidence again for each of them.
Without measurements, P(class) is the model's.

The belief is the average of two distributions of λ, one under either label, weighted by
P(class). Each is conditioned as in `copula`, with the scores of observed cells under
their more probable labels. The distribution of an observed cell under its less probable
label uses the cell's own score under that label. Cells without a pair are updated as in
`copula`.
Letters in shapes: B episodes, H×W cells.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.conditioned import ConditionedDistribution
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import expect
from benchnav.core.pooled import PooledDistribution
from benchnav.planning.sensing import copula_state
from benchnav.planning.sensing.belief import Belief, CovarianceModel
from benchnav.planning.sensing.chains import draw_labels
from benchnav.planning.sensing.class_state import (
    MIN_PROBABILITY,
    ClassesState,
    add_measurement,
    evidence_of,
    log_density_ratio,
    moments_of,
    rescored_cells,
    scores_of_likelier_class,
)
from benchnav.planning.sensing.copula import Copula
from benchnav.planning.sensing.labels import (
    CHAINS,
    Couplings,
    count_bits,
    fair_labels,
    sweep_bits,
    sweep_labels,
)
from benchnav.planning.sensing.pairs import split_by_class, statistics_of
from benchnav.planning.sensing.score_table import TabulatedDistribution
from benchnav.planning.sensing.sensor import Measurement

_MAX_STRENGTH = 0.88  # below the critical β of a Potts field, ln(1 + √2)
_FIRST_SWEEPS = 40  # number of sweeps over whole maps at the start
_MORE_SWEEPS = 10  # number of sweeps over cells that are assigned to a pair later
_MIN_STD = 1e-9  # minimum standard deviation of a score, as a divisor
_SAME_LOG_ODDS = 0.01  # smaller differences of predicted log odds are ignored


@dataclass(frozen=True)
class Classes(Belief[ClassesState]):
    """Belief that updates the class of look-alike cells, and λ within the class.

    Two approximations are made. If an observation is a number under one class and an
    interval under the other class, labels are weighted with the noise of the first
    class.
    Drawn fields have no skewness under the less probable class.

    Args:
        correlation_m: assumed ℓ, as in `Copula`.
        window: maximum number of observations in an update, as in `Copula`.
        strength: β ≥ 0, the log odds that a neighbour adds for its own class; None for
            the strength fitted to the training maps, but at most 0.88. Above
            ln(1 + √2) ≈ 0.881, a Potts field tends to a single class, so that few
            observations would decide the class of all look-alike cells. The fitted
            strength is far higher, 2.3 on stakes-v1. On these maps, in cells up to 6 m
            from a path with measurements, the mean log loss of P(class) is 0.693
            without evidence, 0.665 with β = 0.5, 0.617 with 0.8, 0.603 with 0.88, 0.624
            with 1.0, 0.774 with 1.4 and 1.070 with 2.15.
    """

    needs_statistics: ClassVar[bool] = True

    correlation_m: float | Literal["world", "estimated"] = "world"
    window: int = 256
    strength: float | None = None
    _copula: Copula = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Validate the correlation length, the window and the strength."""
        object.__setattr__(self, "_copula", Copula(self.correlation_m, self.window))
        expect(
            self.strength is None or 0 <= self.strength < math.inf,
            f"`strength` ≥ 0 and finite, got {self.strength}.",
        )

    def init(
        self, prior: TraversabilityDistribution, covariance: CovarianceModel
    ) -> ClassesState:
        """Return the state without observations.

        Raises:
            ConfigError: If the prediction has no classes, or the statistics do not list
                the look-alike classes.
        """
        first, second, pair, log_odds = split_by_class(prior, covariance)
        copula = self._copula.init(first, covariance)
        under_second = self._copula.init(second, covariance)
        zeros = torch.zeros_like(copula.mean)
        density = torch.stack((zeros, zeros), 1)
        state = ClassesState(
            copula=copula,
            per_class=(copula, under_second),
            density=density,
            pair=pair,
            log_odds=log_odds,
            p_first=zeros + 0.5,
            labels=_fair_labels_for(pair),
            sweeps=torch.zeros_like(pair[:, 0, 0]),
        )
        return self._sweep(state, pair > 0, _FIRST_SWEEPS)

    def update(
        self,
        state: ClassesState,
        sensed: Measurement,
        prior: TraversabilityDistribution | None = None,
    ) -> ClassesState:
        """Draw labels near new observations, and condition cells near them.

        A new prediction replaces the old one where it differs, as in `Copula`. The
        scores of observed λ are computed again there, and repeated measurements of a
        cell are then treated as one.
        """
        updated = state
        has_new_prediction = torch.zeros_like(sensed.mask)
        if prior is not None:
            updated, has_new_prediction = self._with_prior(state, prior)
        updated, changed = add_measurement(updated, sensed)
        is_rescored = has_new_prediction & rescored_cells(state, updated)
        updated = self._draw_labels(updated, changed | is_rescored)
        copula = scores_of_likelier_class(updated)
        other_lower = copula.lower != updated.copula.lower
        other_upper = copula.upper != updated.copula.upper
        is_relabelled = other_lower | other_upper
        to_condition = changed | (
            copula.observed & (has_new_prediction | is_relabelled)
        )
        copula = self._copula.learn(copula, to_condition)
        updated = replace(updated, copula=copula)
        # The tables need rows for the cells that `at` will be called with.
        cells = self.changed(state, updated)
        first, second = updated.per_class
        first_rows = copula.table.with_rows(first.prior, cells)
        paired_cells = cells & (updated.pair > 0)
        second_rows = second.table.with_rows(second.prior, paired_cells)
        copula = replace(copula, table=first_rows)
        second = replace(second, table=second_rows)
        return replace(updated, copula=copula, per_class=(first, second))

    def _draw_labels(self, state: ClassesState, changed: Tensor) -> ClassesState:
        """Return the state with labels drawn near changed observations.

        Args:
            state: state with the observations; it is not changed.
            changed: mask of changed observations, bool, shape [B, H, W].
        """
        episodes = _episodes_with(changed & (state.pair > 0))
        if len(episodes) == 0:
            return state
        strength = self._strength(state.copula.covariance)
        evidence = evidence_of(state).select(episodes)
        new_evidence = draw_labels(evidence, changed[episodes], strength, self.window)
        p_first = state.p_first.index_copy(0, episodes, new_evidence.p_first)
        labels = state.labels.index_copy(0, episodes, new_evidence.labels)
        sweeps = state.sweeps.index_copy(0, episodes, new_evidence.sweeps)
        return replace(state, p_first=p_first, labels=labels, sweeps=sweeps)

    def distribution(self, state: ClassesState) -> TraversabilityDistribution:
        """Return the average of the distributions under either class.

        Each of the two distributions is conditioned on all observations.
        """
        if not statistics_of(state.copula.covariance).look_alikes:
            return self._copula.distribution(state.copula)
        dtype = state.copula.prior.dtype
        moments = [values.to(dtype) for values in moments_of(state)]
        distributions = []
        for class_index, given_class in enumerate(state.per_class):
            mean, std, skew = (values[:, class_index] for values in moments)
            distributions.append(
                ConditionedDistribution(given_class.prior, mean, std, skew)
            )
        p_first = state.probability()
        weights = torch.stack((p_first, 1 - p_first), 1).to(dtype)
        return PooledDistribution(tuple(distributions), weights)

    def at(self, state: ClassesState, cells: Tensor) -> TabulatedDistribution:
        """Return the belief in some cells, from tables of scores.

        See `Belief` and `Copula.at`.
        """
        copula_belief = self._copula.at(state.copula, cells)
        has_pair = state.pair[cells] > 0
        if not bool(has_pair.any()):
            return copula_belief
        cells = cells & (state.pair > 0)
        by_class = [values.movedim(1, -1) for values in moments_of(state)]
        moments = [values[cells] for values in by_class]
        tables = state.copula.table, state.per_class[1].table
        under_class = []
        for class_index, given_class in enumerate(state.per_class):
            table = tables[class_index].with_rows(given_class.prior, cells)
            mean, std, skew = (values[:, class_index] for values in moments)
            under_class.append(table.below(cells, mean, std, skew))
        under_first, under_second = under_class
        p_first = state.probability()[cells].to(under_first)
        pooled = torch.lerp(under_second, under_first, p_first[:, None])
        below = copula_belief.below.clone()
        below[:, 0, has_pair] = pooled.T.to(below)
        return TabulatedDistribution(below)

    def changed(self, before: ClassesState, after: ClassesState) -> Tensor:
        """Return a mask of cells whose score, class or prediction changed."""
        is_changed = self._copula.changed(before.copula, after.copula)
        other_probability = before.p_first != after.p_first
        other_log_odds = before.log_odds != after.log_odds
        is_changed |= (other_probability | other_log_odds) & (after.pair > 0)
        for old, new in zip(before.per_class, after.per_class, strict=True):
            other_score = old.lower != new.lower
            other_noise = old.noise_std != new.noise_std
            is_changed |= new.observed & (other_score | other_noise)
            if old.prior is not new.prior:
                is_changed |= old.prior.differs(new.prior)
        return is_changed

    def put(
        self, state: ClassesState, members: Tensor, others: ClassesState
    ) -> ClassesState:
        """Return the belief state with some episodes replaced; see `Belief`."""
        put = self._copula.put
        copula = put(state.copula, members, others.copula)
        first, second = state.per_class
        new_first, new_second = others.per_class
        first = put(first, members, new_first)
        second = put(second, members, new_second)
        merged = state.put(members, others)
        return replace(merged, copula=copula, per_class=(first, second))

    def sample_fields(
        self, state: ClassesState, count: int, keys: Sequence[int]
    ) -> Tensor:
        """Draw fields of λ from the labels of a random chain and from drawn scores.

        Predicted odds can make P(class) differ from the fraction of the chains with
        that class. Then some labels are switched to the more probable class. All cells
        of a field are switched by the same random number, so that patches stay whole.
        """
        scores = self._copula.sample_scores(state.copula, count, keys)
        means, stds, _ = moments_of(state)
        score_std = state.copula.std.clamp(min=_MIN_STD)
        scales = stds / score_std[:, None]
        p_to_first, p_to_second = _switch_probabilities(state)
        streams = [rng.stream_key(key, "labels") for key in keys]
        indices = np.arange(count)
        uniforms = [rng.uniform(stream, indices, (2,)) for stream in streams]
        uniforms_by_field = torch.from_numpy(np.stack(uniforms)).to(scores.device)
        chain_indices = (uniforms_by_field[..., 0] * CHAINS).long()
        switch_uniforms = uniforms_by_field[..., 1]
        fields = []
        for index, field_scores in enumerate(scores.unbind(1)):
            chain = chain_indices[:, index, None, None]
            uniform = switch_uniforms[:, index, None, None]
            bits = state.labels >> chain & 1
            in_first = bits.bool()
            is_first = torch.where(
                in_first, uniform >= p_to_second, uniform < p_to_first
            )
            is_first = is_first | (state.pair == 0)
            residual = field_scores - state.copula.mean
            fields_by_class = []
            for class_index, given_class in enumerate(state.per_class):
                score = means[:, class_index] + scales[:, class_index] * residual
                fields_by_class.append(given_class.fields(score[:, None])[:, 0])
            fields.append(torch.where(is_first, fields_by_class[0], fields_by_class[1]))
        return torch.stack(fields, 1)

    def _strength(self, covariance: CovarianceModel) -> float:
        """Return β: the option `strength`, or the fitted strength up to the maximum."""
        if self.strength is not None:
            return self.strength
        return min(statistics_of(covariance).potts_strength, _MAX_STRENGTH)

    def _sweep(
        self, state: ClassesState, unlabelled: Tensor, count: int
    ) -> ClassesState:
        """Draw labels of some cells by sweeps, given the labels of all other cells.

        Args:
            state: current state; it is not changed.
            unlabelled: mask of cells without measurements whose labels are drawn, bool,
                shape [B, H, W].
            count: number of sweeps.
        """
        episodes = _episodes_with(unlabelled)
        if len(episodes) == 0:
            return state
        unlabelled = unlabelled[episodes]
        labels = state.labels[episodes]
        sweeps = state.sweeps[episodes]
        strength = self._strength(state.copula.covariance)
        couplings = Couplings.of(state.pair[episodes], strength)
        degree = couplings.degree()
        height, width = unlabelled.shape[1:]
        rows = torch.arange(height, device=unlabelled.device)
        columns = torch.arange(width, device=unlabelled.device)
        row = rows[:, None].expand_as(unlabelled)
        column = columns.expand_as(unlabelled)
        free = -unlabelled.long()
        even = -((row + column) % 2)
        torus_size = max(height, width)
        for _ in range(count):
            bits = sweep_bits(sweeps, row, column, degree, strength, torus_size)
            labels = sweep_labels(labels, couplings, free, even, bits)
            sweeps = sweeps + 1
        all_labels = state.labels.index_copy(0, episodes, labels)
        all_sweeps = state.sweeps.index_copy(0, episodes, sweeps)
        return replace(state, labels=all_labels, sweeps=all_sweeps)

    def _with_prior(
        self, state: ClassesState, prior: TraversabilityDistribution
    ) -> tuple[ClassesState, Tensor]:
        """Replace the prediction where it differs, and recompute observed scores there.

        Returns:
            The new state, and a mask of cells with a new prediction, bool, shape
            [B, H, W].
        """
        first, second, pair, log_odds = split_by_class(prior, state.copula.covariance)
        new_first, first_differs = copula_state.with_prior(state.per_class[0], first)
        new_second, second_differs = copula_state.with_prior(state.per_class[1], second)
        log_odds_differ = (log_odds - state.log_odds).abs() > _SAME_LOG_ODDS
        has_new_prediction = first_differs | second_differs | log_odds_differ
        rescored = has_new_prediction & new_first.observed
        density = state.density.clone()
        for class_index, given_class in enumerate((new_first, new_second)):
            value = given_class.value[rescored]
            log_ratio = log_density_ratio(given_class, rescored, value)
            density[:, class_index][rescored] = log_ratio
        has_new_pair = has_new_prediction & (pair != state.pair)
        table = state.copula.table.without_rows(first_differs)
        copula = replace(state.copula, prior=new_first.prior, table=table)
        updated = replace(
            state,
            copula=copula,
            per_class=(new_first, new_second),
            density=density,
            pair=torch.where(has_new_prediction, pair, state.pair),
            log_odds=torch.where(has_new_prediction, log_odds, state.log_odds),
            p_first=torch.where(has_new_pair, 0.5, state.p_first),
            labels=torch.where(has_new_pair, _fair_labels_for(pair), state.labels),
        )
        with_labels = self._sweep(updated, has_new_pair & (pair > 0), _MORE_SWEEPS)
        return with_labels, has_new_prediction


def _fair_labels_for(pair: Tensor) -> Tensor:
    height, width = pair.shape[1:]
    labels = fair_labels(height, width).to(pair.device)
    return labels.expand_as(pair)


def _episodes_with(cells: Tensor) -> Tensor:
    """Return the indices of episodes with a cell of a mask, int64."""
    return cells.flatten(1).any(1).nonzero()[:, 0]


def _switch_probabilities(state: ClassesState) -> tuple[Tensor, Tensor]:
    """Return probabilities of switching a label to the first class and to the second.

    With these, drawn labels have the posterior probability of the first class instead
    of its fraction among the chains. Each result has the shape [B, H, W].
    """
    p_first = state.probability()
    of_chains = count_bits(state.labels) / CHAINS
    in_second = (1 - of_chains).clamp(min=MIN_PROBABILITY)
    p_to_first = ((p_first - of_chains) / in_second).clamp(min=0)
    in_first = of_chains.clamp(min=MIN_PROBABILITY)
    p_to_second = ((of_chains - p_first) / in_first).clamp(min=0)
    return p_to_first, p_to_second
