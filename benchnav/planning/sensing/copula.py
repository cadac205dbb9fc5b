"""The copula belief: observed λ conditions the Gaussian field that the world's λ goes
through.

A cell's λ has a rank in its own predicted distribution, whose normal score is a number,
or an interval where the distribution has an atom, as at 0 and 1. The scores of all
cells are a correlated Gaussian field (`benchnav.core.copula`), which the observed
scores condition (`gaussian`). With the true distribution of each cell this is the
posterior under the law, up to expectation propagation for intervals, the reach below,
the lattice that stands for many observations (`lattice`), and the rejection of draws
without a feasible path; with a model's prediction it is an approximation.

Only cells within `_REACH` ℓ of what is new are updated, from all that was observed
within `_BEYOND` ℓ more, and only where mean or standard deviation of the score change
by `_LEAST_CHANGE` or more. λ that a prediction holds impossible is taken for the end of
what it allows, `_FARTHEST` standard deviations off.
Letters in shapes: B episodes, H×W cells, N observations, R×C cells of a block, K values
of λ.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from benchnav.core import rng
from benchnav.core.conditioned import ConditionedDistribution, skewed
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import expect
from benchnav.planning.sensing.belief import Belief, Law, Predicted, draw_scores
from benchnav.planning.sensing.gaussian import (
    Field,
    Observed,
    condition,
    evidence,
    predict,
)
from benchnav.planning.sensing.lattice import Lattice, condition_and_predict, spacing_of
from benchnav.planning.sensing.score_table import ScoreTable, TabulatedDistribution
from benchnav.planning.sensing.sensor import LEAST_STD, Sensed

_REACH = 4.0  # ℓ; the correlation is 3e-4 there
# ℓ; what is observed farther off changes no cell within `_REACH` by `_LEAST_CHANGE`
_BEYOND = 2.0
# Observations that are conditioned on without a lattice, those nearest to what is new,
# so that an update takes half a second at most. Cells that were observed and are left
# out keep what is known of them.
_MOST_AT_ONCE = 2048
_SAME_SCORE, _SAME_STD = 1e-6, 0.99  # a second look that tells less than this is none
_LEAST_CHANGE = 0.005  # of a score
_OF_SKEW = 1 / 6  # by how much the score of the median moves with the skewness
_FARTHEST = 6.0  # score
_NO_TERM = 1e-12  # precision under which a term says nothing
_SAME_PREDICTION = 1e-3  # of its parameters; λ̂ is then the same within about as much
_MEDIAN_M, _LOG_STD = 1.5, math.log(2)  # of ℓ, before anything was observed
_LENGTHS_M = tuple(_MEDIAN_M * 2 ** (step / 4) for step in range(-8, 9))
_FEWEST = 8  # observations that an estimate of ℓ takes
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
    """What the copula belief knows; of observations NaN where there is none.

    Args:
        table: scores of λ under the prediction, of the cells of which something else is
            believed.
        field: how the scores hang together, B of them.
        estimated_from: from how many observations ℓ was estimated; 0 where it was not,
            int64, shape [B].
        value: observed λ, of several looks the average, float64, shape [B, H, W].
        lower: least observed score of each cell, float64, shape [B, H, W].
        upper: greatest observed score; where it is the least, the score itself, shape
            [B, H, W].
        noise_std: standard deviation of the noise of the observed score, shape [B, H,
            W].
        precision: of the Gaussian term that stands for the observation; 0 where there
            is none, shape [B, H, W].
        shift: precision times mean of the term, shape [B, H, W].
        mean: of the score given all observations, shape [B, H, W].
        std: of the score given all observations, shape [B, H, W].
        skew: of the score given all observations, its skewness, shape [B, H, W].
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
        """Cells of which something was observed, bool, shape [B, H, W]."""
        return ~self.value.isnan()


@dataclass(frozen=True)
class Copula(Belief[CopulaState]):
    """Learns from sensed λ what λ is like nearby, since neighbouring ground is alike.

    Args:
        correlation_m: ℓ that is believed, in metres; `world`, that of the world, which
            is privileged knowledge; or `estimated` in each episode from what is
            observed in it: the mode of the posterior of log ℓ under a log-normal prior
            of median 1.5 m and standard deviation ln 2. It is estimated from 8, 16, 32,
            … observations on, until the window is full; before, it is the median.
        window: most observations that an estimate of ℓ looks at, those nearest to what
            is new; where more are near, and ℓ is four cells or more, an update solves
            for a lattice of cells (`lattice`).
        nugget: share of the variance of a cell's score that is its own and no
            neighbour's; None for the law's.
    """

    correlation_m: float | Literal["world", "estimated"] = "world"
    window: int = 256
    nugget: float | None = None

    def __post_init__(self) -> None:
        """Refuses lengths that are none, and windows without room."""
        given = self.correlation_m
        expect(
            given in ("world", "estimated")
            if isinstance(given, str)
            else 0 <= given < math.inf,
            f"`correlation_m` ≥ 0 and finite, 'world' or 'estimated', got {given!r}.",
        )
        expect(self.window >= 1, f"`window` of at least 1, got {self.window}.")
        expect(
            self.nugget is None or 0 <= self.nugget < 1,
            f"`nugget` in [0, 1), got {self.nugget}.",
        )

    def init(self, prior: TraversabilityDistribution, law: Law) -> CopulaState:
        """Knows the prediction alone."""
        named = {"world": law.correlation_m, "estimated": _MEDIAN_M}
        length_m = (
            named[self.correlation_m]
            if isinstance(self.correlation_m, str)
            else self.correlation_m
        )
        law = law if self.nugget is None else replace(law, nugget=self.nugget)
        lengths = [length_m / law.grid.resolution_m] * prior.shape[0]
        zeros = torch.zeros(prior.shape, dtype=torch.float64, device=prior.device)
        none = torch.full_like(zeros, torch.nan)
        return CopulaState(
            prior=prior,
            table=ScoreTable.empty(prior),
            law=law,
            field=Field.of(law.grid.shape, lengths, prior.device, law.nugget),
            estimated_from=zeros[:, 0, 0].long(),
            value=none,
            lower=none,
            upper=none,
            noise_std=none,
            precision=zeros,
            shift=zeros,
            mean=zeros,
            std=torch.ones_like(zeros),
            skew=zeros,
        )

    def update(
        self,
        state: CopulaState,
        sensed: Sensed,
        prior: TraversabilityDistribution | None = None,
    ) -> CopulaState:
        """Conditions cells near what is new on what is observed there.

        Looks at a score are averaged. Of looks at an interval the one with the least
        noise counts. Of a new prediction the cells count whose parameters differ by
        more than 10⁻³ from those known.
        """
        noted, other = state, torch.zeros_like(state.observed)
        if prior is not None:
            noted, other = with_prior(state, prior)
        noted, news = note(noted, sensed)
        learnt = self.learn(noted, news | (other & noted.observed))
        moved = other | _moved(state, learnt)
        return replace(learnt, table=learnt.table.having(learnt.prior, moved))

    def learn(self, noted: CopulaState, news: Tensor) -> CopulaState:
        """Conditions cells near what is new.

        Args:
            noted: of which observations are noted; it is not changed.
            news: cells of which something was noted that is not yet known, bool, shape
                [B, H, W].
        """
        members = news.flatten(1).any(1).nonzero()[:, 0].tolist()
        if not members:
            return noted
        # On the host, where such small systems are solved quickest.
        host = replace(
            noted, **{name: getattr(noted, name).to("cpu") for name in _MAPS}
        )
        host = replace(
            host, **{name: getattr(host, name).clone().to("cpu") for name in _LEARNT}
        )
        for own, new in zip(members, news[members].cpu().numpy(), strict=True):
            self._learn(host, own, new)
        return replace(
            noted, **{name: getattr(host, name).to(news.device) for name in _LEARNT}
        )

    def _learn(self, state: CopulaState, own: int, new: ndarray) -> None:
        """Makes of what was noted in one episode what is known; writes into the state.

        Episodes go one by one: as many observations as each has, so that none depends
        on the others.
        """
        maps = {name: getattr(state, name)[own].numpy() for name in _MAPS}
        observed = ~np.isnan(maps["value"])
        count, before = int(observed.sum()), int(state.estimated_from[own])
        if (
            self.correlation_m == "estimated"
            and max(_FEWEST, 2 * before) <= count
            and before < self.window
        ):
            state.estimated_from[own] = count
            row, column = nearest(observed, new, self.window)
            length = _estimate(state, maps, row[: self.window], column[: self.window])
            if length != float(state.field.length[own]):
                state.field.write(
                    own,
                    Field.of(state.law.grid.shape, [length], "cpu", state.law.nugget),
                )
                maps["mean"][:], maps["std"][:], maps["skew"][:] = 0, 1, 0
                new = observed
        _condition(state.field, own, maps, new, self.window)

    def distribution(self, state: CopulaState) -> TraversabilityDistribution:
        """The prediction, given what was observed."""
        dtype = state.prior.dtype
        return ConditionedDistribution(
            state.prior, state.mean.to(dtype), state.std.to(dtype), state.skew.to(dtype)
        )

    def at(self, state: CopulaState, cells: Tensor) -> TabulatedDistribution:
        """What is believed of some cells; see `Belief`.

        From a table of scores, which is far quicker than `distribution` and tells λ̂
        within 0.01 of it.
        """
        table = state.table.having(state.prior, cells)
        below = table.below(
            cells, state.mean[cells], state.std[cells], state.skew[cells]
        )
        return TabulatedDistribution(below.T[:, None].to(state.prior.dtype))

    def changed(self, before: CopulaState, after: CopulaState) -> Tensor:
        """Cells whose score, or whose prediction, is another."""
        moved = _moved(before, after)
        return (
            moved
            if before.prior is after.prior
            else moved | before.prior.differs(after.prior)
        )

    def put(
        self, state: CopulaState, members: Tensor, others: CopulaState
    ) -> CopulaState:
        """Puts episodes in the places of others; see `Belief`."""
        return replace(
            state.put(members, others), table=state.table.put(members, others.table)
        )

    def sample_fields(
        self, state: CopulaState, count: int, keys: Sequence[int]
    ) -> Tensor:
        """Draws fields given all observations, by Matheron's rule: a field of the law,
        moved to what was observed.
        """
        return state.fields(self.sample_scores(state, count, keys))

    def sample_scores(
        self, state: CopulaState, count: int, keys: Sequence[int]
    ) -> Tensor:
        """Normal scores of the fields that `sample_fields` draws, shape [B, M, H, W]."""
        (height, width), device = state.law.grid.shape, state.mean.device
        lines = (
            torch.arange(height, device=device)[:, None],
            torch.arange(width, device=device),
        )
        scores = []
        for own, length in enumerate(state.field.length.tolist()):
            law = replace(state.law, correlation_m=length * state.law.grid.resolution_m)
            drawn = draw_scores(law, count, keys[own : own + 1])[0].to(device).double()
            scores.append(drawn)
            row, column = (state.precision[own] > _NO_TERM).nonzero(as_tuple=True)
            if len(row) == 0:
                continue
            precision, shift = (
                state.precision[own, row, column],
                state.shift[own, row, column],
            )
            noise_keys = [rng.stream_key(keys[own], "observations")]
            noise = draw_scores(
                replace(law, correlation_m=0.0, nugget=0.0), count, noise_keys
            )
            noise = noise[0].to(drawn)[:, row, column] / precision.sqrt()
            inner = state.field.covariance(
                own, row[:, None] - row, column[:, None] - column
            )
            inner.diagonal().add_(1 / precision)
            away = (shift / precision - drawn[:, row, column] - noise).T
            moved = torch.cholesky_solve(away, torch.linalg.cholesky(inner))
            apart = (
                places[:, None, None] - line
                for places, line in zip((row, column), lines, strict=True)
            )
            drawn += (
                state.field.covariance(own, *apart).flatten(1).T @ moved
            ).T.view_as(drawn)
        mean, std, skew = (
            values[:, None] for values in (state.mean, state.std, state.skew)
        )
        normal = (torch.stack(scores) - mean) / std.clamp(min=_NO_TERM)
        return mean + std * skewed(normal, skew)


def _moved(before: CopulaState, after: CopulaState) -> Tensor:
    """Of which cells something else is believed of the score, bool, shape [B, H, W]."""
    return (
        (before.mean != after.mean)
        | (before.std != after.std)
        | (before.skew != after.skew)
    )


def with_prior(
    state: CopulaState, prior: TraversabilityDistribution
) -> tuple[CopulaState, Tensor]:
    """Takes the prediction of cells where it differs, bool [B, H, W], and what the λ
    observed there says under it.
    """
    other = state.prior.differs(prior, _SAME_PREDICTION)
    if not bool(other.any()):
        return state, other
    anew = other & state.observed
    low, high = scores_at(prior, anew, state.value[anew])
    precision, shift = _terms(low, high, state.noise_std[anew])
    # Of the other cells the prediction stays what it was, so that small changes do not
    # add up unseen.
    prior = prior if bool(other.all()) else state.prior.replaced(other, prior)
    told = replace(
        state,
        prior=prior,
        table=state.table.without(other),
        lower=state.lower.index_put((anew,), low),
        upper=state.upper.index_put((anew,), high),
        precision=state.precision.index_put((anew,), precision),
        shift=state.shift.index_put((anew,), shift),
    )
    return told, other


def _terms(low: Tensor, high: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
    """Precision and shift of what is known of scores; nothing yet where it is an
    interval.
    """
    precision = torch.where(high <= low, 1 / std.square(), 0.0)
    return precision, torch.where(high <= low, precision * low, 0.0)


def scores_at(
    prior: TraversabilityDistribution, cells: Tensor, value: Tensor
) -> tuple[Tensor, Tensor]:
    """Least and greatest scores of observed λ [N] in some cells, bool [B, H, W]; both
    the same but for an atom.
    """
    low, high = (
        end[0].double()
        for end in prior.at(cells).to_normal(value[None].to(prior.dtype))
    )
    number = high <= low
    middle = low.clamp(-_FARTHEST, _FARTHEST)
    low, high = low.clamp(max=_FARTHEST), high.clamp(min=-_FARTHEST)
    return torch.where(number, middle, low), torch.where(number, middle, high)


def note(state: CopulaState, sensed: Sensed) -> tuple[CopulaState, Tensor]:
    """Notes what was sensed, and tells of which cells something new is known, bool of
    shape [B, H, W].
    """
    new = sensed.mask
    if not bool(new.any()):
        return state, new
    value = sensed.traversability[new]
    low, high = scores_at(state.prior, new, value)
    std = sensed.std[new].double().clamp(min=LEAST_STD)
    was_low, was_high, was_std = (
        state.lower[new],
        state.upper[new],
        state.noise_std[new],
    )
    known, number, was_number = ~was_low.isnan(), high <= low, was_high <= was_low
    weight = torch.where(
        number & was_number, was_std.square() / (was_std.square() + std.square()), 1.0
    )
    score = torch.where(weight < 1, torch.lerp(was_low, low, weight), low)
    shared = torch.where(weight < 1, (weight.sqrt() * std).clamp(min=LEAST_STD), std)
    nothing_new = ((score - was_low).abs() < _SAME_SCORE) & (
        shared > _SAME_STD * was_std
    )
    sharper = ~known | (~was_number & (std < was_std))
    news = torch.where(number, ~(was_number & nothing_new), sharper)
    changed = torch.zeros_like(new)
    changed[new] = news

    def put(whole: Tensor, own: Tensor) -> Tensor:
        return whole.index_put((changed,), own[news])

    known_value = torch.where(
        weight < 1, torch.lerp(state.value[new], value.double(), weight), value.double()
    )
    score, high = torch.where(number, score, low), torch.where(number, score, high)
    precision, shift = _terms(score, high, shared)
    noted = replace(
        state,
        value=put(state.value, known_value),
        lower=put(state.lower, score),
        upper=put(state.upper, high),
        noise_std=put(state.noise_std, shared),
        precision=put(state.precision, precision),
        shift=put(state.shift, shift),
    )
    return noted, changed


def _condition(
    field: Field, own: int, maps: dict[str, ndarray], new: ndarray, window: int
) -> None:
    """Updates terms of observations, and scores of cells, near what is new in one
    episode; writes into its maps.

    Cells are rewritten within `_REACH` ℓ of what is new, from all that was observed
    within `_BEYOND` ℓ more: nothing that bears on them is left out, so that nothing is
    forgotten.
    """
    length = float(field.length[own])
    reach = math.ceil(_REACH * length)
    rows, columns = _around(new, reach)
    near = _around(new, reach + math.ceil(_BEYOND * length))
    left = np.zeros_like(new)
    left[near] = ~np.isnan(maps["value"][near])
    by_lattice = left.sum() > window and spacing_of(length) > 1
    row, column = nearest(left, new, left.size if by_lattice else _MOST_AT_ONCE)
    cells = row, column
    left[cells] = False
    observed = _observed(maps, *cells)
    shape = rows.stop - rows.start, columns.stop - columns.start
    if by_lattice:
        down, across = (
            places.ravel()
            for places in np.mgrid[rows.start : rows.stop, columns.start : columns.stop]
        )
        precision, shift, (mean, variance, skew) = condition_and_predict(
            Lattice.around(field, own, cells), observed, cells, (down, across)
        )
    else:
        at_row, at_column = (torch.from_numpy(places)[:, None] for places in cells)
        covariance = field.covariance(
            own, at_row - at_row.T, at_column - at_column.T
        ).numpy()
        known = condition(covariance, observed)
        precision, shift = known.precision, known.shift
        downs, acrosses = (
            torch.arange(rows.start, rows.stop),
            torch.arange(columns.start, columns.stop),
        )
        block = field.covariance(
            own, (at_row - downs)[..., None], (at_column - acrosses)[:, None]
        )
        mean, variance, skew = predict(
            known, covariance, observed, block.flatten(1).numpy()
        )
    found = np.stack((mean, np.sqrt(variance.clip(0)), skew)).reshape(3, *shape)
    old = np.stack([maps[name][rows, columns] for name in ("mean", "std", "skew")])
    # What was observed at a cell says more of it than what there is room for. Numbers
    # make no cell less sure.
    kept = left[rows, columns]
    if not observed.interval.any():
        kept |= found[1] > old[1] + _LEAST_CHANGE
        found[1] = np.minimum(found[1], old[1])
    moved = (
        abs(found - old) >= _LEAST_CHANGE / np.array((1, 1, _OF_SKEW))[:, None, None]
    ).any(0) & ~kept
    for name, values in zip(("mean", "std", "skew"), found, strict=True):
        np.copyto(maps[name][rows, columns], values, where=moved)
    maps["precision"][cells], maps["shift"][cells] = precision, shift


def _around(new: ndarray, reach: int) -> tuple[slice, slice]:
    """Rows and columns of a map within some cells of what is new."""
    rows, columns = (
        slice(max(low - reach, 0), min(high + reach + 1, size))
        for (low, high), size in zip(bounds(new), new.shape, strict=True)
    )
    return rows, columns


def _observed(maps: dict[str, ndarray], row: ndarray, column: ndarray) -> Observed:
    """What is known of observed cells of one episode."""
    names = ("lower", "upper", "noise_std", "precision", "shift")
    return Observed(*(maps[name][row, column] for name in names))


def _estimate(
    state: CopulaState, maps: dict[str, ndarray], row: ndarray, column: ndarray
) -> float:
    """ℓ of one episode, in cells: the mode of its posterior among `_LENGTHS_M`."""
    grid, observed = state.law.grid, _observed(maps, row, column)
    field = _candidates(grid.shape, grid.resolution_m, state.law.nugget)
    apart = [torch.from_numpy(places[:, None] - places) for places in (row, column)]
    likely = []
    for own, length_m in enumerate(_LENGTHS_M):
        covariance = field.covariance(own, *apart).numpy()
        found = evidence(covariance, observed, condition(covariance, observed))
        likely.append(found - 0.5 * (math.log(length_m / _MEDIAN_M) / _LOG_STD) ** 2)
    return float(field.length[int(np.argmax(likely))])


@lru_cache(maxsize=8)
def _candidates(shape: tuple[int, int], resolution_m: float, nugget: float) -> Field:
    return Field.of(
        shape, [length / resolution_m for length in _LENGTHS_M], "cpu", nugget
    )


def bounds(new: ndarray) -> list[tuple[int, int]]:
    """First and last row, and first and last column, of some cells of a map."""
    return [(int(places.min()), int(places.max())) for places in new.nonzero()]


def nearest(observed: ndarray, new: ndarray, window: int) -> tuple[ndarray, ndarray]:
    """Rows and columns of what is new on a map, and of the observed cells nearest to it
    while the window has room.
    """
    row, column = observed.nonzero()
    (top, bottom), (left, right) = bounds(new)
    down, across = (
        np.maximum(top - row, row - bottom).clip(0),
        np.maximum(left - column, column - right).clip(0),
    )
    # Of equal distances the first cell goes first, on every machine.
    order = np.where(new[row, column], -1, down**2 + across**2).argsort(kind="stable")
    kept = order[: max(window, int(new.sum()))]
    return row[kept], column[kept]
