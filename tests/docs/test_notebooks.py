"""The notebooks are short, keep no outputs, and run from their first cell to their last
in a Jupyter kernel.
"""

import ast
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.docs.pages import ROOT

NOTEBOOKS = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))
EACH = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
MOST_LINES = 14
LIMIT_S = 900


def cells(path: Path) -> list[dict[str, Any]]:
    return json.loads(path.read_text())["cells"]


def test_there_are_two() -> None:
    assert [path.name for path in NOTEBOOKS] == ["ablation.ipynb", "own_model.ipynb"]


@EACH
def test_a_cell_is_short_follows_a_sentence_and_keeps_no_output(path: Path) -> None:
    kinds = [cell["cell_type"] for cell in cells(path)]
    assert kinds == [
        "markdown",
        *["markdown", "code"] * ((len(kinds) - 2) // 2),
        "markdown",
    ]
    for cell in cells(path):
        if cell["cell_type"] == "code":
            assert (cell["outputs"], cell["execution_count"]) == ([], None)
            assert len(cell["source"]) <= MOST_LINES


@EACH
def test_what_is_in_a_notebook_can_be_read(path: Path) -> None:
    for cell in cells(path):
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            for link in re.findall(r"\]\(([^)#]+)", text):
                assert (path.parent / link).exists(), link
        elif text.startswith("%%bash\n"):
            read = subprocess.run(
                ["bash", "-n"],
                input=text.partition("\n")[2],
                capture_output=True,
                text=True,
            )
            assert read.returncode == 0, read.stderr
        else:
            ast.parse(text)


@EACH
def test_a_tutorial_and_the_readme_name_it(path: Path) -> None:
    page = {"ablation": "risk-ablation", "own_model": "own-model"}[path.stem]
    named = path.relative_to(ROOT).as_posix()
    assert f"`{named}`" in (ROOT / "docs" / "tutorials" / f"{page}.md").read_text()
    assert f"({named})" in (ROOT / "README.md").read_text()


@pytest.mark.docs
@EACH
def test_a_notebook_runs(path: Path, folder: Path, environment: dict[str, str]) -> None:
    import nbclient
    import nbformat

    # a link to ours, until it is a folder to write in
    place = folder / "examples" / "notebooks"
    place.unlink()
    place.mkdir()
    shutil.copy(path, place)
    del environment["MPLBACKEND"]  # so that figures are shown in the notebook
    book = nbformat.read(place / path.name, as_version=4)
    nbformat.validate(book)
    nbclient.NotebookClient(
        book, timeout=LIMIT_S, resources={"metadata": {"path": str(place)}}
    ).execute(env=environment)
    shown = [
        output.get("data", {})
        for cell in book.cells
        for output in cell.get("outputs", [])
    ]
    assert any("text/html" in data for data in shown)
    assert sum("image/png" in data for data in shown) == 2
