"""Convert bags of ROS 1 or ROS 2 to the log that `import-drives` reads.

    pip install rosbags
    python examples/read_bag.py monday.mcap tuesday/ --odometry /odometry/gnss --command /cmd_vel --out drives.csv
    benchnav-datagen import-drives drives.csv --dem dem.tif --photo photo.tif --out site.h5

A bag is a .bag, .mcap or .db3 file, or a folder with metadata.yaml. Each bag is one
drive.

Odometry (`nav_msgs/Odometry`) must measure the speed over ground, for example by GNSS,
vision or lidar. Odometry from wheels only does not measure slip, so λ would be 1
everywhere. The speed is along the robot's axis. The position is in the odometry's
frame, which `--origin EAST NORTH HEADING_DEG` places in the coordinate reference system
of the elevation model. A command (`geometry_msgs/Twist` or `TwistStamped`) is valid
until the next command, but for half a second at most.
"""

import argparse
import math
import sys
from pathlib import Path

import pandas as pd

MAX_COMMAND_AGE_S = 0.5
ODOMETRY = ("nav_msgs/msg/Odometry",)
COMMANDS = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")


def read(path: Path, odometry: str, command: str) -> pd.DataFrame:
    """Read a bag; return a row per odometry message, with the command at that time.

    The commanded speed is NaN if no command was valid. If the package rosbags, the bag
    or a topic is missing, exit with a message.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        sys.exit(
            f"Expected rosbags to be installed for reading bags, got: {error}. Run: pip "
            "install rosbags"
        )
    odometry_rows, commanded = [], []
    # Message definitions are read from the bag. Old bags of ROS 2 contain no
    # definitions; those of ROS 2 Humble are used for them.
    if not path.exists():
        sys.exit(f"Expected an existing bag, got {path}.")
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
        topics = {
            topic_connection.topic: topic_connection.msgtype
            for topic_connection in bag.connections
        }
        for option, topic, kinds in (
            ("--odometry", odometry, ODOMETRY),
            ("--command", command, COMMANDS),
        ):
            if topics.get(topic) not in kinds:
                available = ", ".join(
                    f"{name} ({kind})" for name, kind in sorted(topics.items())
                )
                sys.exit(
                    f"Expected topic {topic} of type {' or '.join(kinds)} in {path}, "
                    f"got {topics.get(topic, 'none')}. "
                    f"Pass {option} TOPIC; the bag has {available or 'no topics'}."
                )
        connections = [
            topic_connection
            for topic_connection in bag.connections
            if topic_connection.topic in (odometry, command)
        ]
        for connection, nanoseconds, raw in bag.messages(connections):
            message, time_s = (
                bag.deserialize(raw, connection.msgtype),
                nanoseconds / 1e9,
            )
            if connection.topic == odometry:
                position = message.pose.pose.position
                odometry_rows.append(
                    (time_s, position.x, position.y, message.twist.twist.linear.x)
                )
            else:
                twist = (
                    message.twist if connection.msgtype.endswith("Stamped") else message
                )
                commanded.append((time_s, twist.linear.x))
    rows = pd.DataFrame(
        odometry_rows, columns=["time_s", "x_m", "y_m", "measured_m_s"]
    ).sort_values("time_s")
    commands = pd.DataFrame(
        commanded, columns=["time_s", "commanded_m_s"], dtype=float
    ).sort_values("time_s")
    rows = pd.merge_asof(rows, commands, on="time_s", tolerance=MAX_COMMAND_AGE_S)
    return rows.assign(
        time_s=(rows["time_s"] - rows["time_s"].min()).round(3), drive=str(path)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bags", type=Path, nargs="+", help="bags, one per drive")
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
        help="position [m] and heading [°] of the odometry's origin",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("drives.csv"), help="file for the log"
    )
    arguments = parser.parse_args()
    rows = pd.concat(
        [read(path, arguments.odometry, arguments.command) for path in arguments.bags]
    )
    east, north, heading = (
        arguments.origin[0],
        arguments.origin[1],
        math.radians(arguments.origin[2]),
    )
    x, y = rows["x_m"], rows["y_m"]
    rows["x_m"] = (east + math.cos(heading) * x - math.sin(heading) * y).round(4)
    rows["y_m"] = (north + math.sin(heading) * x + math.cos(heading) * y).round(4)
    rows.to_csv(arguments.out, index=False)
    without = rows["commanded_m_s"].isna().sum()
    print(
        f"wrote {arguments.out}: {len(rows)} rows, {without} without a command, number "
        f"of bags: {len(arguments.bags)}"
    )


if __name__ == "__main__":
    main()
