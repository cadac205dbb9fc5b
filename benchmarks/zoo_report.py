"""Tables, tests and the figure of `benchmarks/zoo_study.py`."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from scipy.stats import kendalltau, t

from benchnav.core.resampling import holm, sign_flips
from benchnav.eval.stats.paired_difference import mean_interval
from benchnav.viz.panels import line_looks
from benchnav.viz.style import risk_name, save, styled

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


def report_doses(out: Path, rows: pd.DataFrame, loss: pd.Series, models: list[Dose], digest: str) -> None:
    """Prints the test of the hypothesis, and success and time against dose; writes both to files."""
    table = rows.pivot_table(index="model", columns="map", values="success", aggfunc="mean").loc[loss.index]
    slopes = slopes_by_map(loss.to_numpy(), table.to_numpy())
    mean, low, high = mean_interval(slopes[None])
    found = {
        "models": len(loss), "maps": len(slopes), "episodes": len(rows),
        "slope_points_per_0.001": 0.1 * float(mean[0]), "interval": [0.1 * float(low[0]), 0.1 * float(high[0])],
        "p_one_sided": flipped(slopes, -1), "hypothesis_sha256": digest,
    }  # fmt: skip
    (out / "hypothesis.json").write_text(json.dumps(found, indent=1))
    print(json.dumps(found, indent=1))
    for label, chosen in exploratory(models):
        own = slopes_by_map(loss[chosen].to_numpy(), table.loc[chosen].to_numpy())
        mean, low, high = mean_interval(own[None])
        said = f"{0.1 * mean[0]:+.3f} ({0.1 * low[0]:+.3f} to {0.1 * high[0]:+.3f}) points per 0.001"
        print(f"exploratory: {label}, {len(chosen)} models: {said}, two-sided p = {flipped(own, 0):.4f}")
    for one, other in contrasts(models):
        labels = [
            [dose.label for dose in models if (dose.size, dose.what, dose.dose) == key]
            for key in (one, other)
        ]
        gain = 100 * (table.loc[labels[0]].mean(0) - table.loc[labels[1]].mean(0)).to_numpy()
        mean, low, high = mean_interval(gain[None])
        said = f"{mean[0]:+.1f} points ({low[0]:+.1f} to {high[0]:+.1f}), p = {flipped(gain, 0):.4f}"
        print(
            f"exploratory: {one} − {other}: {said}; loss {loss[labels[0]].mean() - loss[labels[1]].mean():+.4f}"
        )
    every = doses_table(rows, loss, models)
    every.to_csv(out / "doses.csv", index=False)
    print_frame("success and time against dose, over seeds", every)
    save(draw_doses(every), out / "zoo-doses.png", "png", dpi=200)


def flipped(values: np.ndarray, sign: int) -> float:
    """p of a mean over maps by flipping signs: of one as low (−1), or as far from 0 (0)."""
    drawn, seen = sign_flips(len(values)) @ values, values.sum()
    return float((drawn <= seen + 1e-12 if sign < 0 else abs(drawn) >= abs(seen) - 1e-12).mean())


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
        gained, least, most = (float(value[0]) for value in mean_interval(gain[None]))
        cells = {}
        for risk in RISKS:
            under = own[own["risk"] == risk]
            cells |= {
                f"success {risk}": 100 * under["success"].mean(),
                f"T_total {risk}": under["total_time_s"].mean(),
            }
        lines[key] = {**cells, "gain": gained, "low": least, "high": most, "p": flipped(gain, 0)}
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


def print_frame(title: str, frame: pd.DataFrame) -> None:
    """Prints a table."""
    printed = Table(*(str(name) for name in frame.columns), title=title)
    for _, line in frame.iterrows():
        printed.add_row(*(f"{value:.4g}" if isinstance(value, float) else str(value) for value in line))
    Console(width=200).print(printed)


def print_quality(title: str, table: pd.DataFrame, against: str = "") -> None:
    """Prints means over seeds with the half width of their t interval; with `against`, differences to that method."""
    shown = [name for name in SHOWN if name in table and table[name].notna().any()]
    wide = table.set_index(["split", "method", "seed"])[shown]
    if against:
        wide = wide - wide.xs(against, level="method").reindex(wide.index.droplevel("method")).set_axis(
            wide.index
        )
    printed = Table("split", "method", *shown, title=title)
    for (split, method), own in wide.groupby(level=["split", "method"], sort=False):
        half = t.ppf(0.975, len(own) - 1) * own.std() / len(own) ** 0.5 if len(own) > 1 else own.std()
        cells = (
            f"{own[name].mean():.4f}" + (f" ±{half[name]:.4f}" if len(own) > 1 else "")
            if own[name].notna().any()
            else "–"
            for name in shown
        )
        printed.add_row(str(split), str(method), *cells)
    Console(width=240).print(printed)


def report_zoo(out: Path, rows: pd.DataFrame, table: pd.DataFrame) -> None:
    """Prints success of every method, against the fused model, and how it ranks with each score."""
    groups: dict[str, list[str]] = {}
    for label in sorted(rows["model"].unique()):
        groups.setdefault(label.rsplit("-s", maxsplit=1)[0], []).append(label)
    quality = table[(table["split"] == SPLIT) & ~table["privileged"]].groupby("method")[list(SCORES)].mean()
    every = quality.join(success_table(rows, groups, "fused")).sort_values("pinball")
    every.to_csv(out / "zoo-success.csv")
    print_frame(
        "the methods: scores, success and time, over seeds",
        every.reset_index().drop(columns=list(SCORES[:3])),
    )
    success = every[[f"success {risk}" for risk in RISKS]].mean(axis=1)
    for name in SCORES:
        has = every[name].notna()
        tau, p = kendalltau(every.loc[has, name], success[has])
        print(
            f"exploratory: Kendall's τ of {name} and success over {has.sum()} methods {tau:+.2f}, p = {p:.3f}"
        )
