"""The contract of beliefs, tried on small maps made on the spot.

Letters in shapes: B episodes, H×W cells, M drawn fields, N cells of a choice.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError
from benchnav.core.grid import Grid
from benchnav.core.ground import GroundStatistics
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.quantiles import LEVELS, quantiles_at
from benchnav.planning.sensing.belief import Belief, CovarianceModel, draw_scores
from benchnav.planning.sensing.sensor import MIN_STD, Measurement
from benchnav.testing.breaches import NOTHING, SEED, Breaches, same
from benchnav.testing.distribution import check_functions

_KEYS, _OTHER_KEYS = (3, 14, 15, 92), (65, 35, 89, 79)
_UNTOLD = 3  # the episode in which nothing is sensed
_STEPS = 3
_STD = 0.1  # of what is sensed
_VALUES = (0.0, 0.1, 0.4, 0.8)  # of λ, at which distributions are compared
_FIELDS = 200
_DRAWS = 8  # of all that is sensed
_BY_CHANCE = 0.01  # by which the mean over so few draws may rise
_FAR_OFF = 6  # standard errors
_QUICK = 0.01  # by how much λ̂ of `at` may differ from that of `distribution`


def check_belief(
    belief: Any,
    shapes: Sequence[tuple[int, int]] = ((10, 10), (8, 13)),
    device: torch.device | str = "cpu",
    tolerance: float = 1e-3,
) -> None:
    """Tries whether a belief keeps the contract, by telling it λ along a way in three
    of four episodes.

    The predictions: a mixture of three classes, two of which look alike, and one by
    quantiles, which a belief that needs another may refuse by a ConfigError that names
    its class.
    The contract: the distribution is a TraversabilityDistribution of shape [B, H, W] on
    the prediction's device, whose functions fit each other; it is the prediction until
    something is sensed, and stays in an episode in which nothing is; a new prediction
    takes the old one's place there. What was sensed once more changes nothing where it
    is nothing, or what was known without noise, nor anything at all in a belief that
    does not learn. What is drawn from the prediction makes it surer on average.
    `changed` names all cells of which something else is believed; `at` tells λ̂ of some
    cells within 0.01 of the distribution's. `sample_fields` gives λ in [0, 1] of shape
    [B, M, H, W], the same under the same keys and others under others, whose cells have
    what is believed up to chance. Arguments and global generators are left as they
    were; the answer is the same when asked again, after other maps were begun, and for
    episodes alone, in another order, kept by `select` or put elsewhere by `put`.

    Args:
        belief: any belief, or the name, file or mapping of one as suites have it.
        shapes: (H, W) of the maps to try.
        device: where the predictions are.
        tolerance: by how much probabilities of λ may differ where the same is expected.

    Raises:
        ConfigError: the belief breaks the contract; every breach is named.
    """
    made = registry.take("belief", belief)
    breaches = Breaches("belief", type(made).__name__)
    breaches.expect(
        isinstance(made.learns, bool),
        f"Expected `learns` of type bool, got {made.learns!r}.",
    )
    breaches.refuse()
    for number, (height, width) in enumerate(shapes):
        for kind in ("a mixture", "quantiles")[: 1 if number else 2]:
            breaches.place = f"{height}×{width}, {kind}"
            covariance, prior, other = _make_ground(
                height, width, kind == "quantiles", torch.device(device)
            )
            if kind == "quantiles" and _refuses_by_name(made, prior, covariance):
                continue
            _Trial(made, covariance, prior, other, tolerance, breaches).run()
    breaches.refuse()


@dataclass(frozen=True)
class _Trial:
    """A belief on one batch, and where its breaches are noted."""

    belief: Belief[Any]
    covariance: CovarianceModel
    prior: TraversabilityDistribution
    other: TraversabilityDistribution  # another prediction
    tolerance: float
    breaches: Breaches

    def run(self) -> None:
        """Tells what is sensed step by step, then anew under what should change
        nothing.
        """
        looks = list(_looks(self.prior, self.covariance))
        state = first = self.begin(self.prior)
        if state is NOTHING or not self.is_sound(state):
            return
        self.expect_of(
            state,
            self.prior,
            "Expected what is believed at first to be the prediction, got another.",
        )
        for sensed in looks:
            before, state = state, self.update(state, sensed)
            if state is NOTHING or not self.is_sound(state):
                return
            again = self.belief.update(before, sensed)
            self.expect(
                self.alike(again, state, 0),
                "Expected the same from `update` when asked again, got another.",
            )
            self.try_changed(before, state)
        shown, _ = _shown(self.belief.distribution(state)), self.begin(self.other)
        again = _shown(self.belief.distribution(state))
        self.expect(
            same(again, shown),
            "Expected the same after other maps were begun, got another.",
        )
        check_functions(self.belief.distribution(state), self.tolerance, self.breaches)
        self.try_nothing(first, state)
        self.try_repeated(state, looks[-1])
        self.try_drawn(first, looks)
        self.try_prior(state)
        self.try_at(state)
        self.try_fields(state)
        self.try_members(looks, state)
        self.try_put(state)

    def expect(self, kept: bool, breach: str) -> bool:
        """Notes a breach."""
        return self.breaches.expect(kept, breach)

    def begin(self, prior: TraversabilityDistribution) -> Any:
        """A state, or `NOTHING`."""
        return self.breaches.watch(
            "init",
            lambda: self.belief.init(prior, self.covariance),
            prior=prior,
            covariance=self.covariance,
        )

    def update(
        self,
        state: Any,
        sensed: Measurement,
        prior: TraversabilityDistribution | None = None,
    ) -> Any:
        """The next state, or `NOTHING`."""
        given = (state, sensed) if prior is None else (state, sensed, prior)
        named = dict(zip(("state", "sensed", "prior"), given, strict=False))
        return self.breaches.watch(
            "update", lambda: self.belief.update(*given), **named
        )

    def is_sound(self, state: Any) -> bool:
        """Whether what is believed can be looked at further."""
        found = self.breaches.watch(
            "distribution", lambda: self.belief.distribution(state), state=state
        )
        if found is NOTHING:
            return False
        is_one = isinstance(found, TraversabilityDistribution)
        said = type(found).__name__
        if not self.expect(
            is_one,
            f"Expected a TraversabilityDistribution from `distribution`, got {said}.",
        ):
            return False
        wanted = list(self.prior.shape), self.prior.device
        got = list(found.shape), found.device
        if not self.expect(
            got == wanted and found.dtype.is_floating_point,
            f"Expected a distribution of shape {wanted[0]} on {wanted[1]}, got one of "
            f"shape {got[0]} in {found.dtype} "
            f"on {got[1]}.",
        ):
            return False
        shown = _shown(found)
        return self.expect(
            bool(((shown >= 0) & (shown <= 1)).all()),
            "Expected probabilities in [0, 1] of what is believed, got others.",
        )

    def alike(
        self, one: Any, other: Any, tolerance: float, members: Tensor | None = None
    ) -> bool:
        """Whether two states believe the same; of the second some episodes alone, where
        they are given.
        """
        first, second = (
            _shown(self.belief.distribution(state)) for state in (one, other)
        )
        return same(first, second if members is None else second[:, members], tolerance)

    def expect_of(
        self, state: Any, prior: TraversabilityDistribution, breach: str, first: int = 0
    ) -> None:
        """Expects a prediction of episodes from some number on."""
        found, wanted = _shown(self.belief.distribution(state)), _shown(prior)
        self.expect(same(found[:, first:], wanted[:, first:], self.tolerance), breach)

    def try_changed(self, before: Any, after: Any, told: bool = True) -> None:
        """Expects `changed` to name the cells of which something else is believed."""
        named = self.breaches.watch(
            "changed",
            lambda: self.belief.changed(before, after),
            before=before,
            after=after,
        )
        shape = tuple(self.prior.shape)
        is_map = (
            isinstance(named, Tensor)
            and named.dtype == torch.bool
            and tuple(named.shape) == shape
        )
        if named is NOTHING or not self.expect(
            is_map, f"Expected a bool map of shape {list(shape)} from `changed`."
        ):
            return
        one, other = (
            _shown(self.belief.distribution(state)) for state in (before, after)
        )
        moved = ((one - other).abs() > self.tolerance).any(0)
        self.expect(
            not bool((moved & ~named).any()),
            "Expected `changed` to name all cells of which something else is "
            "believed, got some left out.",
        )
        if told and not self.belief.learns:
            said = (
                "Expected of a belief that does not learn (`learns`) that what is "
                "sensed changes nothing, got more."
            )
            self.expect(not bool(moved.any()), said)

    def try_nothing(self, first: Any, last: Any) -> None:
        """Expects that nothing sensed changes nothing."""
        nothing = _sensed(torch.full(self.prior.shape, torch.nan), self.prior)
        for state in (first, last):
            after = self.update(state, nothing)
            self.expect(
                after is NOTHING or self.alike(after, state, self.tolerance),
                "Expected that nothing changes where nothing is sensed, got a change.",
            )
        said = (
            "Expected the prediction of an episode in which nothing was sensed, "
            "got another."
        )
        self.expect_of(last, self.prior, said, _UNTOLD)

    def try_repeated(self, last: Any, sensed: Measurement) -> None:
        """Expects that λ which is told twice without noise changes nothing the second
        time.
        """
        exact = Measurement(
            traversability=sensed.traversability,
            std=torch.full_like(sensed.traversability, MIN_STD),
        )
        once = self.update(last, exact)
        twice = NOTHING if once is NOTHING else self.update(once, exact)
        if twice is not NOTHING and self.is_sound(twice):
            said = (
                "Expected λ that is sensed again without noise to change nothing, "
                "got a change."
            )
            self.expect(self.alike(twice, once, self.tolerance), said)

    def try_drawn(self, first: Any, looks: Sequence[Measurement]) -> None:
        """Expects that what is drawn from the prediction makes other cells surer on
        average.

        Of the chance p of λ under a number the variance is p (1 − p); over what may be
        sensed its mean cannot rise (the law of total variance). One update alone may
        raise it.
        """
        if not self.belief.learns:
            return
        seen = torch.stack([sensed.mask for sensed in looks]).any(0)
        scores = draw_scores(self.covariance, _DRAWS, _KEYS).to(
            self.prior.device, self.prior.dtype
        )
        before, after = _shown(self.prior), []
        for number in range(_DRAWS):
            field = self.prior.from_normal(scores[:, number])
            state = self.update(
                first, _sensed(torch.where(seen, field, torch.nan), self.prior)
            )
            if state is NOTHING or not self.is_sound(state):
                return
            found = _shown(self.belief.distribution(state))
            after.append(found * (1 - found))
        rise = (torch.stack(after).mean(0) - before * (1 - before))[:, ~seen]
        said = (
            "Expected what is drawn from the prediction to make it surer on "
            "average, got less sure."
        )
        self.expect(float(rise.mean()) <= _BY_CHANCE, said)

    def try_prior(self, last: Any) -> None:
        """Expects a new prediction to be taken."""
        nothing = _sensed(torch.full(self.prior.shape, torch.nan), self.prior)
        after = self.update(last, nothing, self.other)
        if after is NOTHING or not self.is_sound(after):
            return
        said = (
            "Expected a new prediction to take the old one's place where nothing "
            "was sensed, got another."
        )
        self.expect_of(after, self.other, said, _UNTOLD)
        self.try_changed(last, after, told=False)

    def try_at(self, state: Any) -> None:
        """Expects of some cells what the distribution tells of them."""
        cells = torch.zeros(
            self.prior.shape, dtype=torch.bool, device=self.prior.device
        )
        cells[0, ::2], cells[2, 1], cells[_UNTOLD, :, 3] = True, True, True
        found = self.breaches.watch(
            "at", lambda: self.belief.at(state, cells), state=state, cells=cells
        )
        if found is NOTHING:
            return
        shape = [1, int(cells.sum())]
        got = (
            list(found.shape)
            if isinstance(found, TraversabilityDistribution)
            else type(found).__name__
        )
        if not self.expect(
            got == shape,
            f"Expected a distribution of shape {shape} from `at`, got {got}.",
        ):
            return
        wanted = self.belief.distribution(state)
        near = (
            same(own, whole[cells][None], _QUICK)
            for own, whole in zip(_means(found), _means(wanted), strict=True)
        )
        self.expect(
            all(near),
            f"Expected mean and CVaR of `at` within {_QUICK} of the distribution's, "
            "got others.",
        )

    def try_fields(self, state: Any) -> None:
        """Expects fields that are drawn to be keyed, and of what is believed."""

        def draw(given: Any, count: int, keys: Sequence[int]) -> Any:
            return self.breaches.watch(
                "sample_fields",
                lambda: self.belief.sample_fields(given, count, keys),
                state=given,
            )

        fields = draw(state, _FIELDS, _KEYS)
        shape = [len(_KEYS), _FIELDS, *self.prior.shape[1:]]
        got = (
            list(fields.shape) if isinstance(fields, Tensor) else type(fields).__name__
        )
        if fields is NOTHING or not self.expect(
            got == shape, f"Expected fields of shape {shape}, got {got}."
        ):
            return
        self.expect(
            bool(((fields >= 0) & (fields <= 1)).all()),
            "Expected fields of λ in [0, 1], got others.",
        )
        few, others = draw(state, 2, _KEYS), draw(state, 2, _OTHER_KEYS)
        self.expect(
            same(draw(state, 2, _KEYS), few),
            "Expected the same fields when asked again, got others.",
        )
        self.expect(
            others is NOTHING or not any(map(same, few, others)),
            "Expected other fields under other keys, got the same.",
        )
        some = torch.tensor([2, 0], device=self.prior.device)
        chosen = self.select(state, some)
        alone = (
            chosen
            if chosen is NOTHING
            else draw(chosen, 2, [_KEYS[own] for own in (2, 0)])
        )
        self.expect(
            alone is NOTHING or same(alone, few[some], self.tolerance),
            "Expected an episode's fields to be those of its own key whatever else is "
            "drawn, got others.",
        )
        found = self.belief.distribution(state)
        for value in _VALUES[1:]:
            share = found.cdf(value).double()
            error = (share * (1 - share) / _FIELDS).sqrt()
            away = ((fields <= value).double().mean(1) - share).abs()
            self.expect(
                bool((away <= _FAR_OFF * error + 0.03).all()),
                "Expected fields whose cells have the distribution that is believed, "
                "got others.",
            )

    def try_members(self, looks: Sequence[Measurement], last: Any) -> None:
        """Expects of episodes alone, in another order, and kept on the way, what they
        got in the batch.
        """
        for members in ([3], [1], [2, 0]):
            some = torch.tensor(members, device=self.prior.device)
            alone, kept = self.begin(self.prior.select(some)), self.begin(self.prior)
            for number, sensed in enumerate(looks):
                if number == 1:
                    kept = self.select(kept, some)
                if alone is NOTHING or kept is NOTHING:
                    return
                alone = self.update(alone, sensed.select(some))
                kept = self.update(kept, sensed.select(some) if number else sensed)
            if alone is NOTHING or kept is NOTHING:
                return
            self.expect(
                self.alike(alone, last, self.tolerance, some),
                "Expected for episodes alone and in another order what they got in "
                "the batch, got another.",
            )
            self.expect(
                self.alike(kept, last, self.tolerance, some),
                "Expected of episodes that `select` keeps what they got in the batch, "
                "got another.",
            )

    def try_put(self, state: Any) -> None:
        """Expects episodes that are put in the places of others to be there as they
        were.
        """
        places = torch.tensor([1, _UNTOLD], device=self.prior.device)
        some = torch.tensor([2, 0], device=self.prior.device)
        others = self.select(state, some)
        if others is NOTHING:
            return
        found = self.breaches.watch(
            "put",
            lambda: self.belief.put(state, places, others),
            state=state,
            others=others,
        )
        order = torch.tensor([0, 2, 2, 0], device=self.prior.device)
        if found is not NOTHING and self.is_sound(found):
            self.expect(
                self.alike(found, state, self.tolerance, order),
                "Expected episodes that `put` puts in the places of others to be as "
                "they were, got others.",
            )

    def select(self, state: Any, members: Tensor) -> Any:
        """A state of some episodes, or `NOTHING`."""
        if state is NOTHING:
            return NOTHING
        kept = self.breaches.watch(
            "select", lambda: self.belief.select(state, members), state=state
        )
        if kept is NOTHING:
            return NOTHING
        got, count = list(self.belief.distribution(kept).shape), len(members)
        wanted = [count, *self.prior.shape[1:]]
        said = (
            f"Expected a distribution of shape {wanted} of episodes that `select` "
            f"keeps, got {got}."
        )
        return kept if self.expect(got == wanted, said) else NOTHING


def _shown(distribution: TraversabilityDistribution) -> Tensor:
    """Probabilities that λ is at most some values, shape [V, B, H, W]."""
    return torch.stack([distribution.cdf(value).double() for value in _VALUES])


def _means(distribution: TraversabilityDistribution) -> tuple[Tensor, Tensor]:
    return distribution.mean(), distribution.cvar(0.8)


def _refuses_by_name(
    belief: Belief[Any], prior: TraversabilityDistribution, covariance: CovarianceModel
) -> bool:
    try:
        belief.init(prior, covariance)
    except ConfigError as error:
        return type(prior).__name__ in str(error)
    except Exception:
        return False  # which is noted where it is tried
    return False


def _sensed(values: Tensor, prior: TraversabilityDistribution) -> Measurement:
    values = values.to(dtype=prior.dtype, device=prior.device)
    return Measurement(traversability=values, std=torch.full_like(values, _STD))


def _looks(
    prior: TraversabilityDistribution, covariance: CovarianceModel
) -> Iterator[Measurement]:
    """λ along a way from left to right, also 0 and 1; of the second episode nothing at
    first, of the last never.
    """
    score = draw_scores(covariance, 1, _KEYS)[:, 0].to(prior.device)
    field = prior.from_normal(score.to(prior.dtype))
    height, width = covariance.grid.shape
    for step in range(_STEPS):
        values, row = torch.full_like(field, torch.nan), height // 2
        begin, end = step * width // (_STEPS + 1), (step + 1) * width // (_STEPS + 1)
        values[:, row - 1 : row + 1, begin:end] = field[:, row - 1 : row + 1, begin:end]
        values[0, row, begin], values[2, row, begin] = 0.0, 1.0
        values[_UNTOLD] = torch.nan
        if step == 0:
            values[1] = torch.nan
        yield _sensed(values, prior)


def _make_ground(
    height: int, width: int, by_quantiles: bool, device: torch.device
) -> tuple[CovarianceModel, TraversabilityDistribution, TraversabilityDistribution]:
    """A covariance model, and two predictions of the λ of four maps."""
    covariance = CovarianceModel(
        grid=Grid(height, width, 0.5),
        correlation_m=1.0,
        statistics=GroundStatistics(
            weights=(0.3, 0.7),
            means=(0.1, 0.7),
            stds=(0.1, 0.15),
            layer_means={"rgb": (120.0, 110.0, 90.0)},
            look_alikes=(("firm", "soft"),),
            potts_strength=0.8,
        ),
        class_names=("firm", "soft", "sand"),
    )
    generator = torch.Generator().manual_seed(SEED)

    def predict() -> TraversabilityDistribution:
        drawn = torch.rand(3, len(_KEYS), 3, height, width, generator=generator).to(
            device
        )
        weights = (
            torch.tensor([0.5, 0.3, 0.1], device=device).view(-1, 1, 1) + 0.2 * drawn[0]
        )
        centres = torch.tensor([0.75, 0.05, 0.45], device=device).view(-1, 1, 1)
        means, stds = centres + 0.1 * drawn[1], 0.08 + 0.05 * drawn[2]
        mixture = TraversabilityMixture(
            weights / weights.sum(1, keepdim=True), means, stds, (0, 1, 2)
        )
        return quantiles_at(mixture, LEVELS) if by_quantiles else mixture

    return covariance, predict(), predict()
