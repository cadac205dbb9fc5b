"""The studies whose hypotheses are fixed before their run, from their maps to their tables.

    python benchmarks/study.py knowledge maps                  # makes the maps, or checks the digests of those there
    python benchmarks/study.py knowledge estimate primary      # ten maps a condition: how long the whole takes
    python benchmarks/study.py knowledge develop               # the hypotheses on maps to develop on; then their power
    python benchmarks/study.py knowledge run primary known     # hours; killed and begun again it goes on
    python benchmarks/study.py knowledge report                # tables, and the figure

`knowledge` is docs/studies/knowledge.md: `primary` holds the hypotheses; `known` and `known-mppi` are part A, `near`
part B, `sensitivity` and `kernel` part C, `seen` has old maps, `nugget` maps to develop on. `cost` is risk on the
cost: `levels` drives each arm at each level on maps to develop on, `primary` holds the hypotheses, `frontier` the
levels that these leave out and `own` another time to go, both and `primary` once more with `--maps 50 --out
runs/first50`, and `best` the optimal planners. `confirmation` tests on new maps what these studies found by looking.
Parts are suites of docs/knowledge, docs/cost and docs/confirmation, each with a run of its own. Maps and runs lie in
the folders `--maps_in` and `--out`, and `--maps` takes only the first maps, to try it.
"""

import argparse
import hashlib
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.stats import norm

from benchnav.core.tables import Table, to_markdown
from benchnav.datagen import TerrainDataset
from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.report.write import read_report
from benchnav.viz.style import (
    LINE_COLOURS,
    MARKERS,
    TWO_COLUMNS_IN,
    legend_outside,
    risk_name,
    save,
    styled,
)

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True, kw_only=True)
class Study:
    """A study.

    Args:
        name: of the study, which its runs' names begin with, and of its folder in docs.
        page: which tells of it, in docs/studies.
        parts: its suites.
        development: maps on which its hypotheses were developed.
        seed: of the episodes there.
    """

    name: str
    page: str
    parts: tuple[str, ...]
    development: str = "stakes-v1-seed1"
    seed: int = 1

    @property
    def suites(self) -> Path:
        """Folder of its suites and of the digests of its maps."""
        return ROOT / "docs" / self.name

    @property
    def developed(self) -> str:
        """Name of the run by which the power of its hypotheses is known."""
        return f"{self.name}-developed"


STUDIES = {
    "knowledge": Study(
        name="knowledge",
        page="knowledge.md",
        parts=("primary", "known", "known-mppi", "near", "sensitivity", "kernel", "seen", "nugget"),
    ),
    "cost": Study(name="cost", page="risk.md", parts=("levels", "primary", "frontier", "own", "best")),
    "confirmation": Study(name="confirmation", page="risk.md", parts=("primary",)),
}
SPLIT = "test/std"
ALPHA = 0.05
# What is known, by sensor of the ground and belief, from nothing to all.
KNOWN = {
    ("–", "static"): "the prediction",
    ("contact", "copula"): "λ under\nthe robot",
    ("probe:1", "copula"): "λ within\n1 m",
    ("probe:2", "copula"): "λ within\n2 m",
}
ALL_KNOWN = "all of λ"


def command(program: str, *words: object) -> None:
    """Runs one of our commands from the root of the repository, where the suites' parts are."""
    if code := subprocess.run(
        [Path(sys.executable).with_name(program), *map(str, words)], cwd=ROOT
    ).returncode:
        sys.exit(code)  # it has said why


def suite_of(study: Study, part: str, maps_in: Path, maps: int) -> dict[str, Any]:
    """A part's suite, on maps that lie in a folder; of the first maps alone where a number is given."""
    suite: dict[str, Any] = yaml.safe_load((study.suites / f"{part}.yaml").read_text())
    return suite | {"data": str(maps_in / f"{suite['data']}.h5")} | ({"maps": maps} if maps else {})


# --- maps -------------------------------------------------------------------------------------------


def make_maps(study: Study, maps_in: Path) -> None:
    """Makes the maps that are not there, and refuses others than those of which the digests were fixed."""
    known: Mapping[str, Mapping[str, Any]] = yaml.safe_load((study.suites / "data.yaml").read_text())
    maps_in.mkdir(parents=True, exist_ok=True)
    for name, about in known.items():
        path = maps_in / f"{name}.h5"
        if not path.exists():
            command("benchnav-datagen", "create", *about["create"], "--splits", f"[{SPLIT}]", "--out", path)
        found = TerrainDataset(path).splits[SPLIT]["digest"]
        if found != about["digest"]:
            sys.exit(f"Expected maps of digest {about['digest']} in {path}, got {found}.")
        print(f"{name}: {found}")


# --- runs -------------------------------------------------------------------------------------------


def drive(suite: dict[str, Any], name: str, out: Path, jobs: int) -> None:
    """Runs a suite into a folder of this name, or what is left of it."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"{name}.yaml"
    path.write_text(yaml.safe_dump(suite, sort_keys=False, allow_unicode=True))
    command("benchnav-eval", "run", "--config", path, "--out", out / name, "--jobs", jobs)


def run(study: Study, parts: list[str], out: Path, maps_in: Path, maps: int, jobs: int) -> None:
    """Runs parts, one after another."""
    for part in parts:
        begun = time.perf_counter()
        drive(suite_of(study, part, maps_in, maps), f"{study.name}-{part}", out, jobs)
        print(f"-- {part}: {time.perf_counter() - begun:.0f} s", flush=True)


def estimate(study: Study, parts: list[str], out: Path, maps_in: Path, maps: int, jobs: int) -> None:
    """Says how long parts take, by some maps of each condition."""
    maps = maps or 10
    for part in parts:
        whole = suite_of(study, part, maps_in, 0)
        some = {name: value for name, value in whole.items() if name != "hypotheses"}
        begun = time.perf_counter()
        drive(some | {"maps": maps, "realisations": 1}, f"estimate-{study.name}-{part}", out, jobs)
        seconds = time.perf_counter() - begun
        hours = seconds * whole["maps"] * whole.get("realisations", 1) / maps / 3600
        print(
            f"{part}: {seconds:.0f} s for {maps} maps; {hours:.1f} hours of {jobs} processes in all",
            flush=True,
        )


def develop(study: Study, out: Path, maps_in: Path, maps: int, jobs: int) -> None:
    """Runs the conditions of the hypotheses on the maps that the study was developed on, and tells the tests' power."""
    suite = suite_of(study, "primary", maps_in, maps)
    suite |= {
        "data": str(maps_in / f"{study.development}.h5"),
        "seed": study.seed,
        "maps": min(200, suite["maps"]),
    }
    drive(suite, study.developed, out, jobs)
    print(power(study, out))


def power(study: Study, out: Path) -> str:
    """The power of each hypothesis, by what was found on the maps that the study was developed on.

    For the first and the last place of Holm's correction, where the difference is the one that was found; of
    equivalence and non-inferiority also where there is none. Of differences also the smallest that is shown with a
    power of 0.8 in the first place.
    """
    maps = yaml.safe_load((study.suites / "primary.yaml").read_text())["maps"]
    report, rows = read_report(out / study.developed), []
    for number, row in enumerate(report.tests.to_dict("records"), start=1):
        # Of the mean over so many maps.
        error = (row["high"] - row["low"]) / 2 / norm.ppf(0.975) * np.sqrt(row["n_maps"] / maps)
        found, none = (
            " to ".join(
                f"{power_of(row, error, alpha, difference):.2f}"
                for alpha in (ALPHA / len(report.tests), ALPHA)
            )
            for difference in (row["difference"], 0.0)
        )
        none = none if row["kind"] in ("equivalence", "non-inferiority") else "–"
        ends = f"{row['low']:+.1f} to {row['high']:+.1f}"
        tails = 1 if row["direction"] else 2
        least = error * (norm.ppf(1 - ALPHA / len(report.tests) / tails) + norm.ppf(0.8))
        smallest = f"{least:.1f}" if row["kind"] == "difference" else "–"
        rows.append((str(number), row["claim"], f"{row['difference']:+.2f} ({ends})", found, none, smallest))
    headings = ("", "hypothesis", "found on other maps (95 %)", "power, if so", "power, if no difference")
    headings = (*headings, "smallest difference with a power of 0.8")
    return to_markdown(Table(headings=headings, labels=2, rows=tuple(rows)))


def power_of(row: Mapping[Any, Any], error: float, alpha: float, difference: float) -> float:
    """Chance that a hypothesis is supported, where the estimate of this difference is normal with this error."""
    kind, margin = row["kind"], row["margin"]
    if kind == "equivalence":
        ends = (
            (margin + away) / max(error, 1e-9) - norm.ppf(1 - alpha) for away in (difference, -difference)
        )
        return max(0.0, float(sum(norm.cdf(end) for end in ends)) - 1)
    # Of a difference either way the side that it lies on counts.
    gain = difference * (-1 if row["direction"] == "lower" else 1) if row["direction"] else abs(difference)
    least = -margin if kind == "non-inferiority" else margin
    tails = 1 if row["direction"] else 2
    return float(norm.cdf((gain - least) / max(error, 1e-9) - norm.ppf(1 - alpha / tails)))


# --- what is reported -------------------------------------------------------------------------------


def known_of(row: Mapping[Any, Any]) -> str:
    """What is known in a condition; empty where it is none of the study's main series."""
    if row["model"] == "clairvoyant":
        return ALL_KNOWN
    return KNOWN.get((row["ground"], row["belief"]), "") if row["sensor"] == "full" else ""


@styled()
def knowledge_figure(summary: pd.DataFrame) -> Figure:
    """Success over what is known, a line a risk setting, a panel a planner and model; bars are 95 % intervals."""
    rows = summary[summary["world"] == "stakes"]
    rows = rows.assign(known=[known_of(row) for row in rows.to_dict("records")])
    rows = rows[(rows["known"] != "") & rows["planner"].isin(["astar_dwa", "astar_mppi"])]
    names = [*KNOWN.values(), ALL_KNOWN]
    panels = [
        pair
        for pair in dict.fromkeys(zip(rows["planner"], rows["model"], strict=True))
        if pair[1] != "clairvoyant"
    ]
    figure = Figure(figsize=(TWO_COLUMNS_IN, 2.3 * -(-len(panels) // 2) + 0.4), layout="constrained")
    axes = figure.subplots(-(-len(panels) // 2), 2, sharex=True, sharey=True, squeeze=False).flat
    risks = [risk for risk in dict.fromkeys(rows["risk"]) if risk != NOT_USED]
    for panel, (planner, model) in zip(axes, panels, strict=False):
        own = rows[(rows["planner"] == planner) & rows["model"].isin([model, "clairvoyant"])]
        for place, risk in enumerate(risks):
            # The clairvoyant has one row for all risk settings.
            line = own[own["risk"].isin([risk, NOT_USED])].drop_duplicates("known").set_index("known")
            line = line.reindex([name for name in names if name in line.index])
            at = [names.index(name) + 0.1 * (place - (len(risks) - 1) / 2) for name in line.index]
            middle, low, high = (100 * line[f"success_{end}"].to_numpy() for end in ("rate", "low", "high"))
            panel.errorbar(
                at, middle, yerr=[middle - low, high - middle], color=LINE_COLOURS[place], marker=MARKERS[place],
                ms=4, lw=1.1, elinewidth=0.8, capsize=2, label=risk_name(risk),
            )  # fmt: skip
        panel.set_title(f"{'A*+DWA' if planner == 'astar_dwa' else 'A*+MPPI'}, model {model}")
        panel.set_xticks(range(len(names)), names)
        panel.grid(axis="y", color="0.93")
        panel.set_ylabel("success [%]")
    legend_outside(figure, columns=len(risks))
    return figure


@styled()
def frontier_figure(summary: pd.DataFrame) -> Figure:
    """Success over the time to the goal, a line an arm through its levels, with 95 % intervals of success.

    A panel a planner; in the row below with entrapment. Marks grow with the level.
    """
    arms = [arm_of(row) for row in summary.to_dict("records")]
    rows = summary.assign(
        **{name: [arm[name] for arm in arms] for name in ("planner", "arm", "held", "level")}
    )
    rows = rows[rows["arm"] != ""]
    panels = list(dict.fromkeys(rows["planner"]))
    figure = Figure(figsize=(TWO_COLUMNS_IN, 4.6), layout="constrained")
    axes = figure.subplots(2, len(panels), sharex="row", sharey=True, squeeze=False)
    handles: dict[str, Line2D] = {}
    for (held, planner), panel in zip(product((False, True), panels), axes.flat, strict=True):
        for place, arm in enumerate(ARMS):
            own = rows[(rows["planner"] == planner) & (rows["arm"] == arm) & (rows["held"] == held)]
            own = own.sort_values("level")
            middle, low, high = (100 * own[f"success_{end}"].to_numpy() for end in ("rate", "low", "high"))
            time_s = own["success_time_mean_s"].to_numpy()
            looks = {"color": LINE_COLOURS[place], "marker": MARKERS[place]}
            panel.errorbar(
                time_s, middle, yerr=[middle - low, high - middle], color=LINE_COLOURS[place], lw=1.1, elinewidth=0.6,
                capsize=1.5,
            )  # fmt: skip
            panel.scatter(time_s, middle, s=(3 + 5 * own["level"]) ** 2, zorder=3, lw=0, **looks)
            handles[arm] = Line2D([], [], ms=5, lw=1.1, label=arm, **looks)
        panel.set_title(f"{planner}, entrapment" if held else planner)
        panel.grid(color="0.93")
    for panel in axes[-1]:
        panel.set_xlabel("mean time of those that arrive [s]")
    for panel in axes[:, 0]:
        panel.set_ylabel("success [%]")
    legend_outside(figure, list(handles.values()), len(ARMS))
    return figure


ARMS = ("CVaR of λ", "CVaR of time", "CVaR of the cost")
# Of each planner of the study its name in the figure.
FAMILIES = {"mppi": "MPPI", "astar_mppi": "A*+MPPI"}


def arm_of(row: Mapping[Any, Any]) -> dict[str, Any]:
    """Planner, arm and level of a condition, and whether it has entrapment; other conditions have no arm."""
    part, _, kind = row["planner"].partition(" ")
    name, _, level = row["risk"].partition(":")
    found = {"planner": FAMILIES.get(part, ""), "held": "held" in kind, "arm": "", "level": 0.0}
    if part not in FAMILIES or row["model"] == "clairvoyant":
        return found
    if "cost" in kind:
        return found | {"arm": "CVaR of the cost", "level": float(kind.split()[1])}
    arm = "CVaR of λ" if name in ("cvar", "mean") else "CVaR of time"
    return found | {"arm": arm, "level": float(level or 0)}


def knowledge_report(out: Path) -> None:
    """Draws success over what is known."""
    summaries = [out / f"knowledge-{part}" / "summary.csv" for part in ("known", "known-mppi")]
    _draw(summaries, knowledge_figure, "knowledge.png")


def cost_report(out: Path) -> None:
    """Draws the frontiers, of the runs that are on the first 50 maps alike."""
    summaries = [out / "first50" / f"cost-{part}" / "summary.csv" for part in ("primary", "frontier")]
    _draw(summaries, frontier_figure, "risk-cost.png")


def _draw(summaries: list[Path], figure: Callable[[pd.DataFrame], Figure], name: str) -> None:
    if all(path.exists() for path in summaries):
        path = ROOT / "docs/figures" / name
        save(figure(pd.concat(map(pd.read_csv, summaries))), path, "png", dpi=200)
        print(f"wrote {path}")
    else:
        print(f"no figure: it needs {' and '.join(str(path.parent) for path in summaries)}")


def report(study: Study, out: Path) -> None:
    """Writes the figure, the tables of the page where there is one, and the power where it is known."""
    print(f"hypotheses {hashlib.sha256((study.suites / 'primary.yaml').read_bytes()).hexdigest()}")
    {"knowledge": knowledge_report, "cost": cost_report}.get(study.name, lambda out: None)(out)
    page = ROOT / "docs/studies" / study.page
    subprocess.run([sys.executable, ROOT / "benchmarks/tables.py", page, "--runs", out], check=True)
    if (out / study.developed / "episodes.parquet").exists():
        print(power(study, out))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", choices=list(STUDIES))
    parser.add_argument("what", choices=["maps", "estimate", "develop", "power", "run", "report"])
    parser.add_argument("parts", nargs="*", default=[], help="of the study; all if none is named")
    parser.add_argument("--out", type=Path, default=Path("runs"), help="folder of the runs")
    parser.add_argument("--maps_in", type=Path, default=Path("datasets"), help="folder of the maps")
    parser.add_argument(
        "--maps", type=int, default=0, help="of each condition, in place of what the suites say"
    )
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    study, out, maps_in = STUDIES[given.study], given.out.resolve(), given.maps_in.resolve()
    parts = given.parts or list(study.parts)
    if unknown := set(parts) - set(study.parts):
        parser.error(f"Expected parts among {', '.join(study.parts)}, got {', '.join(sorted(unknown))}.")
    if given.what == "maps":
        make_maps(study, maps_in)
    elif given.what in ("estimate", "run"):
        {"estimate": estimate, "run": run}[given.what](study, parts, out, maps_in, given.maps, given.jobs)
    elif given.what == "develop":
        develop(study, out, maps_in, given.maps, given.jobs)
    elif given.what == "power":
        print(power(study, out))
    else:
        report(study, out)


if __name__ == "__main__":
    main()
