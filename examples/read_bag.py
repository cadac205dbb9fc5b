"""From bags of ROS 1 or ROS 2 (.bag, a folder with metadata.yaml, .mcap, .db3) to the
log that `import-drives` takes.

    pip install rosbags
    python examples/read_bag.py monday.mcap tuesday/ --odometry /odometry/gnss --command /cmd_vel --out drives.csv
    benchnav-datagen import-drives drives.csv --dem dem.tif --photo photo.tif --out site.h5

A bag is a drive. Odometry (`nav_msgs/Odometry`) has to know the ground: fused with
GNSS, vision or lidar. That of wheels alone turns with them where they slip, and λ would
be 1 everywhere. Its speed is along the robot's own axis; its position is in its own
frame, which `--origin EAST NORTH HEADING_DEG` lays into the coordinate reference system
of the elevation model. A command (`geometry_msgs/Twist` or `TwistStamped`) holds until
the next one, at most half a second.
"""

import argparse
import math
import sys
from pathlib import Path

import pandas as pd

HOLDS_S = 0.5
ODOMETRY = ("nav_msgs/msg/Odometry",)
COMMANDS = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")


def read(path: Path, odometry: str, command: str) -> pd.DataFrame:
    """Rows at the times of odometry, with the command that held then; NaN where none
    did.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        sys.exit(
            f"Expected the package rosbags, which reads bags, got: {error}. Install "
            "it: pip install rosbags"
        )
    moved, told = [], []
    # The definitions of messages are those in the bag; old ones of ROS 2 have none.
    if not path.exists():
        sys.exit(f"Expected a bag, got {path}, which is not there.")
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
        topics = {one.topic: one.msgtype for one in bag.connections}
        for option, topic, kinds in (
            ("--odometry", odometry, ODOMETRY),
            ("--command", command, COMMANDS),
        ):
            if topics.get(topic) not in kinds:
                known = ", ".join(
                    f"{name} ({kind})" for name, kind in sorted(topics.items())
                )
                sys.exit(
                    f"Expected topic {topic} of type {' or '.join(kinds)} in {path}, "
                    f"got {topics.get(topic, 'none')}. "
                    f"Pass {option} TOPIC; the bag has {known or 'no topics'}."
                )
        both = [one for one in bag.connections if one.topic in (odometry, command)]
        for own, nanoseconds, raw in bag.messages(both):
            message, time_s = bag.deserialize(raw, own.msgtype), nanoseconds / 1e9
            if own.topic == odometry:
                place = message.pose.pose.position
                moved.append((time_s, place.x, place.y, message.twist.twist.linear.x))
            else:
                twist = message.twist if own.msgtype.endswith("Stamped") else message
                told.append((time_s, twist.linear.x))
    rows = pd.DataFrame(
        moved, columns=["time_s", "x_m", "y_m", "measured_m_s"]
    ).sort_values("time_s")
    commands = pd.DataFrame(
        told, columns=["time_s", "commanded_m_s"], dtype=float
    ).sort_values("time_s")
    rows = pd.merge_asof(rows, commands, on="time_s", tolerance=HOLDS_S)
    return rows.assign(
        time_s=(rows["time_s"] - rows["time_s"].min()).round(3), drive=str(path)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bags", type=Path, nargs="+", help="one a drive")
    parser.add_argument(
        "--odometry", default="/odom", help="topic of nav_msgs/Odometry"
    )
    parser.add_argument(
        "--command",
        default="/cmd_vel",
        help="topic of geometry_msgs/Twist or TwistStamped",
    )
    parser.add_argument(
        "--origin",
        type=float,
        nargs=3,
        default=(0, 0, 0),
        metavar=("EAST", "NORTH", "HEADING_DEG"),
    )
    parser.add_argument("--out", type=Path, default=Path("drives.csv"))
    asked = parser.parse_args()
    rows = pd.concat([read(path, asked.odometry, asked.command) for path in asked.bags])
    east, north, heading = (
        asked.origin[0],
        asked.origin[1],
        math.radians(asked.origin[2]),
    )
    x, y = rows["x_m"], rows["y_m"]
    rows["x_m"] = (east + math.cos(heading) * x - math.sin(heading) * y).round(4)
    rows["y_m"] = (north + math.sin(heading) * x + math.cos(heading) * y).round(4)
    rows.to_csv(asked.out, index=False)
    without = rows["commanded_m_s"].isna().sum()
    print(
        f"wrote {asked.out}: {len(rows)} rows, {without} without a command, from "
        f"bags: {len(asked.bags)}"
    )


if __name__ == "__main__":
    main()
