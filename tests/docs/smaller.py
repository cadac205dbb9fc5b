"""A command of ours with fewer maps and epochs than the words ask for: for
`test_blocks.py`, which puts it on the path.

BENCHNAV_DOCS_MAPS says how many maps a split and a scenario have; a network is trained
for one epoch.
"""

import os
import sys
from importlib import import_module

from benchnav.datagen import shipped_recipes
from benchnav.datagen.recipe.load import shipped_sizes
from tests.commands import PACKAGES


def smaller(program: str, words: list[str], maps: int) -> list[str]:
    """The words of a smaller run."""
    asked, *rest = words or ["--help"]
    if {"--help", "--print_config"} & set(rest):
        return words
    if (program, asked) == ("datagen", "create") and rest[0] in shipped_recipes():
        given = {word.partition("=")[0] for word in rest}
        sizes = {
            split: max(maps, 4) if split == "valid" else maps
            for split in shipped_sizes(rest[0])
        }
        # a half of `valid` needs two
        fewer = [f"splits.{split}.maps={count}" for split, count in sizes.items()]
        named = [] if "id" in given else [f"id={rest[0]}-small"]
        out = (
            []
            if {"--out", "--seed", "id"} & given
            else ["--out", f"datasets/{rest[0]}.h5"]
        )
        return [asked, *rest, *fewer, *named, *out]
    if program == "train" and asked in ("fit", "classifier", "all", "mdn"):
        return [*words, "--trainer.max_epochs", "1"]
    if (program, asked) == ("eval", "run"):
        return [*words, "--maps", str(maps)]
    return words


if __name__ == "__main__":
    program = sys.argv[1]
    sys.argv = [
        f"benchnav-{program}", *smaller(program, sys.argv[2:], int(os.environ["BENCHNAV_DOCS_MAPS"]))
    ]  # fmt: skip
    import_module(f"{PACKAGES[program]}.cli").main()
