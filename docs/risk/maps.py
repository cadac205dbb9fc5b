"""Makes stakes-v1's std maps with soft spots of another weight or depth, for docs/studies/risk.md.

python docs/risk/maps.py --weight 0.2      # datasets/stakes-weight-0.2.h5
python docs/risk/maps.py --depth 0.15      # datasets/stakes-depth-0.15.h5: their λ is N(0.15, 0.05)
"""

import argparse
import subprocess
import sys
from pathlib import Path

SOFT = ("wet_clay", "loose_soil", "fine_sand", "dune_sand")


def main() -> None:
    """Calls `benchnav-datagen create` with the overrides."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    chosen = parser.add_mutually_exclusive_group(required=True)
    chosen.add_argument("--weight", help="share of the ground of the classes with soft spots")
    chosen.add_argument("--depth", help="mean λ of soft spots before clipping")
    given = parser.parse_args()
    name, field, value = (
        ("weight", "weight", given.weight) if given.weight else ("depth", "mean", given.depth)
    )
    dataset = f"stakes-{name}-{value}"
    overrides = [f"id={dataset}", *(f"classes.{soft}.soft.{field}={value}" for soft in SOFT)]
    command = Path(sys.executable).parent / "benchnav-datagen"
    options = ["--splits", "[test/std]", "--overwrite"]
    subprocess.run([str(command), "create", "stakes-v1", *overrides, *options], check=True)


if __name__ == "__main__":
    main()
