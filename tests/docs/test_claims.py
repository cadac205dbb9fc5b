"""Findings in README, the home page, the FAQ and the openings of studies are registered
hypotheses, or are called exploratory.
"""

import re
from collections.abc import Iterator

import pytest

from tests.docs.pages import DOCS, ROOT

STUDIES = DOCS / "studies"
NUMBER = r"[+−-]?\d+(?:\.\d+)?"
INTERVAL = re.compile(rf"({NUMBER}) to ({NUMBER})(?!\d|\.\d| [a-z]| %)")
# A sentence that calls itself exploratory, up to the next one.
EXPLORATORY = re.compile(r"\*{0,2}Exploratory\b.*?(?:\.(?= [A-Z])|$)", re.MULTILINE)
REACH = 200  # characters before an interval, within which its difference stands


def size(text: str) -> float:
    """The number without its sign, which a sentence may say in words."""
    return abs(float(text.replace("−", "-")))


def is_rounded(said: str, known: float) -> bool:
    """Whether a text is a number, up to the decimals that it has."""
    decimals = len(said.partition(".")[2])
    return abs(size(said) - known) <= 0.51 * 10**-decimals


def registered() -> list[tuple[float, float, float, bool]]:
    """Of each hypothesis: difference, ends of its interval, and whether that is of 90
    %; sizes without sign.
    """
    found: list[tuple[float, float, float, bool]] = []
    for page in sorted(STUDIES.glob("*.md")):
        for block in re.findall(
            r"<!-- hypotheses .*?<!-- end -->", page.read_text(), re.DOTALL
        ):
            rows = re.findall(
                rf"\| ({NUMBER}) (?:points|s) \| ({NUMBER}) to ({NUMBER}) \((90|95) %\)",
                block,
            )
            found += [
                (size(by), size(low), size(high), level == "90")
                for by, low, high, level in rows
            ]
    zoo = (STUDIES / "zoo.md").read_text()
    ((by, low, high),) = re.findall(
        rf"the hypothesis \| ({NUMBER}) \| ({NUMBER}) to ({NUMBER})", zoo
    )
    assert len(found) > 60
    return [*found, (size(by), size(low), size(high), False)]


def unbacked(text: str) -> Iterator[str]:
    """Intervals that are neither a hypothesis' nor exploratory.

    A margin is tested with an interval of 90 %; a wider one of 95 % about the same
    difference is its as well.
    """
    known = registered()
    for match in INTERVAL.finditer(text):
        before = re.findall(NUMBER, text[max(0, match.start() - REACH) : match.start()])
        for difference, low, high, is_90 in known:
            ends = sorted(map(size, match.groups()))
            same = all(
                map(is_rounded, sorted(match.groups(), key=size), sorted((low, high)))
            )
            wider = (
                is_90
                and ends[0] <= min(low, high)
                and max(low, high) <= ends[1] < max(low, high) + 1
            )
            if (same or wider) and any(
                is_rounded(number, difference) for number in before
            ):
                break
        else:
            yield text[max(0, match.start() - 60) : match.end()]


def without_exploratory(text: str) -> str:
    """A text without what it calls exploratory: a sentence, or a paragraph with the
    table after it.
    """
    kept, skips = [], False
    for paragraph in re.split(r"\n\s*\n", text):
        one = paragraph.strip()
        is_table = one.startswith("|")
        is_whole = bool(re.match(r"\*{0,2}Exploratory\b", one)) and not is_table
        if not (is_whole or (skips and is_table)):
            lines = one.splitlines() if is_table else [" ".join(one.split())]
            kept += [EXPLORATORY.sub("", line.replace(" |", "\n")) for line in lines]
        skips = is_whole
    return "\n\n".join(kept)


def opening(study: str) -> str:
    """What a study says before its first section."""
    return (STUDIES / f"{study}.md").read_text().partition("\n## ")[0]


FINDINGS = {
    "README": (ROOT / "README.md")
    .read_text()
    .partition("## Findings")[2]
    .partition("\n## ")[0],
    "home": (DOCS / "index.md").read_text(),
    "faq": (DOCS / "faq.md").read_text(),
    **{study: opening(study) for study in ("risk", "results", "zoo", "knowledge")},
}


@pytest.mark.parametrize("page", FINDINGS)
def test_a_finding_is_a_registered_hypothesis_or_says_that_it_is_exploratory(
    page: str,
) -> None:
    said = without_exploratory(FINDINGS[page])
    assert len(INTERVAL.findall(said)) >= 1
    assert list(unbacked(said)) == []


def test_an_exploratory_number_among_hypotheses_is_seen() -> None:
    """The headline of version 1.0, of a setting that no hypothesis names."""
    headline = "A\\*+DWA under CVaR at 0.9 arrives 21.8 points more often (95 % interval 16.7 to 26.6, p < 0.0001)."
    assert len(list(unbacked(headline))) == 1
    assert not list(unbacked(without_exploratory(f"Exploratory: {headline}")))
    assert not list(
        unbacked(
            "success under CVaR at 0.8 is higher by 15.0 points (10.4 to 19.3, p ≤ 0.0001)"
        )
    )
    assert list(
        unbacked(
            "success under CVaR at 0.8 is higher by 21.8 points (10.4 to 19.3, p ≤ 0.0001)"
        )
    )
