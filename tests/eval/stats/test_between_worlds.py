import json
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from benchnav.eval.stats import hypotheses
from benchnav.eval.stats.between import BetweenWorlds, compare_worlds
from benchnav.eval.stats.summary import success_mean
from benchnav.eval.stats.world_blocks import find_blocks
from benchnav.stats.best import best_set_p
from tests.eval.report import made

WORLDS = ("stakes", "stakes time_budget_ratio=2", "paper")
RISKS = ("mean", "cvar:0.8", "cvar:0.95", "low")
# Success rates by world and risk setting.
RATES = np.array([[0.6, 0.8, 0.9, 0.3], [0.5, 0.6, 0.9, 0.2], [0.8, 0.6, 0.7, 0.1]])
MAPS = 40
DRAWS = 2


def episodes(
    labels: dict[str, str], rate: float, maps: int = MAPS, seed: int = 0
) -> list[dict[str, Any]]:
    """Episodes of one condition; the same seed has the same difficulty of maps."""
    rng = np.random.default_rng(seed)
    rows = []
    for index, draw in product(range(maps), range(DRAWS)):
        time_s = 30.0 if rng.random() < rate else None
        rows.append(made.row(labels, index, time_s, realisation=draw))
    return rows


@pytest.fixture(scope="module")
def rows() -> pd.DataFrame:
    conditions = []
    for (w, world), (r, risk) in product(enumerate(WORLDS), enumerate(RISKS)):
        labels = made.condition("mppi", risk, world=world)
        conditions.append(episodes(labels, RATES[w, r], seed=r))
    return made.rows(*conditions)


def entries(rows: pd.DataFrame, **changes: Any) -> dict[str, dict[str, Any]]:
    """Conditions as in `run.json`, whose worlds differ as their labels do."""
    conditions = made.conditions(rows)
    for entry in conditions.values():
        label = entry["labels"]["world"]
        budget_s = 10.0 * (1 + len(label))
        world = {"noise": "resampled", "time_budget_s": budget_s}
        entry["value"] = {**entry["value"], "world": world}
        entry["value"] |= changes.get(label, {})
    return json.loads(json.dumps(conditions))  # type: ignore[no-any-return]


def condition_id(world: str, risk: str) -> str:
    labels = made.condition("mppi", risk, world=world)
    return str(made.row(labels)["condition"])


@pytest.fixture(scope="module")
def compared(rows: pd.DataFrame) -> BetweenWorlds:
    return compare_worlds(entries(rows), rows)


def by_map(rows: pd.DataFrame, world: str) -> np.ndarray:
    """Successes by map and risk setting, shape [M, C]."""
    selected = rows[rows["world"] == world]
    counts = selected.pivot_table("success", "map", "risk", aggfunc="sum")
    return counts[list(RISKS)].to_numpy(int)


def test_a_run_of_one_world_has_nothing_to_compare(rows: pd.DataFrame) -> None:
    one = rows[rows["world"] == "stakes"]
    compared = compare_worlds(entries(one), one)
    assert compared.settings.empty
    assert compared.agreement.empty
    assert compared.hypotheses.empty
    assert compared.worlds == []
    # The same planner with one risk setting in each world has no common setting.
    first = one[one["risk"] == "mean"]
    second = rows[(rows["world"] == "paper") & (rows["risk"] == "low")]
    both = pd.concat([first, second])
    assert compare_worlds(entries(both), both).settings.empty


def test_rates_of_each_setting_in_each_world(
    rows: pd.DataFrame, compared: BetweenWorlds
) -> None:
    assert compared.worlds == list(WORLDS)
    table = compared.settings.set_index(["world", "risk"])
    for world, risk in product(WORLDS, RISKS):
        own_rows = rows[(rows["world"] == world) & (rows["risk"] == risk)]
        expected = success_mean(own_rows)
        row = table.loc[world, risk]
        columns = ["success_rate", "success_low", "success_high"]
        assert tuple(row[columns]) == pytest.approx(expected)
        assert row["condition"] == condition_id(world, risk)
        assert (row["n_episodes"], row["n_maps"]) == (MAPS * DRAWS, MAPS)


def test_best_sets_are_those_of_each_world_at_a_divided_level(
    rows: pd.DataFrame, compared: BetweenWorlds
) -> None:
    table = compared.settings.set_index(["world", "risk"])
    in_best = []
    rates = []
    for world in WORLDS:
        wins = by_map(rows, world)
        p, _ = best_set_p(wins, DRAWS)
        assert table.loc[world, "best_p"].tolist() == pytest.approx(p.tolist())
        in_best.append(p >= 0.05 / 3)
        assert table.loc[world, "in_best"].tolist() == in_best[-1].tolist()
        rates.append(wins.mean(0) / DRAWS)
    robust = np.all(in_best, axis=0).tolist()
    regret = [max(max(rate) - rate[c] for rate in rates) for c in range(4)]
    for world in WORLDS:
        assert table.loc[world, "robust"].tolist() == robust
        assert table.loc[world, "regret"].tolist() == pytest.approx(regret)
    assert table["competes"].all()


def test_agreement_of_each_pair_of_worlds(
    rows: pd.DataFrame, compared: BetweenWorlds
) -> None:
    table = compared.agreement
    pairs = list(zip(table["world"], table["other"], strict=True))
    assert pairs == [WORLDS[:2], WORLDS[::2], WORLDS[1:]]
    for (first, second), row in zip(pairs, table.to_dict("records"), strict=True):
        a, b = (by_map(rows, world).mean(0) / DRAWS for world in (first, second))
        assert row["pearson"] == pytest.approx(stats.pearsonr(a, b).statistic)
        assert row["spearman"] == pytest.approx(stats.spearmanr(a, b).statistic)
        assert row["mmrv"] == pytest.approx(violation(predicted=b, reference=a))
        assert row["mmrv_back"] == pytest.approx(violation(predicted=a, reference=b))
        keys = ["risk", "map", "realisation"]
        sides = [
            rows[rows["world"] == world].sort_values(keys)["success"].to_numpy()
            for world in (first, second)
        ]
        observed = np.mean(sides[0] == sides[1])
        p, q = sides[0].mean(), sides[1].mean()
        chance = p * q + (1 - p) * (1 - q)
        assert row["kappa"] == pytest.approx((observed - chance) / (1 - chance))
        assert row["n_settings"] == 4
        assert row["same_draws"]
    first_row = table.iloc[0]
    assert first_row["mmrv"] == first_row["mmrv_back"] == 0
    last_row = table.iloc[-1]
    assert last_row["mmrv"] != last_row["mmrv_back"]
    assert last_row["n_pairs"] >= 3
    assert last_row["same_sign"] < 1


def violation(predicted: np.ndarray, reference: np.ndarray) -> float:
    largest = []
    for i in range(len(reference)):
        costs = [0.0]
        for j in range(len(reference)):
            if (predicted[i] < predicted[j]) != (reference[i] < reference[j]):
                costs.append(abs(reference[i] - reference[j]))
        largest.append(max(costs))
    return float(np.mean(largest))


def test_settings_are_compared_by_common_episodes() -> None:
    """A setting with more maps in one world counts only on the maps of both."""
    labels = [
        made.condition("mppi", risk, world=w) for w in WORLDS[:2] for risk in "ab"
    ]
    longer = episodes(labels[0], 0.5, MAPS + 20)
    rows = made.rows(longer, *(episodes(x, 0.5, MAPS, 3) for x in labels[1:]))
    compared = compare_worlds(entries(rows), rows)
    table = compared.settings
    assert set(table["n_maps"]) == {MAPS}
    common = [row["success"] for row in longer[: MAPS * DRAWS]]
    assert table["success_rate"].iloc[0] == pytest.approx(np.mean(common))
    assert compared.agreement["n_episodes"].iloc[0] == MAPS * DRAWS


def test_without_common_episodes_there_is_no_agreement() -> None:
    labels = [made.condition("mppi", "mean", world=world) for world in WORLDS[:2]]
    first, second = (episodes(x, 0.5) for x in labels)
    rows = made.rows(first, [row | {"seed": 1} for row in second])
    compared = compare_worlds(entries(rows), rows)
    assert compared.agreement.empty
    assert compared.settings["success_rate"].isna().all()
    assert not compared.settings["competes"].any()


def test_privileged_and_missing_settings_do_not_compete(rows: pd.DataFrame) -> None:
    oracle = made.condition("mppi", "mean", model="oracle")
    extra = [episodes({**oracle, "world": world}, 1.0) for world in WORLDS]
    only_first = made.condition("astar_dwa", "mean", world=WORLDS[0])
    more = pd.concat([rows, made.rows(*extra, episodes(only_first, 1.0))])
    compared = compare_worlds(entries(more), more)
    table = compared.settings
    is_extra = (table["model"] == "oracle") | (table["planner"] == "astar_dwa")
    assert not table.loc[is_extra, "competes"].any()
    assert table.loc[is_extra, "best_p"].isna().all()
    assert table.loc[~is_extra, "competes"].all()
    # The privileged model still counts in the agreement; the other is in one world.
    assert set(compared.agreement["n_settings"]) == {5}


def test_settings_differ_by_changes_of_rules() -> None:
    """Two rules in one world are two settings, and no second world."""
    rules = {"free_space": {"by": "risk", "above": 0.3}, "min_traversability": 0.2}
    changed = "paper min_traversability=0.2"
    labels = [made.condition("mppi", "mean", world=w) for w in ("paper", changed)]
    rows = made.rows(*(episodes(x, 0.5) for x in labels))
    conditions = entries(rows, **{changed: {"rules": rules}})
    for entry in conditions.values():
        entry["value"]["world"] = {"noise": "resampled", "time_budget_s": 9.0}
    assert find_blocks(conditions) == []
    worlds = ["paper noise=stored", "paper noise=stored min_traversability=0.2"]
    more_labels = [made.condition("mppi", "mean", world=w) for w in worlds]
    more = pd.concat([rows, made.rows(*(episodes(x, 0.5) for x in more_labels))])
    conditions = entries(
        more, **{world: {"rules": rules} for world in (changed, worlds[1])}
    )
    for entry in conditions.values():
        noise = "stored" if "stored" in entry["labels"]["world"] else "resampled"
        entry["value"]["world"] = {"noise": noise, "time_budget_s": 9.0}
    (block,) = find_blocks(conditions)
    assert block.worlds == ("paper", "paper noise=stored")
    assert [s.labels["rules"] for s in block.settings] == [
        "–",
        "min_traversability=0.2",
    ]
    assert all(len(s.ids) == 2 for s in block.settings)
    agreement = compare_worlds(conditions, more).agreement
    assert not agreement["same_draws"].any()


def test_hypotheses_are_tested_in_each_world(rows: pd.DataFrame) -> None:
    conditions = entries(rows)
    claim = {
        "metric": "success",
        "kind": "difference",
        "direction": "",
        "margin": 0.0,
        "names": ["a", "b"],
        "claim": "c",
    }
    stated = []
    for world in ("stakes", "paper"):
        ids = {"one": condition_id(world, "cvar:0.8")}
        ids["other"] = condition_id(world, "mean")
        stated.append(ids | claim)
    low = {"one": condition_id("paper", "low"), "other": condition_id("paper", "mean")}
    stated.append(low | claim | {"kind": "equivalence", "margin": 5.0})
    compared = compare_worlds(conditions, rows, {"tests": stated})
    table = compared.hypotheses
    # The two statements of one contrast are one hypothesis, registered in two worlds.
    assert table["number"].tolist() == [1, 1, 1, 2, 2, 2]
    assert table["world"].tolist() == list(WORLDS) * 2
    assert table["registered"].tolist() == [True, False, True, False, False, True]
    labels = compared.setting_labels[2]
    assert [side["risk"] for side in labels] == ["low", "mean"]
    worlds = {i: entry["value"]["world"] for i, entry in conditions.items()}
    alone = hypotheses.test_hypotheses({"tests": stated}, rows, worlds)
    for number, world, expected in ((1, 0, 0), (1, 2, 1), (2, 2, 2)):
        row = table[table["number"] == number].iloc[world]
        for name in ("difference", "low", "high", "low_90", "p", "n_maps"):
            assert row[name] == alone[name].iloc[expected]
    assert np.sign(table["difference"].iloc[:3]).tolist() == [1, 1, -1]
    unfinished = compare_worlds(conditions, rows, {"tests": stated}, is_whole=False)
    assert unfinished.hypotheses["p"].isna().all()
    one_world = [stated[0] | {"one": condition_id("elsewhere", "mean")}]
    assert compare_worlds(conditions, rows, {"tests": one_world}).hypotheses.empty
