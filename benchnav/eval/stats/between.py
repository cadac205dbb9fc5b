"""Results of the same settings in several worlds: rates, agreement, robust set.

A setting is a condition without its world; see `world_blocks`. It is compared between
worlds by the episodes that it has in all of them. Settings are compared with each other
by the episodes that all of them have in all worlds. `benchnav.stats.between` defines
the statistics.
Letters in shapes: W worlds; C settings; M maps, or groups of maps.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.quantity import Quantity
from benchnav.eval.stats.best import competing
from benchnav.eval.stats.hypotheses import test_hypotheses
from benchnav.eval.stats.pairs import drawn_field, on_common_draws
from benchnav.eval.stats.summary import success_mean
from benchnav.eval.stats.world_blocks import Block, Conditions, Setting, find_blocks
from benchnav.metrics.shipped import QUANTITIES
from benchnav.stats.between import (
    best_sets,
    estimate,
    kappa_interval,
    pearson,
    rank_violation,
    regret_intervals,
    same_sign,
    spearman,
)
from benchnav.stats.episodes import Interval
from benchnav.stats.intervals import success_interval

# Attributes in which hypotheses differ in addition to their settings.
_CLAIM = ("metric", "kind", "direction", "margin")


@dataclass(frozen=True, kw_only=True, eq=False)
class BetweenWorlds:
    """Comparison of worlds; all tables are empty if a run has only one world.

    Args:
        settings: one row per setting and world: labels of the setting; `world`;
            `condition`, the id; `n_episodes` and `n_maps`, those that the setting has
            in all its worlds, where a group of maps counts as a map; `success_rate`
            with its 95 % interval `success_low`, `success_high`; `competes`, whether
            the setting was run in all worlds and may be the best; `best_p`, the p-value
            in this world; `in_best`, whether the setting is in the best set of this
            world at level 0.05/W; `robust`, whether it is in the best set of all
            worlds; `regret`, its largest regret over worlds as a fraction, with its
            interval `regret_low`, `regret_high`. Settings that do not compete have NaN
            and false.
        agreement: one row per pair of worlds: labels of the block; `world` and `other`;
            `n_settings`, `n_episodes`, `n_maps`; `same_draws`, whether both worlds draw
            λ in the same way; `pearson`, `spearman`, `mmrv` (of the ranks in `other`,
            by the differences in `world`), `mmrv_back` (of the ranks in `world`, by
            the differences in `other`) and `kappa`, each with `…_low` and `…_high`; and
            for the pairs of settings that are significant in `world`, `n_pairs`,
            `same_sign` (the fraction with the same sign in `other`), its one-sided 95 %
            bound `same_sign_low` and `same_sign_p` for H₀: at most one half; the same
            with `_back` for the pairs that are significant in `other`.
        hypotheses: one row per hypothesis and world: `number`; `world`; `registered`,
            whether the suite states the hypothesis for this world; and the columns of
            `test_hypotheses` without correction, with `direction` and `claim` as
            registered.
        setting_labels: labels of the settings `one` and `other` by the hypothesis's
            `number`.
    """

    settings: pd.DataFrame = field(default_factory=pd.DataFrame)
    agreement: pd.DataFrame = field(default_factory=pd.DataFrame)
    hypotheses: pd.DataFrame = field(default_factory=pd.DataFrame)
    setting_labels: Mapping[int, tuple[Mapping[str, str], Mapping[str, str]]] = field(
        default_factory=dict
    )

    @property
    def worlds(self) -> list[str]:
        """Labels of the worlds, in the order of the run."""
        return [] if self.settings.empty else list(self.settings["world"].unique())


def compare_worlds(
    conditions: Conditions,
    episodes: pd.DataFrame,
    fixed: Mapping[str, Any] | None = None,
    is_whole: bool = True,
    quantities: Mapping[str, Quantity] = QUANTITIES,
) -> BetweenWorlds:
    """Compare the results of the same settings in several worlds.

    Args:
        conditions: entries of `run.json` by id, of conditions that have episodes.
        episodes: rows of episodes.
        fixed: entry of hypotheses in `run.json`; None without hypotheses.
        is_whole: whether the run is finished; if it is not, hypotheses have no p.
        quantities: quantities by which conditions are compared, by name.
    """
    blocks = find_blocks(conditions)
    if not blocks:
        return BetweenWorlds()
    rows = dict(list(episodes.groupby("condition", sort=False)))
    setting_rows: list[dict[str, Any]] = []
    agreement_rows: list[dict[str, Any]] = []
    for block in blocks:
        setting_rows += _settings_of(block, rows)
        for pair in combinations(block.worlds, 2):
            agreement_rows += _agreement_of(block, pair, rows, conditions)
    hypotheses = pd.DataFrame()
    labels: dict[int, Any] = {}
    if fixed:
        tests, labels = _tests_in_worlds(blocks, fixed["tests"])
        if tests:
            worlds = {i: entry["value"]["world"] for i, entry in conditions.items()}
            hypotheses = test_hypotheses(
                {"tests": tests}, episodes, worlds, is_whole, quantities
            ).drop(columns=["p_holm", "supported"])
    return BetweenWorlds(
        settings=pd.DataFrame(setting_rows),
        agreement=pd.DataFrame(agreement_rows),
        hypotheses=hypotheses,
        setting_labels=labels,
    )


def _settings_of(
    block: Block, rows: Mapping[str, pd.DataFrame]
) -> list[dict[str, Any]]:
    """Return the rows of the table of settings for a block."""
    best = _best_columns(block, rows)
    table_rows = []
    for setting in block.settings:
        common = on_common_draws({i: rows[i] for i in setting.ids.values()})
        for world in block.worlds:
            if world not in setting.ids:
                continue
            condition = setting.ids[world]
            episodes = common[condition]
            rate, low, high = np.nan, np.nan, np.nan
            if not episodes.empty:
                rate, low, high = success_mean(episodes)
            row: dict[str, Any] = {**setting.labels, "world": world}
            row["condition"] = condition
            row["n_episodes"] = len(episodes)
            row["n_maps"] = episodes["group"].nunique()
            row |= {"success_rate": rate, "success_low": low, "success_high": high}
            table_rows.append(row | best[condition])
    return table_rows


def _best_columns(
    block: Block, rows: Mapping[str, pd.DataFrame]
) -> dict[str, dict[str, Any]]:
    """Return the columns on the best sets and on regret, by id of the condition."""
    columns: dict[str, dict[str, Any]] = {}
    for setting in block.settings:
        for condition in setting.ids.values():
            columns[condition] = {
                "competes": False,
                "best_p": np.nan,
                "in_best": False,
                "robust": False,
                **_named("regret", (np.nan, np.nan, np.nan)),
            }
    settings = _competing(block.settings_in(block.worlds))
    wins, sizes = _wins(settings, block.worlds, rows)
    if not len(sizes):
        return columns
    p, in_best = best_sets(wins, sizes)
    intervals = np.stack(regret_intervals(wins, sizes), axis=1)
    for index, setting in enumerate(settings):
        for world_index, world in enumerate(block.worlds):
            columns[setting.ids[world]] = {
                "competes": True,
                "best_p": p[world_index, index],
                "in_best": bool(in_best[world_index, index]),
                "robust": bool(in_best[:, index].all()),
                **_named("regret", tuple(intervals[index])),
            }
    return columns


def _competing(settings: Sequence[Setting]) -> list[Setting]:
    """Return the settings that may be the best; see `best.competing`."""
    if not settings:
        return []
    table = pd.DataFrame([setting.labels for setting in settings])
    table["privileged"] = [setting.privileged for setting in settings]
    is_competing = competing(table)
    return [s for s, flag in zip(settings, is_competing, strict=True) if flag]


def _wins(
    settings: Sequence[Setting],
    worlds: Sequence[str],
    rows: Mapping[str, pd.DataFrame],
) -> tuple[np.ndarray, np.ndarray]:
    """Return successes and numbers of episodes on each map, over common episodes.

    Args:
        settings: settings that were run in all worlds.
        worlds: labels of the worlds.
        rows: rows of episodes by id of the condition.

    Returns:
        Successes, int64, shape [W, C, M]; and numbers of episodes, int64, shape [M]. M
        is 0 without common episodes.
    """
    ids = [[setting.ids[world] for setting in settings] for world in worlds]
    if not settings:
        return np.zeros((len(worlds), 0, 0), dtype=np.int64), np.zeros(0)
    common = on_common_draws({i: rows[i] for row in ids for i in row})
    _, maps, sizes = np.unique(
        common[ids[0][0]]["group"], return_inverse=True, return_counts=True
    )
    wins = np.zeros((len(worlds), len(settings), len(sizes)), dtype=np.int64)
    for world_index, condition_ids in enumerate(ids):
        for index, condition in enumerate(condition_ids):
            success = common[condition]["success"].to_numpy(dtype=bool)
            counts = np.bincount(maps[success], minlength=len(sizes))
            wins[world_index, index] = counts
    return wins, sizes


def _agreement_of(
    block: Block,
    worlds: tuple[str, str],
    rows: Mapping[str, pd.DataFrame],
    conditions: Conditions,
) -> list[dict[str, Any]]:
    """Return the row of a pair of worlds; none without common episodes."""
    settings = block.settings_in(worlds)
    wins, sizes = _wins(settings, worlds, rows)
    if not len(sizes):
        return []
    first, second = worlds
    ids = [settings[0].ids[world] for world in worlds]
    fields = [drawn_field(conditions[i]["value"]["world"]) for i in ids]
    row: dict[str, Any] = {**block.labels, "world": first, "other": second}
    row["n_settings"] = len(settings)
    row["n_episodes"] = int(sizes.sum())
    row["n_maps"] = len(sizes)
    row["same_draws"] = fields[0] == fields[1]
    row |= _named("pearson", estimate(pearson, wins, sizes))
    row |= _named("spearman", estimate(spearman, wins, sizes))
    swapped = wins[::-1]
    row |= _named("mmrv", estimate(rank_violation, swapped, sizes))
    row |= _named("mmrv_back", estimate(rank_violation, wins, sizes))
    row |= _named("kappa", kappa_interval(_outcome_tables(settings, worlds, rows)))
    for suffix, ordered in (("", wins), ("_back", swapped)):
        signs = same_sign(ordered, sizes)
        row[f"n_pairs{suffix}"] = signs.pairs
        row[f"same_sign{suffix}"] = signs.fraction
        row[f"same_sign_low{suffix}"] = signs.low
        row[f"same_sign_p{suffix}"] = signs.p
    return [row]


def _outcome_tables(
    settings: Sequence[Setting],
    worlds: tuple[str, str],
    rows: Mapping[str, pd.DataFrame],
) -> np.ndarray:
    """Return numbers of episodes by success in both worlds, shape [M, 2, 2].

    All settings are pooled, each with the episodes that both worlds have in common.
    """
    cases = []
    for setting in settings:
        pair = on_common_draws({world: rows[setting.ids[world]] for world in worlds})
        first, second = (pair[world]["success"].to_numpy(bool) for world in worlds)
        groups = pair[worlds[0]]["group"].to_numpy()
        columns = {"group": groups, "first": first, "second": second}
        cases.append(pd.DataFrame(columns))
    table = pd.concat(cases)
    _, maps = np.unique(table["group"], return_inverse=True)
    cells = 4 * maps + 2 * table["first"].to_numpy() + table["second"].to_numpy()
    counts = np.bincount(cells, minlength=4 * (maps.max() + 1))
    return counts.reshape(-1, 2, 2)


def _tests_in_worlds(
    blocks: Sequence[Block], tests: Sequence[Mapping[str, Any]]
) -> tuple[list[dict[str, Any]], dict[int, Any]]:
    """Return each registered test in all worlds that have both settings.

    Args:
        blocks: blocks from `find_blocks`.
        tests: `tests` of the entry of hypotheses in `run.json`.

    Returns:
        Tests with the keys of the registered ones, and `number`, `world` and
        `registered`; and the labels of both settings by number.
    """
    places: dict[str, tuple[Block, Setting]] = {}
    for block in blocks:
        for setting in block.settings:
            for condition in setting.ids.values():
                places[condition] = (block, setting)
    registered = {(test["one"], test["other"], *_claim_of(test)) for test in tests}
    seen: set[tuple[Any, ...]] = set()
    expanded: list[dict[str, Any]] = []
    labels: dict[int, Any] = {}
    for test in tests:
        if not {test["one"], test["other"]} <= places.keys():
            continue
        block, first = places[test["one"]]
        _, second = places[test["other"]]
        claim = _claim_of(test)
        identity = (first.key, second.key, *claim)
        worlds = [w for w in block.worlds if w in first.ids and w in second.ids]
        if identity in seen or len(worlds) < 2:
            continue
        seen.add(identity)
        number = len(labels) + 1
        labels[number] = (first.labels, second.labels)
        for world in worlds:
            ids = (first.ids[world], second.ids[world])
            entry = {**test, "one": ids[0], "other": ids[1]}
            entry |= {"number": number, "world": world}
            entry["registered"] = (*ids, *claim) in registered
            expanded.append(entry)
    return expanded, labels


def _claim_of(test: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(test[name] for name in _CLAIM)


def contrast_by_world(
    settings: tuple[Setting, Setting],
    worlds: Sequence[str],
    rows: Mapping[str, pd.DataFrame],
) -> pd.DataFrame:
    """Return the difference in success of two settings in each world, and its changes.

    Args:
        settings: the first setting, and the one that is subtracted; both were run in
            all worlds.
        worlds: labels of the worlds, in the order of a series.
        rows: rows of episodes by id of the condition.

    Returns:
        One row per world: `world`; `n_episodes` and `n_maps`, common to all worlds;
        `difference` with its 95 % interval `difference_low`, `difference_high`; and
        `change`, the difference minus that in the world before, with its interval
        `change_low`, `change_high`; NaN in the first world. All intervals are those of
        `intervals.success_interval`. Empty without common episodes.
    """
    wins, sizes = _wins(settings, worlds, rows)
    if not len(sizes):
        return pd.DataFrame()
    gains = wins[:, 0] - wins[:, 1]
    table_rows = []
    change = (np.nan, np.nan, np.nan)
    for index, world in enumerate(worlds):
        difference = _success_difference(gains[index], sizes)
        if index:
            change = _success_difference(gains[index] - gains[index - 1], sizes)
        row: dict[str, Any] = {"world": world, "n_episodes": int(sizes.sum())}
        row["n_maps"] = len(sizes)
        row |= _named("difference", difference)
        row |= _named("change", change)
        table_rows.append(row)
    return pd.DataFrame(table_rows)


def _success_difference(gains: np.ndarray, sizes: np.ndarray) -> Interval:
    """Return a difference in success with its interval, NaN if there is only one map."""
    if len(sizes) < 2:
        return float(gains.sum() / sizes.sum()), np.nan, np.nan
    mean, low, high = success_interval(gains, sizes)
    return float(mean), float(low), float(high)


def _named(name: str, interval: Interval) -> dict[str, float]:
    """Return an estimate and the ends of its interval, by column."""
    value, low, high = interval
    return {name: value, f"{name}_low": low, f"{name}_high": high}
