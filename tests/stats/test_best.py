from itertools import combinations, permutations

import numpy as np
import pytest

from benchnav.stats import best
from benchnav.stats.best import best_set_p
from benchnav.stats.bootstrap import bootstrap_counts

SAMPLES = 200  # of those that are drawn, in the test by hand


def by_hand(wins: np.ndarray, size: np.ndarray) -> np.ndarray:
    """p of the stepwise bootstrap-t as its sources say it: every sample, every pair,
    every subset of conditions.
    """
    added = (size**2).mean() ** 0.5
    wins, size = wins[:, order := np.argsort(-wins.sum(0), kind="stable")], size
    rows = np.lexsort(np.column_stack([wins, size]).T)
    wins, size = wins[rows], size[rows]

    def t_of(maps: np.ndarray, i: int, j: int, truth: float = 0.0) -> float:
        """Of a sample of maps, those from M on pseudo-maps; to it four pseudo-maps are
        added.
        """
        gains = np.concatenate(
            [wins[:, i] - wins[:, j], np.array([1, 1, -1, -1]) * added]
        )
        sizes = np.concatenate([size, np.full(4, added)])
        more = np.concatenate([maps, len(size) + np.arange(4)])
        centre = gains[more].sum() / sizes[more].sum()
        error = ((gains[more] - centre * sizes[more]) ** 2).sum() ** 0.5 / sizes[
            more
        ].sum()
        return (gains[maps].sum() / sizes[maps].sum() - truth) / error

    whole = np.arange(len(size))
    samples = [
        np.repeat(np.arange(len(size) + 4), row.astype(int))
        for row in bootstrap_counts(len(size), 4)[:SAMPLES]
    ]
    left: list[int] = list(range(wins.shape[1]))
    removed, seen = [], []
    while len(left) > 1:
        t, worst = max(
            (round(t_of(whole, i, j), 9), -j) for i, j in permutations(left, 2)
        )
        removed.append(-worst)
        seen.append(t)
        left.remove(-worst)
    removed += left
    p, least = np.ones(wins.shape[1]), 0.0
    for step, t in enumerate(seen):
        pairs = list(combinations(removed[step:], 2))
        truth = [
            (wins[:, i] - wins[:, j]).sum() / (size.sum() + 4 * added) for i, j in pairs
        ]
        far = [
            max(
                abs(t_of(sample, *pair, one))
                for pair, one in zip(pairs, truth, strict=True)
            )
            for sample in samples
        ]
        least = max(least, (1 + np.sum(np.array(far) >= t - 1e-6)) / (1 + SAMPLES))
        p[removed[step]] = least
    return p[np.argsort(order)]


@pytest.mark.parametrize(
    ("seed", "draws"), [(0, [3] * 9), (1, [1] * 9), (2, [1, 1, 2, 2, 3, 3, 4, 5, 6])]
)
def test_best_set_is_the_stepwise_bootstrap_t_by_hand(
    seed: int, draws: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    generator, size = np.random.default_rng(seed), np.array(draws)
    wins = generator.binomial(size[:, None], [0.95, 0.8, 0.7, 0.1], (9, 4))
    few = bootstrap_counts(9, 4)[:SAMPLES]
    monkeypatch.setattr(best, "bootstrap_counts", lambda maps, added: few)
    p, shown = best_set_p(wins, size)
    np.testing.assert_allclose(p, by_hand(wins, size))
    assert p[wins.sum(0).argmax()] == 1
    assert p.min() < 0.2
    assert np.all(shown[wins.sum(0) < wins.sum(0).max()] < 1)


def test_blocks_of_samples_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    wins = np.random.default_rng(0).binomial(3, 0.8, (12, 5))
    expected = best_set_p(wins, 3)
    monkeypatch.setattr(best, "_CHUNK_SIZE", 700)
    np.testing.assert_array_equal(best_set_p(wins, 3), expected)
