"""The belief of look-alike classes: what is sensed tells which of two classes cells are of, and then conditions λ.

Some classes look exactly alike, so that a prediction splits a cell's weight between the two of a pair. Such a cell has
one label, the first class or the second. Under either it has the prediction in which that class has all of the pair's
weight; what other classes have stays theirs (a cell that may be of two pairs is of the heavier one). Given labels c and
normal scores z_i = Φ⁻¹(F_i(y_i | c_i)) of observed λ y, the joint density of all that was observed is

    p(y | c) = N(z; 0, K + noise) · Π_i f_i(y_i | c_i) / φ(z_i),

with the correlations K of the ground, and of λ at 0 or 1 the probability of an interval in place of the density. The
labels are a Potts field without outer field (`labels`), whose 64 chains are drawn given y (`chains`).

The prediction's odds of the two classes enter a cell's own answer once, P(first | y) ∝ odds · P(first | y, even odds).
They are not an outer field of the chains: a model has looked at the neighbours of a cell, and a field would count what
it saw once for each of them. Before anything is sensed a cell has the model's probabilities.

λ is then the average of its distributions under either label, each conditioned as `copula` does it: scores of the field
at the more probable label of each observed cell, and of an observed cell also at the other.
Letters in shapes: B episodes, H×W cells, K values of λ.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
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
from benchnav.planning.sensing.chains import Evidence, draw_labels, places_of
from benchnav.planning.sensing.copula import VALUES, Copula, CopulaState, scores_of
from benchnav.planning.sensing.gaussian import interval_moments
from benchnav.planning.sensing.labels import CHAINS, Lattice, fair, noise, swept
from benchnav.planning.sensing.sensor import LEAST_STD, Sensed

_LEAST_MASS, _LEAST_CLASS = 0.05, 0.01  # of a cell's weight: the pair's, and each of its classes'
_FIRST_SWEEPS = 40  # before anything is sensed
_SAME_SCORE = 0.05  # a change of an observed score under which its label is not drawn again
_SURE = 1e-9  # of a probability


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
        state = self._begun(prior, law)
        return self._swept(state) if bool(state.pair.any()) else state

    def update(
        self, state: ClassesState, sensed: Sensed, prior: TraversabilityDistribution | None = None
    ) -> ClassesState:
        """Draws labels near what is new, and conditions cells on what is observed there.

        Under a new prediction all observed λ is scored anew, by looks at a cell as one.
        """
        renewed = moved = torch.zeros_like(sensed.mask)
        if prior is not None:
            was, state = state, self._with_prior(state, prior)
            renewed, moved = state.copula.observed, _moved(was, state)
        if not bool(state.pair.any()):
            known = None if prior is None else state.copula.prior
            return replace(state, copula=self._copula.update(state.copula, sensed, known))
        state, changed = _noted(state, sensed)
        news = changed | moved
        members = (news.flatten(1).any(1) & state.pair.flatten(1).any(1)).nonzero()[:, 0]
        if len(members) > 0:
            some, strength = _evidence(state).select(members), self._strength(state.law)
            some = draw_labels(some, news[members], state.law, strength, self.window)
            names = ("chance", "labels", "sweeps")
            put = {name: getattr(state, name).index_copy(0, members, getattr(some, name)) for name in names}
            state = replace(state, **put)
        window = self.window if prior is None else changed[0].numel()
        return replace(state, copula=_at_labels(state, changed | renewed, window))

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
        chance, wanted = state.chance.clamp(_SURE, 1 - _SURE), state.probability()
        up = ((wanted - chance) / (1 - chance)).clamp(min=0)
        down = ((chance - wanted) / chance).clamp(min=0)
        streams = [rng.stream_key(key, "labels") for key in keys]
        numbers = np.stack([rng.uniform(stream, np.arange(count), (2,)) for stream in streams])
        drawn = torch.from_numpy(numbers).to(scores.device)
        fields = []
        for which, scale, own in zip(
            (drawn[..., 0] * CHAINS).long().T, drawn[..., 1].T, scores.unbind(1), strict=True
        ):
            first = (state.labels >> which[:, None, None] & 1).bool()
            toss = scale[:, None, None]
            first = torch.where(first, toss >= down, toss < up) | (state.pair == 0)
            parts = []
            for part, look in enumerate(state.looks):
                score = (own + means[:, part] - state.copula.mean).to(look.prior.dtype)
                parts.append(look.prior.from_normal(score))
            fields.append(torch.where(first, parts[0], parts[1]))
        return torch.stack(fields, 1)

    def _begun(self, prior: TraversabilityDistribution, law: Law) -> ClassesState:
        """Knows the prediction alone; each cell has labels for itself."""
        if self.correlation_m is not None:
            law = replace(law, correlation_m=self.correlation_m)
        first, second, pair, odds = _split(prior, law)
        copula = self._copula.init(first, law)
        zeros = torch.zeros_like(copula.mean)
        labels = fair(*law.grid.shape).to(pair.device).expand_as(pair)
        return ClassesState(
            copula=copula, looks=(_bare(copula, first), _bare(copula, second)),
            density=torch.stack((zeros, zeros), 1), scores=_second_scores(copula.scores, second, pair), pair=pair,
            odds=odds, chance=zeros + 0.5, labels=labels, sweeps=torch.zeros_like(pair[:, 0, 0]),
        )  # fmt: skip

    def _strength(self, law: Law) -> float:
        return self.strength if self.strength is not None else _statistics(law).potts_strength

    def _swept(self, state: ClassesState) -> ClassesState:
        """Labels as they are before anything is observed."""
        row, column = places_of(state.pair)
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
        fresh = self._begun(prior, state.law)
        std = torch.where(seen, state.copula.noise_std, 1.0)
        fresh, _ = _noted(fresh, Sensed(traversability=value, std=std))
        same = (fresh.pair == state.pair) & (fresh.pair > 0)
        fresh = replace(
            fresh,
            labels=torch.where(same, state.labels, fresh.labels),
            chance=torch.where(same, state.chance, fresh.chance),
            sweeps=state.sweeps,
        )
        copula = _labelled(fresh)
        # Of an interval the term that it had: it stands for it until all terms are found anew.
        interval = copula.upper > copula.lower
        precision = torch.where(interval, state.copula.precision, copula.precision)
        shift = torch.where(interval, state.copula.shift, copula.shift)
        return replace(fresh, copula=replace(copula, precision=precision, shift=shift))


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
    for number, names_of in enumerate(pairs, 1):
        ids = names.index(names_of[0]), names.index(names_of[1])
        first, second = (shares[:, own] for own in ids)
        mass = first + second
        own = (mass >= heaviest) & (torch.minimum(first, second) > _LEAST_CLASS)
        heaviest, pair = torch.where(own, mass, heaviest), torch.where(own, number, pair)
        odds = torch.where(own, (first / second).log(), odds)
        for place, (kept, share) in enumerate(zip(ids, (first, second), strict=True)):
            scale = torch.where(
                group == kept, (mass / share)[:, None], torch.where(group == sum(ids) - kept, 0.0, 1.0)
            )
            scales[place] = torch.where(own[:, None], scale, scales[place])
    one, other = (replace(prior, weights=(weights * scale).to(prior.dtype)) for scale in scales)
    return one, other, pair, odds


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
            density = density.index_put(
                (news,), torch.where(further, density[news] + told - 0.5 * away, told)
            )
        looks.append(noted)
        densities.append(density)
        changed |= news
    return replace(state, looks=(looks[0], looks[1]), density=torch.stack(densities, 1)), changed


def _moved(before: ClassesState, after: ClassesState) -> Tensor:
    """Observed cells whose scores, or whose pair, are others under a new prediction, bool, shape [B, H, W]."""
    moved = before.pair != after.pair
    for old, new in zip(before.looks, after.looks, strict=True):
        ends = ((old.lower, new.lower), (old.upper, new.upper))
        for was, now in ends:
            moved = moved | ~((was == now) | ((was - now).abs() <= _SAME_SCORE))
    return moved & after.copula.observed & (after.pair > 0)


def _evidence(state: ClassesState) -> Evidence:
    """What labels are drawn from."""
    first, second = state.looks
    return Evidence(
        lower=torch.stack((first.lower, second.lower), 1), upper=torch.stack((first.upper, second.upper), 1),
        noise_std=first.noise_std, density=state.density, precision=state.copula.precision, shift=state.copula.shift,
        pair=state.pair, chance=state.chance, labels=state.labels, sweeps=state.sweeps,
    )  # fmt: skip


def _labelled(state: ClassesState) -> CopulaState:
    """The scores observed under the more probable class of each cell; of intervals that are another, no terms."""
    chosen, (first, second), was = state.probability() >= 0.5, state.looks, state.copula
    lower, upper = (
        torch.where(chosen, first.lower, second.lower),
        torch.where(chosen, first.upper, second.upper),
    )
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
    thin = TraversabilityMixture(prior.weights[:, :1], prior.means[:, :1], prior.stds[:, :1])
    return replace(copula, prior=thin, scores=copula.scores[:, :0])


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
