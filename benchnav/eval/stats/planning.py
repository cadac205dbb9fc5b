"""How long trials took to plan."""

import pandas as pd


def planning_times(episodes: pd.DataFrame) -> pd.DataFrame:
    """Gives the 95th percentile of planning time beside the median that the summary has.

    Args:
        episodes: rows of episodes; `planning_ms` is a mean over the steps of a unit.

    Returns:
        A row a trial: `trial`, `planning_ms_p95`, over episodes.
    """
    late = episodes.groupby("trial", sort=False)["planning_ms"].quantile(0.95)
    return late.rename("planning_ms_p95").reset_index()
