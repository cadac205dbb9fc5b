"""Tables, tests and the figure of `benchmarks/zoo_study.py`."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from scipy.stats import kendalltau, t

from benchnav.core.figures import save, styled
from benchnav.core.resampling import sign_flips
from benchnav.eval.stats.paired_difference import mean_interval
from benchnav.models.quality.compare.paired import holm

RISKS, SPLIT = ("expected-time", "cvar:0.8"), "test/std"
SCORES = ("rmse_expected", "nll", "crps", "pinball", "tail_error", "ause")  # of each the least is the best
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
    every = doses_table(rows, table, loss, models)
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


def doses_table(rows: pd.DataFrame, table: pd.DataFrame, loss: pd.Series, models: list[Dose]) -> pd.DataFrame:
    """A row a dose, over its seeds: loss, success and time under each risk setting, and what it gains over the centre.

    The gain is in points of success over both risk settings, with its interval and p by maps, corrected by Holm.
    """
    by_dose: dict[tuple[int, str, float], list[str]] = {}
    for dose in models:
        by_dose.setdefault((dose.size, dose.what, dose.dose), []).append(dose.label)
    centre = table.loc[by_dose[max(dose.size for dose in models), "temperature", 1.0]].mean(0)
    lines = []
    for (size, what, level), labels in by_dose.items():
        own = rows[rows["model"].isin(labels)]
        gain = 100 * (table.loc[labels].mean(0) - centre).to_numpy()
        gained, least, most = (float(value[0]) for value in mean_interval(gain[None]))
        cells = {"training maps": size, "what": what, "dose": level, "pinball": loss[labels].mean()}
        for risk in RISKS:
            under = own[own["risk"] == risk]
            cells |= {
                f"success {risk}": 100 * under["success"].mean(),
                f"T_total {risk}": under["total_time_s"].mean(),
            }
        lines.append({**cells, "gain": gained, "low": least, "high": most, "p": flipped(gain, 0)})
    found = pd.DataFrame(lines)
    others = (found[["low", "high"]] != 0).any(axis=1)
    found.loc[others, "p"] = holm(found.loc[others, "p"].to_numpy())
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
            for (name, own), marker in zip(kinds.items(), "o^vDPX", strict=False):
                panel.plot(
                    own["pinball"], own[f"success {risk}"], marker, label=name, markersize=5, alpha=0.8
                )
            trained = table[table["dose"] == 1]
            panel.plot(
                trained["pinball"], trained[f"success {risk}"], "o", markersize=10, markerfacecolor="none",
                markeredgecolor="0.2", label="as trained",
            )  # fmt: skip
            panel.set(title=risk, xlabel="pinball loss of the lower fifth")
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
    rows = rows.assign(method=rows["model"].str.rsplit("-s", n=1).str[0])
    success = 100 * rows.pivot_table(index="method", columns="map", values="success")
    lines = Table(
        "method", "success [%]", "− fused", "interval", title="success, both risk settings, all seeds"
    )
    for method, own in success.iterrows():
        mean, low, high = mean_interval((own - success.loc["fused"]).to_numpy()[None])
        lines.add_row(str(method), f"{own.mean():.2f}", f"{mean[0]:+.2f}", f"{low[0]:+.2f} to {high[0]:+.2f}")
    Console(width=120).print(lines)
    quality = table[(table["split"] == SPLIT) & ~table["privileged"]].groupby("method")[list(SCORES)].mean()
    quality["success"] = success.mean(1)
    quality.to_csv(out / "zoo-ranks.csv")
    for name in SCORES:
        both = quality[[name, "success"]].dropna()
        tau, p = kendalltau(both[name], both["success"])
        print(
            f"exploratory: Kendall's τ of {name} and success over {len(both)} methods {tau:+.2f}, p = {p:.3f}"
        )
