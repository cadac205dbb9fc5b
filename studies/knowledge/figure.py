"""Success over the observations of λ: one curve per risk setting.

There is one panel per planner and model.
"""

from collections.abc import Mapping
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from benchnav.viz import planner_name, risk_name, styled
from studies.curves import SUCCESS, draw_curves

# Labels of what is known of λ, by traversability sensor and belief, from least to most.
KNOWN = {
    ("–", "static"): "the prediction",
    ("contact", "copula"): "λ under\nthe robot",
    ("probe:1", "copula"): "λ within\n1 m",
    ("probe:2", "copula"): "λ within\n2 m",
}
ALL_KNOWN = "all of λ"


def known_of(row: Mapping[Any, Any]) -> str:
    """Return the label of what is known in a condition; if not plotted, empty."""
    if row["model"] == "clairvoyant":
        return ALL_KNOWN
    return (
        KNOWN.get((row["ground"], row["belief"]), "") if row["sensor"] == "full" else ""
    )


@styled()
def known(summary: pd.DataFrame) -> Figure:
    """Draw the figure from the rows of `known` and `known-mppi`."""
    rows = summary[
        (summary["world"] == "stakes")
        & summary["planner"].isin(("astar_dwa", "astar_mppi"))
    ]
    rows = rows.assign(known=[known_of(row) for row in rows.to_dict("records")])
    rows = rows[rows["known"] != ""]
    # The clairvoyant's one row stands for all models and risk settings.
    is_told = rows["model"] == "clairvoyant"
    settings = rows.loc[~is_told, ["planner", "model", "risk"]].drop_duplicates()
    rows = pd.concat(
        [
            rows[~is_told],
            rows[is_told].drop(columns=["model", "risk"]).merge(settings, on="planner"),
        ]
    )
    names = [*KNOWN.values(), ALL_KNOWN]
    risks = list(dict.fromkeys(rows["risk"]))
    beside = 0.1 * (rows["risk"].map(risks.index) - (len(risks) - 1) / 2)
    rows = rows.assign(
        panel=rows["planner"].map(planner_name) + ", model " + rows["model"],
        line=rows["risk"].map(risk_name),
        x=rows["known"].map(names.index) + beside,
    )
    figure, panels = draw_curves(
        rows.sort_values("x"), {"success": SUCCESS}, high_in=2.3
    )
    for panel in panels.values():
        panel.set_xticks(range(len(names)), names)
    return figure
