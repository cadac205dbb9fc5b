"""Ways of writing a table: Markdown, LaTeX, and text for a terminal."""

import io
import re
from collections.abc import Iterable

from benchnav.eval.report.tables import ResultTable

# Wide enough for any table where there is no terminal to fit it into.
_WIDTH = 400

_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{",
    "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}", "[": "{[}", "±": r"$\pm$", "–": "--", "λ": r"$\lambda$",
    "ω": r"$\omega$", "θ": r"$\theta$", "α": r"$\alpha$", "ε": r"$\varepsilon$", "σ": r"$\sigma$", "µ": r"$\mu$",
    "≥": r"$\geq$", "≤": r"$\leq$", "×": r"$\times$", "→": r"$\to$", "·": r"$\cdot$", "Δ": r"$\Delta$", "−": "$-$",
    "¶": r"\P{}",
}  # fmt: skip
_LATEX |= {raised: rf"\textsuperscript{{{digit}}}" for digit, raised in enumerate("⁰¹²³⁴⁵⁶⁷⁸⁹")}
_MINUS = re.compile(r"(?<![\w-])-(?=\d)")
_LATEX_WORDS = {"λ̄": r"$\bar{\lambda}$", "λ̂": r"$\hat{\lambda}$", "T_total": r"$T_\mathrm{total}$"}


def to_markdown(table: ResultTable) -> str:
    """Writes a table in Markdown, with its notes under it and what its columns hold."""
    lines = [_markdown_row(map(markdown, table.headings)), "|" + "---|" * len(table.headings)]
    for place, row in enumerate(table.rows):
        cells = [
            f"**{markdown(cell)}**" if (place, column) in table.bold else markdown(cell)
            for column, cell in enumerate(row)
        ]
        lines.append(_markdown_row(cells))
    notes = [*table.notes, *([f"Bold: {table.bold_note}"] if table.bold_note else [])]
    lines += [f"\n{markdown(note)}" for note in notes]
    if table.explained:
        lines += ["", *(f"- **{markdown(heading)}**: {markdown(text)}" for heading, text in table.explained)]
    return "\n".join([*lines, ""])


def to_latex(table: ResultTable, caption: str, label: str) -> str:
    """Writes a complete `table*` environment, as wide as the page, with its notes under the table.

    Args:
        table: labels are set left, all else centred. Needs LaTeX's `booktabs` and nothing else.
        caption: what the table shows.
        label: what it is referred to by.
    """
    numbers = len(table.headings) - table.labels
    lines = [
        r"\begin{table*}[t]",
        r"  \centering",
        rf"  \caption{{{latex(caption)}}}",
        rf"  \label{{tab:{latex_label(label)}}}",
        r"  \scriptsize",
        r"  \setlength{\tabcolsep}{3pt}",
        r"  \begin{tabular}{" + "l" * table.labels + "c" * numbers + "}",
        r"    \toprule",
        f"    {_latex_row(map(latex, table.headings))}",
        r"    \midrule",
    ]
    for place, row in enumerate(table.rows):
        cells = [
            rf"\textbf{{{latex(cell)}}}" if (place, column) in table.bold else latex(cell)
            for column, cell in enumerate(row)
        ]
        lines.append(f"    {_latex_row(cells)}")
    lines += [r"    \bottomrule", r"  \end{tabular}"]
    lines += [rf"  \par\smallskip\raggedright {latex(note)}" for note in table.notes]
    return "\n".join([*lines, r"\end{table*}", ""])


def to_terminal(table: ResultTable, width: int | None = None, styled: bool = False) -> str:
    """Draws a table with lines for a terminal, with its notes under it.

    Args:
        table: what to draw.
        width: columns of the terminal; not limited when not given.
        styled: set bold cells in bold; else a star stands behind them.
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    # Escaped, since square brackets are markup.
    drawn = Table()
    for heading in table.headings:
        drawn.add_column(escape(heading), overflow="fold")
    mark = ("[bold]", "[/bold]") if styled else ("", "*")
    for place, row in enumerate(table.rows):
        cells = [
            f"{mark[0]}{escape(cell)}{mark[1]}" if (place, column) in table.bold else escape(cell)
            for column, cell in enumerate(row)
        ]
        drawn.add_row(*cells)
    bold = [f"{'Bold' if styled else '*'}: {table.bold_note}"] if table.bold_note else []
    console = Console(
        file=io.StringIO(), width=width or _WIDTH, force_terminal=styled,
        color_system="standard" if styled else None,
    )  # fmt: skip
    console.print(drawn, *map(escape, (*table.notes, *bold)), sep="\n", highlight=False)
    return console.file.getvalue()  # type: ignore[attr-defined]


def latex(text: str) -> str:
    """Escapes text for LaTeX; a hyphen before a number of its own is a minus."""
    text = _MINUS.sub("−", text)
    for word, written in _LATEX_WORDS.items():
        before, found, after = text.partition(word)
        if found:
            return latex(before) + written + latex(after)
    return "".join(_LATEX.get(character, character) for character in text)


def latex_label(text: str) -> str:
    """A name that LaTeX can refer to."""
    return re.sub(r"[^A-Za-z0-9.:_-]+", "-", text)


def markdown(text: str) -> str:
    """Escapes text for Markdown."""
    for character in "\\|*<`":
        text = text.replace(character, "\\" + character)
    return text


def _latex_row(cells: Iterable[str]) -> str:
    return " & ".join(cells) + r" \\"


def _markdown_row(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"
