"""Tables as text, and one way of writing each: in Markdown, in LaTeX, and for a
terminal.

The HTML page of a report reads the same value in its template. CSV holds numbers rather
than text; pandas writes it.
"""

import io
import re
import shutil
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

# Stands for a number or a name that there is not.
NOTHING = "–"

# Wide enough for any table where there is no terminal to fit it into.
_UNBROKEN = 400
_WIDEST_LINE = 56  # of a list in a cell, that is not broken

# Words before the characters that they begin with.
_LATEX = {
    "λ̄": r"$\bar{\lambda}$",
    "λ̂": r"$\hat{\lambda}$",
    "T_total": r"$T_\mathrm{total}$",
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "[": "{[}",
    "±": r"$\pm$",
    "–": "--",
    "λ": r"$\lambda$",
    "ω": r"$\omega$",
    "θ": r"$\theta$",
    "α": r"$\alpha$",
    "ε": r"$\varepsilon$",
    "σ": r"$\sigma$",
    "µ": r"$\mu$",
    "≥": r"$\geq$",
    "≤": r"$\leq$",
    "×": r"$\times$",
    "→": r"$\to$",
    "·": r"$\cdot$",
    "Δ": r"$\Delta$",
    "−": "$-$",
    "¶": r"\P{}",
}
_LATEX |= {
    raised: rf"\textsuperscript{{{digit}}}" for digit, raised in enumerate("⁰¹²³⁴⁵⁶⁷⁸⁹")
}
# Digits below the line, with the dots between them.
_LOWERED = re.compile("[₀-₉]+(?:\\.[₀-₉]+)?")
_RAISED = str.maketrans("₀₁₂₃₄₅₆₇₈₉", "0123456789")
_WRITTEN = re.compile("|".join([_LOWERED.pattern, *map(re.escape, _LATEX)]))
_MINUS = re.compile(r"(?<![\w-])-(?=\d)")
_COLOUR = re.compile(r"#[0-9a-f]{6}")


class Bold(str):
    """A cell of a table that is set in bold."""

    bold = True


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table as text.

    Args:
        headings: one a column, those of labels first; a line break within one is kept
            in a terminal alone.
        rows: a cell a column. What stands in brackets at a cell's end is set smaller in
            LaTeX.
        labels: number of columns that are labels.
        numbers: whether the other columns hold a number each, which is set right.
        title: over the table, in a terminal alone.
        notes: lines under the table.
        bold_note: what bold means.
        explained: what columns hold, (heading, sentence).
        groups: titles over the columns that are no labels, each over as many, in LaTeX
            alone.
        rules: rows that a line is drawn over, in LaTeX alone.
    """

    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    labels: int = 1
    numbers: bool = False
    title: str = ""
    notes: tuple[str, ...] = ()
    bold_note: str = ""
    explained: tuple[tuple[str, str], ...] = ()
    groups: tuple[str, ...] = ()
    rules: frozenset[int] = frozenset()


def to_markdown(table: Table) -> str:
    """Writes a table in Markdown, with its notes under it and what its columns hold."""
    right = "---:" if table.numbers else "---"
    lines = [
        _markdown_row(markdown(_one_line(heading)) for heading in table.headings),
        "|"
        + "---|" * table.labels
        + f"{right}|" * (len(table.headings) - table.labels),
    ]
    for row in table.rows:
        cells = (
            f"**{markdown(cell)}**" if isinstance(cell, Bold) else markdown(cell)
            for cell in row
        )
        lines.append(_markdown_row(cells))
    notes = [*table.notes, *([f"Bold: {table.bold_note}"] if table.bold_note else [])]
    lines += [f"\n{markdown(note)}" for note in notes]
    if table.explained:
        lines += [
            "",
            *(
                f"- **{markdown(heading)}**: {markdown(text)}"
                for heading, text in table.explained
            ),
        ]
    return "\n".join([*lines, ""])


def to_latex(
    tables: Sequence[Table],
    caption: str,
    label: str,
    wide: bool = True,
    size: str = "scriptsize",
) -> str:
    """Writes a complete environment, with notes under the tables. Needs LaTeX's
    `booktabs` and nothing else.

    Args:
        tables: one, or several under each other; labels are set left, all else is
            centred.
        caption: what is shown.
        label: what it is referred to by.
        wide: as wide as the page, not as a column.
        size: of the text, one of LaTeX's.
    """
    environment = "table*" if wide else "table"
    notes = dict.fromkeys(note for table in tables for note in table.notes)
    return "\n".join(
        [
            rf"\begin{{{environment}}}[t]",
            r"  \centering",
            rf"  \caption{{{latex(caption)}}}",
            rf"  \label{{tab:{re.sub(r'[^A-Za-z0-9.:_-]+', '-', label)}}}",
            rf"  \{size}",
            r"  \setlength{\tabcolsep}{3pt}",
            "\n  \\par\\medskip\n".join(map(_tabular, tables)),
            *(rf"  \par\smallskip\raggedright {latex(note)}" for note in notes),
            rf"\end{{{environment}}}",
            "",
        ]
    )


def _tabular(table: Table) -> str:
    numbers = len(table.headings) - table.labels
    lines = [
        r"  \begin{tabular}{" + "l" * table.labels + "c" * numbers + "}",
        r"    \toprule",
    ]
    if table.groups:
        width = numbers // len(table.groups)
        titles = [
            rf"\multicolumn{{{width}}}{{c}}{{{latex(title)}}}" for title in table.groups
        ]
        ends = range(table.labels + width, len(table.headings) + 1, width)
        lines.append(_latex_row([*[""] * table.labels, *titles]))
        lines.append(
            "    "
            + " ".join(rf"\cmidrule(lr){{{end - width + 1}-{end}}}" for end in ends)
        )
    lines += [
        _latex_row(latex(_one_line(heading)) for heading in table.headings),
        r"    \midrule",
    ]
    for place, row in enumerate(table.rows):
        lines += [r"    \midrule"] if place in table.rules else []
        lines.append(_latex_row(map(_latex_cell, row)))
    return "\n".join([*lines, r"    \bottomrule", r"  \end{tabular}"])


def _latex_cell(cell: str) -> str:
    """A cell whose brackets at its end, such as of an interval, are set smaller and
    never in bold.
    """
    value, space, bracket = (
        cell.rpartition(" (") if cell.endswith(")") else (cell, "", "")
    )
    written = rf"\textbf{{{latex(value)}}}" if isinstance(cell, Bold) else latex(value)
    return rf"{written} {{\scriptsize ({latex(bracket)}}}" if space else written


def _latex_row(cells: Iterable[str]) -> str:
    return f"    {' & '.join(cells)} \\\\"


def _markdown_row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _one_line(heading: str) -> str:
    return " ".join(heading.split())


def latex(text: str) -> str:
    """Escapes text for LaTeX; a hyphen before a number of its own is a minus."""
    return _WRITTEN.sub(_latex_of, _MINUS.sub("−", text))


def _latex_of(found: re.Match[str]) -> str:
    lowered = found[0].translate(_RAISED)
    return _LATEX.get(found[0]) or rf"$_{{{lowered}}}$"


def markdown(text: str) -> str:
    """Escapes text for Markdown."""
    return re.sub(r"[\\|*<`]", r"\\\g<0>", text)


def to_terminal(table: Table, width: int | None = None, styled: bool = False) -> str:
    """Draws a table for a terminal, with its notes under it; a colour such as #00ff00
    is shown beside its code.

    Args:
        table: what to draw.
        width: columns of the terminal; not limited when not given.
        styled: set bold cells in bold and show colours; else a star stands behind bold
            cells.
    """
    from rich import box
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table as Drawn

    bold_note = (
        [f"{'Bold' if styled else '*'}: {table.bold_note}"] if table.bold_note else []
    )
    console = Console(
        file=io.StringIO(),
        width=width or _UNBROKEN,
        force_terminal=styled,
        color_system="256" if styled else None,
        highlight=False,
    )
    drawn = Drawn(
        box=box.SIMPLE_HEAD,
        show_edge=False,
        padding=(0, 0 if table.numbers else 1, 0, 0),
    )
    for column, heading in enumerate(table.headings):
        is_number = table.numbers and column >= table.labels
        # A list of lines that are not too long keeps them whole.
        cells = [row[column] for row in table.rows]
        lines = [line for cell in cells for line in cell.splitlines()]
        is_list = len(lines) > len(cells) and max(map(len, lines)) <= _WIDEST_LINE
        drawn.add_column(
            escape(heading),
            justify="right" if is_number else "left",
            no_wrap=is_number or is_list,
            overflow="fold",
        )

    def drawn_cell(text: str) -> str:
        if isinstance(text, Bold):
            return f"[bold]{escape(text)}[/bold]" if styled else f"{escape(text)}*"
        return (
            f"[on {text}]  [/] {text}"
            if styled and _COLOUR.fullmatch(text)
            else escape(text)
        )

    for row in table.rows:
        drawn.add_row(*map(drawn_cell, row))
    # Square brackets are markup.
    title = [f"[bold]{escape(table.title)}[/bold]"] if table.title else []
    console.print(*title, drawn, *map(escape, (*table.notes, *bold_note)), sep="\n")
    return console.file.getvalue()  # type: ignore[attr-defined]


def print_table(table: Table) -> None:
    """Prints a table as wide as the terminal, or unbroken where none is."""
    is_terminal = sys.stdout.isatty()
    width = shutil.get_terminal_size().columns if is_terminal else None
    print(to_terminal(table, width, styled=is_terminal).rstrip())
