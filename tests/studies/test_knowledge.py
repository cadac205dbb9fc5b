"""The study of knowledge: its hypotheses, its suites and its figure."""

from collections import Counter

import numpy as np
import pandas as pd

from benchnav.eval.experiment.hypotheses import fix_hypotheses
from benchnav.eval.experiment.unit import Extent
from studies.knowledge.figure import ALL_KNOWN, KNOWN, known, known_of
from tests.studies.suites import conditions, suite


def test_the_primary_hypotheses_are_twelve_at_most_and_name_all_that_is_run() -> None:
    hypotheses = suite("knowledge", "primary").hypotheses
    known = {each.id: (each, Extent.product((2026,), 2, 400)) for each in conditions("knowledge", "primary")}
    tests = fix_hypotheses(hypotheses, known)["tests"]
    assert len(tests) == len(hypotheses) <= 12
    named = {test[side] for test in tests for side in ("one", "other")}
    assert named == set(known)
    controls = [test for test in tests if test["margin"] == 3]
    assert Counter(test["kind"] for test in controls) == {"non-inferiority": 1, "equivalence": 2}


def test_what_is_known_is_asked_of_each_planner_model_and_risk_setting() -> None:
    asked = [each for part in ("known", "known-mppi") for each in conditions("knowledge", part)]
    explores = [each for each in asked if each.labels["planner"] == "astar_dwa explores"]
    assert [each.labels["belief"] for each in explores] == ["static", "copula"]
    asked = [each for each in asked if each not in explores]
    # Two planners, two models, three risk settings, four states of knowledge; and the clairvoyant.
    assert len(asked) == 2 * 2 * 3 * 4 + 2
    assert Counter(known_of(each.labels) for each in asked) == {
        **dict.fromkeys(KNOWN.values(), 12), ALL_KNOWN: 2
    }  # fmt: skip


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
    figure = known(pd.DataFrame(rows))
    panel = figure.axes[0]
    assert [label.get_text() for label in panel.get_xticklabels()] == [*KNOWN.values(), ALL_KNOWN]
    mean, cvar = (bars.lines[0] for bars in panel.containers)
    np.testing.assert_allclose(mean.get_ydata(), [50, 60, 70, 80, 100])
    np.testing.assert_allclose(cvar.get_ydata(), [60, 70, 80, 90, 100])
    (bar,) = panel.containers[0].lines[2]
    np.testing.assert_allclose(bar.get_segments()[1][:, 1], [56, 63])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["mean", "CVaR₀.₈"]
