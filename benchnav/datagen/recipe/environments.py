"""Choice of the classes of each environment.

Classes are dealt by units: a class, or all classes of one colour. Look-alikes are shown
together or not at all; otherwise, colour would identify the class. Letters in shapes: E
environments, M classes shown.
"""

import numpy as np

AlikeClasses = tuple[int, ...]


def deal_classes(count: int, shown: int, environments: int) -> np.ndarray:
    """Return the classes of all environments, dealt consecutively from one pack.

    Each class is a unit. The pack is the class table read with a stride, so that the
    classes of an environment differ in colour. The stride changes each time that the
    environments so far have used up a whole number of packs.

    Args:
        count: number of classes.
        shown: M, number of classes of an environment.
        environments: E, number of environments; a larger E does not change the first.

    Returns:
        Class indices, distinct in each row, shape [E, M].
    """
    first = shown * np.arange(environments)[:, None]
    position = first + np.arange(shown)
    cycle = int(np.lcm(shown, count))
    steps = np.array(strides(count))
    stride = steps[first // cycle % len(steps)]
    return stride * position % count


def deal_units(
    units: tuple[AlikeClasses, ...], shown: int, environments: int
) -> np.ndarray:
    """Return the classes of all environments, dealt by units about equally often.

    Units that were dealt least often come first. Among them, the order is that of the
    pack in `deal_classes`; its stride depends on how often they were dealt. A unit that
    does not fit in the remaining room is skipped.

    Args:
        units: classes that are shown together; must exclude those of `never_shown`.
        shown: M, number of classes of an environment.
        environments: E, number of environments; a larger E does not change the first.

    Returns:
        Class indices, distinct in each row, shape [E, M].
    """
    count = len(units)
    times_dealt = [0] * count
    # Positions of the units in the pack, for each stride.
    positions = []
    for stride in dict.fromkeys(strides(count)):
        pack = stride * np.arange(count) % count
        positions.append(np.argsort(pack))

    def rank(unit: int) -> tuple[int, int]:
        times = times_dealt[unit]
        position = positions[times % len(positions)]
        return times, position[unit]

    table = []
    for _ in range(environments):
        order = sorted(range(count), key=rank)
        dealt = _fill(order, units, shown)
        classes: list[int] = []
        for unit in dealt:
            times_dealt[unit] += 1
            classes += units[unit]
        table.append(classes)
    return np.array(table)


def never_shown(units: tuple[AlikeClasses, ...], shown: int) -> list[AlikeClasses]:
    """Return the units that other units cannot complete to `shown` classes."""
    sizes = [len(unit) for unit in units]
    excluded = []
    for index, unit in enumerate(units):
        other_sizes = sizes[:index] + sizes[index + 1 :]
        if shown - len(unit) not in _sums(other_sizes):
            excluded.append(unit)
    return excluded


def strides(count: int) -> list[int]:
    """Return strides that visit all of a pack: 3 and 1, then all from 2 on.

    3 comes twice, since maps of synthesis 1 depend on this order.
    """
    candidates = (3, 1, *range(2, count))
    return [stride for stride in candidates if np.gcd(stride, count) == 1]


def _fill(order: list[int], units: tuple[AlikeClasses, ...], room: int) -> list[int]:
    """Return the first units in their order that fill the room exactly."""
    dealt = []
    for position, unit in enumerate(order):
        remaining = room - len(units[unit])
        later_sizes = [len(units[later]) for later in order[position + 1 :]]
        if remaining in _sums(later_sizes):
            dealt.append(unit)
            room = remaining
    return dealt


def _sums(sizes: list[int]) -> set[int]:
    """Return the sums of all subsets of the sizes."""
    sums = {0}
    for size in sizes:
        sums |= {total + size for total in sums}
    return sums
