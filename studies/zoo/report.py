"""Tables, tests and the figure of the study."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import kendalltau, t

from benchnav.stats.flips import mean_flip_p
from benchnav.stats.holm import holm
from benchnav.stats.intervals import mean_interval
from benchnav.viz.panels import line_looks
from benchnav.viz.style import risk_name, styled

RISKS, SPLIT = ("expected-time", "cvar:0.8"), "test/std"
SCORES = ("rmse_expected", "nll", "crps", "pinball", "tail_error", "ause")  # of each the least is the best
Key = TypeVar("Key")
SHOWN = ("accuracy", "miou", *SCORES[:4], "coverage", "width", *SCORES[4:], "prediction_ms", "parameters")


@dataclass(frozen=True, kw_only=True)
class Dose:
    """A model of the study: maps that it was trained on, its training seed, and what is changed about it."""

    size: int
    seed: int
    what: str = "temperature"
    dose: float = 1.0

    @property
    def label(self) -> str:
        """Its name in tables."""
        return f"n{self.size}-s{self.seed}-{self.what}-{self.dose:g}"


def slopes_by_map(loss: np.ndarray, success: np.ndarray) -> np.ndarray:
    """Least-squares slopes of success on the loss over models, one a map.

    Args:
        loss: of each model, shape [K].
        success: share of success of each model and map, shape [K, M].

    Returns:
        Success per unit of loss, shape [M].
    """
    centred = loss - loss.mean()
    return centred @ (success - success.mean(0)) / (centred @ centred)


def doses_results(
    rows: pd.DataFrame, loss: pd.Series, models: list[Dose], digest: str
) -> dict[str, pd.DataFrame | Figure]:
    """Return the test of the hypothesis, exploratory slopes and contrasts, and success and time against dose."""
    by_map = rows.pivot_table(index="model", columns="map", values="success", aggfunc="mean").loc[loss.index]
    slopes = slopes_by_map(loss.to_numpy(), by_map.to_numpy())
    hypothesis = {
        "models": len(loss),
        "maps": len(slopes),
        "episodes": len(rows),
        "hypothesis_sha256": digest,
    }
    explored = []
    for name, chosen in exploratory(models):
        values = slopes_by_map(loss[chosen].to_numpy(), by_map.loc[chosen].to_numpy())
        explored.append({"slope over": name, "models": len(chosen), **_slope(values)})
    compared = []
    for one, other in contrasts(models):
        a, b = (
            [dose.label for dose in models if (dose.size, dose.what, dose.dose) == key]
            for key in (one, other)
        )
        gain = 100 * (by_map.loc[a].mean(0) - by_map.loc[b].mean(0)).to_numpy()
        difference = {"one": one, "other": other, **_interval("points", gain), "p": mean_flip_p(gain)}
        compared.append(difference | {"loss": loss[a].mean() - loss[b].mean()})
    table = doses_table(rows, loss, models)
    return {
        "hypothesis": pd.DataFrame([hypothesis | _slope(slopes, "lower")]), "exploratory": pd.DataFrame(explored),
        "contrasts": pd.DataFrame(compared), "table": table, "doses": draw_doses(table),
    }  # fmt: skip


def _interval(name: str, values: np.ndarray) -> dict[str, float]:
    """Return a mean over maps with its 95 % interval."""
    mean, low, high = (float(end[0]) for end in mean_interval(values[None]))
    return {name: mean, "low": low, "high": high}


def _slope(slopes: np.ndarray, direction: str = "") -> dict[str, float]:
    """Return the mean of the maps' slopes in points of success per 0.001 of loss, and p of the exchange test."""
    return {**_interval("points per 0.001", 0.1 * slopes), "p": mean_flip_p(slopes, direction)}


def exploratory(models: list[Dose]) -> Iterator[tuple[str, list[str]]]:
    """Parts of the models of which the slope is told too."""
    largest = max(dose.size for dose in models)
    at_one = [dose for dose in models if dose.dose == 1]
    yield "training maps alone, temperature as trained", [dose.label for dose in at_one]
    for what in ("temperature", "soft", "brightness"):
        own = [dose for dose in models if dose.what == what or dose.dose == 1]
        yield f"{what} alone, of the largest training set", [d.label for d in own if d.size == largest]
    yield "without brightness", [dose.label for dose in models if dose.what != "brightness"]
    for seed in sorted({dose.seed for dose in models}):
        yield f"seed {seed}", [dose.label for dose in models if dose.seed == seed]


def contrasts(models: list[Dose]) -> Iterator[tuple[tuple[int, str, float], tuple[int, str, float]]]:
    """Pairs of doses on both sides of what was trained: too cautious and too bold, too sure and too vague."""
    sizes = sorted({dose.size for dose in models})
    yield (sizes[-1], "soft", 2.0), (sizes[-1], "soft", 0.0)
    for size in sizes:
        yield (size, "temperature", 0.25), (size, "temperature", 4.0)


def success_table(rows: pd.DataFrame, groups: dict[Key, list[str]], first: Key) -> pd.DataFrame:
    """A row a group of models: success and time under each risk setting, and what it gains over the first group.

    The gain is in points of success over both risk settings, with its interval and p by maps, corrected by Holm.
    """
    by_map = rows.pivot_table(index="model", columns="map", values="success", aggfunc="mean")
    centre, lines = by_map.loc[groups[first]].mean(0), {}
    for key, labels in groups.items():
        own = rows[rows["model"].isin(labels)]
        gain = 100 * (by_map.loc[labels].mean(0) - centre).to_numpy()
        cells = {}
        for risk in RISKS:
            under = own[own["risk"] == risk]
            cells |= {
                f"success {risk}": 100 * under["success"].mean(),
                f"T_total {risk}": under["total_time_s"].mean(),
            }
        lines[key] = {**cells, **_interval("gain", gain), "p": mean_flip_p(gain)}
    found = pd.DataFrame(lines).T
    others = [key != first for key in groups]
    found.loc[others, "p"] = holm(found.loc[others, "p"].to_numpy())
    return found


def doses_table(rows: pd.DataFrame, loss: pd.Series, models: list[Dose]) -> pd.DataFrame:
    """A row a dose, over its seeds, with its loss; see `success_table`."""
    groups: dict[tuple[int, str, float], list[str]] = {}
    for dose in models:
        groups.setdefault((dose.size, dose.what, dose.dose), []).append(dose.label)
    found = success_table(rows, groups, (max(dose.size for dose in models), "temperature", 1.0))
    for place, (name, values) in enumerate(
        zip(("training maps", "what", "dose"), zip(*groups, strict=True), strict=True)
    ):
        found.insert(place, name, list(values))
    found.insert(3, "pinball", [loss[labels].mean() for labels in groups.values()])
    return found.sort_values("pinball")


def draw_doses(table: pd.DataFrame) -> Figure:
    """Success over the loss, a mark a dose, a panel a risk setting."""
    with styled():
        figure = Figure(figsize=(7.2, 2.9), layout="constrained")
        panels = figure.subplots(1, len(RISKS), sharey=True)
        largest = table["training maps"].max()
        kinds = {
            **{
                f"temperature, {size} maps": table[
                    (table["what"] == "temperature") & (table["training maps"] == size)
                ]
                for size in sorted(set(table["training maps"]), reverse=True)
            },
            **{
                name: table[(table["training maps"] == largest) & (table["what"] == name)]
                for name in ("soft", "brightness")
            },
        }
        for panel, risk in zip(panels, RISKS, strict=True):
            for (name, own), look in zip(kinds.items(), line_looks(list(kinds)).values(), strict=True):
                success = own[f"success {risk}"]
                panel.plot(own["pinball"], success, label=name, alpha=0.8, **{**look, "ls": "none", "ms": 5})
            trained = table[table["dose"] == 1]
            panel.plot(
                trained["pinball"], trained[f"success {risk}"], "o", markersize=10, markerfacecolor="none",
                markeredgecolor="0.2", label="as trained",
            )  # fmt: skip
            panel.set(title=risk_name(risk), xlabel="pinball loss of the lower fifth")
        panels[0].set_ylabel("success [%]")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center", frameon=False)
    return figure


def quality(table: pd.DataFrame, against: str = "") -> pd.DataFrame:
    """Return means over seeds with the half width of their t interval; with `against`, differences to that method."""
    shown = [name for name in SHOWN if name in table and table[name].notna().any()]
    wide = table.set_index(["split", "method", "seed"])[shown]
    if against:
        first = wide.xs(against, level="method").reindex(wide.index.droplevel("method")).set_axis(wide.index)
        wide = wide - first
    rows = []
    for (split, method), seeds in wide.groupby(level=["split", "method"], sort=False):
        half = t.ppf(0.975, max(1, len(seeds) - 1)) * seeds.std() / len(seeds) ** 0.5
        cells = {
            name: f"{seeds[name].mean():.4f}" + (f" ±{half[name]:.4f}" if len(seeds) > 1 else "")
            if seeds[name].notna().any()
            else "–"
            for name in shown
        }
        rows.append({"split": split, "method": method, **cells})
    return pd.DataFrame(rows)


def zoo_results(rows: pd.DataFrame, table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return success of every method, against the fused model, and how it ranks with each score (Kendall's τ)."""
    groups: dict[str, list[str]] = {}
    for label in sorted(rows["model"].unique()):
        groups.setdefault(label.rsplit("-s", maxsplit=1)[0], []).append(label)
    chosen = table[(table["split"] == SPLIT) & ~table["privileged"]]
    scores = chosen.groupby("method")[list(SCORES)].mean()
    methods = scores.join(success_table(rows, groups, "fused")).sort_values("pinball")
    success = methods[[f"success {risk}" for risk in RISKS]].mean(axis=1)
    ranks = []
    for name in SCORES:
        has = methods[name].notna()
        tau, p = kendalltau(methods.loc[has, name], success[has])
        ranks.append({"score": name, "methods": has.sum(), "tau": tau, "p": p})
    return {"success": methods.reset_index(names="method"), "ranks": pd.DataFrame(ranks)}
