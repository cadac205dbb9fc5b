"""The table of a comparison by one metric: a row a pair of conditions, corrected over all rows together."""

from collections.abc import Sequence

import pandas as pd

from benchnav.core.quantity import Quantity
from benchnav.eval.stats.hypotheses import comparable, describe_pair
from benchnav.eval.stats.pairs import Pair
from benchnav.stats.episodes import difference_p
from benchnav.stats.holm import holm


def compare_by(pairs: Sequence[Pair], quantity: Quantity) -> pd.DataFrame:
    """Compares each pair map by map over the episodes in which both conditions have a value.

    Args:
        pairs: from `pairs.find_pairs`.
        quantity: what is compared.

    Returns:
        A row a pair: labels of the two, `one`, `other`; `metric`, `unit` of all that follows; `n_maps`, `n_groups`,
        `n_episodes` of each condition; `mean_one`, `mean_other`, `difference` with its 95 % interval `low`, `high`; `p`
        of a test by flipping signs and, corrected, `p_holm`. A difference and its ends are NaN without episodes.
    """
    rows = []
    for pair in pairs:
        one, other = pair.members
        episodes = comparable(one.episodes, other.episodes, quantity)
        about = describe_pair(quantity, episodes)
        rows.append(
            {
                **pair.shared,
                "one": pair.one,
                "other": pair.other,
                "metric": quantity.name,
                "unit": about["unit"],
                "n_maps": episodes["map"].nunique(),
                "n_groups": about["n_maps"],
                "n_episodes": about["n_episodes"],
                **{name: about[name] for name in ("mean_one", "mean_other", "difference", "low", "high")},
                "p": difference_p(episodes, quantity.column),
            }
        )
    table = pd.DataFrame(rows)
    return table.assign(p_holm=holm(table["p"].to_numpy()))
