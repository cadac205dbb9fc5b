"""Recipes, weights and predictions are those of version 1.3, bit for bit."""

import json

import pytest

from tests.golden import values
from tests.golden.rows import machine

STORED = json.loads(values.STORED.read_text())


@pytest.mark.parametrize(
    ("kind", "compute"),
    [
        ("recipes", values.recipe_digests),
        ("weights", values.weight_digests),
        ("predictions", values.prediction_digests),
    ],
)
def test_digests_stay(kind: str, compute: object) -> None:
    if kind == "predictions" and STORED["machine"] != machine():
        pytest.skip(f"predictions were frozen on {STORED['machine']}, this is {machine()}")
    assert compute() == STORED[kind]  # type: ignore[operator]
