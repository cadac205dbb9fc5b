from html.parser import HTMLParser
from pathlib import Path

import matplotlib.image
import numpy as np
import pandas as pd
import pytest

from benchnav.core.tables import Bold, Table
from benchnav.eval.report.failures import Sheets
from benchnav.eval.report.write import Report, provenance_lines, render
from tests.eval.forged import code_with

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
        if tag not in ("meta", "img"):
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
        headings=("planner", EVIL), labels=1, rows=(("a", "1"), (EVIL, Bold("2"))), notes=(EVIL,),
        bold_note="the best", explained=(("planner", EVIL),),
    )  # fmt: skip
    about = {
        "datasets": {}, "conditions": {}, "codes": {"a": code_with(parts={EVIL: EVIL})},
        "machine": {"processor": "", "cores": 2}, "history": [{"command": EVIL, "commit": "", "benchnav": "1"}],
    }  # fmt: skip
    nothing = pd.DataFrame()
    report = Report(
        name=EVIL, header=(EVIL,), warnings=(EVIL,), findings={EVIL: [EVIL]},
        table=table, about=about, summary=nothing, tests=nothing, episodes=nothing, failures=nothing,
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
    cells = [place for place, tag in enumerate(tags) if tag == "td"]
    assert [tags[place + 1] == "b" for place in cells] == [False, False, False, True]
    assert page.text[page.text.index("Bold") + 1].endswith("the best")


def test_figures_are_named_and_fine_enough_for_any_screen(page: Page) -> None:
    assert "figure img { display: block; zoom: .6;" in page.source
    (image,) = [attributes for tag, attributes in page.tags if tag == "img"]
    assert image["alt"] == "success"


def test_provenance_of_a_run() -> None:
    about = {
        "history": [{"commit": "old", "benchnav": "0"}, {"commit": "abc", "benchnav": "1.2"}],
        "codes": {
            "a": code_with(parts={"model m": "1f"}),
            "b": code_with(parts={"risk r.py:f": "9e"}, environment={"compiles": False}),
        },
        "machine": {"processor": "x86_64", "cores": 2},
        "datasets": {"paper-v1": {"id": "paper-v1", "maps": {"test/std": ["d"] * 20}}},
        "conditions": {"t": {"seeds": [0, 7]}},
    }
    assert provenance_lines(about) == [
        ("commit of benchnav", "abc"), ("version of benchnav", "1.2"),
        ("torch", "2.1"), ("processor", "AVX2"), ("compiles", "True"), ("device", "cpu"), ("planner_limit_s", "0.0"),
        ("torch", "2.1"), ("processor", "AVX2"), ("compiles", "False"), ("device", "cpu"), ("planner_limit_s", "0.0"),
        ("machine", "x86_64, 2 cores"), ("dataset paper-v1", "paper-v1; maps: test/std 20"),
        ("model m", "1f"), ("risk r.py:f", "9e"), ("seeds", "0, 7"),
    ]  # fmt: skip
    assert ("device", "cpu") in provenance_lines(about | {"device": "cpu", "gpu": None})
