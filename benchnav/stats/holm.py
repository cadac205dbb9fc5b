"""Correction of p-values for multiple tests, and the level of significance, `ALPHA`."""

import numpy as np

ALPHA = 0.05


def holm(p: np.ndarray) -> np.ndarray:
    """Correct p-values for multiple tests.

    statsmodels' `multipletests` returns the same values, but runs the garbage collector
    at each call, which takes longer than the tests.
    Source: Holm (1979), "A simple sequentially rejective multiple test procedure".

    Args:
        p: p-values, shape [N].

    Returns:
        Corrected p-values, at most 1, shape [N].
    """
    order = np.argsort(p)
    factors = np.arange(len(p), 0, -1)
    scaled = p[order] * factors
    corrected = np.maximum.accumulate(scaled).clip(max=1)
    original_order = np.argsort(order)
    return corrected[original_order]
