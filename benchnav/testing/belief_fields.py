"""The check of joint samples of a belief.

Letters in shapes: B episodes; H×W cells; M joint samples.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from benchnav.planning.sensing.belief import Belief
from benchnav.testing.belief_inputs import KEYS
from benchnav.testing.breaches import NOTHING, Breaches, same

VALUES = (0.0, 0.1, 0.4, 0.8)
"""Values of λ at which CDFs are compared."""
_OTHER_KEYS = (65, 35, 89, 79)
_FIELDS = 200
_MAX_ERRORS = 6  # tolerance of frequencies in standard errors


def check_fields(
    belief: Belief[Any], state: Any, selected: Any, tolerance: float, breaches: Breaches
) -> None:
    """Check that joint samples depend only on keys, and have the belief's marginals.

    Args:
        belief: the belief.
        state: belief state of four episodes.
        selected: belief state of episodes 2 and 0, or `NOTHING`.
        tolerance: tolerance between λ of fields that should be equal.
        breaches: collection of breaches.
    """
    expect = breaches.expect

    def draw(state: Any, count: int, keys: Sequence[int]) -> Any:
        return breaches.watch(
            "sample_fields",
            lambda: belief.sample_fields(state, count, keys),
            state=state,
        )

    distribution = belief.distribution(state)
    fields = draw(state, _FIELDS, KEYS)
    shape = [len(KEYS), _FIELDS, *distribution.shape[1:]]
    got: Any = type(fields).__name__
    if isinstance(fields, Tensor):
        got = list(fields.shape)
    breach = f"Expected fields of shape {shape}, got {got}."
    if fields is NOTHING or not expect(got == shape, breach):
        return
    in_range = (fields >= 0) & (fields <= 1)
    expect(
        bool(in_range.all()), "Expected fields of λ in [0, 1], got values outside it."
    )
    two_fields = draw(state, 2, KEYS)
    fields_of_other_keys = draw(state, 2, _OTHER_KEYS)
    expect(
        same(draw(state, 2, KEYS), two_fields),
        "Expected the same fields from the same keys, got different fields.",
    )
    is_different = fields_of_other_keys is NOTHING or not any(
        map(same, two_fields, fields_of_other_keys)
    )
    expect(
        is_different,
        "Expected different fields from different keys, got equal fields.",
    )
    if selected is not NOTHING:
        selected_fields = draw(selected, 2, [KEYS[2], KEYS[0]])
        members = torch.tensor([2, 0], device=fields.device)
        expected = two_fields[members]
        is_same = selected_fields is NOTHING or same(
            selected_fields, expected, tolerance
        )
        expect(
            is_same,
            "Expected an episode's fields to depend only on its state and key, got "
            "different fields after `select`.",
        )
    for value in VALUES[1:]:
        probability = distribution.cdf(value).double()
        error = (probability * (1 - probability) / _FIELDS).sqrt()
        frequency = (fields <= value).double().mean(1)
        deviation = (frequency - probability).abs()
        is_close = deviation <= _MAX_ERRORS * error + 0.03
        expect(
            bool(is_close.all()),
            "Expected the λ of each cell, taken over all fields, to follow the "
            "belief's distribution, got other frequencies.",
        )
