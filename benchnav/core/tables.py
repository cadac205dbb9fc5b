"""Tables of text, written as Markdown, as LaTeX, or for a terminal.

The template of a report's HTML page reads the same `Table`. CSV files contain numbers
instead of text; pandas writes them.
"""

import io
import re
import shutil
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

# Text for a missing number or name.
NOTHING = "–"

# Width in characters if the output is not a terminal; it is enough for any table.
_UNLIMITED_WIDTH = 400
# Maximum width in characters of a list in a cell whose lines are not broken.
_MAX_LIST_WIDTH = 56

# LaTeX code by text. The order matters: "λ̄" must precede "λ", or only its first
# character would match.
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
    "κ": r"$\kappa$",
    "ρ": r"$\rho$",
    "θ": r"$\theta$",
    "α": r"$\alpha$",
    "ε": r"$\varepsilon$",
    "σ": r"$\sigma$",
    "µ": r"$\mu$",
    "≥": r"$\geq$",
    "≤": r"$\leq$",
    "×": r"$\times$",
    "→": r"$\to$",
    "←": r"$\leftarrow$",
    "·": r"$\cdot$",
    "Δ": r"$\Delta$",
    "−": "$-$",
    "¶": r"\P{}",
}
_LATEX |= {
    superscript: rf"\textsuperscript{{{digit}}}"
    for digit, superscript in enumerate("⁰¹²³⁴⁵⁶⁷⁸⁹")
}
# Subscript digits, and dots between these digits.
_SUBSCRIPT = re.compile("[₀-₉]+(?:\\.[₀-₉]+)?")
_NORMAL_DIGITS = str.maketrans("₀₁₂₃₄₅₆₇₈₉", "0123456789")
_ESCAPED = re.compile("|".join([_SUBSCRIPT.pattern, *map(re.escape, _LATEX)]))
_MINUS = re.compile(r"(?<![\w-])-(?=\d)")
_COLOUR = re.compile(r"#[0-9a-f]{6}")


class Bold(str):
    """Table cell in bold."""

    bold = True


@dataclass(frozen=True, kw_only=True)
class Table:
    """Table of text.

    Args:
        headings: one heading per column, labels first. Only a terminal keeps a line
            break in a heading.
        rows: rows with one cell per column. In LaTeX, a bracket at the end of a cell is
            set in a smaller font.
        n_labels: number of leading columns that are labels.
        numbers: whether the columns after the labels contain numbers, which are aligned
            right.
        title: title above the table, only in a terminal.
        notes: lines below the table.
        bold_note: meaning of bold cells.
        explained: meanings of columns, as (heading, sentence).
        groups: titles that each span the same number of columns after the labels; only
            in LaTeX.
        rules: indices of rows that have a horizontal line above; only in LaTeX.
    """

    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    n_labels: int = 1
    numbers: bool = False
    title: str = ""
    notes: tuple[str, ...] = ()
    bold_note: str = ""
    explained: tuple[tuple[str, str], ...] = ()
    groups: tuple[str, ...] = ()
    rules: frozenset[int] = frozenset()


def to_markdown(table: Table) -> str:
    """Return a table in Markdown, with notes and meanings of columns below it."""
    headings = [markdown(_one_line(heading)) for heading in table.headings]
    label_rules = "---|" * table.n_labels
    rule = "---:|" if table.numbers else "---|"
    value_rules = rule * (len(headings) - table.n_labels)
    lines = [_markdown_row(headings), f"|{label_rules}{value_rules}"]
    lines += [_markdown_row(map(_markdown_cell, row)) for row in table.rows]
    notes = [*table.notes]
    if table.bold_note:
        notes.append(f"Bold: {table.bold_note}")
    lines += [f"\n{markdown(note)}" for note in notes]
    if table.explained:
        lines.append("")
    for heading, meaning in table.explained:
        lines.append(f"- **{markdown(heading)}**: {markdown(meaning)}")
    return "\n".join([*lines, ""])


def to_latex(
    tables: Sequence[Table],
    caption: str,
    label: str,
    wide: bool = True,
    size: str = "scriptsize",
) -> str:
    """Return a LaTeX environment with stacked tables and notes below them.

    It needs the package `booktabs`.

    Args:
        tables: tables to stack vertically. Columns of labels are aligned left, the
            other columns are centred.
        caption: caption of the environment.
        label: name for cross-references, without "tab:".
        wide: whether the environment spans the page instead of a column.
        size: LaTeX font size, such as "scriptsize".
    """
    environment = "table*" if wide else "table"
    label = re.sub(r"[^A-Za-z0-9.:_-]+", "-", label)
    notes = dict.fromkeys(note for table in tables for note in table.notes)
    lines = [
        rf"\begin{{{environment}}}[t]",
        r"  \centering",
        rf"  \caption{{{latex(caption)}}}",
        rf"  \label{{tab:{label}}}",
        rf"  \{size}",
        r"  \setlength{\tabcolsep}{3pt}",
        "\n  \\par\\medskip\n".join(map(_tabular, tables)),
    ]
    lines += [rf"  \par\smallskip\raggedright {latex(note)}" for note in notes]
    lines += [rf"\end{{{environment}}}", ""]
    return "\n".join(lines)


def _tabular(table: Table) -> str:
    n_values = len(table.headings) - table.n_labels
    alignment = "l" * table.n_labels + "c" * n_values
    lines = [rf"  \begin{{tabular}}{{{alignment}}}", r"    \toprule"]
    if table.groups:
        width = n_values // len(table.groups)
        group = rf"\multicolumn{{{width}}}{{c}}"
        titles = [f"{group}{{{latex(title)}}}" for title in table.groups]
        ends = range(table.n_labels + width, len(table.headings) + 1, width)
        lines.append(_latex_row([*[""] * table.n_labels, *titles]))
        rules = [rf"\cmidrule(lr){{{end - width + 1}-{end}}}" for end in ends]
        lines.append(f"    {' '.join(rules)}")
    headings = [latex(_one_line(heading)) for heading in table.headings]
    lines += [_latex_row(headings), r"    \midrule"]
    for index, row in enumerate(table.rows):
        if index in table.rules:
            lines.append(r"    \midrule")
        lines.append(_latex_row(map(_latex_cell, row)))
    return "\n".join([*lines, r"    \bottomrule", r"  \end{tabular}"])


def _latex_cell(cell: str) -> str:
    """Return a cell for LaTeX; a bracket at its end is smaller and never bold."""
    value, bracket = cell, ""
    if cell.endswith(")") and " (" in cell:
        value, _, bracket = cell.rpartition(" (")
    escaped = latex(value)
    if isinstance(cell, Bold):
        escaped = rf"\textbf{{{escaped}}}"
    return rf"{escaped} {{\scriptsize ({latex(bracket)}}}" if bracket else escaped


def _latex_row(cells: Iterable[str]) -> str:
    return f"    {' & '.join(cells)} \\\\"


def _markdown_cell(cell: str) -> str:
    escaped = markdown(cell)
    return f"**{escaped}**" if isinstance(cell, Bold) else escaped


def _markdown_row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _one_line(heading: str) -> str:
    return " ".join(heading.split())


def latex(text: str) -> str:
    """Escape text for LaTeX; the hyphen of a negative number becomes a minus."""
    return _ESCAPED.sub(_latex_of, _MINUS.sub("−", text))


def _latex_of(match: re.Match[str]) -> str:
    digits = match[0].translate(_NORMAL_DIGITS)
    return _LATEX.get(match[0]) or rf"$_{{{digits}}}$"


def markdown(text: str) -> str:
    """Escape text for Markdown."""
    return re.sub(r"[\\|*<`]", r"\\\g<0>", text)


def to_terminal(table: Table, width: int | None = None, styled: bool = False) -> str:
    """Return a table as text for a terminal, with notes below it.

    Args:
        table: table to write.
        width: width of the terminal in characters; None for no limit.
        styled: whether to set bold cells in bold, and to show the colour next to codes
            such as #00ff00. Otherwise, an asterisk follows bold cells.
    """
    from rich import box
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table as RichTable

    console = Console(
        file=io.StringIO(),
        width=width or _UNLIMITED_WIDTH,
        force_terminal=styled,
        color_system="256" if styled else None,
        highlight=False,
    )
    rich_table = RichTable(
        box=box.SIMPLE_HEAD,
        show_edge=False,
        padding=(0, 0 if table.numbers else 1, 0, 0),
    )
    for column, heading in enumerate(table.headings):
        is_number = table.numbers and column >= table.n_labels
        # The lines of a list are not broken, unless one is longer than the maximum.
        cells = [row[column] for row in table.rows]
        lines = [line for cell in cells for line in cell.splitlines()]
        is_list = len(lines) > len(cells) and max(map(len, lines)) <= _MAX_LIST_WIDTH
        rich_table.add_column(
            escape(heading),
            justify="right" if is_number else "left",
            no_wrap=is_number or is_list,
            overflow="fold",
        )

    def marked_up(cell: str) -> str:
        if isinstance(cell, Bold):
            return f"[bold]{escape(cell)}[/bold]" if styled else f"{escape(cell)}*"
        if styled and _COLOUR.fullmatch(cell):
            return f"[on {cell}]  [/] {cell}"
        return escape(cell)

    for row in table.rows:
        rich_table.add_row(*map(marked_up, row))
    # `escape`, because square brackets are markup.
    title = [f"[bold]{escape(table.title)}[/bold]"] if table.title else []
    notes = [escape(note) for note in table.notes]
    if table.bold_note:
        mark = "Bold" if styled else "*"
        notes.append(escape(f"{mark}: {table.bold_note}"))
    console.print(*title, rich_table, *notes, sep="\n")
    return console.file.getvalue()  # type: ignore[attr-defined]


def print_table(table: Table) -> None:
    """Print a table at the terminal's width; no limit if the output is not a terminal."""
    is_terminal = sys.stdout.isatty()
    width = shutil.get_terminal_size().columns if is_terminal else None
    print(to_terminal(table, width, styled=is_terminal).rstrip())
