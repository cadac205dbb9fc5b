"""The five hypotheses of the study of physics, and their tests.

They were fixed before any episode on the maps of the study was run. All are about the
world of rigid bodies with ruts, and pool both scenarios: a unit is a map of either, with
its two draws of λ.

1. With A*+DWA, CVaR₀.₉₅ reaches the goal more often than the mean.
2. CVaR₀.₉₅ reaches it more often than driving straight.
3. Under CVaR₀.₉₅, planning with the footprint reaches it more often than planning for a
   point.
4. Of the pairs of planned settings that differ significantly with bodies and ruts, more
   than half have the same sign in the kinematic world of earlier studies.
5. The same holds for tracks.

Differences are tested by exact sign flips per map, two-sided, and are equivalent to 0 by
two one-sided tests at 5 points. Fractions of signs are tested by a bootstrap over maps.
Holm's correction covers the five.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.errors import expect
from benchnav.eval.folder.results import read_table
from benchnav.eval.folder.run_folder import EPISODES
from benchnav.stats.between import same_sign
from benchnav.stats.flips import sign_flip_p
from benchnav.stats.holm import holm
from benchnav.stats.intervals import success_interval
from benchnav.stats.margins import margin_p
from studies.study import Rows, Work

WORLDS = ("kinematic", "kinematic, observed", "tracks", "bodies", "bodies with ruts")
"""Short names of the worlds; the last is that of the hypotheses."""
PLANNED = ("mean", "expected-time", "cvar:0.8", "cvar:0.95")
STRAIGHT = "straight"
POINT = "cvar:0.95, for a point"
CONTRASTS = {
    "CVaR₀.₉₅ − mean": ("cvar:0.95", "mean"),
    "CVaR₀.₉₅ − straight": ("cvar:0.95", STRAIGHT),
    "with the footprint − for a point": ("cvar:0.95", POINT),
}
MARGIN = 0.05

Interval = tuple[float, float, float]


def primaries(
    work: Work, folder: Path, run: str = "physics-primary", maps: int = 0
) -> dict[str, Rows]:
    """Return the tests of the hypotheses, and the contrasts in all worlds.

    Args:
        work: folders of the study.
        folder: folder of the part; not used.
        run: name of the finished run.
        maps: number of maps of each scenario, from the first; 0 for all.
    """
    episodes = read_table(work.out / run, EPISODES)
    if maps:
        episodes = episodes[episodes["map"] < maps]
    return tables(episodes)


def tables(episodes: pd.DataFrame) -> dict[str, Rows]:
    """Return the tables of a run's episodes; see `primaries`."""
    wins, n_episodes = wins_of(episodes)
    contrasts = []
    for name, sides in CONTRASTS.items():
        for world in WORLDS:
            row = _contrast(wins[world], n_episodes, sides)
            contrasts.append({"contrast": name, "world": world, **row})
    physics = wins[WORLDS[-1]]
    tests: Rows = []
    for row in contrasts:
        if row["world"] == WORLDS[-1]:
            tests.append({"hypothesis": row["contrast"], **row})
    planned = np.stack([physics[setting] for setting in PLANNED])
    for world in ("kinematic", "tracks"):
        other = np.stack([wins[world][setting] for setting in PLANNED])
        signs = same_sign(np.stack((planned, other)), n_episodes)
        tests.append(
            {
                "hypothesis": f"same sign in {world}, of {signs.pairs} pairs",
                "value": signs.fraction,
                "low": signs.low,
                "high": np.nan,
                "p": signs.p,
            }
        )
    corrected = holm(np.array([row["p"] for row in tests]))
    shown = ("hypothesis", "value", "low", "high", "p", "p of equivalence")
    rows = []
    for row, p_holm in zip(tests, corrected, strict=True):
        entry = {name: row.get(name, np.nan) for name in shown}
        rows.append(entry | {"p by Holm": float(p_holm)})
    return {"primaries": rows, "contrasts": contrasts}


def wins_of(
    episodes: pd.DataFrame,
) -> tuple[dict[str, dict[str, np.ndarray]], np.ndarray]:
    """Return numbers of successes by world and setting, and numbers of episodes.

    Returns:
        Successes on each map of both scenarios, shape [M]; and the number of draws of
        each map, shape [M].

    Raises:
        ConfigError: If settings do not have the same episodes.
    """
    keys = pd.DataFrame(
        {
            "world": episodes["world"].map(world_name),
            "setting": _settings(episodes),
            "scenario": episodes["scenario"],
            "map": episodes["map"],
        }
    )
    grouped = episodes["success"].astype(int).groupby([keys[name] for name in keys])
    successes = grouped.sum().unstack(["world", "setting"])
    counts = grouped.size().unstack(["world", "setting"])
    is_complete = bool((counts.nunique(axis=1) == 1).all())
    expect(
        is_complete and not counts.isna().any(axis=None),
        "the same episodes of all settings in all worlds, got missing episodes. Finish "
        "the run.",
    )
    wins: dict[str, dict[str, np.ndarray]] = {}
    for world, setting in successes.columns:
        values = successes[(world, setting)].to_numpy(dtype=np.int64)
        wins.setdefault(world, {})[setting] = values
    return wins, counts.iloc[:, 0].to_numpy(dtype=np.int64)


def world_name(label: str) -> str:
    """Return the short name of a world, given its label in tables."""
    if "backend=physics" in label:
        return "bodies" if "entrapment=none" in label else "bodies with ruts"
    if "backend=tracks" in label:
        return "tracks"
    return "kinematic, observed" if "/observed" in label else "kinematic"


def _settings(episodes: pd.DataFrame) -> pd.Series:
    is_straight = episodes["planner"] == STRAIGHT
    settings = episodes["risk"].where(~is_straight, STRAIGHT)
    is_for_point = episodes["world"].str.contains("inflation=none", regex=False)
    return settings.where(~is_for_point | is_straight, POINT)


def _contrast(
    wins: dict[str, np.ndarray], n_episodes: np.ndarray, sides: tuple[str, str]
) -> dict[str, Any]:
    one, other = sides
    gains = wins[one] - wins[other]

    def interval(confidence: float) -> Interval:
        value, low, high = success_interval(gains, n_episodes, confidence)
        return float(value), float(low), float(high)

    value, low, high = interval(0.95)
    return {
        "value": value,
        "low": low,
        "high": high,
        "p": sign_flip_p(gains),
        "p of equivalence": margin_p(interval, "equivalence", "", MARGIN),
    }
