"""Success over what is known: a curve a risk setting, a panel a planner and model."""

from collections.abc import Mapping
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from benchnav.eval.experiment.condition import NOT_USED
from benchnav.viz.style import TWO_COLUMNS_IN, legend_outside, risk_name, styled
from studies.curves import draw_curve

# What is known, by sensor of λ and belief, from nothing to all.
KNOWN = {
    ("–", "static"): "the prediction",
    ("contact", "copula"): "λ under\nthe robot",
    ("probe:1", "copula"): "λ within\n1 m",
    ("probe:2", "copula"): "λ within\n2 m",
}
ALL_KNOWN = "all of λ"
PLANNERS = {"astar_dwa": "A*+DWA", "astar_mppi": "A*+MPPI"}


def known_of(row: Mapping[Any, Any]) -> str:
    """Return what is known in a condition; empty where it is none of the study's main series."""
    if row["model"] == "clairvoyant":
        return ALL_KNOWN
    return KNOWN.get((row["ground"], row["belief"]), "") if row["sensor"] == "full" else ""


@styled()
def known(summary: pd.DataFrame) -> Figure:
    """Draw the figure from the rows of `known` and `known-mppi`."""
    rows = summary[(summary["world"] == "stakes") & summary["planner"].isin(PLANNERS)]
    rows = rows.assign(known=[known_of(row) for row in rows.to_dict("records")])
    rows = rows[rows["known"] != ""]
    names = [*KNOWN.values(), ALL_KNOWN]
    pairs = dict.fromkeys(zip(rows["planner"], rows["model"], strict=True))
    panels = [pair for pair in pairs if pair[1] != "clairvoyant"]
    down = -(-len(panels) // 2)
    figure = Figure(figsize=(TWO_COLUMNS_IN, 2.3 * down + 0.4), layout="constrained")
    axes = figure.subplots(down, 2, sharex=True, sharey=True, squeeze=False).flat
    risks = [risk for risk in dict.fromkeys(rows["risk"]) if risk != NOT_USED]
    for panel, (planner, model) in zip(axes, panels, strict=False):
        in_panel = rows[(rows["planner"] == planner) & rows["model"].isin([model, "clairvoyant"])]
        for place, risk in enumerate(risks):
            # The clairvoyant has one row for all risk settings.
            curve = (
                in_panel[in_panel["risk"].isin([risk, NOT_USED])].drop_duplicates("known").set_index("known")
            )
            curve = curve.reindex([name for name in names if name in curve.index])
            at = [names.index(name) + 0.1 * (place - (len(risks) - 1) / 2) for name in curve.index]
            draw_curve(panel, at, curve, place, risk_name(risk))
        panel.set_title(f"{PLANNERS[planner]}, model {model}")
        panel.set_xticks(range(len(names)), names)
    legend_outside(figure, columns=len(risks))
    return figure
