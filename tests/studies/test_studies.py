"""Each study is whole: suites, scripts, figures, digests, and a place on its page."""

import re

import pytest
import yaml

from benchnav import ConfigError
from benchnav.eval.experiment.hypotheses import fix_hypotheses
from benchnav.eval.experiment.unit import Extent
from studies.page import BLOCK, FIGURES
from studies.runs import digest_of
from studies.study import HOME, ROOT, Study
from studies.tables import KINDS
from tests.studies.suites import WORK, conditions, suite

STUDIES = {
    path.parent.name: Study.load(path.parent.name)
    for path in sorted(HOME.glob("*/study.yaml"))
}
SUITES = [
    (name, part)
    for name, study in STUDIES.items()
    for part in study.parts
    if not study.parts[part].script
]
MASKED = ("knowledge", "near")  # whose model is not shipped
PAGES = sorted((ROOT / "docs").rglob("*.md"))


@pytest.mark.parametrize(
    ("study", "part"), [pair for pair in SUITES if pair != MASKED], ids="-".join
)
def test_each_suite_makes_conditions_and_names_them_in_its_hypotheses(
    study: str, part: str
) -> None:
    made = conditions(study, part)
    assert len(made) >= 4
    known = {
        condition.id: (condition, Extent.product((0,), 1, 1)) for condition in made
    }
    hypotheses = suite(study, part).hypotheses
    assert len(fix_hypotheses(hypotheses, known).get("tests", [])) >= len(hypotheses)


@pytest.mark.parametrize("study", STUDIES.values(), ids=lambda study: study.name)
def test_all_that_a_study_names_is_there_and_all_that_is_there_is_named(
    study: Study,
) -> None:
    assert (ROOT / study.page).is_file()
    used = {
        study.suite_of(part) for part in study.parts if not study.parts[part].script
    }
    assert all(path.is_file() for path in used)
    others = {
        study.folder / name
        for name in ("study.yaml", "hypothesis.yaml", "open.yaml", "tables.yaml")
    }
    assert set(study.folder.glob("*.yaml")) - others <= used
    scripts = [part.script for part in study.parts.values() if part.script]
    for spec in (
        *scripts,
        *study.tables.values(),
        *(figure.draw for figure in study.figures.values()),
    ):
        assert not spec or callable(study.function(spec))
    assert all((FIGURES / name).is_file() for name in study.figures)
    runs = {study.run_of(part) for part in study.parts}
    for drawing in study.figures.values():
        assert set(drawing.parts) <= set(study.parts)
        assert not drawing.copy or drawing.copy.partition("/")[0] in runs
    assert not study.develop or study.develop in study.maps


def test_each_table_of_a_page_is_of_one_study_and_of_a_kind_that_it_makes() -> None:
    owners = {
        study.run_of(part): (study, part)
        for study in STUDIES.values()
        for part in study.parts
    }
    assert len(owners) == sum(len(study.parts) for study in STUDIES.values())
    written = 0
    for page in PAGES:
        for _, kind, run in BLOCK.findall(page.read_text()):
            study, part = owners[run]
            assert page == ROOT / study.page, run
            assert study.parts[part].script or kind in {*KINDS, *study.tables}, kind
            written += 1
        assert page.read_text().count("<!-- end -->") == len(
            BLOCK.findall(page.read_text())
        ), page
    assert written == 39


def test_digests_on_pages_are_those_of_the_files_that_they_name() -> None:
    named = [
        pair
        for page in PAGES
        for pair in re.findall(
            r"`(studies/[\w/-]+\.yaml)`, SHA-256\s+`(\w{64})`", page.read_text()
        )
    ]
    assert len(named) == 3
    for path, digest in named:
        assert digest_of(ROOT / path) == digest, path


def test_hypotheses_that_were_fixed_keep_their_bytes() -> None:
    fixed = {
        "confirmation": "d8917284d70800c608a5c41160559192689290ad998dbb2387ba6f3e8d19e7e3",
        "cost": "dae97f767b9ccd77bd1da61f5fb854bf081903c665aa0ec7e00630459518995d",
        "knowledge": "a4d1973b6dedb38abd85183c52b55636623c6bdd9f26108b4dbaa41258a8ae92",
    }
    for study, digest in fixed.items():
        assert digest_of(HOME / study / "primary.yaml") == digest


def test_files_of_a_fixed_suite_are_read_where_they_are_today() -> None:
    study = STUDIES["knowledge"]
    text = study.suite_of("primary").read_text()
    placed = yaml.safe_dump(study.suite("primary", WORK))
    for old, new in study.moved.items():
        assert old in text
        assert old not in placed
        assert (ROOT / new).is_file()
    labels = {
        condition.labels["ground"] for condition in conditions("knowledge", "primary")
    }
    assert "elsewhere" in labels


def test_a_study_or_part_that_there_is_not_is_rejected() -> None:
    with pytest.raises(ConfigError, match=r"`study` among .*knowledge.*, got nothing"):
        Study.load("nothing")
    with pytest.raises(
        ConfigError, match=r"`parts` among .*'primary'.*, got .'second'"
    ):
        STUDIES["cost"].choose(["primary", "second"])
