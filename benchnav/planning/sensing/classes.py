"""The belief of look-alike classes: observed λ determines the class of cells, and
conditions λ within the class.

Some classes look exactly alike, so that a prediction splits a cell's weight between the
two classes of a pair. Such a cell has one label, the first class or the second. Under
either label, its prediction is the one in which that class has all of the pair's
weight; the weights of other classes are unchanged. A cell that may be of two pairs is
of the heavier one. Given labels c and normal scores z_i = Φ⁻¹(F_i(y_i | c_i)) of
observed λ y, the joint density of all observations is

    p(y | c) = N(z; 0, K + noise) · Π_i f_i(y_i | c_i) / φ(z_i),

with the correlations K of the scores; for λ at 0 or 1 it has the probability of an
interval instead of the density. The labels are a Potts field without an outer field
(`labels`), whose 64 chains are drawn given y (`chains`).

The prediction's odds of the two classes enter a cell's own posterior once,
P(first | y) ∝ odds · P(first | y, even odds). They are not an outer field of the
chains: a model has used the neighbours of a cell, and an outer field would count this
evidence once for each of them. Without measurements a cell has the model's
probabilities.

λ is then the average of its distributions under either label, each conditioned as in
`copula`: with scores of the field at the more probable label of each observed cell, and
for an observed cell also at the other label. Cells without a pair, such as unobserved
ones, are as under `copula`.
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
from benchnav.planning.sensing import copula as within
from benchnav.planning.sensing.belief import Belief, CovarianceModel
from benchnav.planning.sensing.chains import draw_labels
from benchnav.planning.sensing.class_state import (
    MIN_PROBABILITY,
    ClassesState,
    evidence_of,
    labelled,
    log_density_ratio,
    moments_of,
    moved_cells,
    note,
)
from benchnav.planning.sensing.copula import Copula
from benchnav.planning.sensing.labels import (
    CHAINS,
    Lattice,
    count_bits,
    fair,
    noise,
    sweep_labels,
)
from benchnav.planning.sensing.pairs import split, statistics_of
from benchnav.planning.sensing.score_table import TabulatedDistribution
from benchnav.planning.sensing.sensor import Measurement

_MAX_STRENGTH = 0.88  # ln(1 + √2) is critical
_FIRST_SWEEPS = 40  # of cells without measurements, on whole maps
_MORE_SWEEPS = 10  # of cells that are observed later
_SAME_ODDS = 0.01  # of a prediction


@dataclass(frozen=True)
class Classes(Belief[ClassesState]):
    """Belief that updates the class of look-alike cells, and λ within the class.

    Two things are approximate. If an observation is a number under one class and an
    interval under the other, labels are weighed with the noise of the first class.
    Drawn fields have no skewness under the less probable class.

    Args:
        correlation_m: assumed ℓ, as in `Copula`.
        window: maximum number of observations in an update, as in `Copula`.
        strength: β, the log odds that a neighbour of one class adds; None for that of
            the training maps, but at most 0.88. From 0.881 = ln(1 + √2) on a whole
            Potts field tends to one class, so that few observations would decide the
            class of all look-alike cells. A strength that is fitted to neighbours is
            far above, 2.3 on stakes-v1. On its maps the mean log loss of P(class) of
            cells up to 6 m from a path with measurements is 0.693 without evidence,
            0.665 with β = 0.5, 0.617 with 0.8, 0.603 with 0.88, 0.624 with 1.0, 0.774
            with 1.4 and 1.070 with 2.15.
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
        first, second, pair, odds = split(prior, covariance)
        copula = self._copula.init(first, covariance)
        zeros = torch.zeros_like(copula.mean)
        state = ClassesState(
            copula=copula,
            per_class=(copula, self._copula.init(second, covariance)),
            density=torch.stack((zeros, zeros), 1),
            pair=pair,
            odds=odds,
            p_first=zeros + 0.5,
            labels=_fair(pair),
            sweeps=torch.zeros_like(pair[:, 0, 0]),
        )
        return self._sweep(state, pair > 0, _FIRST_SWEEPS)

    def update(
        self,
        state: ClassesState,
        sensed: Measurement,
        prior: TraversabilityDistribution | None = None,
    ) -> ClassesState:
        """Draw labels near new observations, and condition cells there.

        A new prediction replaces the old one in the cells that `Copula` takes. Observed
        λ there is scored again; several measurements of a cell count as one.
        """
        updated = state
        renewed = torch.zeros_like(sensed.mask)
        if prior is not None:
            updated, renewed = self._with_prior(state, prior)
        updated, changed = note(updated, sensed)
        updated = self._draw_labels(
            updated, changed | (renewed & moved_cells(state, updated))
        )
        copula = labelled(updated)
        other_label = (copula.lower != updated.copula.lower) | (
            copula.upper != updated.copula.upper
        )
        new = changed | (copula.observed & (renewed | other_label))
        copula = self._copula.learn(copula, new)
        updated = replace(updated, copula=copula)
        # Rows of the tables for `at`.
        cells = self.changed(state, updated)
        first, second = updated.per_class
        first_table = copula.table.having(first.prior, cells)
        second_table = second.table.having(second.prior, cells & (updated.pair > 0))
        return replace(
            updated,
            copula=replace(copula, table=first_table),
            per_class=(first, replace(second, table=second_table)),
        )

    def _draw_labels(self, state: ClassesState, news: Tensor) -> ClassesState:
        """Return the state with labels drawn near new observations, bool, [B, H, W]."""
        members = (news & (state.pair > 0)).flatten(1).any(1).nonzero()[:, 0]
        if len(members) == 0:
            return state
        drawn = draw_labels(
            evidence_of(state).select(members),
            news[members],
            self._strength(state.copula.covariance),
            self.window,
        )
        return replace(
            state,
            p_first=state.p_first.index_copy(0, members, drawn.p_first),
            labels=state.labels.index_copy(0, members, drawn.labels),
            sweeps=state.sweeps.index_copy(0, members, drawn.sweeps),
        )

    def distribution(self, state: ClassesState) -> TraversabilityDistribution:
        """Return the average of the distributions under either class.

        Each is conditioned on all observations.
        """
        if not statistics_of(state.copula.covariance).look_alikes:
            return self._copula.distribution(state.copula)
        dtype = state.copula.prior.dtype
        first = state.probability()
        moments = [values.to(dtype) for values in moments_of(state)]
        parts = [
            ConditionedDistribution(
                given_class.prior, *(values[:, part] for values in moments)
            )
            for part, given_class in enumerate(state.per_class)
        ]
        weights = torch.stack((first, 1 - first), 1).to(dtype)
        return PooledDistribution(tuple(parts), weights)

    def at(self, state: ClassesState, cells: Tensor) -> TabulatedDistribution:
        """Return the belief in some cells, from tables of scores.

        See `Belief` and `Copula.at`.
        """
        copula_belief = self._copula.at(state.copula, cells)
        has_pair = state.pair[cells] > 0
        if not bool(has_pair.any()):
            return copula_belief
        cells = cells & (state.pair > 0)
        moments = [values.movedim(1, -1)[cells] for values in moments_of(state)]
        tables = state.copula.table, state.per_class[1].table
        under_class = []
        for part, given_class in enumerate(state.per_class):
            table = tables[part].having(given_class.prior, cells)
            part_moments = (values[:, part] for values in moments)
            under_class.append(table.below(cells, *part_moments))
        under_first, under_second = under_class
        p_first = state.probability()[cells][:, None].to(under_first)
        below = copula_belief.below.clone()
        pooled = torch.lerp(under_second, under_first, p_first)
        below[:, 0, has_pair] = pooled.T.to(below)
        return TabulatedDistribution(below)

    def changed(self, before: ClassesState, after: ClassesState) -> Tensor:
        """Return a mask of cells whose score, class or prediction changed."""
        moved = self._copula.changed(before.copula, after.copula)
        other_odds = before.odds != after.odds
        moved |= ((before.p_first != after.p_first) | other_odds) & (after.pair > 0)
        for old, new in zip(before.per_class, after.per_class, strict=True):
            rescored = (old.lower != new.lower) | (old.noise_std != new.noise_std)
            moved |= new.observed & rescored
            if old.prior is not new.prior:
                moved |= old.prior.differs(new.prior)
        return moved

    def put(
        self, state: ClassesState, members: Tensor, others: ClassesState
    ) -> ClassesState:
        """Replace episodes; see `Belief`."""
        put = self._copula.put
        first, second = state.per_class
        new_first, new_second = others.per_class
        return replace(
            state.put(members, others),
            copula=put(state.copula, members, others.copula),
            per_class=(
                put(first, members, new_first),
                put(second, members, new_second),
            ),
        )

    def sample_fields(
        self, state: ClassesState, count: int, keys: Sequence[int]
    ) -> Tensor:
        """Draw a chain's labels, then scores given all observations, and λ of both.

        Prior odds can make the probability of a label differ from its fraction among
        the chains. Labels of the less likely class are then changed to the other. One
        number a field decides this for all cells, so that patches stay whole.
        """
        scores = self._copula.sample_scores(state.copula, count, keys)
        means, stds, _ = moments_of(state)
        spread = stds / state.copula.std.clamp(min=MIN_PROBABILITY)[:, None]
        of_chains = count_bits(state.labels) / CHAINS
        p_first = state.probability()
        others = (1 - of_chains).clamp(min=MIN_PROBABILITY)
        p_to_first = ((p_first - of_chains) / others).clamp(min=0)
        firsts = of_chains.clamp(min=MIN_PROBABILITY)
        p_to_second = ((of_chains - p_first) / firsts).clamp(min=0)
        streams = [rng.stream_key(key, "labels") for key in keys]
        uniform = np.stack(
            [rng.uniform(stream, np.arange(count), (2,)) for stream in streams]
        )
        drawn = torch.from_numpy(uniform).to(scores.device)
        chains = (drawn[..., 0] * CHAINS).long()
        fields = []
        for index, drawn_scores in enumerate(scores.unbind(1)):
            bit = state.labels >> chains[:, index, None, None] & 1
            first = bit.bool()
            toss = drawn[:, index, 1, None, None]
            first = torch.where(first, toss >= p_to_second, toss < p_to_first)
            first = first | (state.pair == 0)
            away = drawn_scores - state.copula.mean
            parts = []
            for part, given_class in enumerate(state.per_class):
                score = means[:, part] + spread[:, part] * away
                parts.append(given_class.fields(score[:, None])[:, 0])
            fields.append(torch.where(first, parts[0], parts[1]))
        return torch.stack(fields, 1)

    def _strength(self, covariance: CovarianceModel) -> float:
        """Return β: the option, or the fitted strength up to the maximum."""
        if self.strength is not None:
            return self.strength
        return min(statistics_of(covariance).potts_strength, _MAX_STRENGTH)

    def _sweep(self, state: ClassesState, fresh: Tensor, count: int) -> ClassesState:
        """Sweep labels of unobserved cells, bool [B, H, W], given those of all others."""
        members = fresh.flatten(1).any(1).nonzero()[:, 0]
        if len(members) == 0:
            return state
        fresh = fresh[members]
        labels = state.labels[members]
        sweeps = state.sweeps[members]
        strength = self._strength(state.copula.covariance)
        lattice = Lattice.of(state.pair[members], strength)
        height, width = fresh.shape[1:]
        row = torch.arange(height, device=fresh.device)[:, None].expand_as(fresh)
        column = torch.arange(width, device=fresh.device).expand_as(fresh)
        degree = lattice.degree()
        free = -fresh.long()
        even = -((row + column) % 2)
        torus = max(height, width)
        for _ in range(count):
            bits = noise(sweeps, row, column, degree, strength, torus)
            labels = sweep_labels(labels, lattice, free, even, bits)
            sweeps = sweeps + 1
        return replace(
            state,
            labels=state.labels.index_copy(0, members, labels),
            sweeps=state.sweeps.index_copy(0, members, sweeps),
        )

    def _with_prior(
        self, state: ClassesState, prior: TraversabilityDistribution
    ) -> tuple[ClassesState, Tensor]:
        """Replace the prediction where it differs, and score the observed λ again.

        Returns:
            The state, and the mask of cells with a new prediction, bool, [B, H, W].
        """
        first, second, pair, odds = split(prior, state.copula.covariance)
        new_first, first_differs = within.with_prior(state.per_class[0], first)
        new_second, second_differs = within.with_prior(state.per_class[1], second)
        odds_differ = (odds - state.odds).abs() > _SAME_ODDS
        renewed = first_differs | second_differs | odds_differ
        rescored = renewed & new_first.observed
        density = state.density.clone()
        for part, given_class in enumerate((new_first, new_second)):
            value = given_class.value[rescored]
            density[:, part][rescored] = log_density_ratio(given_class, rescored, value)
        fresh = renewed & (pair != state.pair)
        table = state.copula.table.without(first_differs)
        updated = replace(
            state,
            copula=replace(state.copula, prior=new_first.prior, table=table),
            per_class=(new_first, new_second),
            density=density,
            pair=torch.where(renewed, pair, state.pair),
            odds=torch.where(renewed, odds, state.odds),
            p_first=torch.where(fresh, 0.5, state.p_first),
            labels=torch.where(fresh, _fair(pair), state.labels),
        )
        return self._sweep(updated, fresh & (pair > 0), _MORE_SWEEPS), renewed


def _fair(pair: Tensor) -> Tensor:
    return fair(*pair.shape[1:]).to(pair.device).expand_as(pair)
