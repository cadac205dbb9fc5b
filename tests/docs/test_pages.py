"""Pages are short, their code can be read by what is to run it, and the site shows all
of them.
"""

import ast
import re
import subprocess
from pathlib import Path

import pytest
import yaml

from tests.docs.pages import DOCS, ROOT, blocks, name, pages
from tools.reference import PACKAGES, names_page

MOST_WORDS = 1500
LONG = ("docs/studies/", "docs/reference/")
EACH = pytest.mark.parametrize("page", pages(), ids=name)


@EACH
def test_a_page_is_short(page: Path) -> None:
    words = len(page.read_text().split())
    assert words <= MOST_WORDS or name(page).startswith(LONG)


@EACH
def test_blocks_can_be_read(page: Path) -> None:
    for block in blocks(page):
        where = f"{name(page)}:{block.line}"
        if block.kind == "python":
            ast.parse(block.body, where)
        elif block.kind == "sh":
            read = subprocess.run(
                ["bash", "-n"], input=block.body, capture_output=True, text=True
            )
            assert read.returncode == 0, f"{where}: {read.stderr}"
        elif block.kind == "yaml":
            list(yaml.safe_load_all(block.body))


def test_the_site_shows_every_page() -> None:
    shown = set(re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text()))
    assert {page.relative_to(DOCS).as_posix() for page in pages()[1:]} == {
        page for page in shown if not page.startswith("reference/commands/")
    }


@pytest.mark.parametrize("package", PACKAGES)
def test_pages_of_public_names_follow_the_docstrings(package: str) -> None:
    page = DOCS / "reference" / "api" / f"{package.rpartition('.')[2]}.md"
    assert page.read_text() == names_page(package), (
        "run: python tools/reference.py names docs/reference/api"
    )


@pytest.mark.parametrize("page", [*pages(), ROOT / "CONTRIBUTING.md"], ids=name)
def test_a_list_begins_after_an_empty_line(page: Path) -> None:
    """Without one a list is set as running text on the site, though not in a
    repository's view.
    """
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    item = re.compile(r"\s*(\d+\.|[-*]) ")
    for paragraph in re.split(r"\n\s*\n", text):
        lines = paragraph.strip("\n").splitlines()
        begun = [bool(item.match(line)) for line in lines]
        assert (
            not any(begun)
            or begun[0]
            or lines[0].startswith(("#", "|", "<", " ", "???", "!!!"))
        ), lines[0]
