"""The table of a run for a paper: settings down, scenarios across, each with success, T_total and λ̄.

Source: Endo, Honda and Ishigami (2024), Table I. Needs LaTeX's `booktabs` and nothing else.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.report.charts.panels import blocks
from benchnav.eval.report.figure_style import display_name
from benchnav.eval.report.rendering import latex, latex_label
from benchnav.eval.report.tables import bold_note, maps_in_words, rate_in_words

_MOST_ACROSS = 3
_MEASURES = (r"Succ.\ [\%]", r"$T_\mathrm{total}$ [s]", r"$\bar{\lambda}$ [\%]")


def paper_table(summary: pd.DataFrame, label: str) -> str:
    """Writes a complete `table` environment; bold is what is not significantly worse than a block's best.

    More than three blocks stand in several tabulars under each other.

    Args:
        summary: from `summary.summarise`, joined with `best.against_best`.
        label: what the table is referred to by.
    """
    known = blocks(summary)
    wide = "*" if len(known) > 1 else ""
    tabulars = [_tabular(known[i : i + _MOST_ACROSS], summary) for i in range(0, len(known), _MOST_ACROSS)]
    note = latex(f"Bold: {bold_note(summary)}") if summary["best_marked"].any() else ""
    return "\n".join(
        [
            rf"\begin{{table{wide}}}[t]",
            r"  \centering",
            rf"  \caption{{{_caption(summary)} {note}}}",
            rf"  \label{{tab:{latex_label(label)}}}",
            r"  \footnotesize",
            r"  \setlength{\tabcolsep}{4pt}",
            "\n  \\par\\medskip\n".join(tabulars),
            rf"\end{{table{wide}}}",
            "",
        ]
    )


def _caption(summary: pd.DataFrame) -> str:
    maps, groups = (summary[name] for name in ("n_maps", "n_groups"))
    count = maps_in_words(*(_span(counts) for counts in (maps, groups)))
    return (
        f"Planning results on {count} a scenario: success with its 95\\,\\% interval, "
        r"$T_\mathrm{total}$ with a failure counted as $T$ and mean traversability observed $\bar{\lambda}$, "
        r"mean $\pm$ standard deviation over episodes."
    )


def _tabular(known: list[tuple[str, pd.DataFrame]], summary: pd.DataFrame) -> str:
    labels = ["planner", *(["model"] if _several(summary, "model") else []), "risk"]
    width, count = len(_MEASURES), len(labels)
    ends = [(count + 1 + width * i, count + width * (i + 1)) for i in range(len(known))]
    titles = [rf"\multicolumn{{{width}}}{{c}}{{{latex(title)}}}" for title, _ in known]
    lines = [
        r"  \begin{tabular}{" + "l" * count + "ccc" * len(known) + "}",
        r"    \toprule",
        "    " + " & ".join([*([""] * count), *titles]) + r" \\",
        "    " + " ".join(rf"\cmidrule(lr){{{first}-{last}}}" for first, last in ends),
        "    " + " & ".join([*(name.capitalize() for name in labels), *(_MEASURES * len(known))]) + r" \\",
        *_body(known, labels),
        r"    \bottomrule",
        r"  \end{tabular}",
    ]
    return "\n".join(lines)


def _body(known: list[tuple[str, pd.DataFrame]], labels: list[str]) -> Iterator[str]:
    cells = [
        {tuple(str(row[name]) for name in labels): row for row in rows.to_dict("records")}
        for _, rows in known
    ]
    settings = list(dict.fromkeys(setting for block in cells for setting in block))
    planners = list(dict.fromkeys(setting[0] for setting in settings))
    before: tuple[str, ...] = ()
    for setting in sorted(settings, key=lambda setting: planners.index(setting[0])):
        if not before or setting[0] != before[0]:
            yield r"    \midrule"
        shown = [
            ""
            if before and setting[: place + 1] == before[: place + 1] and place < len(labels) - 1
            else latex(word)
            for place, word in enumerate((display_name(setting[0]), *setting[1:]))
        ]
        numbers = [cell for block in cells for cell in _numbers(block.get(setting))]
        yield "    " + " & ".join([*shown, *numbers]) + r" \\"
        before = setting


def _numbers(row: Mapping[Any, Any] | None) -> tuple[str, ...]:
    if row is None:
        return ("--",) * len(_MEASURES)
    rate = rate_in_words(row)
    rate = rf"\textbf{{{rate}}}" if row["best_marked"] else rate
    interval = f"{100 * row['success_low']:.0f}--{100 * row['success_high']:.0f}"
    return (
        rf"{rate} {{\scriptsize ({interval})}}",
        _spread(row["total_time_mean_s"], row["total_time_std_s"]),
        _spread(100 * row["traversability_mean"], 100 * row["traversability_std"]),
    )


def _spread(mean: float, std: float) -> str:
    if np.isnan(mean):
        return "--"
    return f"{mean:.1f}" if np.isnan(std) else rf"{mean:.1f} $\pm$ {std:.1f}"


def _span(counts: pd.Series) -> str:
    return f"{counts.min()}" if counts.nunique() == 1 else f"{counts.min()} to {counts.max()}"


def _several(summary: pd.DataFrame, name: str) -> bool:
    return summary.loc[summary[name] != NOT_USED, name].nunique() > 1
