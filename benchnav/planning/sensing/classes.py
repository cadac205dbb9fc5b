"""The belief of look-alike classes: what is sensed tells which of two classes cells are
of, and then conditions λ.

Some classes look exactly alike, so that a prediction splits a cell's weight between the
two of a pair. Such a cell has one label, the first class or the second. Under either it
has the prediction in which that class has all of the pair's weight; what other classes
have stays theirs (a cell that may be of two pairs is of the heavier one). Given labels
c and normal scores z_i = Φ⁻¹(F_i(y_i | c_i)) of observed λ y, the joint density of all
that was observed is

    p(y | c) = N(z; 0, K + noise) · Π_i f_i(y_i | c_i) / φ(z_i),

with the correlations K of the ground, and of λ at 0 or 1 the probability of an interval
in place of the density. The labels are a Potts field without outer field (`labels`),
whose 64 chains are drawn given y (`chains`).

The prediction's odds of the two classes enter a cell's own answer once, P(first | y) ∝
odds · P(first | y, even odds).
They are not an outer field of the chains: a model has looked at the neighbours of a
cell, and a field would count what it saw once for each of them. Before anything is
sensed a cell has the model's probabilities.

λ is then the average of its distributions under either label, each conditioned as
`copula` does it: scores of the field at the more probable label of each observed cell,
and of an observed cell also at the other. Cells of no pair, as those that were not
seen, are as under `copula`.
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
from benchnav.core.batch import Batch
from benchnav.core.conditioned import ConditionedDistribution
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import expect
from benchnav.core.pooled import PooledDistribution
from benchnav.planning.sensing import copula as within
from benchnav.planning.sensing.belief import Belief, Law
from benchnav.planning.sensing.chains import draw_labels
from benchnav.planning.sensing.copula import Copula, CopulaState
from benchnav.planning.sensing.gaussian import interval_moments
from benchnav.planning.sensing.labels import CHAINS, Lattice, fair, noise, swept, tally
from benchnav.planning.sensing.pairs import split, statistics_of
from benchnav.planning.sensing.score_table import TabulatedDistribution
from benchnav.planning.sensing.sensor import LEAST_STD, Sensed
from benchnav.planning.sensing.sites import Evidence

_MOST_STRENGTH = 0.88  # ln(1 + √2) is critical
# of cells of which nothing is sensed: of whole maps, and of what is seen later
_FIRST_SWEEPS, _MORE_SWEEPS = (
    40,
    10,
)
_SAME_SCORE = (
    0.05  # a change of an observed score under which its label is not drawn again
)
_SAME_ODDS = 0.01  # of a prediction
_SURE = 1e-9  # of a probability


@dataclass(frozen=True, kw_only=True)
class ClassesState(Batch):
    """What the belief of look-alike classes knows.

    Args:
        copula: scores, at the more probable class of each observed cell; its prediction
            is that of the first class.
        looks: what was observed under the first class and under the second; of these no
            scores are inferred.
        density: log f / φ of what was observed under either class, 0 where it is an
            interval, shape [B, 2, H, W].
        pair: number of the pair of which each cell may be, from 1; 0 for none, int64,
            shape [B, H, W].
        odds: log odds of the first class, as predicted, float64, shape [B, H, W].
        chance: of the first class given what was observed, were the odds even, float64,
            shape [B, H, W].
        labels: of the chains; a bit is set for the first class, int64, shape [B, H, W].
        sweeps: how many each episode had, int64, shape [B].
    """

    copula: CopulaState
    looks: tuple[CopulaState, CopulaState]
    density: Tensor
    pair: Tensor
    odds: Tensor
    chance: Tensor
    labels: Tensor
    sweeps: Tensor

    def probability(self) -> Tensor:
        """Of the first class of a cell's pair given what was observed, 1 where there is
        no pair, shape [B, H, W].
        """
        learnt = torch.logit(self.chance, eps=_SURE)
        return torch.where(self.pair > 0, torch.sigmoid(self.odds + learnt), 1.0)


@dataclass(frozen=True)
class Classes(Belief[ClassesState]):
    """Learns which of two look-alike classes the ground is of, and its λ within the
    class.

    Approximate are the noise of an observation that is a number under one class and an
    interval under the other, which is that of the first where labels are weighed, and
    in drawn fields the skewness under the less probable class.

    Args:
        correlation_m: ℓ that is believed, as of `Copula`.
        window: most observations that an update looks at, as of `Copula`.
        strength: β, the log odds that a neighbour of one class adds; where it is not
            given, that of the training maps, but at most 0.88. From 0.881 = ln(1 + √2)
            on a whole Potts field tends to one class, so that what a robot finds would
            tell of all ground that looks alike. A strength that is fitted to neighbours
            tells how seldom classes meet, and is far above, 2.3 on stakes-v1. On its
            maps the mean log loss of P(class) of cells up to 6 m from a way on which λ
            was probed is 0.693 for who knows nothing, 0.665 with β = 0.5, 0.617 with
            0.8, 0.603 with 0.88, 0.624 with 1.0, 0.774 with 1.4 and 1.070 with 2.15.
    """

    needs_statistics: ClassVar[bool] = True

    correlation_m: float | Literal["world", "estimated"] = "world"
    window: int = 256
    strength: float | None = None
    _copula: Copula = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Refuses lengths that are none, windows without room, and neighbours that
        repel.
        """
        object.__setattr__(self, "_copula", Copula(self.correlation_m, self.window))
        expect(
            self.strength is None or 0 <= self.strength < math.inf,
            f"`strength` ≥ 0 and finite, got {self.strength}.",
        )

    def init(self, prior: TraversabilityDistribution, law: Law) -> ClassesState:
        """Knows the prediction alone.

        Raises:
            ConfigError: the prediction tells no classes, or the law does not say which
                look alike.
        """
        first, second, pair, odds = split(prior, law)
        copula = self._copula.init(first, law)
        none = torch.zeros_like(copula.mean)
        state = ClassesState(
            copula=copula,
            looks=(copula, self._copula.init(second, law)),
            density=torch.stack((none, none), 1),
            pair=pair,
            odds=odds,
            chance=none + 0.5,
            labels=_fair(pair),
            sweeps=torch.zeros_like(pair[:, 0, 0]),
        )
        return self._swept(state, pair > 0, _FIRST_SWEEPS)

    def update(
        self,
        state: ClassesState,
        sensed: Sensed,
        prior: TraversabilityDistribution | None = None,
    ) -> ClassesState:
        """Draws labels near what is new, and conditions cells on what is observed
        there.

        Of a new prediction the cells count that `Copula` takes, and λ observed there is
        scored anew, by looks at a cell as one.
        """
        told, renewed = state, torch.zeros_like(sensed.mask)
        if prior is not None:
            told, renewed = self._with_prior(state, prior)
        told, changed = _noted(told, sensed)
        news = changed | (renewed & _moved(state, told))
        members = (news & (told.pair > 0)).flatten(1).any(1).nonzero()[:, 0]
        if len(members) > 0:
            some = draw_labels(
                _evidence(told).select(members),
                news[members],
                self._strength(told.copula.law),
                self.window,
            )
            names = ("chance", "labels", "sweeps")
            put = {
                name: getattr(told, name).index_copy(0, members, getattr(some, name))
                for name in names
            }
            told = replace(told, **put)
        copula = _labelled(told)
        other = (copula.lower != told.copula.lower) | (
            copula.upper != told.copula.upper
        )
        copula = self._copula.learn(
            copula, changed | (copula.observed & (renewed | other))
        )
        told = replace(told, copula=copula)
        asked = self.changed(state, told)
        first, second = told.looks
        return replace(
            told,
            copula=replace(copula, table=copula.table.having(first.prior, asked)),
            looks=(
                first,
                replace(
                    second,
                    table=second.table.having(second.prior, asked & (told.pair > 0)),
                ),
            ),
        )

    def distribution(self, state: ClassesState) -> TraversabilityDistribution:
        """The average over the classes of a cell, each given what was observed."""
        if not statistics_of(state.copula.law).look_alikes:
            return self._copula.distribution(state.copula)
        dtype, first = state.copula.prior.dtype, state.probability()
        moments = [values.to(dtype) for values in _moments(state)]
        parts = [
            ConditionedDistribution(look.prior, *(values[:, own] for values in moments))
            for own, look in enumerate(state.looks)
        ]
        return PooledDistribution(
            tuple(parts), torch.stack((first, 1 - first), 1).to(dtype)
        )

    def at(self, state: ClassesState, cells: Tensor) -> TabulatedDistribution:
        """What is believed of some cells, from tables of scores; see `Belief` and
        `Copula.at`.
        """
        found, among = self._copula.at(state.copula, cells), state.pair[cells] > 0
        if not bool(among.any()):
            return found
        cells = cells & (state.pair > 0)
        moments = [values.movedim(1, -1)[cells] for values in _moments(state)]
        one, other = (
            table.having(look.prior, cells).below(
                cells, *(values[:, own] for values in moments)
            )
            for own, (table, look) in enumerate(
                zip(
                    (state.copula.table, state.looks[1].table), state.looks, strict=True
                )
            )
        )
        below, first = found.below.clone(), state.probability()[cells][:, None].to(one)
        below[:, 0, among] = torch.lerp(other, one, first).T.to(below)
        return TabulatedDistribution(below)

    def changed(self, before: ClassesState, after: ClassesState) -> Tensor:
        """Cells whose score, class, or prediction is another."""
        moved = self._copula.changed(before.copula, after.copula)
        moved |= ((before.chance != after.chance) | (before.odds != after.odds)) & (
            after.pair > 0
        )
        for was, now in zip(before.looks, after.looks, strict=True):
            moved |= now.observed & (
                (was.lower != now.lower) | (was.noise_std != now.noise_std)
            )
            if was.prior is not now.prior:
                moved |= was.prior.differs(now.prior)
        return moved

    def put(
        self, state: ClassesState, members: Tensor, others: ClassesState
    ) -> ClassesState:
        """Puts episodes in the places of others; see `Belief`."""
        put = self._copula.put
        (first, second), (one, other) = state.looks, others.looks
        return replace(
            state.put(members, others),
            copula=put(state.copula, members, others.copula),
            looks=(put(first, members, one), put(second, members, other)),
        )

    def sample_fields(
        self, state: ClassesState, count: int, keys: Sequence[int]
    ) -> Tensor:
        """Draws a chain's labels, then scores given all observations, and λ of both.

        Where the chains that hold a label are not as many as it is likely, as by the
        prediction's odds, labels of the less likely class become the other's, the same
        cells' for one number that a field draws, so that patches stay whole.
        """
        scores = self._copula.sample_scores(state.copula, count, keys)
        means, stds, _ = _moments(state)
        spread = stds / state.copula.std.clamp(min=_SURE)[:, None]
        held, wanted = tally(state.labels) / CHAINS, state.probability()
        up = ((wanted - held) / (1 - held).clamp(min=_SURE)).clamp(min=0)
        down = ((held - wanted) / held.clamp(min=_SURE)).clamp(min=0)
        streams = [rng.stream_key(key, "labels") for key in keys]
        numbers = np.stack(
            [rng.uniform(stream, np.arange(count), (2,)) for stream in streams]
        )
        drawn = torch.from_numpy(numbers).to(scores.device)
        fields = []
        for which, scale, own in zip(
            (drawn[..., 0] * CHAINS).long().T,
            drawn[..., 1].T,
            scores.unbind(1),
            strict=True,
        ):
            first = (state.labels >> which[:, None, None] & 1).bool()
            toss = scale[:, None, None]
            first = torch.where(first, toss >= down, toss < up) | (state.pair == 0)
            parts = []
            for part, look in enumerate(state.looks):
                score = means[:, part] + spread[:, part] * (own - state.copula.mean)
                parts.append(look.fields(score[:, None])[:, 0])
            fields.append(torch.where(first, parts[0], parts[1]))
        return torch.stack(fields, 1)

    def _strength(self, law: Law) -> float:
        return (
            min(statistics_of(law).potts_strength, _MOST_STRENGTH)
            if self.strength is None
            else self.strength
        )

    def _swept(self, state: ClassesState, fresh: Tensor, count: int) -> ClassesState:
        """Draws labels of cells, bool [B, H, W], of which nothing is observed, given
        those of all others.
        """
        members = fresh.flatten(1).any(1).nonzero()[:, 0]
        if len(members) == 0:
            return state
        fresh, labels, sweeps = (
            fresh[members],
            state.labels[members],
            state.sweeps[members],
        )
        lattice = Lattice.of(state.pair[members], self._strength(state.copula.law))
        row, column = (
            torch.arange(size, device=fresh.device) for size in fresh.shape[1:]
        )
        row, column = row[:, None].expand_as(fresh), column.expand_as(fresh)
        degree, free, even = lattice.degree(), -fresh.long(), -((row + column) % 2)
        for _ in range(count):
            bits = noise(
                sweeps, row, column, degree, lattice.strength, max(fresh.shape[1:])
            )
            labels, sweeps = swept(labels, lattice, free, even, bits), sweeps + 1
        return replace(
            state,
            labels=state.labels.index_copy(0, members, labels),
            sweeps=state.sweeps.index_copy(0, members, sweeps),
        )

    def _with_prior(
        self, state: ClassesState, prior: TraversabilityDistribution
    ) -> tuple[ClassesState, Tensor]:
        """Takes the prediction of cells where it differs, bool [B, H, W], and scores
        the λ observed there under it.
        """
        first, second, pair, odds = split(prior, state.copula.law)
        (one, differs), (other, also) = (
            within.with_prior(look, own)
            for look, own in zip(state.looks, (first, second), strict=True)
        )
        renewed = differs | also | ((odds - state.odds).abs() > _SAME_ODDS)
        seen = renewed & one.observed
        density = state.density.clone()
        for own, look in enumerate((one, other)):
            density[:, own][seen] = _density(look, seen, look.value[seen])
        fresh = renewed & (pair != state.pair)
        told = replace(
            state,
            copula=replace(
                state.copula, prior=one.prior, table=state.copula.table.without(differs)
            ),
            looks=(one, other),
            density=density,
            pair=torch.where(renewed, pair, state.pair),
            odds=torch.where(renewed, odds, state.odds),
            chance=torch.where(fresh, 0.5, state.chance),
            labels=torch.where(fresh, _fair(pair), state.labels),
        )
        return self._swept(told, fresh & (pair > 0), _MORE_SWEEPS), renewed


def _fair(pair: Tensor) -> Tensor:
    return fair(*pair.shape[1:]).to(pair.device).expand_as(pair)


def _density(look: CopulaState, cells: Tensor, value: Tensor) -> Tensor:
    """Log f / φ of observed λ [N] in some cells under a class, 0 of intervals, shape
    [N].
    """
    low, high = within.scores_at(look.prior, cells, value)
    told = look.prior.at(cells).log_prob(value[None].double())[0].double()
    return torch.where(
        high > low, 0.0, told + 0.5 * (low.square() + math.log(2 * math.pi))
    )


def _noted(state: ClassesState, sensed: Sensed) -> tuple[ClassesState, Tensor]:
    """Notes what was sensed under either class, and tells of which cells something new
    is known.
    """
    changed, looks, density = torch.zeros_like(sensed.mask), [], state.density.clone()
    for own, look in enumerate(state.looks):
        noted, news = within.note(look, sensed)
        if bool(news.any()):
            value, std = (
                sensed.traversability[news],
                sensed.std[news].double().clamp(min=LEAST_STD),
            )
            low, high = within.scores_at(look.prior, news, value)
            # A further number adds its own density, and that of its distance from what
            # was known.
            was, was_std = look.lower[news], look.noise_std[news]
            further = (high <= low) & (was >= look.upper[news])
            away = (low - was).square() / (std.square() + was_std.square())
            told = _density(look, news, value)
            density[:, own][news] = torch.where(
                further, density[:, own][news] + told - 0.5 * away, told
            )
        looks.append(noted)
        changed |= news
    return replace(state, looks=(looks[0], looks[1]), density=density), changed


def _moved(before: ClassesState, after: ClassesState) -> Tensor:
    """Observed cells whose scores, or whose pair, are others under a new prediction,
    bool, shape [B, H, W].
    """
    moved = before.pair != after.pair
    for old, new in zip(before.looks, after.looks, strict=True):
        for was, now in ((old.lower, new.lower), (old.upper, new.upper)):
            moved |= ~((was == now) | ((was - now).abs() <= _SAME_SCORE))
    return moved & after.looks[0].observed & (after.pair > 0)


def _evidence(state: ClassesState) -> Evidence:
    """What labels are drawn from."""
    first, second = state.looks
    return Evidence(
        field=state.copula.field,
        lower=torch.stack((first.lower, second.lower), 1),
        upper=torch.stack((first.upper, second.upper), 1),
        noise_std=first.noise_std,
        density=state.density,
        precision=state.copula.precision,
        shift=state.copula.shift,
        pair=state.pair,
        chance=state.chance,
        labels=state.labels,
        sweeps=state.sweeps,
    )


def _labelled(state: ClassesState) -> CopulaState:
    """The scores observed under the more probable class of each cell; of intervals that
    are another, no terms.
    """
    chosen, (first, second), was = state.probability() >= 0.5, state.looks, state.copula
    lower, upper, noise_std = (
        torch.where(chosen, getattr(first, name), getattr(second, name))
        for name in ("lower", "upper", "noise_std")
    )
    number, same = (
        upper <= lower,
        (lower == was.lower) & (upper == was.upper) & (noise_std == was.noise_std),
    )
    precision = torch.where(
        number, 1 / noise_std.square(), torch.where(same, was.precision, 0.0)
    )
    shift = torch.where(number, precision * lower, torch.where(same, was.shift, 0.0))
    return replace(
        was,
        value=first.value,
        lower=lower,
        upper=upper,
        noise_std=noise_std,
        precision=precision,
        shift=shift,
    )


def _moments(state: ClassesState) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, standard deviation and skewness of each cell's score under either class,
    each of shape [B, 2, H, W].
    """
    own, chosen = state.copula, state.probability() >= 0.5
    wanted = own.observed & (state.pair > 0)
    means, stds, skews = (
        torch.stack((values, values), 1) for values in (own.mean, own.std, own.skew)
    )
    if not bool(wanted.any()):
        return means, stds, skews
    mean, variance = own.mean[wanted], own.std[wanted].square().clamp(min=1e-12)
    # Without the cell's own term; that of the field alone has a precision of 1.
    left = (1 / variance - own.precision[wanted]).clamp(min=1)
    centre, left = (mean / variance - own.shift[wanted]) / left, 1 / left
    for part, look in enumerate(state.looks):
        lower, upper, noise_std = (
            look.lower[wanted],
            look.upper[wanted],
            look.noise_std[wanted],
        )
        total = left + noise_std.square()
        gain, number = left / total, upper <= lower
        given = centre, total, lower, torch.where(number, lower + 1, upper)
        moments = interval_moments(*(one.cpu().numpy() for one in given))
        found, spread = (torch.from_numpy(values).to(lower) for values in moments)
        found, spread = (
            torch.where(number, lower, found),
            torch.where(number, 0.0, spread),
        )
        std = (left - left * gain + gain.square() * spread).sqrt()
        new = centre + gain * (found - centre), std, torch.zeros_like(std)
        held = chosen[wanted] == (part == 0)
        for whole, value in zip((means, stds, skews), new, strict=True):
            whole[:, part][wanted] = torch.where(held, whole[:, part][wanted], value)
    return means, stds, skews
