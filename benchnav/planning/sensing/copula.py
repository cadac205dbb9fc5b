"""The copula belief: observed λ conditions the Gaussian field that the world's λ goes through.

A cell's λ has a rank in its own predicted distribution, whose normal score is a number, or an interval where the
distribution has an atom, as at 0 and 1. The scores of all cells are a correlated Gaussian field
(`benchnav.core.copula`), which the observed scores condition (`gaussian`). With the true distribution of each cell this
is the posterior under the law, up to expectation propagation for intervals, the reach and the window below, and the
rejection of draws without a feasible path; with a model's prediction it is an approximation.

Only cells within `_REACH` ℓ of what is new are updated, from the observations nearest to what is new, and only where
mean or standard deviation of the score change by `_LEAST_CHANGE` or more. λ that a prediction holds impossible is taken
for the end of what it allows, `_FARTHEST` standard deviations off.
Letters in shapes: B episodes, H×W cells, N observations, R×C cells of a block, K values of λ.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.conditioned import conditioned
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import expect
from benchnav.core.quantiles import QuantileDistribution
from benchnav.planning.sensing.belief import Belief, Law, draw_scores, fields_of
from benchnav.planning.sensing.gaussian import Cells, Field, Observed, condition
from benchnav.planning.sensing.sensor import LEAST_STD, Sensed

_REACH = 4.0  # ℓ; the correlation is 3e-4 there
_SAME_SCORE, _SAME_STD = 1e-6, 0.99  # a second look that tells less than this is none
_LEAST_CHANGE = 0.005  # of a score
_FARTHEST = 6.0  # score
_NO_TERM = 1e-12  # precision under which a term says nothing


VALUES: tuple[float, ...] = (
    *(round(0.005 * step, 3) for step in range(40)),
    *(round(0.2 + 0.02 * step, 2) for step in range(41)),
)
"""λ between which a belief's quantiles are linear in the normal score: denser where risk is."""
_LEVELS: tuple[float, ...] = (
    *(round(0.0025 * step, 4) for step in range(80)),
    *(round(0.2 + 0.02 * step, 2) for step in range(40)),
    *(0.99, 0.995, 0.9975, 1.0),
)
_MOST_SCORE = 9.0  # beyond which ranks are alike
_LAST_RANK = 3.4  # at levels 0 and 1, so that the mean of the ranks beyond the next level is right


@dataclass(frozen=True, kw_only=True)
class CopulaState(Batch):
    """What the copula belief knows; of observations NaN where there is none.

    Args:
        prior: the model's prediction, shape [B, H, W].
        scores: normal scores of `VALUES` in each cell under the prediction, shape [B, K, H, W].
        law: how λ hangs together.
        lower: least observed score of each cell, float64, shape [B, H, W].
        upper: greatest observed score; where it is the least, the score itself, shape [B, H, W].
        noise_std: standard deviation of the noise of the observed score, shape [B, H, W].
        precision: of the Gaussian term that stands for the observation; 0 where there is none, shape [B, H, W].
        shift: precision times mean of the term, shape [B, H, W].
        mean: of the score given all observations, shape [B, H, W].
        std: of the score given all observations, shape [B, H, W].
    """

    prior: TraversabilityDistribution
    scores: Tensor
    law: Law
    lower: Tensor
    upper: Tensor
    noise_std: Tensor
    precision: Tensor
    shift: Tensor
    mean: Tensor
    std: Tensor

    @property
    def observed(self) -> Tensor:
        """Cells of which something was observed, bool, shape [B, H, W]."""
        return ~self.lower.isnan()


@dataclass(frozen=True)
class Copula(Belief[CopulaState]):
    """Learns through the correlation of the ground.

    Args:
        correlation_m: ℓ that is believed; that of the world where it is not given, which is privileged knowledge.
        window: most observations that an update looks at, those nearest to what is new; more where more is new.
    """

    correlation_m: float | None = None
    window: int = 128

    def __post_init__(self) -> None:
        """Refuses lengths that are none, and windows without room."""
        expect(
            self.correlation_m is None or 0 <= self.correlation_m < math.inf,
            f"`correlation_m` ≥ 0 and finite, got {self.correlation_m}.",
        )
        expect(self.window >= 1, f"`window` of at least 1, got {self.window}.")

    def init(self, prior: TraversabilityDistribution, law: Law) -> CopulaState:
        """Knows the prediction alone."""
        law = law if self.correlation_m is None else replace(law, correlation_m=self.correlation_m)
        zeros = torch.zeros(prior.shape, dtype=torch.float64, device=prior.device)
        none = torch.full_like(zeros, torch.nan)
        return CopulaState(
            prior=prior, scores=scores_of(prior), law=law, lower=none, upper=none, noise_std=none,
            precision=zeros, shift=zeros, mean=zeros, std=torch.ones_like(zeros),
        )  # fmt: skip

    def update(
        self, state: CopulaState, sensed: Sensed, prior: TraversabilityDistribution | None = None
    ) -> CopulaState:
        """Conditions cells near what is new on what is observed there.

        Looks at a score are averaged. Of looks at an interval the one with the least noise counts.
        """
        if prior is not None:
            state = _with_prior(state, prior)
        noted, changed = _note(state, sensed)
        renewed = changed if prior is None else changed | noted.observed
        members = renewed.flatten(1).any(1).nonzero()[:, 0]
        if len(members) == 0:
            return noted
        window = self.window if prior is None else renewed[0].numel()
        return _put(noted, members, _updated(noted.select(members), renewed[members], window))

    def distribution(self, state: CopulaState) -> TraversabilityDistribution:
        """The prediction, given what was observed."""
        dtype = state.prior.dtype
        return conditioned(state.prior, state.mean.to(dtype), state.std.to(dtype))

    def at(self, state: CopulaState, cells: Tensor) -> QuantileDistribution:
        """What is believed of some cells; see `Belief`.

        By quantiles between `VALUES`, which is far quicker than `distribution` and tells λ̂ within 0.01 of it.
        """
        scores = state.scores.movedim(1, -1)[cells].contiguous()
        dtype, device = scores.dtype, scores.device
        wanted = (state.mean[cells][:, None] + state.std[cells][:, None] * _ranks(device)).to(dtype)
        values = torch.tensor(VALUES, dtype=dtype, device=device)
        after = torch.searchsorted(scores, wanted.contiguous()).clamp(1, len(VALUES) - 1)
        low, high = scores.gather(1, after - 1), scores.gather(1, after)
        part = ((wanted - low) / torch.where(high > low, high - low, 1.0)).clamp(0, 1)
        found = torch.lerp(values[after - 1], values[after], part)
        return QuantileDistribution(found.T[:, None].to(state.prior.dtype), _LEVELS)

    def changed(self, before: CopulaState, after: CopulaState) -> Tensor:
        """Cells whose score, or whose prediction, is another."""
        moved = (before.mean != after.mean) | (before.std != after.std)
        # Maps of many values, which an update without a new prediction hands on as they are.
        same = before.scores is after.scores
        return moved if same else moved | (before.scores != after.scores).any(1)

    def sample_fields(self, state: CopulaState, count: int, keys: Sequence[int]) -> Tensor:
        """Draws fields given all observations, by Matheron's rule: a field of the law, moved to what was observed."""
        return fields_of(state.prior, self.sample_scores(state, count, keys))

    def sample_scores(self, state: CopulaState, count: int, keys: Sequence[int]) -> Tensor:
        """The normal scores of `sample_fields`, shape [B, M, H, W]."""
        field = Field.of(state.law.grid.shape, state.law.correlation_cells, state.mean.device)
        scores = draw_scores(state.law, count, keys).to(state.mean.device)
        every = _all_cells(state.law.grid.shape, state.mean.device)
        for own, drawn in enumerate(scores):
            row, column = (state.precision[own] > _NO_TERM).nonzero(as_tuple=True)
            if len(row) == 0:
                continue
            cells = Cells(row=row[None], column=column[None])
            precision, shift = state.precision[own, row, column], state.shift[own, row, column]
            # As the white noise of further fields, of which the first cells are taken.
            noise = draw_scores(replace(state.law, correlation_m=0.0), 2 * count, keys[own : own + 1])
            noise = noise[0, count:].to(drawn)[:, row, column] / precision.sqrt()
            inner = field.covariance(cells, cells)[0] + torch.diag(1 / precision)
            away = (shift / precision - drawn[:, row, column] - noise).T
            moved = torch.cholesky_solve(away, torch.linalg.cholesky(inner))
            drawn += (field.covariance(every, cells)[0] @ moved).T.view_as(drawn)
        return scores


def scores_of(prior: TraversabilityDistribution) -> Tensor:
    """Normal scores of `VALUES` under a prediction, float32, shape [B, K, H, W]; an atom's end at 0 and at 1."""
    ends = [prior.to_normal(value)[value < 1] for value in VALUES]
    return torch.stack([end.float().clamp(-_MOST_SCORE, _MOST_SCORE) for end in ends], dim=1)


def _ranks(device: torch.device) -> Tensor:
    """Standard normal numbers of `_LEVELS`."""
    levels = torch.tensor(_LEVELS, dtype=torch.float64, device=device)
    return torch.special.ndtri(levels).clamp(-_LAST_RANK, _LAST_RANK)


def _with_prior(state: CopulaState, prior: TraversabilityDistribution) -> CopulaState:
    """Knows the same λ of another prediction, and nothing yet of what it tells of other cells."""
    seen = state.observed
    lower, upper = state.lower.clone(), state.upper.clone()
    if bool(seen.any()):
        middle = torch.where(state.upper > state.lower, _inner(state.lower, state.upper), state.lower)
        value = state.prior.at(seen).from_normal(middle[seen][None].to(prior.dtype))[0]
        lower[seen], upper[seen] = _scores(prior, seen, value)
    zeros = torch.zeros_like(state.mean)
    return replace(
        state, prior=prior, scores=scores_of(prior), lower=lower, upper=upper, precision=zeros, shift=zeros, mean=zeros,
        std=torch.ones_like(zeros),
    )  # fmt: skip


def _scores(prior: TraversabilityDistribution, cells: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
    """Least and greatest scores of observed λ [N] in some cells, bool [B, H, W]; both the same but for an atom."""
    low, high = (end[0].double() for end in prior.at(cells).to_normal(value[None].to(prior.dtype)))
    number = high <= low
    middle = low.clamp(-_FARTHEST, _FARTHEST)
    low, high = low.clamp(max=_FARTHEST), high.clamp(min=-_FARTHEST)
    return torch.where(number, middle, low), torch.where(number, middle, high)


def _inner(lower: Tensor, upper: Tensor) -> Tensor:
    """A number within each interval."""
    return torch.where(lower.isinf(), upper - 1, torch.where(upper.isinf(), lower + 1, (lower + upper) / 2))


def _note(state: CopulaState, sensed: Sensed) -> tuple[CopulaState, Tensor]:
    """Notes what was sensed, and tells of which cells something new is known, bool of shape [B, H, W]."""
    new = sensed.mask
    if not bool(new.any()):
        return state, new
    value = sensed.traversability[new]
    low, high = _scores(state.prior, new, value)
    std = sensed.std[new].double().clamp(min=LEAST_STD)
    was_low, was_high, was_std = state.lower[new], state.upper[new], state.noise_std[new]
    known, number, was_number = ~was_low.isnan(), high <= low, was_high <= was_low
    weight = torch.where(number & was_number, was_std.square() / (was_std.square() + std.square()), 1.0)
    score = torch.where(weight < 1, torch.lerp(was_low, low, weight), low)
    shared = torch.where(weight < 1, (weight.sqrt() * std).clamp(min=LEAST_STD), std)
    nothing_new = ((score - was_low).abs() < _SAME_SCORE) & (shared > _SAME_STD * was_std)
    sharper = ~known | (~was_number & (std < was_std))
    news = torch.where(number, ~(was_number & nothing_new), sharper)
    changed = torch.zeros_like(new)
    changed[new] = news

    def put(whole: Tensor, own: Tensor) -> Tensor:
        return whole.clone().index_put((changed,), own[news])

    precision = torch.where(number, 1 / shared.square(), 0.0)
    noted = replace(
        state,
        lower=put(state.lower, torch.where(number, score, low)),
        upper=put(state.upper, torch.where(number, score, high)),
        noise_std=put(state.noise_std, shared),
        precision=put(state.precision, precision),
        shift=put(state.shift, torch.where(number, precision * score, 0.0)),
    )
    return noted, changed


def _updated(state: CopulaState, changed: Tensor, window: int) -> CopulaState:
    """Updates terms of observations, and scores of cells, near what changed in each episode."""
    shape, device = state.law.grid.shape, state.mean.device
    field = Field.of(shape, state.law.correlation_cells, device)
    first, last = _bounds(changed)
    cells, there = _nearest(state.observed, changed, first, last, window)
    member = torch.arange(len(changed), device=device)[:, None]

    def of(values: Tensor, empty: float) -> Tensor:
        return torch.where(there, values[member, cells.row, cells.column], empty)

    known = condition(
        field.covariance(cells, cells),
        Observed(
            lower=of(state.lower, 0.0), upper=of(state.upper, 0.0), std=of(state.noise_std, 1.0),
            precision=of(state.precision, 0.0), shift=of(state.shift, 0.0), there=there,
        ),
    )  # fmt: skip
    block, own = _block(first, last, math.ceil(_REACH * state.law.correlation_cells), shape)
    mean, variance = known.moments(field.covariance(cells, block))
    std, at_block = variance.sqrt(), (member, block.row, block.column)
    moved = torch.maximum((mean - state.mean[at_block]).abs(), (std - state.std[at_block]).abs())
    own &= moved >= _LEAST_CHANGE

    def put(whole: Tensor, where: Cells, which: Tensor, values: Tensor) -> Tensor:
        places = [place[which] for place in (member.expand_as(where.row), where.row, where.column)]
        return whole.index_put(tuple(places), values[which])

    return replace(
        state,
        precision=put(state.precision, cells, there, known.precision),
        shift=put(state.shift, cells, there, known.shift),
        mean=put(state.mean, block, own, mean),
        std=put(state.std, block, own, std),
    )


def _put(whole: CopulaState, members: Tensor, part: CopulaState) -> CopulaState:
    """Puts some episodes' terms and scores where they were taken from."""
    names = ("precision", "shift", "mean", "std")
    return replace(
        whole, **{name: getattr(whole, name).index_copy(0, members, getattr(part, name)) for name in names}
    )


def _bounds(changed: Tensor) -> tuple[Tensor, Tensor]:
    """First and last row and column of some cells of each episode, each int64, shape [B, 2]."""
    ends = []
    for along in (changed.any(2), changed.any(1)):
        size = along.shape[1]
        ends.append((along.int().argmax(1), size - 1 - along.flip(1).int().argmax(1)))
    (top, bottom), (left, right) = ends
    return torch.stack((top, left), 1), torch.stack((bottom, right), 1)


def _nearest(
    observed: Tensor, changed: Tensor, first: Tensor, last: Tensor, window: int
) -> tuple[Cells, Tensor]:
    """What has changed and the observed cells nearest to it, and which of them are there, bool, shape [B, N]."""
    new, known = (int(cells.flatten(1).sum(1).max()) for cells in (changed, observed))
    count = min(max(window, new), known)
    away = [
        (torch.maximum(low[:, None] - at, at - high[:, None])).clamp(min=0)
        for low, high, size in zip(first.T, last.T, observed.shape[1:], strict=True)
        for at in (torch.arange(size, device=observed.device),)
    ]
    distance = (away[0].square()[:, :, None] + away[1].square()[:, None]).double()
    distance = torch.where(changed, -1.0, torch.where(observed, distance, torch.inf)).flatten(1)
    # Of equal distances the first cell goes first, on every machine.
    place = distance.argsort(dim=1, stable=True)[:, :count]
    width = observed.shape[2]
    return Cells(row=place // width, column=place % width), distance.gather(1, place).isfinite()


def _block(first: Tensor, last: Tensor, reach: int, shape: tuple[int, int]) -> tuple[Cells, Tensor]:
    """Cells of a block around each rectangle, all of one size, and which of them are within its reach."""
    lines, near = [], []
    for low, high, size in zip(first.T, last.T, shape, strict=True):
        most = min(int((high - low).max()) + 1 + 2 * reach, size)
        begin = (low - reach).clamp(min=0).clamp(max=size - most)
        line = begin[:, None] + torch.arange(most, device=low.device)
        lines.append(line)
        near.append((line >= low[:, None] - reach) & (line <= high[:, None] + reach))
    (rows, columns), (down, across) = lines, near
    row = rows[:, :, None].expand(-1, -1, columns.shape[1])
    column = columns[:, None].expand(-1, rows.shape[1], -1)
    own = down[:, :, None] & across[:, None]
    return Cells(row=row.flatten(1), column=column.flatten(1)), own.flatten(1)


def _all_cells(shape: tuple[int, int], device: torch.device) -> Cells:
    place = torch.arange(shape[0] * shape[1], device=device)[None]
    return Cells(row=place // shape[1], column=place % shape[1])
