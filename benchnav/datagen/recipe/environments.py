"""Which classes an environment shows. Letters in shapes: E environments, M classes
shown.

Classes are dealt by units: a class, or all classes that share a colour. These are shown
together or not at all, since the other colours would tell which one it must be.
"""

import numpy as np

AlikeClasses = tuple[int, ...]


def deal_classes(count: int, shown: int, environments: int) -> np.ndarray:
    """The classes of all environments, each its own unit: consecutive deals from one
    pack.

    The pack is the class table taken with a stride, so that an environment shows
    classes of some distance in colour; each time the deals come full circle the stride
    changes.

    Args:
        count: number of classes.
        shown: how many of them an environment shows, M.
        environments: how many environments, E. More of them leave the first as they
            are.

    Returns:
        Class indices, distinct in each row, shape [E, M].
    """
    first = shown * np.arange(environments)[:, None]
    steps = np.array(strides(count))
    stride = steps[first // int(np.lcm(shown, count)) % len(steps)]
    return stride * (first + np.arange(shown)) % count


def deal_units(
    units: tuple[AlikeClasses, ...], shown: int, environments: int
) -> np.ndarray:
    """The classes of all environments, dealt by units so that all are shown about
    equally often.

    Those shown least come first; among them the order is that of the pack, as in
    `deal_classes`, with another stride for each time shown. A unit that does not fit in
    what is left is passed over for the next that fits.

    Args:
        units: classes that are shown together, none of them in `never_shown`.
        shown: how many classes an environment shows, M.
        environments: how many environments, E. More of them leave the first as they
            are.

    Returns:
        Class indices, distinct in each row, shape [E, M].
    """
    count, times = len(units), [0] * len(units)
    # By stride, the place of each unit in the pack.
    places = [
        np.argsort(stride * np.arange(count) % count)
        for stride in dict.fromkeys(strides(count))
    ]
    table = []
    for _ in range(environments):
        order = sorted(
            range(count),
            key=lambda unit: (times[unit], places[times[unit] % len(places)][unit]),
        )
        dealt = _fill(order, units, shown)
        for unit in dealt:
            times[unit] += 1
        table.append([member for unit in dealt for member in units[unit]])
    return np.array(table)


def never_shown(units: tuple[AlikeClasses, ...], shown: int) -> list[AlikeClasses]:
    """The units that no choice of others fills an environment of `shown` classes with."""
    sizes = [len(unit) for unit in units]
    return [
        unit
        for number, unit in enumerate(units)
        if shown - len(unit) not in _sums(sizes[:number] + sizes[number + 1 :])
    ]


def strides(count: int) -> list[int]:
    """Strides that visit all of a pack, 3 and 1 first; 3 stands twice, as maps of
    synthesis 1 have it.
    """
    return [s for s in (3, 1, *range(2, count)) if np.gcd(s, count) == 1]


def _fill(order: list[int], units: tuple[AlikeClasses, ...], room: int) -> list[int]:
    """The first units in their order that fill the room exactly; those with which
    nothing would are left out.
    """
    dealt = []
    for position, unit in enumerate(order):
        left = room - len(units[unit])
        if left in _sums([len(units[other]) for other in order[position + 1 :]]):
            dealt.append(unit)
            room = left
    return dealt


def _sums(sizes: list[int]) -> set[int]:
    """All sums of some of the sizes."""
    sums = {0}
    for size in sizes:
        sums |= {total + size for total in sums}
    return sums
