"""Tables, tests and the figure of the study.

The table `models` has one row per varied model, indexed by label. Its columns are
`size`, the number of training maps; `seed`; `what`, the varied property; `dose`, by how
much it is varied, 1 for a model as trained; and `loss`.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import kendalltau, t

from benchnav.core.tables import NOTHING
from benchnav.stats.flips import mean_flip_p
from benchnav.stats.holm import holm
from benchnav.stats.intervals import mean_interval
from benchnav.viz import legend_outside, line_looks, panel_grid, risk_name, styled

RISKS, SPLIT = ("expected-time", "cvar:0.8"), "test/std"
# Lower is better for all of these.
SCORES = (
    "rmse_expected",
    "nll",
    "crps",
    "pinball",
    "tail_error",
    "ause",
)
SHOWN = (
    "accuracy",
    "miou",
    *SCORES[:4],
    "coverage",
    "width",
    *SCORES[4:],
    "prediction_ms",
    "parameters",
)
GROUP = ["size", "what", "dose"]


def slopes_by_map(loss: pd.Series, success: pd.DataFrame) -> np.ndarray:
    """Return the least-squares slope of success on the loss over models, per map.

    Args:
        loss: loss of each model.
        success: success rate, with a row per model and a column per map.

    Returns:
        Success per unit of loss, shape [M].
    """
    centred = (loss - loss.mean()).to_numpy()
    values = success.loc[loss.index].to_numpy()
    return centred @ (values - values.mean(0)) / (centred @ centred)


def doses_results(
    rows: pd.DataFrame, models: pd.DataFrame, digest: str
) -> dict[str, pd.DataFrame | Figure]:
    """Return the test of the hypothesis, and exploratory slopes, contrasts and doses.

    Args:
        rows: rows of the episodes.
        models: table of varied models.
        digest: SHA-256 of the file of the hypothesis.
    """
    by_map = _success_by_map(rows)
    loss = models["loss"]
    hypothesis = {
        "models": len(loss),
        "maps": by_map.shape[1],
        "episodes": len(rows),
        "hypothesis_sha256": digest,
        **_slope(slopes_by_map(loss, by_map), "lower"),
    }
    explored = [
        {
            "slope over": name,
            "models": len(labels),
            **_slope(slopes_by_map(loss[labels], by_map)),
        }
        for name, labels in exploratory(models)
    ]
    groups = {
        key: list(labels)
        for key, labels in models.groupby(GROUP, sort=False).groups.items()
    }
    compared = []
    for first, second in contrasts(sorted(set(models["size"].tolist()))):
        a, b = groups[first], groups[second]
        gain = 100 * (by_map.loc[a].mean(0) - by_map.loc[b].mean(0)).to_numpy()
        row = {"one": first, "other": second, **_interval("points", gain)}
        row["p"] = mean_flip_p(gain)
        row["loss"] = loss[a].mean() - loss[b].mean()
        compared.append(row)
    centre = models["size"].max(), "temperature", 1.0
    table = success_table(rows, groups, centre)
    loss_by_dose = models.groupby(GROUP, sort=False)["loss"].mean()
    table.insert(0, "pinball", loss_by_dose.to_numpy())
    table = table.rename_axis(["training maps", "what", "dose"]).reset_index()
    table = table.sort_values("pinball")
    return {
        "hypothesis": pd.DataFrame([hypothesis]),
        "exploratory": pd.DataFrame(explored),
        "contrasts": pd.DataFrame(compared),
        "table": table,
        "doses": draw_doses(table),
    }


def _success_by_map(rows: pd.DataFrame) -> pd.DataFrame:
    return rows.pivot_table(
        index="model", columns="map", values="success", aggfunc="mean"
    )


def _interval(name: str, values: np.ndarray) -> dict[str, float]:
    """Return a mean over maps with its 95 % interval."""
    mean, low, high = (float(end[0]) for end in mean_interval(values[None]))
    return {name: mean, "low": low, "high": high}


def _slope(slopes: np.ndarray, direction: str = "") -> dict[str, float]:
    """Return the mean slope over maps with its interval, and p of the exchange test.

    The slope is in points of success per 0.001 of loss.
    """
    return {
        **_interval("points per 0.001", 0.1 * slopes),
        "p": mean_flip_p(slopes, direction),
    }


def exploratory(models: pd.DataFrame) -> Iterator[tuple[str, pd.Index]]:
    """Yield names and labels of subsets of models, for exploratory slopes."""
    yield "only training maps, temperature as trained", models.query("dose == 1").index
    largest = models[models["size"] == models["size"].max()]
    for what in ("temperature", "soft", "brightness"):
        yield (
            f"only {what}, with the largest training set",
            largest.query("what == @what or dose == 1").index,
        )
    yield "without brightness", models.query("what != 'brightness'").index
    for seed, models_of_seed in models.groupby("seed"):
        yield f"seed {seed}", models_of_seed.index


def contrasts(
    sizes: list[int],
) -> Iterator[tuple[tuple[int, str, float], tuple[int, str, float]]]:
    """Yield pairs of doses below and above that of training.

    They compare too cautious with too bold models, and too certain with too uncertain
    ones.
    """
    yield (sizes[-1], "soft", 2.0), (sizes[-1], "soft", 0.0)
    for size in sizes:
        yield (size, "temperature", 0.25), (size, "temperature", 4.0)


def success_table(
    rows: pd.DataFrame, groups: Mapping[object, list[str]], first: object
) -> pd.DataFrame:
    """Return success and time per risk setting and the gain, with a row per group.

    The gain is that over the first group of models, in points of success over both risk
    settings, with its interval and p by maps; p has Holm's correction.
    """
    by_map = _success_by_map(rows)
    centre = by_map.loc[groups[first]].mean(0)
    lines = {}
    for key, labels in groups.items():
        of_group = rows[rows["model"].isin(labels)]
        means = of_group.groupby("risk")[["success", "total_time_s"]].mean()
        gain = 100 * (by_map.loc[labels].mean(0) - centre).to_numpy()
        line = {}
        for risk in RISKS:
            success, time_s = means.loc[risk]
            line[f"success {risk}"] = 100 * success
            line[f"T_total {risk}"] = time_s
        lines[key] = {**line, **_interval("gain", gain), "p": mean_flip_p(gain)}
    table = pd.DataFrame(lines).T
    others = [key != first for key in groups]
    table.loc[others, "p"] = holm(table.loc[others, "p"].to_numpy())
    return table


@styled()
def draw_doses(table: pd.DataFrame) -> Figure:
    """Draw success over the loss: one marker per dose, one panel per risk setting."""
    sizes = table["training maps"].astype(str)
    is_temperature = table["what"] == "temperature"
    kind = table["what"].where(~is_temperature, "temperature, " + sizes + " maps")
    by_size = table.sort_values("training maps", ascending=False, kind="stable").index
    looks = line_looks(list(kind[by_size]))
    titles = [risk_name(risk) for risk in RISKS]
    figure, places = panel_grid(titles, len(RISKS), 2.3, 0.6, sharey=True)
    trained = table[table["dose"] == 1]
    for (panel,), risk in zip(places, RISKS, strict=True):
        for name, look in looks.items():
            points = table[kind == name]
            style: dict[str, Any] = look | {"ls": "none", "ms": 5, "label": name}
            panel.plot(points["pinball"], points[f"success {risk}"], **style)
        circled: dict[str, Any] = {
            "ms": 10,
            "mfc": "none",
            "mec": "0.2",
            "label": "as trained",
        }
        panel.plot(trained["pinball"], trained[f"success {risk}"], "o", **circled)
        panel.set_xlabel("pinball loss of the lower fifth")
    places[0][0].set_ylabel("success [%]")
    legend_outside(figure)
    return figure


def quality(table: pd.DataFrame, against: str = "") -> pd.DataFrame:
    """Return means over seeds with the half width of their t interval.

    With `against`, they are of the differences from that method.
    """
    shown = [name for name in SHOWN if name in table and table[name].notna().any()]
    wide = table.set_index(["split", "method", "seed"])[shown]
    if against:
        first = wide.xs(against, level="method")
        first = first.reindex(wide.index.droplevel("method"))
        wide = wide - first.set_axis(wide.index)
    methods = wide.groupby(level=["split", "method"], sort=False)
    return methods.agg(_over_seeds).reset_index()


def _over_seeds(values: pd.Series) -> str:
    """Format a mean over seeds, with several also the half width of its t interval."""
    if values.isna().all():
        return NOTHING
    text = f"{values.mean():.4f}"
    if len(values) > 1:
        half = t.ppf(0.975, len(values) - 1) * values.std() / len(values) ** 0.5
        text += f" ±{half:.4f}"
    return text


def ranked(
    rows: pd.DataFrame, table: pd.DataFrame, labels: Iterable[str]
) -> dict[str, pd.DataFrame]:
    """Return the success of all methods, and its rank correlation with each score.

    Gains are over the first method. The rank correlation is Kendall's τ.
    """
    groups: dict[object, list[str]] = {}
    for label in labels:
        groups.setdefault(label.rsplit("-s", maxsplit=1)[0], []).append(label)
    chosen = table[(table["split"] == SPLIT) & ~table["privileged"]]
    scores = chosen.groupby("method")[list(SCORES)].mean()
    successes = success_table(rows, groups, next(iter(groups)))
    methods = scores.join(successes).sort_values("pinball")
    success = methods[[f"success {risk}" for risk in RISKS]].mean(axis=1)
    ranks = []
    for name, values in methods[list(SCORES)].items():
        scored = values.dropna()
        tau, p = kendalltau(scored, success[scored.index])
        ranks.append({"score": name, "methods": len(scored), "tau": tau, "p": p})
    return {
        "success": methods.reset_index(names="method"),
        "ranks": pd.DataFrame(ranks),
    }
