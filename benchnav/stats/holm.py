"""Correction of p-values for their number, and the level of significance."""

import numpy as np

ALPHA = 0.05


def holm(p: np.ndarray) -> np.ndarray:
    """Correct p-values for their number.

    statsmodels' `multipletests` returns the same, but collects garbage at each call,
    which takes longer than the tests.
    Source: Holm (1979), "A simple sequentially rejective multiple test procedure".

    Args:
        p: shape [N].

    Returns:
        Shape [N], at most 1.
    """
    order = np.argsort(p)
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)).clip(max=1)
    return stepped[np.argsort(order)]
