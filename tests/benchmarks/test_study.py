"""The studies: their suites, their maps, their power and their figures."""

from collections import Counter
from itertools import product
from operator import itemgetter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import PathCollection
from scipy.stats import norm

from benchmarks import study, tables
from benchmarks.study import (
    ALL_KNOWN,
    ARMS,
    KNOWN,
    STUDIES,
    Study,
    arm_of,
    frontier_figure,
    knowledge_figure,
    known_of,
    power_of,
    suite_of,
)
from benchnav.core.errors import ConfigError
from benchnav.core.settings import of, read
from benchnav.datagen import TerrainDataset
from benchnav.eval.experiment.condition import Condition, conditions_of
from benchnav.eval.experiment.hypotheses import fix_hypotheses
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.experiment.unit import Extent
from benchnav.eval.stats.pairs import Compared
from benchnav.eval.stats.regret import find_chains
from tests import factories

KNOWLEDGE = STUDIES["knowledge"]
RUNNABLE = [part for part in KNOWLEDGE.parts if part != "near"]  # whose models are shipped


@pytest.fixture(autouse=True)
def at_the_root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(study.ROOT)


def suite(part: str, of_study: Study = KNOWLEDGE) -> Suite:
    made: Suite = read(Suite, suite_of(of_study, part, Path("maps"), 0), of("the suite"))
    return made


def conditions(part: str, of_study: Study = KNOWLEDGE) -> list[Condition]:
    return conditions_of(suite(part, of_study), lambda data: ["std"])


@pytest.fixture(scope="module")
def primary() -> list[Condition]:
    return conditions_of(
        read(Suite, suite_of(KNOWLEDGE, "primary", Path("maps"), 0), of("the suite")), lambda data: ["std"]
    )


def test_the_primary_hypotheses_are_twelve_at_most_and_name_all_that_is_run(primary: list[Condition]) -> None:
    known = {each.id: (each, Extent.product((2026,), 2, 400)) for each in primary}
    tests = fix_hypotheses(suite("primary").hypotheses, known)["tests"]
    assert len(tests) == len(suite("primary").hypotheses) <= 12
    named = {test[side] for test in tests for side in ("one", "other")}
    assert named == set(known)
    controls = [test for test in tests if test["margin"] == 3]
    assert Counter(test["kind"] for test in controls) == {"non-inferiority": 1, "equivalence": 2}


def test_what_is_known_is_asked_of_each_planner_model_and_risk_setting() -> None:
    known = [each for part in ("known", "known-mppi") for each in conditions(part)]
    explores = [each for each in known if each.labels["planner"] == "astar_dwa explores"]
    assert [each.labels["belief"] for each in explores] == ["static", "copula"]
    known = [each for each in known if each not in explores]
    # Two planners, two models, three risk settings, four states of knowledge; and the clairvoyant.
    assert len(known) == 2 * 2 * 3 * 4 + 2
    assert Counter(known_of(each.labels) for each in known) == {
        **dict.fromkeys(KNOWN.values(), 12), ALL_KNOWN: 2
    }  # fmt: skip


@pytest.mark.parametrize("part", [part for part in RUNNABLE if not part.startswith(("primary", "known"))])
def test_the_parts_of_suites_are_there(part: str) -> None:
    assert conditions(part)


def test_maps_to_confirm_on_are_neither_those_to_develop_on_nor_the_seen_ones() -> None:
    confirmed = {
        suite_of(KNOWLEDGE, part, Path("maps"), 0)["data"]
        for part in ("primary", "known", "near", "sensitivity")
    }
    assert confirmed == {"maps/stakes-v1-400-seed2026.h5"}
    assert suite_of(KNOWLEDGE, "primary", Path("maps"), 7)["maps"] == 7
    known = study.yaml.safe_load((KNOWLEDGE.suites / "data.yaml").read_text())
    assert len({about["digest"] for about in known.values()}) == len(known)


def test_maps_of_another_digest_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    place = factories.tiny_dataset(tmp_path / "maps" / "tiny.h5")
    monkeypatch.setattr(study, "ROOT", tmp_path)
    KNOWLEDGE.suites.mkdir(parents=True)
    digest = TerrainDataset(place).splits["test/std"]["digest"]
    for given in (digest, "0" * 64):
        (KNOWLEDGE.suites / "data.yaml").write_text(f"tiny: {{create: [tiny-v1], digest: '{given}'}}")
        if given == digest:
            study.make_maps(KNOWLEDGE, place.parent)
        else:
            with pytest.raises(SystemExit, match=f"{'0' * 64} in .*, got {digest}"):
                study.make_maps(KNOWLEDGE, place.parent)


@pytest.mark.parametrize(
    ("kind", "direction", "margin", "true"),
    [
        ("difference", "higher", 0.0, 2.0),
        ("difference", "lower", 0.0, -2.0),
        ("superiority", "higher", 5.0, 8.0),
        ("non-inferiority", "higher", 3.0, 0.0),
        ("non-inferiority", "lower", 3.0, 1.0),
        ("equivalence", "", 3.0, 0.0),
        ("equivalence", "", 3.0, 1.0),
    ],
)
def test_power_is_the_share_of_studies_that_support_it(
    kind: str, direction: str, margin: float, true: float
) -> None:
    error, alpha = 1.2, 0.05
    z = norm.ppf(1 - alpha)
    found = np.random.default_rng(0).normal(true, error, 200_000)
    low, high = found - z * error, found + z * error
    if direction == "lower":
        low, high = -high, -low
    supported = {
        "difference": low > 0,
        "superiority": low > margin,
        "non-inferiority": low > -margin,
        "equivalence": (low > -margin) & (high < margin),
    }[kind]
    row = {"kind": kind, "direction": direction, "margin": margin}
    assert power_of(row, error, alpha, true) == pytest.approx(supported.mean(), abs=0.005)


def test_the_figure_has_a_line_a_risk_setting_over_what_is_known() -> None:
    rows = []
    for place, (ground, belief) in enumerate(KNOWN):
        for risk, more in (("mean", 0.0), ("cvar:0.8", 0.1)):
            middle = 0.5 + 0.1 * place + more
            rows.append({
                "world": "stakes", "planner": "astar_dwa", "model": "oracle", "sensor": "full", "ground": ground,
                "belief": belief, "risk": risk, "success_rate": middle, "success_low": middle - 0.04,
                "success_high": middle + 0.03,
            })  # fmt: skip
    others = {
        "sensor": "near:8",
        "world": "stakes noise=resampled",
        "ground": "elsewhere",
        "planner": "cl_rrt",
    }
    rows += [{**rows[0], name: value} for name, value in others.items()]
    rows.append(
        {
            **rows[0],
            "model": "clairvoyant",
            "ground": "–",
            "risk": "–",
            "success_rate": 1.0,
            "success_high": 1.0,
        }
    )
    figure = knowledge_figure(pd.DataFrame(rows))
    panel = figure.axes[0]
    assert [label.get_text() for label in panel.get_xticklabels()] == [*KNOWN.values(), ALL_KNOWN]
    mean, cvar = (bars.lines[0] for bars in panel.containers)
    np.testing.assert_allclose(mean.get_ydata(), [50, 60, 70, 80, 100])
    np.testing.assert_allclose(cvar.get_ydata(), [60, 70, 80, 90, 100])
    (bar,) = panel.containers[0].lines[2]
    np.testing.assert_allclose(bar.get_segments()[1][:, 1], [56, 63])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["mean", "CVaR₀.₈"]


def test_power_is_of_the_maps_that_the_study_confirms_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    row = {
        "claim": "it pays",
        "kind": "difference",
        "direction": "higher",
        "margin": 0.0,
        "difference": 3.0,
        "n_maps": 100,
    }
    tests = pd.DataFrame([{**row, "low": 3 - 1.96 * 3, "high": 3 + 1.96 * 3}] * 4)

    class Read:
        def __init__(self, folder: Path) -> None:
            assert folder == tmp_path / "knowledge-developed"
            self.tests = tests

    monkeypatch.setattr(study, "read_report", Read)
    # A standard error of 3 over 100 maps is one of 1.5 over 400.
    first, last = (norm.cdf(3 / 1.5 - norm.ppf(1 - alpha)) for alpha in (0.05 / 4, 0.05))
    told = study.power(KNOWLEDGE, tmp_path)
    assert f"| 1 | it pays | +3.00 (-2.9 to +8.9) | {first:.2f} to {last:.2f} | – |" in told


COST = STUDIES["cost"]


def test_arms_of_risk_on_the_cost_differ_in_what_they_are_called_for_alone() -> None:
    found = conditions("levels", COST)
    told = Counter()
    for each in found:
        family, arm, held, level = itemgetter("planner", "arm", "held", "level")(arm_of(each.labels))
        options = dict(each.planner.options)
        own = options["mppi"] if each.planner.part == "astar_mppi" else options
        assert (own["samples"], own["cost_to_go"]) == (1024, "expected-time")
        assert own.get("entrapment", False) is held
        if "cost" in arm:
            assert (own["risk_on"], own.get("level", 0), own.get("fields", 64)) == ("cost", level, 64)
            assert each.labels["risk"] == "expected-time"
        else:
            assert own.get("risk_on", "map") == "map"
        told[family, arm, held] += 1
    assert told.pop(("MPPI", "", False)) == 1  # the clairvoyant
    assert told == dict.fromkeys(product(("MPPI", "A*+MPPI"), ARMS, (False, True)), 3)


def test_the_frontiers_have_a_line_an_arm_through_its_levels() -> None:
    rows = []
    for place, each in enumerate(conditions("levels", COST)):
        middle = 0.5 + 0.01 * place
        rows.append({
            **each.labels, "success_rate": middle, "success_low": middle - 0.1, "success_high": middle + 0.1,
            "success_time_mean_s": 60.0 - place,
        })  # fmt: skip
    figure = frontier_figure(pd.DataFrame(rows))
    planners = ["MPPI", "A*+MPPI"]
    titles = [*planners, *(f"{planner}, entrapment" for planner in planners)]
    assert [panel.get_title() for panel in figure.axes] == titles
    for panel in figure.axes:
        assert len(panel.containers) == len(ARMS)
        marks = [found for found in panel.collections if isinstance(found, PathCollection)]
        assert [list(own.get_sizes()) for own in marks] == len(ARMS) * [[9.0, 30.25, 49.0]]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [*ARMS]
    for name, panel in (("mppi cost 0.8", figure.axes[0]), ("mppi cost 0.8 held", figure.axes[2])):
        own = next(row for row in rows if row["planner"] == name)
        line = panel.containers[-1].lines[0]
        assert (line.get_xdata()[-1], line.get_ydata()[-1]) == (
            own["success_time_mean_s"],
            100 * own["success_rate"],
        )


def test_on_new_maps_the_arms_are_those_of_the_maps_to_develop_on() -> None:
    """But for `mean` with rollouts that are held, which drives as `mean` does."""

    def named(part: str) -> list[tuple[str, str, str]]:
        return [
            tuple(each.labels[name] for name in ("planner", "model", "risk"))
            for each in conditions(part, COST)
        ]

    left_out = {(f"{planner} map held", "stakes-v1", "mean") for planner in ("mppi", "astar_mppi")}
    new = [*named("primary"), *named("frontier")]
    assert len(new) == len({*new})
    assert {*new} == {*named("levels")} - left_out
    for part in ("primary", "frontier"):
        options = {each.labels["planner"]: each.planner for each in conditions("levels", COST)}
        assert all(each.planner == options[each.labels["planner"]] for each in conditions(part, COST))


def test_the_hypotheses_of_risk_on_the_cost_are_eight() -> None:
    own = suite("primary", COST)
    known = {each.id: (each, Extent.product((3027,), 1, 200)) for each in conditions("primary", COST)}
    tests = fix_hypotheses(own.hypotheses, known)["tests"]
    assert len(tests) == 8
    assert own.maps == 200


def table_of_arms(
    part: str,
    arrived: dict[tuple[str, str], int],
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    other_maps: str = "",
) -> dict[tuple[str, str], list[str]]:
    """Rows of a part where arms arrive on so many of 40 maps, in 30 s, and all others on 35, 2 s later.

    Planners of `other_maps` drove on maps with other digests.
    """

    def conditions_in(name: str) -> list[Compared]:
        found = []
        for each in conditions(name, COST):
            arm = (each.labels["planner"], each.labels["risk"])
            success = np.arange(40) < arrived.get(arm, 35)
            episodes = pd.DataFrame({
                "seed": 3027, "realisation": 0, "map": range(40), "group": range(40), "success": success,
                "total_time_s": np.where(success, 30.0 + 2 * (arm not in arrived), 90.0), "time_budget_s": 90.0,
            })  # fmt: skip
            digest = "b" if each.labels["planner"] == other_maps else "a"
            maps = tuple(f"{digest}{place}" for place in range(40))
            found.append(Compared(labels=each.labels, value={}, maps=maps, episodes=episodes))
        return found

    summary = [
        {
            **each.labels, "success_rate": each.episodes["success"].mean(), "success_low": 0.2, "success_high": 0.9,
            "total_time_mean_s": each.episodes["total_time_s"].mean(), "planning_ms_median": 1.5,
        }
        for each in conditions_in(part)
    ]  # fmt: skip
    run = folder / f"cost-{part}"
    run.mkdir()
    pd.DataFrame(summary).to_csv(run / "summary.csv")
    monkeypatch.setattr(tables, "open_run", lambda run: run)
    monkeypatch.setattr(
        tables, "read_conditions", lambda runs: conditions_in(runs[0].name.removeprefix("cost-"))
    )
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in tables.arms(run).splitlines()[2:]]
    found = {(row[0], row[1]): row[2:] for row in rows}
    assert len(rows) == len(found) == len(summary)
    return found


def test_the_table_of_arms_sets_each_beside_cvar_of_time_with_its_planner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = {("mppi map", "time-cvar:0.5"): 20, ("astar_mppi map", "time-cvar:0.5"): 30}
    found = table_of_arms("primary", base, tmp_path, monkeypatch)
    assert found["mppi map", "time-cvar:0.5"][:3] == ["50.0 (20–90)", "60.0", "1.5"]
    assert all(found[arm][3:] == ["", "", ""] for arm in base)
    # All 5 maps that differ speak for an arm of A*+MPPI: 2 / 2⁵; after 8 smaller p of 15, Holm's factor is 7.
    for planner, points, least, most in (("mppi", "+37.5", 0, 0.01), ("astar_mppi", "+12.5", 0.42, 0.46)):
        gain, p, later = found[f"{planner} cost 0.8", "expected-time"][3:]
        assert gain.startswith(points)
        assert least <= float(p) <= most
        assert later.startswith("+2.0")


def test_the_table_of_arms_refuses_an_arm_on_other_maps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigError, match=r"same maps, got mppi cost 0\.8 and mppi map,"):
        table_of_arms("primary", {}, tmp_path, monkeypatch, other_maps="mppi cost 0.8")


def test_the_table_of_other_levels_compares_with_the_primary_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = {("mppi map", "time-cvar:0.5"): 20, ("astar_mppi map", "time-cvar:0.5"): 30}
    found = table_of_arms("frontier", base, tmp_path, monkeypatch)
    for (planner, _), row in found.items():
        assert row[3].startswith("+12.5" if planner.startswith("astar") else "+37.5")


def test_an_arm_with_its_own_time_to_go_stands_beside_itself_with_the_shared_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shared = {
        ("mppi map", "cvar:0.8"): 20, ("mppi map", "time-cvar:0.5"): 25, ("astar_mppi map", "cvar:0.8"): 30,
        ("astar_mppi map", "time-cvar:0.5"): 32, ("mppi cost 0.8", "expected-time"): 33,
    }  # fmt: skip
    found = table_of_arms("own", shared, tmp_path, monkeypatch)
    gains = {arm: row[3].split()[0] for arm, row in found.items()}
    assert gains == {
        ("mppi map own", "cvar:0.8"): "+37.5", ("mppi map own", "time-cvar:0.5"): "+25.0",
        ("astar_mppi map own", "cvar:0.8"): "+12.5", ("astar_mppi map own", "time-cvar:0.5"): "+7.5",
        ("mppi cost 0.8 own", "time-cvar:0.5"): "+5.0",
    }  # fmt: skip


def test_own_time_to_go_is_all_that_differs() -> None:
    primary = {each.labels["planner"]: each.planner.options for each in conditions("primary", COST)}
    for each in conditions("own", COST):
        same = primary[each.labels["planner"].removesuffix(" own")]
        own, other = (dict(options).get("mppi", options) for options in (each.planner.options, same))
        assert {**own, "cost_to_go": "expected-time"} == {**other}
        assert own["cost_to_go"] == "map"


def test_the_way_to_the_best_has_a_chain_of_each_planner() -> None:
    about = {each.id: {"value": each.value, "labels": each.labels} for each in conditions("best", COST)}
    chains = find_chains(about)
    assert {about[chain[0]]["labels"]["planner"] for chain in chains} == {
        "astar_dwa", "cl_rrt", "mppi", "astar_mppi",
    }  # fmt: skip


def test_each_part_has_its_suite() -> None:
    for name, own in STUDIES.items():
        assert {path.stem for path in own.suites.glob("*.yaml")} == {*own.parts, "data"}, name
