"""The page of a report: what it holds, and what a browser does with it."""

import html
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import matplotlib.image
import numpy as np
import pandas as pd
import pytest

from benchnav.core.tables import Bold, Table
from benchnav.eval.failures import Sheets
from benchnav.eval.report.write import Report, read_report, render
from tests.eval.forged import code_with
from tests.eval.report.test_write import episodes, run_folder

EVIL = "<script>alert(1)</script> & \"quoted\" 'too'"


class Page(HTMLParser):
    """What a browser would find: tags, and text outside of scripts and styles."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.inside: list[str] = []
        self.source = text
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "input"):
            self.inside.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.inside.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.inside and self.inside[-1] not in ("script", "style"):
            self.text.append(data.strip())


@pytest.fixture
def page(tmp_path: Path) -> Page:
    picture = tmp_path / "success.png"
    matplotlib.image.imsave(picture, np.zeros((20, 1000, 3)))
    table = Table(
        headings=("planner", EVIL), n_labels=1, rows=(("a", "1"), (EVIL, Bold("2"))), notes=(EVIL,),
        bold_note="the best", explained=(("planner", EVIL),),
    )  # fmt: skip
    about = {
        "datasets": {}, "conditions": {}, "codes": {"a": code_with(parts={EVIL: EVIL})},
        "machine": {"processor": "", "cores": 2}, "history": [{"command": EVIL, "commit": "", "benchnav": "1"}],
    }  # fmt: skip
    nothing = pd.DataFrame()
    report = Report(
        name=EVIL, header=(EVIL,), warnings=(EVIL,), findings={EVIL: [EVIL]},
        table=table, about=about, summary=nothing, tests=nothing, regret=nothing, episodes=nothing, failures=nothing,
        sheets=Sheets(shown=(), predicted={}, left_out=""),
    )  # fmt: skip
    return Page(render("report.html", report, {picture: EVIL}))


def test_text_of_users_is_text(page: Page) -> None:
    assert [tag for tag, _ in page.tags].count("script") == 1
    assert sum(EVIL in text for text in page.text) >= 11
    assert not page.inside


def test_it_needs_nothing_else(page: Page) -> None:
    sources = [
        attributes[name] or ""
        for _, attributes in page.tags
        for name in ("src", "href")
        if name in attributes
    ]
    assert sources
    assert all(source.startswith(("data:image/png;base64,", "#")) for source in sources)
    assert not [tag for tag, _ in page.tags if tag in ("link", "iframe")]


def test_the_table_has_its_cells_and_bold_where_it_belongs(page: Page) -> None:
    tags = [tag for tag, _ in page.tags]
    assert (tags.count("th"), tags.count("td")) == (2, 4)
    assert tags.count("button") == 2
    assert [attributes["type"] for tag, attributes in page.tags if tag == "input"] == [
        "search"
    ]
    cells = [place for place, tag in enumerate(tags) if tag == "td"]
    assert [tags[place + 1] == "b" for place in cells] == [False, False, False, True]
    assert page.text[page.text.index("Bold") + 1].endswith("the best")


def test_figures_are_named_and_fine_enough_for_any_screen(page: Page) -> None:
    (image,) = [attributes for tag, attributes in page.tags if tag == "img"]
    assert image["alt"] == "success"
    # It is drawn no wider than 0.78 of its pixels.
    (figure,) = [attributes for tag, attributes in page.tags if tag == "figure"]
    assert figure["style"] == "--w: 1000"
    assert "max-width: calc(var(--w) * .78px)" in page.source


def test_hypotheses_are_a_table_of_their_own(tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "run", episodes())
    report = read_report(folder)
    assert len(tables(report)) == 1
    tests = pd.DataFrame({"one": [1]})
    own = Table(
        headings=("hypothesis", "p"), rows=(("a beats b", "0.01"),), notes=("Holm.",)
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Report, "hypotheses", own)
        first, second = tables(replace(report, tests=tests))
    assert (first[0], first[1:]) == (["hypothesis", "p"], [["a beats b", "0.01"]])
    assert len(second) == 1 + len(report.table.rows)


def tables(report: Report) -> list[list[list[str]]]:
    """The tables of a page: rows of the text of their cells, the headings first."""
    page = render("report.html", report, {})
    found = re.findall(r"<table>(.*?)</table>", page, re.DOTALL)
    rows = [re.findall(r"<tr>(.*?)</tr>", table, re.DOTALL) for table in found]
    return [
        [
            [
                re.sub("<[^>]*>", "", cell)
                for cell in re.findall(r"<t[hd][ >].*?</t[hd]>", row)
            ]
            for row in table
        ]
        for table in rows
    ]


# Clicks on the headings and words in the filter, one after the other; then what is
# shown, and how it is sorted.
_USES = (
    ("", "", "b a c d", ""),
    ("Succ.", "", "c a b d", "ascending"),
    ("Succ.", "", "b a c d", "descending"),
    ("risk", "", "d b a c", "ascending"),
    ("", "cvar0.9 2", "c", "ascending"),
    ("", "CVaR 0.9", "a c", "ascending"),
    ("", "nothing", "", "ascending"),
    ("planner", "", "a b c d", "ascending"),
)


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs a browser")
def test_a_browser_sorts_and_filters_the_table_and_a_phone_shows_all_of_its_width(
    tmp_path: Path,
) -> None:
    rows = (
        ("b", "10.5 (9–12)", "CVaR₀.₅"),
        ("a", "≤ 9", "CVaR₀.₉"),
        ("c", "−2", "CVaR₀.₉₂"),
        ("d", "–", "chance"),
    )
    report = replace(
        read_report(run_folder(tmp_path / "run", episodes())), name="x" * 200
    )
    table = Table(headings=("planner", "Succ.", "risk"), rows=rows)
    page = render("report.html", replace(report, table=table), {})
    script = """
    const said = [], input = document.querySelector("input");
    for (const [click, words] of USES) {
      if (click) [...document.querySelectorAll("th button")].find(own => own.textContent === click).click();
      input.value = words;
      input.dispatchEvent(new Event("input"));
      const rows = [...document.querySelectorAll("tbody tr")].filter(row => row.checkVisibility());
      const sorted = document.querySelector("th[aria-sort]");
      said.push([rows.map(row => row.cells[0].textContent).join(" "), sorted ? sorted.ariaSort : ""]);
    }
    const root = document.documentElement;
    document.title = JSON.stringify([said, root.scrollWidth <= root.clientWidth]);
    """.replace("USES", json.dumps(_USES))
    inner = page.replace("</body>", f"<script>{script}</script></body>")
    (tmp_path / "page.html").write_text(inner)
    outer = '<iframe src="page.html" style="width: 390px; height: 800px" onload="said()"></iframe><pre></pre>'
    told = "const said = () => { document.querySelector('pre').textContent = frames[0].document.title; }"
    (tmp_path / "phone.html").write_text(f"<script>{told}</script>{outer}")
    options = [
        "headless",
        "no-sandbox",
        "disable-gpu",
        "disable-sync",
        "disable-background-networking",
        "dump-dom",
    ]
    options += [
        "disable-component-update",
        "allow-file-access-from-files",
        f"user-data-dir={tmp_path / 'profile'}",
    ]
    shown = subprocess.run(
        ["chromium", *(f"--{name}" for name in options), (tmp_path / "phone.html").as_uri()],
        capture_output=True, text=True, check=True, timeout=120,
    ).stdout  # fmt: skip
    said, fits = json.loads(
        html.unescape(shown.partition("<pre>")[2].partition("</pre>")[0])
    )
    assert said == [[rows, order] for _, _, rows, order in _USES]
    assert fits
