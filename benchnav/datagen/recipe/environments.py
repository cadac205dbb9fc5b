"""Selection of the classes of each environment.

Classes are selected by units, from a sequence that is called the pack. A unit is a
class, or, in synthesis 2, all classes of one colour. Environments show all look-alike
classes or none of them; otherwise, colour would identify the class. Letters in shapes:
E environments, M classes of an environment.
"""

import numpy as np

AlikeClasses = tuple[int, ...]


def deal_classes(count: int, shown: int, environments: int) -> np.ndarray:
    """Return the classes of all environments, dealt consecutively from the pack.

    Each class is a unit. The pack is the class table, read with a stride so that the
    classes of an environment differ in colour. The stride changes whenever an
    environment ends at the end of a pack.

    Args:
        count: number of classes.
        shown: M, number of classes of an environment.
        environments: E, number of environments; a larger E only adds environments.

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

    Units that were dealt least often are dealt first. Units that were dealt equally
    often have the order of the pack, whose stride depends on that number. A unit is
    skipped if other units cannot complete it to M classes.

    Args:
        units: class indices of each unit; must exclude the units of `never_shown`.
        shown: M, number of classes of an environment.
        environments: E, number of environments; a larger E only adds environments.

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
    """Return the units that no other units complete to `shown` classes."""
    sizes = [len(unit) for unit in units]
    excluded = []
    for index, unit in enumerate(units):
        other_sizes = sizes[:index] + sizes[index + 1 :]
        if shown - len(unit) not in _sums(other_sizes):
            excluded.append(unit)
    return excluded


def strides(count: int) -> list[int]:
    """Return the strides that visit each unit of a pack: 3, 1, and then all from 2 on.

    3 may occur twice, since maps of synthesis 1 depend on this order.
    """
    candidates = (3, 1, *range(2, count))
    return [stride for stride in candidates if np.gcd(stride, count) == 1]


def _fill(order: list[int], units: tuple[AlikeClasses, ...], room: int) -> list[int]:
    """Return the first units in `order` that together have exactly `room` classes."""
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
