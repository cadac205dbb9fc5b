"""The belief of look-alike classes: what is sensed tells which of two classes cells are of, and then conditions λ.

Some classes look exactly alike, so that a prediction splits a cell's weight between the two of a pair. Such a cell has
one label, the first class or the second. Under either it has the prediction in which that class has all of the pair's
weight; what other classes have stays theirs (a cell that may be of two pairs is of the heavier one). Given labels c and
normal scores z_i = Φ⁻¹(F_i(y_i | c_i)) of observed λ y, the joint density of all that was observed is

    p(y | c) = N(z; 0, K + noise) · Π_i f_i(y_i | c_i) / φ(z_i),

with the correlations K of the ground, and of λ at 0 or 1 the probability of an interval in place of the density. The
labels are a Potts field without outer field (`labels`), whose 64 chains are drawn given y: new observations weigh the
chains, which are resampled (a particle filter), then sweeps of single labels follow, of cells in reach. Terms of
expectation propagation, at the more probable label of their cell, stand for the intervals that older observations are.

The prediction's odds of the two classes enter a cell's own answer once, P(first | y) ∝ odds · P(first | y, even odds).
They are not an outer field of the chains: a model has looked at the neighbours of a cell, and a field would count what
it saw once for each of them. Before anything is sensed a cell has the model's probabilities.

λ is then the average of its distributions under either label, each conditioned as `copula` does it: scores of the field
at the more probable label of each observed cell, and of an observed cell also at the other.
Letters in shapes: B episodes, H×W cells, N observations, S chains, K values of λ, R×C cells of a block.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import cast

import numpy as np
import torch
from torch import Tensor

from benchnav.core import rng
from benchnav.core.batch import Batch
from benchnav.core.conditioned import conditioned
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError, expect
from benchnav.core.ground import GroundStatistics
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.pooled import PooledDistribution
from benchnav.core.quantiles import QuantileDistribution
from benchnav.planning.sensing import copula as within
from benchnav.planning.sensing.belief import Belief, Law
from benchnav.planning.sensing.copula import VALUES, Copula, CopulaState, scores_of
from benchnav.planning.sensing.gaussian import Cells, Field, interval_moments
from benchnav.planning.sensing.labels import (
    CHAINS,
    Lattice,
    count,
    fair,
    joined,
    noise,
    packed,
    swept,
    unpacked,
)
from benchnav.planning.sensing.sensor import LEAST_STD, Sensed

_LEAST_MASS, _LEAST_CLASS = 0.05, 0.01  # of a cell's weight: the pair's, and each of its classes'
_REACH = 12  # cells from what is new, within which labels are drawn anew
_FIRST_SWEEPS = 40  # before anything is sensed
_ROUNDS, _TOLD = 6, 3  # of sweeps in an update, and how many of the last of them are counted
_SETTLED = 0.005  # probability of a label under which an observed cell is not looked at again
_LEAST_CHANGE = 0.01  # of a probability that is not an observed cell's
_LEAST_PRECISION = 1e-6  # of a term
_SURE = 1e-9


@dataclass(frozen=True, kw_only=True)
class ClassesState(Batch):
    """What the belief of look-alike classes knows.

    Args:
        copula: scores, at the more probable class of each observed cell; its prediction is that of the first class.
        looks: what was observed under the first class and under the second; of these no scores are inferred.
        density: log f / φ of what was observed under either class, 0 where it is an interval, shape [B, 2, H, W].
        scores: normal scores of `VALUES` under the second class, shape [B, K, H, W].
        pair: number of the pair of which each cell may be, from 1; 0 for none, int64, shape [B, H, W].
        odds: log odds of the first class, as predicted, float64, shape [B, H, W].
        chance: of the first class given what was observed, were the odds even, float64, shape [B, H, W].
        labels: of the chains; a bit is set for the first class, int64, shape [B, H, W].
        sweeps: how many each episode had, int64, shape [B].
    """

    copula: CopulaState
    looks: tuple[CopulaState, CopulaState]
    density: Tensor
    scores: Tensor
    pair: Tensor
    odds: Tensor
    chance: Tensor
    labels: Tensor
    sweeps: Tensor

    @property
    def law(self) -> Law:
        """How λ hangs together."""
        return self.copula.law

    def probability(self) -> Tensor:
        """Of the first class of a cell's pair given what was observed, 1 where there is no pair, shape [B, H, W]."""
        learnt = torch.logit(self.chance, eps=_SURE)
        return torch.where(self.pair > 0, torch.sigmoid(self.odds + learnt), 1.0)


@dataclass(frozen=True)
class Classes(Belief[ClassesState]):
    """Learns which of two look-alike classes the ground is of, and its λ within the class.

    Args:
        correlation_m: ℓ that is believed; that of the world where it is not given, which is privileged knowledge.
        window: most observations that an update looks at, those nearest to what is new; more where more is new.
        strength: β, the log odds that a neighbour of one class adds; that of the training maps where it is not given.
    """

    correlation_m: float | None = None
    window: int = 128
    strength: float | None = None
    _copula: Copula = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Refuses lengths that are none, windows without room, and neighbours that repel."""
        object.__setattr__(self, "_copula", Copula(self.correlation_m, self.window))
        expect(
            self.strength is None or 0 <= self.strength < math.inf,
            f"`strength` ≥ 0 and finite, got {self.strength}.",
        )

    def init(self, prior: TraversabilityDistribution, law: Law) -> ClassesState:
        """Knows the prediction alone.

        Raises:
            ConfigError: the prediction tells no classes, or the law does not say which look alike.
        """
        if self.correlation_m is not None:
            law = replace(law, correlation_m=self.correlation_m)
        first, second, pair, odds = _split(prior, law)
        copula = self._copula.init(first, law)
        zeros = torch.zeros_like(copula.mean)
        labels = fair(*law.grid.shape).to(pair.device).expand_as(pair)
        state = ClassesState(
            copula=copula, looks=(_bare(copula, first), _bare(copula, second)),
            density=torch.stack((zeros, zeros), 1), scores=_second_scores(copula.scores, second, pair), pair=pair,
            odds=odds, chance=zeros + 0.5, labels=labels, sweeps=torch.zeros_like(pair[:, 0, 0]),
        )  # fmt: skip
        return self._swept(state) if bool(pair.any()) else state

    def update(
        self, state: ClassesState, sensed: Sensed, prior: TraversabilityDistribution | None = None
    ) -> ClassesState:
        """Draws labels near what is new, and conditions cells on what is observed there.

        Under a new prediction all observed λ is scored anew, by looks at a cell as one.
        """
        renewed = torch.zeros_like(sensed.mask)
        if prior is not None:
            renewed, state = state.copula.observed, self._with_prior(state, prior)
        if not bool(state.pair.any()):
            known = None if prior is None else state.copula.prior
            return replace(state, copula=self._copula.update(state.copula, sensed, known))
        state, changed = _noted(state, sensed)
        changed = changed | renewed
        window = self.window if prior is None else changed[0].numel()
        drawn = (changed.flatten(1).any(1) & state.pair.flatten(1).any(1)).nonzero()[:, 0]
        if len(drawn) > 0:
            some = _drawn(_light(state).select(drawn), changed[drawn], self._strength(state.law), window)
            state = replace(
                state, **{
                    name: getattr(state, name).index_copy(0, drawn, getattr(some, name))
                    for name in ("chance", "labels", "sweeps")
                },
            )  # fmt: skip
        return replace(state, copula=_at_labels(state, changed, window))

    def distribution(self, state: ClassesState) -> TraversabilityDistribution:
        """The average over the classes of a cell, each given what was observed."""
        if not bool(state.pair.any()):
            return self._copula.distribution(state.copula)
        dtype, first = state.copula.prior.dtype, state.probability()
        means, stds = _moments(state)
        parts = [
            conditioned(look.prior, means[:, own].to(dtype), stds[:, own].to(dtype))
            for own, look in enumerate(state.looks)
        ]
        return PooledDistribution(tuple(parts), torch.stack((first, 1 - first), 1).to(dtype))

    def at(self, state: ClassesState, cells: Tensor) -> QuantileDistribution:
        """What is believed of some cells; see `Belief`.

        By quantiles between `VALUES`, as `Copula.at`.
        """
        found = self._copula.at(state.copula, cells)
        pairs = (state.pair[cells] > 0).nonzero()[:, 0]
        if len(pairs) == 0:
            return found
        cells = cells & (state.pair > 0)
        means, stds = (values.movedim(1, -1)[cells] for values in _moments(state))
        shares = []
        for own, scores in enumerate((state.copula.scores, state.scores)):
            away = scores.movedim(1, -1)[cells] - means[:, own, None]
            shares.append(torch.special.ndtr(away / stds[:, own, None].clamp(min=_SURE)))
        cdf = torch.lerp(shares[1], shares[0], state.probability()[cells][:, None]).cummax(1).values
        levels = cdf.new_tensor(found.levels).expand(len(cdf), -1).contiguous()
        after = torch.searchsorted(cdf.contiguous(), levels).clamp(1, len(VALUES) - 1)
        low, high = cdf.gather(1, after - 1), cdf.gather(1, after)
        part = ((levels - low) / torch.where(high > low, high - low, 1.0)).clamp(0, 1)
        values = cdf.new_tensor(VALUES)
        quantiles = torch.lerp(values[after - 1], values[after], part)
        whole = found.values.clone()
        whole[:, 0, pairs] = quantiles.T.to(whole.dtype)
        return QuantileDistribution(whole, found.levels)

    def changed(self, before: ClassesState, after: ClassesState) -> Tensor:
        """Cells whose score, class, or prediction is another."""
        moved = self._copula.changed(before.copula, after.copula)
        moved |= (before.chance != after.chance) & (after.pair > 0)
        if before.scores is not after.scores:
            moved |= (before.odds != after.odds) | (before.scores != after.scores).any(1)
        return moved

    def sample_fields(self, state: ClassesState, count: int, keys: Sequence[int]) -> Tensor:
        """Draws a chain's labels, then scores given all observations, and λ of both.

        Where the prediction's odds are not even, as many labels of the less likely class as needed become the
        other's, the same cells' for one number that a field draws, so that patches stay whole.
        """
        scores = self._copula.sample_scores(state.copula, count, keys)
        means, _ = _moments(state)
        chance, wanted = state.chance, state.probability()
        up = ((wanted - chance) / (1 - chance)).clamp(min=0)
        down = ((chance - wanted) / chance).clamp(min=0)
        numbers = np.stack([rng.uniform(rng.stream_key(key, "labels"), np.arange(count), (2,)) for key in keys])
        drawn = torch.from_numpy(numbers).to(scores.device)
        fields = []
        for which, scale, own in zip((drawn[..., 0] * CHAINS).long().T, drawn[..., 1].T, scores.unbind(1), strict=True):
            first = (state.labels >> which[:, None, None] & 1).bool()
            toss = scale[:, None, None]
            first = torch.where(first, toss >= down, toss < up) | (state.pair == 0)
            parts = []
            for part, look in enumerate(state.looks):
                score = (own + means[:, part] - state.copula.mean).to(look.prior.dtype)
                parts.append(look.prior.from_normal(score))
            fields.append(torch.where(first, *parts))
        return torch.stack(fields, 1)

    def _strength(self, law: Law) -> float:
        return self.strength if self.strength is not None else _statistics(law).potts_strength

    def _swept(self, state: ClassesState) -> ClassesState:
        """Labels as they are before anything is observed."""
        row, column = (
            place.expand_as(state.pair)
            for place in (torch.arange(size, device=state.pair.device).view(view) for size, view in
                          zip(state.pair.shape[1:], ((-1, 1), (1, -1)), strict=True))
        )  # fmt: skip
        lattice = Lattice.of(state.pair, self._strength(state.law))
        labels, sweeps, degree = state.labels, state.sweeps, lattice.degree()
        free, even = -(state.pair > 0).long(), -((row + column) % 2)
        for _ in range(_FIRST_SWEEPS):
            bits = noise(sweeps, row, column, degree, lattice.strength, max(state.pair.shape[1:]))
            labels, sweeps = swept(labels, lattice, free, even, bits), sweeps + 1
        return replace(state, labels=labels, sweeps=sweeps)

    def _with_prior(self, state: ClassesState, prior: TraversabilityDistribution) -> ClassesState:
        """Knows the same λ of another prediction, and labels where the pair is the same."""
        seen, chosen = state.copula.observed, state.probability() >= 0.5
        value = torch.full_like(state.odds, torch.nan)
        if bool(seen.any()):
            low, high = state.copula.lower[seen], state.copula.upper[seen]
            middle = torch.where(high > low, within._inner(low, high), low)[None]
            first, second = (
                look.prior.at(seen).from_normal(middle.to(prior.dtype))[0] for look in state.looks
            )
            value[seen] = torch.where(chosen[seen], first, second).double()
        fresh = self.init(prior, state.law)
        std = torch.where(seen, state.copula.noise_std, 1.0)
        fresh, _ = _noted(fresh, Sensed(traversability=value, std=std))
        same = (fresh.pair == state.pair) & (fresh.pair > 0)
        return replace(
            fresh,
            labels=torch.where(same, state.labels, fresh.labels),
            chance=torch.where(same, state.chance, fresh.chance),
            sweeps=state.sweeps,
            copula=_labelled(fresh),
        )


def _statistics(law: Law) -> GroundStatistics:
    expect(
        law.statistics is not None,
        "statistics of the ground, which say which classes look alike, got none. Take a model that has them, or the "
        "belief copula.",
    )
    return cast(GroundStatistics, law.statistics)


def _split(
    prior: TraversabilityDistribution, law: Law
) -> tuple[TraversabilityMixture, TraversabilityMixture, Tensor, Tensor]:
    """The prediction under the first and the second class, the pair of each cell, and its log odds."""
    names, pairs = law.class_names, _statistics(law).look_alikes
    if not isinstance(prior, TraversabilityMixture) or prior.group is None:
        raise ConfigError(
            "Expected a mixture whose components belong to classes for the belief classes, got "
            f"{type(prior).__name__}{' without `group`' if isinstance(prior, TraversabilityMixture) else ''}. "
            "Take another model, or the belief copula."
        )
    strange = sorted({name for pair in pairs for name in pair} - set(names))
    expect(not strange, f"look-alike classes among those of the prediction, got {', '.join(strange)}.")
    pair = torch.zeros(prior.shape, dtype=torch.int64, device=prior.device)
    odds = torch.zeros(prior.shape, dtype=torch.float64, device=prior.device)
    if not pairs:
        return prior, prior, pair, odds
    weights = prior.weights.double()
    shares = replace(prior, weights=weights / weights.sum(-3, keepdim=True)).class_probabilities(len(names))
    group = torch.tensor(prior.group, device=prior.device).view(-1, 1, 1)
    heaviest = torch.full_like(odds, _LEAST_MASS)
    scales = [torch.ones_like(weights), torch.ones_like(weights)]
    for number, (one, other) in enumerate(pairs, 1):
        ids = names.index(one), names.index(other)
        first, second = (shares[:, own] for own in ids)
        mass = first + second
        own = (mass >= heaviest) & (torch.minimum(first, second) > _LEAST_CLASS)
        heaviest, pair = torch.where(own, mass, heaviest), torch.where(own, number, pair)
        odds = torch.where(own, (first / second).log(), odds)
        for place, (kept, share) in enumerate(zip(ids, (first, second), strict=True)):
            scale = torch.where(group == kept, (mass / share)[:, None], torch.where(group == sum(ids) - kept, 0.0, 1.0))
            scales[place] = torch.where(own[:, None], scale, scales[place])
    parts = (replace(prior, weights=(weights * scale).to(prior.dtype)) for scale in scales)
    return (*parts, pair, odds)


def _second_scores(first: Tensor, second: TraversabilityMixture, pair: Tensor) -> Tensor:
    """Scores of `VALUES` under the second class, which are those of the first where there is no pair."""
    cells = pair > 0
    if not bool(cells.any()):
        return first
    whole = first.movedim(1, -1).clone()
    whole[cells] = scores_of(second.at(cells)._in_members())[0, :, 0].T
    return whole.movedim(-1, 1)


def _bare(copula: CopulaState, prior: TraversabilityMixture) -> CopulaState:
    """What is to note observations under a class, without scores of `VALUES`."""
    return replace(copula, prior=prior, scores=copula.scores[:, :0])


def _noted(state: ClassesState, sensed: Sensed) -> tuple[ClassesState, Tensor]:
    """Notes what was sensed under either class, and tells of which cells something new is known."""
    new, looks, densities = sensed.mask, [], []
    changed = torch.zeros_like(new)
    for own, look in enumerate(state.looks):
        noted, news = within._note(look, sensed)
        density = state.density[:, own]
        if bool(news.any()):
            value, std = sensed.traversability[news], sensed.std[news].double().clamp(min=LEAST_STD)
            low, high = within._scores(look.prior, news, value)
            told = look.prior.at(news).log_prob(value[None].double())[0].double() + 0.5 * low.square()
            told = torch.where(high > low, 0.0, told + 0.5 * math.log(2 * math.pi))
            # A further number adds its own density, and that of its distance from what was known.
            was, was_std = look.lower[news], look.noise_std[news]
            further = (high <= low) & (was >= look.upper[news])
            away = (low - was).square() / (std.square() + was_std.square())
            density = density.index_put((news,), torch.where(further, density[news] + told - 0.5 * away, told))
        looks.append(noted)
        densities.append(density)
        changed |= news
    return replace(state, looks=(looks[0], looks[1]), density=torch.stack(densities, 1)), changed


def _labelled(state: ClassesState) -> CopulaState:
    """The scores observed under the more probable class of each cell; of intervals that are another, no terms."""
    chosen, (first, second), was = state.probability() >= 0.5, state.looks, state.copula
    lower, upper = torch.where(chosen, first.lower, second.lower), torch.where(chosen, first.upper, second.upper)
    noise_std = torch.where(chosen, first.noise_std, second.noise_std)
    number, same = upper <= lower, (lower == was.lower) & (upper == was.upper) & (noise_std == was.noise_std)
    precision = torch.where(number, 1 / noise_std.square(), torch.where(same, was.precision, 0.0))
    shift = torch.where(number, precision * lower, torch.where(same, was.shift, 0.0))
    return replace(was, lower=lower, upper=upper, noise_std=noise_std, precision=precision, shift=shift)


def _at_labels(state: ClassesState, changed: Tensor, window: int) -> CopulaState:
    """Conditions the scores of cells near what is new, or is now held to be of the other class."""
    was, copula = state.copula, _labelled(state)
    other = (copula.lower != was.lower) | (copula.upper != was.upper)
    changed = changed | (copula.observed & other)
    members = changed.flatten(1).any(1).nonzero()[:, 0]
    if len(members) == 0:
        return copula
    some = _scores_alone(copula).select(members)
    return within._put(copula, members, within._updated(some, changed[members], window))


def _scores_alone(copula: CopulaState) -> CopulaState:
    """As much of a state as conditions scores, without the large tables of a prediction, which take long to copy."""
    prior = cast(TraversabilityMixture, copula.prior)
    thin = TraversabilityMixture(*(own[:, :1] for own in (prior.weights, prior.means, prior.stds)))
    return replace(copula, prior=thin, scores=copula.scores[:, :0])


def _light(state: ClassesState) -> ClassesState:
    """As much of a state as draws labels."""
    first, second = state.looks
    return replace(
        state,
        copula=_scores_alone(state.copula),
        looks=(_scores_alone(first), _scores_alone(second)),
        scores=state.scores[:, :0],
    )


def _moments(state: ClassesState) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of each cell's score under either class, each of shape [B, 2, H, W]."""
    own, chosen = state.copula, state.probability() >= 0.5
    wanted = own.observed & (state.pair > 0)
    means, stds = (torch.stack((values, values), 1) for values in (own.mean, own.std))
    if not bool(wanted.any()):
        return means, stds
    mean, variance = own.mean[wanted], own.std[wanted].square().clamp(min=1e-12)
    # Without the cell's own term; that of the field alone has a precision of 1.
    left = (1 / variance - own.precision[wanted]).clamp(min=1)
    centre, left = (mean / variance - own.shift[wanted]) / left, 1 / left
    for part, look in enumerate(state.looks):
        lower, upper, noise_std = look.lower[wanted], look.upper[wanted], look.noise_std[wanted]
        total = left + noise_std.square()
        gain, number = left / total, upper <= lower
        found, spread = interval_moments(centre, total, lower, torch.where(number, lower + 1, upper))
        found, spread = torch.where(number, lower, found), torch.where(number, 0.0, spread)
        held = chosen[wanted] == (part == 0)
        new = centre + gain * (found - centre), (left - left * gain + gain.square() * spread).sqrt()
        means[:, part][wanted] = torch.where(held, means[:, part][wanted], new[0])
        stds[:, part][wanted] = torch.where(held, stds[:, part][wanted], new[1])
    return means, stds


@dataclass(frozen=True, kw_only=True)
class _Sites:
    """Observed cells, by their place in the window, those that are new at the end of it.

    Args:
        lower: least score under either class, shape [B, 2, N].
        upper: greatest score.
        density: log f / φ, 0 of intervals.
        std: of the noise, shape [B, N].
        near: cells of the block beside each, int64, shape [B, N, 4].
        tied: all bits set where they hang together with it, int64.
        cell: its own place in the block, int64, shape [B, N].
        random: of the torus of random numbers, int64, shape [B, N].
        strength: β.
    """

    lower: Tensor
    upper: Tensor
    density: Tensor
    std: Tensor
    near: Tensor
    tied: Tensor
    cell: Tensor
    random: Tensor
    strength: float

    def draw(
        self, place: int, mean: Tensor, variance: Tensor, labels: Tensor, uniforms: Tensor
    ) -> tuple[Tensor, ...]:
        """Draws the label of one cell of each episode, and a score within it.

        Args:
            place: in the window.
            mean: of the noisy score given all others, shape [B, S].
            variance: as much, shape [B, 1].
            labels: of the block, int64, shape [B, RC].
            uniforms: shape [B, S, 2].

        Returns:
            Whether the label is the first, its probability, log density of what was observed, and the score, each of
            shape [B, S].
        """
        beside = labels.gather(1, self.near[:, place]) & self.tied[:, place]
        many = unpacked(beside).sum(1) * 2 + self.tied[:, place].sum(1)[:, None]
        odds = self.strength * many
        lower, upper, density = (own[:, :, place, None] for own in (self.lower, self.upper, self.density))
        number, std = upper <= lower, variance.sqrt()[:, None]
        low, high = (lower - mean[:, None]) / std, (upper - mean[:, None]) / std
        at = -0.5 * low.square() - std.log() - 0.5 * math.log(2 * math.pi) + density
        mirrored = low + high > 0
        low, high = torch.where(mirrored, -high, low), torch.where(mirrored, -low, high)
        log_high = torch.special.log_ndtr(high)
        apart = (torch.special.log_ndtr(low) - log_high).clamp(max=-1e-300)
        told = torch.where(number, at, log_high + torch.log(-torch.expm1(apart)))
        log_odds = odds + told[:, 0] - told[:, 1]
        chance = torch.sigmoid(log_odds)
        whole = torch.logaddexp(
            told[:, 0] + torch.nn.functional.logsigmoid(odds),
            told[:, 1] + torch.nn.functional.logsigmoid(-odds),
        )
        first = uniforms[..., 0] < chance
        below, above = torch.special.ndtr(low), torch.special.ndtr(high)
        inner = torch.special.ndtri((below + (above - below) * uniforms[:, None, :, 1]).clamp(min=1e-300))
        inner = mean[:, None] + std * torch.where(mirrored, -inner, inner)
        inner = torch.where(number, lower, torch.maximum(torch.minimum(inner, upper), lower))
        return first, chance, whole, torch.where(first, inner[:, 0], inner[:, 1])


def _drawn(state: ClassesState, changed: Tensor, strength: float, window: int) -> ClassesState:
    """Draws labels near what changed, and tells the probabilities of classes there."""
    shape, device = state.law.grid.shape, state.odds.device
    member = torch.arange(len(changed), device=device)[:, None]
    first, last = within._bounds(changed)
    block, _ = within._block(first, last, _REACH + 1, shape)
    across = int((block.row[0] == block.row[0, 0]).sum())
    size = (len(changed), -1, across)
    row, column = block.row.view(size), block.column.view(size)

    def cut(values: Tensor) -> Tensor:
        return values[member, block.row, block.column].view(size)

    own = torch.ones_like(row, dtype=torch.bool)
    for place, low, high in zip((row, column), first.T, last.T, strict=True):
        own &= (place >= low[:, None, None] - _REACH) & (place <= high[:, None, None] + _REACH)
    pair, observed, chance = cut(state.pair), cut(state.copula.observed | changed), cut(state.chance)
    lattice = Lattice.of(pair, strength)
    free, even = -((pair > 0) & own & ~observed).long(), -((row + column) % 2)
    held = ~own & ((chance - 0.5).abs() > _LEAST_CHANGE)
    evidence, degree, torus = -((pair > 0) & (observed | held)).long(), lattice.degree(), max(shape)

    # Observed cells, of which the nearest to what is new come last.
    look, other = state.looks
    cells, there = within._nearest(look.observed, changed, first, last, window)
    cells, there = Cells(row=cells.row.flip(1), column=cells.column.flip(1)), there.flip(1)
    at = member, cells.row, cells.column
    inside = there & (cells.row >= row[:, :1, 0]) & (cells.row <= row[:, -1:, 0])
    inside &= (cells.column >= column[:, 0, :1]) & (cells.column <= column[:, 0, -1:])
    cell = ((cells.row - row[:, :1, 0]) * across + cells.column - column[:, 0, :1]).clamp(0, row[0].numel() - 1)
    beside, ties = _beside(cell, lattice)

    def both(name: str, empty: float) -> Tensor:
        values = torch.stack([getattr(own, name)[at] for own in (look, other)], 1)
        return torch.where(there[:, None], values, empty)

    sites = _Sites(
        lower=both("lower", 0.0), upper=both("upper", 0.0), std=torch.where(there, look.noise_std[at], 1.0),
        density=torch.where(there[:, None], torch.stack([state.density[:, k][at] for k in (0, 1)], 1), 0.0),
        near=beside, tied=torch.where(inside[..., None], ties, 0), cell=cell, random=cells.row * torus + cells.column,
        strength=strength,
    )  # fmt: skip
    fresh, interval = changed[at] & there, (sites.upper > sites.lower)[:, 0]
    precision = state.copula.precision[at].clamp(min=_LEAST_PRECISION)
    noisy = torch.where(interval & ~fresh, 1 / precision, sites.std.square())
    covariance = Field.of(shape, state.law.correlation_cells, device).covariance(cells, cells)
    covariance = torch.where(there[:, :, None] & there[:, None], covariance, 0.0)
    covariance.diagonal(dim1=1, dim2=2).copy_(torch.where(there, 1 + noisy, 1.0))
    factor = torch.linalg.cholesky(covariance)

    # Filter: each new observation weighs the chains.
    labels, sweeps = cut(state.labels).flatten(1), state.sweeps
    bits = unpacked(torch.where(there, state.labels[at], 0)).transpose(1, 2)
    scores = torch.where(bits, sites.lower[:, :1], sites.lower[:, 1:])
    known = interval & ~fresh
    scores = torch.where(known[:, None], (state.copula.shift[at] / precision)[:, None], scores)
    scores = torch.where((there & ~fresh)[:, None], scores, 0.0)
    residual = torch.linalg.solve_triangular(factor, scores.transpose(1, 2), upper=False).transpose(1, 2)
    residual, weights = residual.contiguous(), torch.zeros_like(residual[:, :, 0])
    begin = int((~fresh).int().cumprod(1).sum(1).min())
    uniforms = _uniforms(sweeps, cells, torus, begin)
    for place in range(begin, fresh.shape[1]):
        new, scale = fresh[:, place, None], factor[:, place, place, None]
        mean = (residual[:, :, :place] @ factor[:, place, :place, None])[..., 0]
        toss = uniforms[:, place - begin]
        one, _, told, score = sites.draw(place, mean, scale.square(), labels, toss)
        residual[:, :, place] = torch.where(new, (score - mean) / scale, residual[:, :, place])
        scores[:, :, place] = torch.where(new, score, scores[:, :, place])
        weights = weights + torch.where(new, told, 0.0)
        labels = _put(labels, sites.cell[:, place], one, new)
    labels, scores = _resampled(labels, scores, weights, sweeps)

    # Sweeps: labels of cells that were not observed, and of observed ones that are new or open.
    inverse = torch.cholesky_inverse(factor)
    open_ = fresh | (
        inside & (state.pair[at] > 0) & ((state.chance[at] - 0.5).abs() < 0.5 - _SETTLED)
    )
    visited = [int(place) for place in open_.any(0).nonzero()[:, 0].flip(0)]
    begin = min(visited)
    numbers = inside & ~interval & (state.pair[at] > 0)
    takes = torch.zeros_like(labels, dtype=torch.bool).scatter_(1, cell, numbers)
    barred = (pair > 0) & (~own | (observed & ~takes.view(size)))
    chances, joins = torch.zeros_like(sites.std), torch.zeros_like(chance)
    for turn in range(_ROUNDS):
        drawn = noise(sweeps, row, column, degree, strength, torus)
        words = swept(labels.view(size), lattice, free, even, drawn)
        if turn == _ROUNDS - _TOLD:
            seed = torch.zeros_like(labels).scatter_(1, cell[:, -1:], -numbers[:, -1:].long()).view(size)
            cluster = joined(words, lattice, seed, drawn)
            toss = _uniforms(sweeps + 1, cells, torus, cell.shape[1] - 1)[:, 0, :, 0]
            words, scores = _flipped(words, scores, cluster, barred, sites, numbers, inverse, toss)
        if turn >= _ROUNDS - _TOLD:
            labels = words.flatten(1).clone()
            uniforms = _uniforms(sweeps, cells, torus, begin)
            for place in visited:
                row_of, new = inverse[:, place], open_[:, place, None]
                share = row_of[:, place, None]
                mean = scores[:, :, place] - (scores @ row_of[..., None])[..., 0] / share
                own_noise = sites.std[:, place, None].square() - noisy[:, place, None]
                variance = (1 / share + own_noise).clamp(min=1e-12)
                toss = uniforms[:, place - begin]
                one, likely, _, score = sites.draw(place, mean, variance, labels, toss)
                score = torch.where(known[:, place, None], scores[:, :, place], score)
                scores[:, :, place] = torch.where(new, score, scores[:, :, place])
                chances[:, place] += likely.mean(1) / _TOLD
                labels = _put(labels, sites.cell[:, place], one, new)
            words = labels.view(size)
            ties_on = joined(words, lattice, evidence, drawn)
            joins = joins + count(words & ties_on) + 0.5 * (CHAINS - count(ties_on))
        labels, sweeps = words.flatten(1), sweeps + 1
    total = CHAINS * _TOLD
    found = (joins + 0.5) / (total + 1)
    moved = (free != 0) & ((found - chance).abs() >= _LEAST_CHANGE)
    places = (member.expand_as(block.row), block.row, block.column)
    told = state.chance.index_put(places, torch.where(moved, found, chance).flatten(1))
    told = told.index_put(tuple(place[open_] for place in (member.expand_as(cell), *at[1:])), chances[open_])
    return replace(state, chance=told, labels=state.labels.index_put(places, labels), sweeps=sweeps)


def _flipped(
    words: Tensor,
    scores: Tensor,
    cluster: Tensor,
    barred: Tensor,
    sites: _Sites,
    numbers: Tensor,
    inverse: Tensor,
    toss: Tensor,
) -> tuple[Tensor, Tensor]:
    """Gives all cells of a cluster the other label where what was observed allows it (Metropolis).

    Single labels cannot leave a wrong class of a patch, whose observed scores are alike. Clusters with cells that are
    barred, out of reach or observed as intervals, stay.
    """
    inner = unpacked(cluster.flatten(1))
    stays = (inner & barred.flatten(1)[..., None]).any(1)
    among = (inner.gather(1, sites.cell[..., None].expand(-1, -1, CHAINS)) & numbers[..., None]).transpose(1, 2)
    first = unpacked(words.flatten(1).gather(1, sites.cell)).transpose(1, 2)
    proposed = torch.where(among, torch.where(first, sites.lower[:, 1:], sites.lower[:, :1]), scores)
    gain = (sites.density[:, 1:] - sites.density[:, :1]) * torch.where(first, 1.0, -1.0)
    told = torch.where(among, gain, 0.0).sum(2)
    told = told - 0.5 * (((proposed - scores) @ inverse) * (proposed + scores)).sum(2)
    taken = ~stays & (toss.log() < told)
    words = words ^ (cluster & packed(taken)[:, None, None])
    return words, torch.where(taken[..., None], proposed, scores)


def _beside(cell: Tensor, lattice: Lattice) -> tuple[Tensor, Tensor]:
    """The four cells beside some of a block, and all bits set where they hang together, each of shape [B, N, 4]."""
    across, most = lattice.right.shape[2], lattice.right[0].numel() - 1
    ties = torch.stack([
        part.flatten(1) for part in lattice.neighbours(torch.full_like(lattice.right, -1))
    ], 2)  # fmt: skip
    steps = torch.tensor((1, -1, across, -across), device=cell.device)
    return (cell[..., None] + steps).clamp(0, most), ties.gather(1, cell[..., None].expand(-1, -1, 4))


def _put(labels: Tensor, cell: Tensor, first: Tensor, new: Tensor) -> Tensor:
    """Puts the labels of one cell of each episode, where they are new, into those of a block, [B, RC]."""
    word = torch.where(new, packed(first)[:, None], labels.gather(1, cell[:, None]))
    return labels.scatter(1, cell[:, None], word)


def _resampled(labels: Tensor, scores: Tensor, weights: Tensor, sweeps: Tensor) -> tuple[Tensor, Tensor]:
    """Draws chains by their log weights [B, S], systematically."""
    shares = torch.softmax(weights, 1).cumsum(1)
    start = _starts().to(labels.device)[sweeps % len(_starts())][:, None]
    steps = (torch.arange(CHAINS, device=labels.device) + start) / CHAINS
    chain = torch.searchsorted(shares, steps).clamp(max=CHAINS - 1)
    scores = scores.gather(1, chain[..., None].expand_as(scores))
    return packed((labels[..., None] >> chain[:, None]) & 1), scores


@lru_cache(maxsize=1)
def _starts() -> Tensor:
    return torch.from_numpy(rng.uniform(rng.stream_key(0, "classes", "chains"), np.arange(4096)))


_PASSES = 8  # of which random numbers are kept


def _uniforms(passed: Tensor, cells: Cells, torus: int, begin: int) -> Tensor:
    """Random numbers of cells from a place on, two a chain, float64, shape [B, N, S, 2]."""
    uses = passed[:, None] // _PASSES
    row, column = (cells.row[:, begin:] + 13 * uses) % torus, (cells.column[:, begin:] + 31 * uses) % torus
    return _tosses(torus).to(row.device)[passed[:, None] % _PASSES, row * torus + column].double()


@lru_cache(maxsize=2)
def _tosses(torus: int) -> Tensor:
    drawn = rng.uniform(rng.stream_key(0, "classes", "cells"), np.arange(_PASSES), (torus**2, CHAINS, 2))
    return torch.from_numpy(drawn).float()
