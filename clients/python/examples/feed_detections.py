#!/usr/bin/env python3
"""Feeds the detections of any detector into a cell and prints what the cell agrees on.

    my_detector | feed_detections.py --broker 192.168.1.10:1883 --cell lot-1 --node euclid --pose 1 6 -90

Standard input has a JSON object a line, one for each frame, frames without detections too:

    {"objects": [{"label": "car", "confidence": 0.93, "x_m": 0.2, "y_m": 0.1}], "seen": ["slot-0", "slot-1"]}

`objects` are in the cell's frame, metres east and north; one with a `landmark` is also a vote on what is there. `seen` names
the known locations that were in view; leave it out if it is unknown. docs/protocol.md has all fields. When the
input ends, the program waits for the answer to the last frame. Lines that are no frames are reported and skipped.

A cell with certificates takes the node's own, as `ecod-node pki issue NODE --role cav` makes it:

    ... --broker 192.168.1.10:8883 --ca ca.pem --cert euclid.pem --key euclid.key

A broker with passwords takes `--user`, and the password from `--password` or, better, from ECOD_MQTT__PASSWORD.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import threading
import time
from typing import Any, Optional

import ecod

# Time for the cell to answer the last frame, in seconds.
LAST_ANSWER_S = 1.0


def feed(cell: ecod.Cell, line: bytes, default_pose: Optional[ecod.Pose]) -> bool:
    """Reports the frame in a line of input, and gives whether it was sent; ValueError where there is none."""
    frame = json.loads(line)
    objects = frame.get("objects") if isinstance(frame, dict) else None
    if not isinstance(objects, list) or not all(isinstance(item, dict) for item in objects):
        raise ValueError("no JSON object with a list `objects`")
    captured_at = frame["captured_at_us"] / 1e6 if "captured_at_us" in frame else time.time()
    pose = ecod.Pose(**frame["pose"]) if "pose" in frame else default_pose
    is_sent = cell.report(objects, captured_at=captured_at, pose=pose, seen=frame.get("seen"), view=frame.get("view"))
    votes = [item for item in objects if item.get("landmark")]
    if votes:
        cell.vote(votes, captured_at=captured_at, pose=pose, seen=frame.get("seen"))
    return is_sent


def print_maps(cell: ecod.Cell) -> None:
    for map in cell.maps():
        objects = [f"{thing.label} at ({thing.x_m:.1f}, {thing.y_m:.1f})" for thing in map.objects]
        print("map     ", f"{map.aggregator} round {map.round}", *[described(it) for it in map.landmarks], *objects, sep="  ", flush=True)


def print_verdicts(cell: ecod.Cell) -> None:
    for round in cell.verdicts():
        judged = [f"{verdict.landmark}: {verdict.label} by {verdict.margin:.2f}" for verdict in round.verdicts]
        print("verdicts", f"{round.aggregator} round {round.round}", *judged, sep="  ", flush=True)


def described(landmark: ecod.LandmarkState) -> str:
    if landmark.label is None:
        return f"{landmark.id}: {'empty' if landmark.is_empty else 'unknown'}"
    return f"{landmark.id}: {landmark.label} {landmark.confidence:.2f}"


def pose_of(place: Optional[list[float]], azimuth_deg: Optional[float]) -> Optional[ecod.Pose]:
    """The pose given by --pose and --azimuth."""
    if place is None and azimuth_deg is None:
        return None
    if place is None or len(place) != (3 if azimuth_deg is None else 2):
        sys.exit("--pose takes X_M Y_M HEADING_DEG, or X_M Y_M with --azimuth DEG")
    if azimuth_deg is not None:
        return ecod.Pose.from_compass(place[0], place[1], azimuth_deg)
    return ecod.Pose(place[0], place[1], math.radians(place[2]))


def arguments() -> Any:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--broker", metavar="HOST:PORT", help="the leader's, or the cell's external one; default $ECOD_BROKER")
    parser.add_argument("--cell", help="default $ECOD_CELL")
    parser.add_argument("--node", required=True, help="name of this vehicle, unique in the cell")
    parser.add_argument("--part", default="", help="name of this program beside others of the vehicle")
    place = "metres east and north of the camera, and its heading in degrees counter-clockwise from east"
    parser.add_argument("--pose", nargs="+", type=float, metavar="NUMBER", help=place)
    compass = "heading in degrees clockwise from north, in place of the third number of --pose"
    parser.add_argument("--azimuth", type=float, metavar="DEG", help=compass)
    parser.add_argument("--user", help="for a broker with passwords")
    parser.add_argument("--password", help="default $ECOD_MQTT__PASSWORD")
    parser.add_argument("--ca", metavar="FILE", help="CA of the broker's certificate (PEM); enables TLS")
    parser.add_argument("--cert", metavar="FILE", help="this vehicle's certificate (PEM)")
    parser.add_argument("--key", metavar="FILE", help="the key of --cert (PEM)")
    parser.add_argument("--broker-name", default=ecod.BROKER_NAME, help="name in the broker's certificate (default: %(default)s)")
    return parser.parse_args()


def main() -> None:
    given = vars(arguments())
    default_pose = pose_of(given.pop("pose"), given.pop("azimuth"))
    frames = unsent = 0
    with ecod.Cell(**given) as cell:
        for printer in (print_maps, print_verdicts):
            threading.Thread(target=printer, args=[cell], daemon=True).start()
        for number, line in enumerate(sys.stdin.buffer, 1):
            try:
                unsent += not feed(cell, line, default_pose)
                frames += 1
            except (ValueError, TypeError) as error:
                print(f"line {number} skipped: {error}", file=sys.stderr)
        time.sleep(LAST_ANSWER_S)
    if unsent:
        sys.exit(f"{unsent} of {frames} frames were not sent: the broker is gone or takes them too slowly")


if __name__ == "__main__":
    try:
        main()
    except ecod.EcodError as error:
        sys.exit(str(error))
