"""Output files of measurements: texts, figures, and a page that explains them."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchnav.core.progress import show_progress
from benchnav.core.store import write_text
from benchnav.core.tables import Table, to_markdown
from benchnav.datagen.recipe.scenario import find_series
from benchnav.models.quality.files import FIGURES
from benchnav.viz.figure import Figure
from benchnav.viz.style import save_twice

DPI = 300


@dataclass(frozen=True, kw_only=True)
class Page:
    """A page of tables, notes and figures.

    Args:
        title: title of the page.
        tables: tables of the page. The first follows the title; the others have headings
            and follow the notes.
        notes: notes, one line each.
    """

    title: str
    tables: Sequence[Table]
    notes: Sequence[str] = ()

    def to_markdown(self, figures: Sequence[tuple[str, str, str]] = ()) -> str:
        """Return the page as Markdown.

        Args:
            figures: path of each image relative to the page, its title, and its caption.
        """
        tables = [to_markdown(table).rstrip() for table in self.tables]
        parts = [f"# {self.title}", tables[0], *self.notes]
        for table, text in zip(self.tables[1:], tables[1:], strict=True):
            parts += [f"## {table.title}", text]
        for path, title, caption in figures:
            parts += [f"![{title}]({path})", f"**{title}.** {caption}"]
        return "\n\n".join(parts) + "\n"


def write_folder(
    folder: Path,
    texts: Mapping[str, str],
    name: str,
    page: Page,
    figures: Sequence[Figure],
    data: Any,
) -> None:
    """Write all files of a measurement, replace existing figures, and print the paths.

    Args:
        folder: output folder.
        texts: contents of files by file name.
        name: file name of the page.
        page: page to write.
        figures: figures to draw, with distinct names.
        data: argument with which each figure is called.
    """
    for file, text in texts.items():
        write_text(folder / file, text)
    for old_figure in (folder / FIGURES).glob("*.p[nd][gf]"):
        old_figure.unlink()

    def save() -> Iterator[tuple[int, int]]:
        for count, figure in enumerate(figures, 1):
            path = folder / FIGURES / f"{figure.name}.png"
            save_twice(figure(data), path, dpi=DPI)
            yield count, len(figures)

    show_progress(save(), "figures")
    entries = [
        (f"{FIGURES}/{figure.name}.png", figure.title, figure.caption(data))
        for figure in figures
    ]
    write_text(folder / name, page.to_markdown(entries))
    print(f"wrote {', '.join(texts)}, {name} and {len(figures)} figures in {folder}")
    print(f"columns and figures are explained in {folder / name}")


def json_text(header: Mapping[str, Any], splits: Mapping[str, Any]) -> str:
    """Return a measurement and the series of its splits as JSON; NaN becomes null.

    Args:
        header: information on models and data.
        splits: results by split.
    """
    all_series = {}
    for scenario, pairs in find_series(splits).items():
        rows = [{"severity": severity, "split": split} for severity, split in pairs]
        all_series[scenario] = rows
    content = {**header, "splits": splits, "series": all_series}
    text = json.dumps(content, default=int)
    without_nan = json.loads(text, parse_constant=lambda _: None)
    return json.dumps(without_nan, indent=1) + "\n"
