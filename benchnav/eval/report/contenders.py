"""Names and colours of conditions that are shown together."""

from collections.abc import Mapping, Sequence

from benchnav.eval.experiment.condition import NOT_USED

# Distinct for the colour-blind too (Okabe and Ito, 2008), the ones that are seen best on a map first.
_COLOURS = (
    *((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167)),
    *((230, 159, 0), (86, 180, 233), (0, 0, 0), (240, 228, 66)),
)
NAMING = ("planner", "risk", "model", "robot", "objective", "world")


def condition_colours(count: int) -> list[tuple[int, int, int]]:
    """Colours of conditions; beyond eight they begin anew.

    Returns:
        Red, green, blue, in [0, 255].
    """
    return [_COLOURS[place % len(_COLOURS)] for place in range(count)]


def contender_names(abouts: Sequence[Mapping[str, str]]) -> list[str]:
    """Names conditions by those of their labels that tell them apart; by their planner where nothing does.

    Args:
        abouts: labels of each condition.
    """
    used = {name: {about.get(name, NOT_USED) for about in abouts} - {NOT_USED} for name in NAMING}
    differing = [name for name, labels in used.items() if len(labels) > 1]
    names = []
    for about in abouts:
        words = [about.get(name, NOT_USED) for name in differing or ("planner",)]
        names.append(", ".join(word for word in words if word != NOT_USED) or about["planner"])
    return names
