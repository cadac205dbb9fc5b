import numpy as np
import pandas as pd
from scipy.stats import binom, fisher_exact

from studies.validation.tables import (
    PUBLISHED,
    PUBLISHED_PAIRS,
    show_difference,
    show_p,
    tabulate_pairs,
    tabulate_runs,
    tabulate_success,
)


def rows(density: float, **success: list[bool]) -> pd.DataFrame:
    parts = [
        pd.DataFrame(
            {
                "density": density,
                "setting": setting.replace("_", ":0."),
                "map": np.arange(len(outcomes)) // 2,
                "realisation": np.arange(len(outcomes)) % 2,
                "success": outcomes,
                "time_s": np.where(outcomes, 10.0, np.nan),
            }
        )
        for setting, outcomes in success.items()
    ]
    return pd.concat(parts)


def test_published_pairs_agree_with_published_successes() -> None:
    successes = PUBLISHED["successes"].unstack()
    gained = PUBLISHED_PAIRS["gained"] - PUBLISHED_PAIRS["lost"]
    assert gained.tolist() == (successes["cvar:0.8"] - successes["mean"]).tolist()


def test_interval_of_a_difference_is_that_of_its_source() -> None:
    # Newcombe's first example, table II
    assert show_difference(56, 70, 48, 80) == "+20.0 [5.2, 33.4]"


def test_success_stands_beside_the_published() -> None:
    table = tabulate_success(
        rows(0.4, mean=[True, False, True, False], cvar_7=[True, True, True, False])
    )
    header, _, mean, cvar = table.splitlines()
    assert mean.startswith(
        "| 40 % | `mean` | 50.0 [15, 85] | 10.0 | 69.0 [62, 75] | 9.1 | "
    )
    assert cvar == "| 40 % | `cvar:0.7` | 75.0 [30, 95] | 10.0 | – | – | – | – |"
    assert header.count("|") == mean.count("|") == cvar.count("|")


def test_p_is_corrected_over_all_lines_that_are_compared() -> None:
    arrived = {"mean": 100, "cvar_8": 170}
    trials = {
        name: [True] * count + [False] * (200 - count)
        for name, count in arrived.items()
    }
    table = tabulate_success(rows(0.4, **trials)).splitlines()[2:]
    raw = []
    for name, count in (("mean", 100), ("cvar:0.8", 170)):
        theirs = PUBLISHED.loc[(0.4, name), "successes"]
        raw.append(fisher_exact([[count, 200 - count], [theirs, 200 - theirs]]).pvalue)
    first, second = sorted(raw)
    expected = {first: 2 * first, second: max(2 * first, second)}
    assert [line.split("|")[-2].strip() for line in table] == [
        show_p(expected[p]) for p in raw
    ]


def test_pairs_are_those_of_one_trial() -> None:
    mean, cautious = [True, False, False, False], [False, True, True, False]
    shuffled = rows(1.0, mean=mean, cvar_8=cautious).sample(frac=1, random_state=0)
    line = tabulate_pairs(shuffled, "cvar:0.8", "mean").splitlines()[-1]
    assert line == "| 100 % | +25.0 | 2, 1 | 1.00 | +79.0 | 159, 1 | 2e-46 |"
    head, _, line = tabulate_pairs(shuffled, "mean", "cvar:0.8").splitlines()
    assert head == "| vegetation | points | only `mean`, only `cvar:0.8` | p |"
    assert line == "| 100 % | -25.0 | 1, 2 | 1.00 |"


def test_a_run_stands_beside_the_first_trial_by_trial() -> None:
    first = rows(1.0, mean=[True] * 10 + [False] * 2, cvar_8=[True] * 12)
    other = rows(1.0, mean=[False] * 9 + [True] * 3, cvar_8=[True] * 12).sample(
        frac=1, random_state=0
    )
    whole, change = tabulate_runs({"a": first, "b": other.assign(time_s=20.0)}).split(
        "\n\n"
    )
    assert (
        whole.split("\n")[2]
        == "| 100 % | `mean` | 83.3, 10.0 s | 25.0, 20.0 s | 20.0, 11.6 s |"
    )
    header, _, mean, cautious = change.split("\n")
    assert "won only with b, only with a" in header
    # Two won and nine lost of twelve; p of the binomial tail, twice over two lines.
    p = 2 * 2 * binom.cdf(2, 11, 0.5)
    assert mean == f"| 100 % | `mean` | -58.3 | 2, 9 | {show_p(p)} |"
    assert cautious == "| 100 % | `cvar:0.8` | +0.0 | 0, 0 | 1.00 |"
