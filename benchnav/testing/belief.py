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
    create_predictions,
    measure,
    measurements,
    no_measurement,
)
from benchnav.testing.breaches import NOTHING, Breaches, same
from benchnav.testing.distribution import check_functions

_DRAWS = 8  # number of joint samples of all measurements
_SAMPLING_ERROR = 0.01  # tolerance of the rise of the mean variance over the samples
_AT_TOLERANCE = 0.01  # tolerance between λ̂ of `at` and λ̂ of `distribution`


def check_belief(
    belief: Any,
    shapes: Sequence[tuple[int, int]] = ((10, 10), (8, 13)),
    device: torch.device | str = "cpu",
    tolerance: float = 1e-3,
) -> None:
    """Check that a belief fulfils its contract.

    The belief receives measurements of λ along a path, in three of four episodes. The
    predictions are a mixture of three classes, two of which are look-alike, and
    quantiles. A belief that requires a mixture must reject quantiles with a ConfigError
    that names their Python class.

    The contract:

    - the distribution is a TraversabilityDistribution of shape [B, H, W] on the
      prediction's device, with consistent functions;
    - the distribution equals the last prediction until λ is measured;
    - three updates do not change it: an update without measurements, a repeated
      measurement without noise, and any measurement if the belief does not learn;
    - measurements sampled from the prediction reduce the variance on average;
    - `changed` returns a mask that includes all cells whose belief changed;
    - mean and CVaR of `at` differ from those of the distribution by at most 0.01;
    - `sample_fields` returns λ in [0, 1] of shape [B, M, H, W]; the fields depend only
      on state and keys, and their marginals are those of the distribution;
    - arguments and global generators are unchanged;
    - results are the same when repeated, after `init` on other maps, and for episodes
      in any order, selected by `select` or replaced by `put`.

    Args:
        belief: a belief, or its name, file or mapping as in suites.
        shapes: (H, W) of the maps.
        device: device of the predictions.
        tolerance: tolerance between probabilities that should be equal.

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
            covariance, prior, new_prior = create_predictions(
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
        """Update step by step, then in ways that should have equal results."""
        measured = list(measurements(self.prior, self.covariance))
        first = self.init(self.prior)
        if first is NOTHING or not self.check_state(first):
            return
        breach = "Expected the initial belief to equal the prediction, got differences."
        self.expect_prediction(first, self.prior, breach)
        state = first
        for sensed in measured:
            before = state
            state = self.update(before, sensed)
            if state is NOTHING or not self.check_state(state):
                return
            repeated = self.belief.update(before, sensed)
            self.expect(
                self.are_equal(repeated, state, 0),
                "Expected the same result from `update` when called again, got changes.",
            )
            self.try_changed(before, state)
        cdf_before = _cdf(self.belief.distribution(state))
        self.init(self.new_prior)
        repeated = _cdf(self.belief.distribution(state))
        self.expect(
            same(repeated, cdf_before),
            "Expected the same belief after `init` on other maps, got a different "
            "belief. Keep changing values in the state, not on the belief.",
        )
        distribution = self.belief.distribution(state)
        check_functions(distribution, self.tolerance, self.breaches)
        self.try_nothing(first, state)
        self.try_repeated(state, measured[-1])
        self.try_sampled(first, measured)
        self.try_prior(state)
        self.try_at(state)
        self.try_fields(state)
        self.try_members(measured, state)
        self.try_put(state)

    def expect(self, is_fulfilled: bool, breach: str) -> bool:
        """Note a breach unless the expectation is fulfilled."""
        return self.breaches.expect(is_fulfilled, breach)

    def init(self, prior: TraversabilityDistribution) -> Any:
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
        """Return the updated state, or `NOTHING`."""
        arguments = {"state": state, "sensed": sensed}
        if prior is not None:
            arguments["prior"] = prior
        return self.breaches.watch(
            "update", lambda: self.belief.update(*arguments.values()), **arguments
        )

    def check_state(self, state: Any) -> bool:
        """Note faults of a state's distribution; return whether it is valid."""
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
        has_shape_and_device = got == shape and belief.device == device
        fits = self.expect(
            has_shape_and_device and belief.dtype.is_floating_point,
            f"Expected a distribution of shape {shape} on {device}, got one of "
            f"shape {got} in {belief.dtype} on {belief.device}.",
        )
        if not fits:
            return False
        probabilities = _cdf(belief)
        in_range = (probabilities >= 0) & (probabilities <= 1)
        return self.expect(
            bool(in_range.all()),
            "Expected probabilities of the belief in [0, 1], got values outside it.",
        )

    def are_equal(
        self, first: Any, second: Any, tolerance: float, members: Tensor | None = None
    ) -> bool:
        """Return whether two states have equal distributions.

        Args:
            first: a state.
            second: another state.
            tolerance: tolerance between probabilities.
            members: indices of the episodes of the second state that the first state
                contains; if None, all episodes in order.
        """
        a = _cdf(self.belief.distribution(first))
        b = _cdf(self.belief.distribution(second))
        if members is not None:
            b = b[:, members]
        return same(a, b, tolerance)

    def expect_prediction(
        self, state: Any, prior: TraversabilityDistribution, breach: str, first: int = 0
    ) -> None:
        """Check that the belief equals a prediction in the episodes `first` and later."""
        distribution = self.belief.distribution(state)
        probabilities = _cdf(distribution)[:, first:]
        expected = _cdf(prior)[:, first:]
        is_same = same(probabilities, expected, self.tolerance)
        self.expect(is_same, breach)

    def try_changed(self, before: Any, after: Any, has_measured: bool = True) -> None:
        """Check that `changed` includes the cells whose belief changed."""
        mark = partial(self.belief.changed, before, after)
        changed = self.breaches.watch("changed", mark, before=before, after=after)
        shape = tuple(self.prior.shape)
        is_bool = isinstance(changed, Tensor) and changed.dtype == torch.bool
        is_map = is_bool and tuple(changed.shape) == shape
        breach = f"Expected a bool map of shape {list(shape)} from `changed`."
        if changed is NOTHING or not self.expect(is_map, breach):
            return
        old = _cdf(self.belief.distribution(before))
        new = _cdf(self.belief.distribution(after))
        is_changed = ((old - new).abs() > self.tolerance).any(0)
        is_missed = is_changed & ~changed
        self.expect(
            not bool(is_missed.any()),
            "Expected `changed` to mark all cells whose belief changed, got omissions.",
        )
        if has_measured and not self.belief.learns:
            self.expect(
                not bool(is_changed.any()),
                "Expected measurements to change nothing in a belief that does not "
                "learn (`learns`), got a change.",
            )

    def try_nothing(self, first: Any, last: Any) -> None:
        """Check that an update without measurements changes nothing."""
        nothing = no_measurement(self.prior)
        for state in (first, last):
            after = self.update(state, nothing)
            is_same = after is NOTHING or self.are_equal(after, state, self.tolerance)
            self.expect(
                is_same,
                "Expected an update without measurements to change nothing, got a change.",
            )
        breach = (
            "Expected the belief of an episode without measurements to equal the "
            "prediction, got differences."
        )
        self.expect_prediction(last, self.prior, breach, UNOBSERVED)

    def try_repeated(self, last: Any, sensed: Measurement) -> None:
        """Check that a repeated measurement without noise changes nothing."""
        std = torch.full_like(sensed.traversability, MIN_STD)
        exact = replace(sensed, std=std)
        once = self.update(last, exact)
        if once is NOTHING:
            return
        twice = self.update(once, exact)
        if twice is not NOTHING and self.check_state(twice):
            self.expect(
                self.are_equal(twice, once, self.tolerance),
                "Expected a repeated measurement without noise to change nothing, got a "
                "change.",
            )

    def try_sampled(self, first: Any, measured: Sequence[Measurement]) -> None:
        """Check that measurements sampled from the prediction reduce the variance.

        With p = P(λ ≤ value), the variance of the event λ ≤ value is p (1 − p). A
        single update may increase it, but its mean over possible measurements cannot
        rise (law of total variance).
        """
        if not self.belief.learns:
            return
        masks = torch.stack([sensed.mask for sensed in measured])
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
            if state is NOTHING or not self.check_state(state):
                return
            posterior = _cdf(self.belief.distribution(state))
            variances.append(posterior * (1 - posterior))
        mean_variance = torch.stack(variances).mean(0)
        rise = mean_variance - prior * (1 - prior)
        mean_rise = float(rise[:, ~observed].mean())
        self.expect(
            mean_rise <= _SAMPLING_ERROR,
            "Expected measurements sampled from the prediction to reduce the variance "
            "of λ ≤ value on average, got an increase.",
        )

    def try_prior(self, last: Any) -> None:
        """Check that a new prediction replaces the old one."""
        after = self.update(last, no_measurement(self.prior), self.new_prior)
        if after is NOTHING or not self.check_state(after):
            return
        breach = (
            "Expected a new prediction to replace the old one in an episode without "
            "measurements, got differences."
        )
        self.expect_prediction(after, self.new_prior, breach, UNOBSERVED)
        self.try_changed(last, after, has_measured=False)

    def try_at(self, state: Any) -> None:
        """Check that `at` agrees with the distribution in selected cells."""
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
        breach = f"Expected `at` to return a distribution of shape {shape}, got {got}."
        if not self.expect(got == shape, breach):
            return
        belief = self.belief.distribution(state)
        mean = belief.mean()[cells][None]
        cvar = belief.cvar(0.8)[cells][None]
        has_mean = same(selected.mean(), mean, _AT_TOLERANCE)
        has_cvar = same(selected.cvar(0.8), cvar, _AT_TOLERANCE)
        self.expect(
            has_mean and has_cvar,
            f"Expected mean and CVaR of `at` to differ by at most {_AT_TOLERANCE} from "
            "those of `distribution`, got larger differences.",
        )

    def try_fields(self, state: Any) -> None:
        """Check joint samples of the whole batch and of selected episodes."""
        members = torch.tensor([2, 0], device=self.prior.device)
        selected = self.select(state, members)
        check_fields(self.belief, state, selected, self.tolerance, self.breaches)

    def try_members(self, measured: Sequence[Measurement], last: Any) -> None:
        """Check that beliefs of episodes do not depend on the batch or its order."""
        for indices in ([3], [1], [2, 0]):
            members = torch.tensor(indices, device=self.prior.device)
            separate = self.init(self.prior.select(members))
            selected = self.init(self.prior)
            for step, sensed in enumerate(measured):
                if step == 1:
                    selected = self.select(selected, members)
                if separate is NOTHING or selected is NOTHING:
                    return
                sensed_part = sensed.select(members)
                separate = self.update(separate, sensed_part)
                selected = self.update(selected, sensed_part if step else sensed)
            if separate is NOTHING or selected is NOTHING:
                return
            self.expect(
                self.are_equal(separate, last, self.tolerance, members),
                "Expected results of an episode that do not depend on the other "
                "episodes of the batch or on their order, got different results.",
            )
            self.expect(
                self.are_equal(selected, last, self.tolerance, members),
                "Expected `select` to return episodes with unchanged beliefs, got "
                "different beliefs.",
            )

    def try_put(self, state: Any) -> None:
        """Check that `put` inserts episodes unchanged."""
        replaced_episodes = torch.tensor([1, UNOBSERVED], device=self.prior.device)
        members = torch.tensor([2, 0], device=self.prior.device)
        others = self.select(state, members)
        if others is NOTHING:
            return
        put_others = partial(self.belief.put, state, replaced_episodes, others)
        combined = self.breaches.watch("put", put_others, state=state, others=others)
        order = torch.tensor([0, 2, 2, 0], device=self.prior.device)
        if combined is not NOTHING and self.check_state(combined):
            self.expect(
                self.are_equal(combined, state, self.tolerance, order),
                "Expected `put` to insert episodes unchanged and to leave the others "
                "unchanged, got different beliefs.",
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
            f"Expected a distribution of shape {shape} for episodes that `select` "
            f"returns, got {got}."
        )
        return selected if self.expect(got == shape, breach) else NOTHING


def _cdf(distribution: TraversabilityDistribution) -> Tensor:
    """Return P(λ ≤ value) for the V values of `VALUES`, shape [V, B, H, W]."""
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
        return False  # `_BeliefCheck` notes it
    return False
