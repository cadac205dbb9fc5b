import pytest

from benchnav.command import Command, run

seen: list[object] = []


def work(
    place: str, rest: list[str], deep_cut: bool = False, much_more: int = 1, some: list[int] | None = None
) -> None:
    """Work.

    Args:
        place: Where.
        rest: What else.
        deep_cut: Whether.
        much_more: How much.
        some: Which.
    """
    seen.append((place, rest, deep_cut, much_more, *(some or ())))


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        (["a"], ("a", [], False, 1)),
        (["a", "--deep-cut"], ("a", [], True, 1)),
        (["--deep_cut", "a"], ("a", [], True, 1)),
        (["--deep-cut", "false", "a"], ("a", [], False, 1)),
        (["a", "--deep-cut=true", "--much-more=3"], ("a", [], True, 3)),
        (["a", "b-c=1", "--d=2"], None),
        ([], None),
        (["a", "--some", "3"], ("a", [], False, 1, 3)),
        (["a", "--some", "3,4", "--deep-cut"], ("a", [], True, 1, 3, 4)),
        (["a", "--some", "[3, 4]"], ("a", [], False, 1, 3, 4)),
        (["a", "b-c=1", "e", "--much-more", "4", "--deep-cut"], ("a", ["b-c=1", "e"], True, 4)),
    ],
)
def test_flags_are_spelled_either_way_and_switches_need_no_value(argv: list[str], expected: object) -> None:
    seen.clear()
    status = run("x", "Does.", {"work": Command(work, ("place", "rest"))}, ["work", *argv])
    assert (seen, status) == (([expected], 0) if expected else ([], 2))
