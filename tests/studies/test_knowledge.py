"""The study of knowledge: its hypotheses, its suites and its figure."""

import numpy as np
import pandas as pd

from studies.knowledge.figure import ALL_KNOWN, KNOWN, known


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
    assert [label.get_text() for label in panel.get_xticklabels()] == [
        *KNOWN.values(),
        ALL_KNOWN,
    ]
    mean, cvar = panel.lines
    np.testing.assert_allclose(mean.get_ydata(), [50, 60, 70, 80, 100])
    np.testing.assert_allclose(cvar.get_ydata(), [60, 70, 80, 90, 100])
    np.testing.assert_allclose(panel.collections[0].get_segments()[1][:, 1], [56, 63])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "mean",
        "CVaR₀.₈",
    ]
