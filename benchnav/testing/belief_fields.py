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

VALUES = (0.0, 0.1, 0.4, 0.8)  # of λ, at which distributions are compared
_OTHER_KEYS = (65, 35, 89, 79)
_FIELDS = 200
_MAX_ERRORS = 6  # tolerated standard errors


def check_fields(
    belief: Belief[Any], state: Any, selected: Any, tolerance: float, breaches: Breaches
) -> None:
    """Expect joint samples to depend on keys, and to have the right marginals.

    Args:
        belief: the belief.
        state: state of four episodes.
        selected: state of the episodes 2 and 0, or `NOTHING`.
        tolerance: tolerance between fields that should be equal.
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
    expect(bool(in_range.all()), "Expected fields of λ in [0, 1], got others.")
    fewer = draw(state, 2, KEYS)
    others = draw(state, 2, _OTHER_KEYS)
    expect(
        same(draw(state, 2, KEYS), fewer),
        "Expected the same fields when called again, got others.",
    )
    differ = others is NOTHING or not any(map(same, fewer, others))
    expect(
        differ,
        "Expected other fields under other keys, got the same.",
    )
    if selected is not NOTHING:
        of_selected = draw(selected, 2, [KEYS[2], KEYS[0]])
        members = torch.tensor([2, 0], device=fields.device)
        expected = fewer[members]
        is_same = of_selected is NOTHING or same(of_selected, expected, tolerance)
        expect(
            is_same,
            "Expected an episode's fields to depend only on its key, got others.",
        )
    for value in VALUES[1:]:
        probability = distribution.cdf(value).double()
        error = (probability * (1 - probability) / _FIELDS).sqrt()
        frequency = (fields <= value).double().mean(1)
        deviation = (frequency - probability).abs()
        is_close = deviation <= _MAX_ERRORS * error + 0.03
        expect(
            bool(is_close.all()),
            "Expected fields whose cells have the belief's distribution, got others.",
        )
