"""The tests of the study of physics, on made-up episodes."""

from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest

from benchnav.core.errors import ConfigError
from benchnav.stats.holm import holm
from studies.physics import primaries

OBSERVED = "immobile=0.1/2s/observed clearance_m=0.354"
LABELS = {
    "kinematic": "stakes clearance_m=0.354",
    "kinematic, observed": f"stakes {OBSERVED}",
    "tracks": f"stakes backend=tracks {OBSERVED}",
    "bodies": f"stakes backend=physics entrapment=none {OBSERVED}",
    "bodies with ruts": f"stakes backend=physics {OBSERVED}",
}
MAPS = 40
# Rates of success by setting: the order of settings in tracks is reversed.
RATES = {
    "cvar:0.95": 0.9,
    "cvar:0.8": 0.7,
    "expected-time": 0.5,
    "mean": 0.3,
    "straight": 0.2,
    "point": 0.9,
}


def episodes_of(draws: int = 1) -> pd.DataFrame:
    rows: list[dict[str, Any]] = []
    for name, label in LABELS.items():
        for setting, rate in RATES.items():
            shown = 1 - rate if name == "tracks" else rate
            inflation = " inflation=none" if setting == "point" else ""
            for scenario in ("std", "hg"):
                for index in range(MAPS):
                    for draw in range(draws):
                        rows.append(
                            {
                                "world": label + inflation,
                                "planner": "straight"
                                if setting == "straight"
                                else "astar_dwa",
                                "risk": {"straight": "–", "point": "cvar:0.95"}.get(
                                    setting, setting
                                ),
                                "scenario": scenario,
                                "map": index,
                                "realisation": draw,
                                "success": index < shown * MAPS,
                            }
                        )
    return pd.DataFrame(rows).sample(frac=1, random_state=0)


@pytest.mark.parametrize("draws", [1, 2])
def test_contrasts_pool_the_maps_of_both_scenarios(draws: int) -> None:
    tables = primaries.tables(episodes_of(draws))
    contrasts = pd.DataFrame(tables["contrasts"]).set_index(["contrast", "world"])
    row = contrasts.loc[("CVaR₀.₉₅ − mean", "bodies with ruts")]
    assert row["value"] == pytest.approx(0.6)
    # 48 of 80 maps differ, all in favour of CVaR; a map is one unit for both draws.
    assert row["p"] == pytest.approx(binomtest(48, 48).pvalue)
    assert row["low"] < 0.6 < row["high"]
    reversed_row = contrasts.loc[("CVaR₀.₉₅ − mean", "tracks")]
    assert reversed_row["value"] == pytest.approx(-0.6)
    same = contrasts.loc[("with the footprint − for a point", "bodies with ruts")]
    assert same["value"] == 0
    assert same["p"] == 1
    assert same["p of equivalence"] < 0.05


def test_hypotheses_are_about_bodies_with_ruts_and_corrected_over_five() -> None:
    table = pd.DataFrame(primaries.tables(episodes_of())["primaries"])
    names = table["hypothesis"].tolist()
    assert names[:3] == list(primaries.CONTRASTS)
    assert names[3:] == [
        "same sign in kinematic, of 6 pairs",
        "same sign in tracks, of 6 pairs",
    ]
    assert table["value"].tolist() == pytest.approx([0.6, 0.7, 0.0, 1.0, 0.0])
    assert table["p"][3] < 0.01 < table["p"][4]
    corrected = holm(table["p"].to_numpy())
    assert np.allclose(table["p by Holm"], corrected)


def test_missing_episodes_are_refused() -> None:
    episodes = episodes_of()
    with pytest.raises(ConfigError, match="the same episodes of all settings"):
        primaries.tables(episodes.iloc[1:])
