"""The check of beliefs on small generated maps.

Letters in shapes: B episodes; H×W cells; M joint samples; V values of λ.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchnav.core import registry
from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError
from benchnav.planning.sensing.belief import Belief, CovarianceModel, draw_scores
from benchnav.planning.sensing.sensor import MIN_STD, Measurement
from benchnav.testing.belief_fields import VALUES, check_fields
from benchnav.testing.belief_inputs import (
    KEYS,
    UNOBSERVED,
    measure,
    measurements,
    no_measurement,
    pose,
)
from benchnav.testing.breaches import NOTHING, Breaches, same
from benchnav.testing.distribution import check_functions

_DRAWS = 8  # joint samples of all measurements
_SAMPLING_ERROR = 0.01  # tolerated rise of the mean variance, for `_DRAWS` samples
_AT_TOLERANCE = 0.01  # between λ̂ of `at` and of `distribution`


def check_belief(
    belief: Any,
    shapes: Sequence[tuple[int, int]] = ((10, 10), (8, 13)),
    device: torch.device | str = "cpu",
    tolerance: float = 1e-3,
) -> None:
    """Check that a belief fulfils its contract.

    It receives measurements of λ along a path in three of four episodes. The
    predictions are quantiles, and a mixture of three classes, two of them look-alike.
    A belief that requires a mixture must reject quantiles with a ConfigError that names
    their class.

    The contract:

    - the distribution is a TraversabilityDistribution of shape [B, H, W] on the
      prediction's device, with consistent functions;
    - it equals the prediction, or a new prediction, until λ is measured;
    - three updates change nothing: one without measurements, a repeated measurement
      without noise, and any measurement if the belief does not learn;
    - measurements sampled from the prediction reduce the variance on average;
    - `changed` marks all cells whose belief changed;
    - `at` returns λ̂ of selected cells, within 0.01 of the distribution's;
    - `sample_fields` returns λ in [0, 1] of shape [B, M, H, W]; it depends only on the
      keys, and its marginals are those of the distribution;
    - arguments and global generators are unchanged;
    - results are the same when repeated, after `init` on other maps, and for episodes
      in any order, selected by `select` or replaced by `put`.

    Args:
        belief: a belief, or its name, file or mapping as in suites.
        shapes: (H, W) of the maps.
        device: device of the predictions.
        tolerance: tolerance between probabilities of λ that should be equal.

    Raises:
        ConfigError: If the belief breaks the contract; the message lists all breaches.
    """
    new_belief = registry.take("belief", belief)
    breaches = Breaches("belief", type(new_belief).__name__)
    learns = new_belief.learns
    is_bool = isinstance(learns, bool)
    breaches.expect(is_bool, f"Expected `learns` of type bool, got {learns!r}.")
    breaches.raise_any()
    for index, (height, width) in enumerate(shapes):
        kinds = ("a mixture",) if index else ("a mixture", "quantiles")
        for kind in kinds:
            breaches.location = f"{height}×{width}, {kind}"
            by_quantiles = kind == "quantiles"
            covariance, prior, new_prior = pose(
                height, width, by_quantiles, torch.device(device)
            )
            if by_quantiles and _rejects_by_name(new_belief, prior, covariance):
                continue
            check = _BeliefCheck(
                new_belief, covariance, prior, new_prior, tolerance, breaches
            )
            check.run()
    breaches.raise_any()


@dataclass(frozen=True)
class _BeliefCheck:
    """The check of a belief on one batch."""

    belief: Belief[Any]
    covariance: CovarianceModel
    prior: TraversabilityDistribution
    new_prior: TraversabilityDistribution
    tolerance: float
    breaches: Breaches

    def run(self) -> None:
        """Update step by step, then again in ways that should change nothing."""
        looks = list(measurements(self.prior, self.covariance))
        first = self.begin(self.prior)
        if first is NOTHING or not self.is_sound(first):
            return
        breach = "Expected the initial belief to equal the prediction, got another."
        self.expect_of(first, self.prior, breach)
        state = first
        for sensed in looks:
            before = state
            state = self.update(before, sensed)
            if state is NOTHING or not self.is_sound(state):
                return
            again = self.belief.update(before, sensed)
            self.expect(
                self.alike(again, state, 0),
                "Expected the same result from `update` when called again, got another.",
            )
            self.try_changed(before, state)
        shown = _cdf(self.belief.distribution(state))
        self.begin(self.new_prior)
        again = _cdf(self.belief.distribution(state))
        self.expect(
            same(again, shown),
            "Expected the same belief after `init` on other maps, got another.",
        )
        distribution = self.belief.distribution(state)
        check_functions(distribution, self.tolerance, self.breaches)
        self.try_nothing(first, state)
        self.try_repeated(state, looks[-1])
        self.try_drawn(first, looks)
        self.try_prior(state)
        self.try_at(state)
        self.try_fields(state)
        self.try_members(looks, state)
        self.try_put(state)

    def expect(self, is_fulfilled: bool, breach: str) -> bool:
        """Note a breach unless the expectation is fulfilled."""
        return self.breaches.expect(is_fulfilled, breach)

    def begin(self, prior: TraversabilityDistribution) -> Any:
        """Return the initial state, or `NOTHING`."""
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
        """Return the next state, or `NOTHING`."""
        arguments = {"state": state, "sensed": sensed}
        if prior is not None:
            arguments["prior"] = prior
        return self.breaches.watch(
            "update", lambda: self.belief.update(*arguments.values()), **arguments
        )

    def is_sound(self, state: Any) -> bool:
        """Return whether the distribution of a state can be checked further."""
        belief = self.breaches.watch(
            "distribution", lambda: self.belief.distribution(state), state=state
        )
        if belief is NOTHING:
            return False
        name = type(belief).__name__
        is_distribution = self.expect(
            isinstance(belief, TraversabilityDistribution),
            f"Expected a TraversabilityDistribution from `distribution`, got {name}.",
        )
        if not is_distribution:
            return False
        shape = list(self.prior.shape)
        device = self.prior.device
        got = list(belief.shape)
        is_in_place = got == shape and belief.device == device
        fits = self.expect(
            is_in_place and belief.dtype.is_floating_point,
            f"Expected a distribution of shape {shape} on {device}, got one of "
            f"shape {got} in {belief.dtype} on {belief.device}.",
        )
        if not fits:
            return False
        probabilities = _cdf(belief)
        in_range = (probabilities >= 0) & (probabilities <= 1)
        return self.expect(
            bool(in_range.all()),
            "Expected probabilities of the belief in [0, 1], got others.",
        )

    def alike(
        self, first: Any, second: Any, tolerance: float, members: Tensor | None = None
    ) -> bool:
        """Return whether two states have equal distributions.

        Args:
            first: a state.
            second: a state.
            tolerance: tolerance between probabilities.
            members: indices of episodes of the second state; if None, all.
        """
        a = _cdf(self.belief.distribution(first))
        b = _cdf(self.belief.distribution(second))
        if members is not None:
            b = b[:, members]
        return same(a, b, tolerance)

    def expect_of(
        self, state: Any, prior: TraversabilityDistribution, breach: str, first: int = 0
    ) -> None:
        """Expect a state to equal a prediction, in the episodes from an index on."""
        distribution = self.belief.distribution(state)
        probabilities = _cdf(distribution)[:, first:]
        expected = _cdf(prior)[:, first:]
        is_same = same(probabilities, expected, self.tolerance)
        self.expect(is_same, breach)

    def try_changed(self, before: Any, after: Any, has_measured: bool = True) -> None:
        """Expect `changed` to mark the cells whose belief changed."""
        changed = partial(self.belief.changed, before, after)
        marked = self.breaches.watch("changed", changed, before=before, after=after)
        shape = tuple(self.prior.shape)
        is_bool = isinstance(marked, Tensor) and marked.dtype == torch.bool
        is_map = is_bool and tuple(marked.shape) == shape
        breach = f"Expected a bool map of shape {list(shape)} from `changed`."
        if marked is NOTHING or not self.expect(is_map, breach):
            return
        old = _cdf(self.belief.distribution(before))
        new = _cdf(self.belief.distribution(after))
        is_changed = ((old - new).abs() > self.tolerance).any(0)
        is_missed = is_changed & ~marked
        self.expect(
            not bool(is_missed.any()),
            "Expected `changed` to mark all cells whose belief changed, got some "
            "left out.",
        )
        if has_measured and not self.belief.learns:
            self.expect(
                not bool(is_changed.any()),
                "Expected measurements to change nothing in a belief that does not "
                "learn (`learns`), got a change.",
            )

    def try_nothing(self, first: Any, last: Any) -> None:
        """Expect an update without measurements to change nothing."""
        nothing = no_measurement(self.prior)
        for state in (first, last):
            after = self.update(state, nothing)
            is_same = after is NOTHING or self.alike(after, state, self.tolerance)
            self.expect(
                is_same,
                "Expected an update without measurements to change nothing, got a change.",
            )
        breach = (
            "Expected the prediction of an episode in which nothing was sensed, "
            "got another."
        )
        self.expect_of(last, self.prior, breach, UNOBSERVED)

    def try_repeated(self, last: Any, sensed: Measurement) -> None:
        """Expect λ that is measured again without noise to change nothing."""
        std = torch.full_like(sensed.traversability, MIN_STD)
        exact = replace(sensed, std=std)
        once = self.update(last, exact)
        if once is NOTHING:
            return
        twice = self.update(once, exact)
        if twice is not NOTHING and self.is_sound(twice):
            self.expect(
                self.alike(twice, once, self.tolerance),
                "Expected λ that is sensed again without noise to change nothing, "
                "got a change.",
            )

    def try_drawn(self, first: Any, looks: Sequence[Measurement]) -> None:
        """Expect measurements sampled from the prediction to reduce the variance.

        With p = P(λ ≤ value), the variance of the event is p (1 − p). A single update
        may increase it, but its mean over possible measurements cannot rise (law of
        total variance).
        """
        if not self.belief.learns:
            return
        masks = torch.stack([sensed.mask for sensed in looks])
        observed = masks.any(0)
        scores = draw_scores(self.covariance, _DRAWS, KEYS)
        scores = scores.to(self.prior.device, self.prior.dtype)
        prior = _cdf(self.prior)
        variances = []
        for index in range(_DRAWS):
            field = self.prior.from_normal(scores[:, index])
            values = torch.where(observed, field, torch.nan)
            sensed = measure(values, self.prior)
            state = self.update(first, sensed)
            if state is NOTHING or not self.is_sound(state):
                return
            posterior = _cdf(self.belief.distribution(state))
            variances.append(posterior * (1 - posterior))
        mean_variance = torch.stack(variances).mean(0)
        rise = mean_variance - prior * (1 - prior)
        mean_rise = float(rise[:, ~observed].mean())
        self.expect(
            mean_rise <= _SAMPLING_ERROR,
            "Expected measurements sampled from the prediction to reduce the "
            "variance on average, got a rise.",
        )

    def try_prior(self, last: Any) -> None:
        """Expect a new prediction to replace the old one."""
        after = self.update(last, no_measurement(self.prior), self.new_prior)
        if after is NOTHING or not self.is_sound(after):
            return
        breach = (
            "Expected a new prediction to replace the old one where nothing was "
            "sensed, got another."
        )
        self.expect_of(after, self.new_prior, breach, UNOBSERVED)
        self.try_changed(last, after, has_measured=False)

    def try_at(self, state: Any) -> None:
        """Expect `at` to agree with the distribution in selected cells."""
        cells = torch.zeros(
            self.prior.shape, dtype=torch.bool, device=self.prior.device
        )
        cells[0, ::2] = True
        cells[2, 1] = True
        cells[UNOBSERVED, :, 3] = True
        selected = self.breaches.watch(
            "at", lambda: self.belief.at(state, cells), state=state, cells=cells
        )
        if selected is NOTHING:
            return
        shape = [1, int(cells.sum())]
        got: Any = type(selected).__name__
        if isinstance(selected, TraversabilityDistribution):
            got = list(selected.shape)
        breach = f"Expected a distribution of shape {shape} from `at`, got {got}."
        if not self.expect(got == shape, breach):
            return
        belief = self.belief.distribution(state)
        mean = belief.mean()[cells][None]
        cvar = belief.cvar(0.8)[cells][None]
        has_mean = same(selected.mean(), mean, _AT_TOLERANCE)
        has_cvar = same(selected.cvar(0.8), cvar, _AT_TOLERANCE)
        self.expect(
            has_mean and has_cvar,
            f"Expected mean and CVaR of `at` within {_AT_TOLERANCE} of the "
            "distribution's, got others.",
        )

    def try_fields(self, state: Any) -> None:
        """Expect valid joint samples of the whole batch and of selected episodes."""
        members = torch.tensor([2, 0], device=self.prior.device)
        selected = self.select(state, members)
        check_fields(self.belief, state, selected, self.tolerance, self.breaches)

    def try_members(self, looks: Sequence[Measurement], last: Any) -> None:
        """Expect equal beliefs for episodes in another batch, order or selection."""
        for indices in ([3], [1], [2, 0]):
            members = torch.tensor(indices, device=self.prior.device)
            separate = self.begin(self.prior.select(members))
            selected = self.begin(self.prior)
            for step, sensed in enumerate(looks):
                if step == 1:
                    selected = self.select(selected, members)
                if separate is NOTHING or selected is NOTHING:
                    return
                of_members = sensed.select(members)
                separate = self.update(separate, of_members)
                selected = self.update(selected, of_members if step else sensed)
            if separate is NOTHING or selected is NOTHING:
                return
            self.expect(
                self.alike(separate, last, self.tolerance, members),
                "Expected the same results for single episodes and in another order as "
                "in the batch, got others.",
            )
            self.expect(
                self.alike(selected, last, self.tolerance, members),
                "Expected the same beliefs for episodes that `select` keeps as in the "
                "batch, got others.",
            )

    def try_put(self, state: Any) -> None:
        """Expect episodes that replace others by `put` to be unchanged."""
        replaced = torch.tensor([1, UNOBSERVED], device=self.prior.device)
        members = torch.tensor([2, 0], device=self.prior.device)
        others = self.select(state, members)
        if others is NOTHING:
            return
        put = partial(self.belief.put, state, replaced, others)
        combined = self.breaches.watch("put", put, state=state, others=others)
        order = torch.tensor([0, 2, 2, 0], device=self.prior.device)
        if combined is not NOTHING and self.is_sound(combined):
            self.expect(
                self.alike(combined, state, self.tolerance, order),
                "Expected episodes that `put` inserts to be unchanged, got others.",
            )

    def select(self, state: Any, members: Tensor) -> Any:
        """Return the state of selected episodes, or `NOTHING`."""
        if state is NOTHING:
            return NOTHING
        selected = self.breaches.watch(
            "select", lambda: self.belief.select(state, members), state=state
        )
        if selected is NOTHING:
            return NOTHING
        shape = [len(members), *self.prior.shape[1:]]
        got = list(self.belief.distribution(selected).shape)
        breach = (
            f"Expected a distribution of shape {shape} of episodes that `select` "
            f"keeps, got {got}."
        )
        return selected if self.expect(got == shape, breach) else NOTHING


def _cdf(distribution: TraversabilityDistribution) -> Tensor:
    """Return P(λ ≤ value) for several values, shape [V, B, H, W]."""
    probabilities = [distribution.cdf(value).double() for value in VALUES]
    return torch.stack(probabilities)


def _rejects_by_name(
    belief: Belief[Any], prior: TraversabilityDistribution, covariance: CovarianceModel
) -> bool:
    try:
        belief.init(prior, covariance)
    except ConfigError as error:
        return type(prior).__name__ in str(error)
    except Exception:
        return False  # noted by `_BeliefCheck`
    return False
