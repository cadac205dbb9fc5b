"""Shards: the shares of a run that several machines make apart, to be merged afterwards.

Which shard a unit is in depends on the unit and the number of shards alone: not on what else is run, in which
order, or what is finished. An extended run therefore leaves every unit where it was.
"""

from benchnav.eval.unit import Unit
from benchnav.share import Share


def shard_of(unit: Unit, of: int) -> Share:
    """The shard that a unit is in, of so many.

    Blocks, realisations and seeds of a trial go to the shards in turn; the shard that a trial begins with is
    drawn by its id, which is a digest.
    """
    turn = int(unit.trial.id, 16) + unit.seed + unit.realisation + unit.block
    return Share(index=turn % of + 1, of=of)
