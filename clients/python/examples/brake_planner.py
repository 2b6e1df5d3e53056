#!/usr/bin/env python3
"""Brakes for what the cell sees ahead, around corners too; without maps it brakes as well.

    brake_planner.py --pose 0 0 90 --speed 10

A real planner takes pose and speed from its localisation; here they are given. Prints a line when the decision changes.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from typing import Optional

import ecod

# Half the width in metres that the vehicle needs; the longest time in seconds that a map may be missing.
HALF_WIDTH_M = 1.5
MISSING_S = 0.5

# Time in seconds until the brakes act, and how they act in m/s².
REACTION_S = 0.5
DECELERATION_MPS2 = 4.0


def distance_ahead(map: ecod.GlobalMap, own_name: str, pose: ecod.Pose, age_s: float) -> Optional[float]:
    """The distance in metres along the heading to the nearest object in the way, moved on by the map's age."""
    ahead = []
    for thing in map.objects:
        # Vehicles that report their pose are in the map, this one too, maybe by a part of it: `euclid--lidar`.
        if (thing.vehicle or "").partition("--")[0] == own_name:
            continue
        east, north = thing.velocity_mps or (0.0, 0.0)
        dx, dy = thing.x_m + age_s * east - pose.x_m, thing.y_m + age_s * north - pose.y_m
        along = dx * math.cos(pose.heading_rad) + dy * math.sin(pose.heading_rad)
        aside = dy * math.cos(pose.heading_rad) - dx * math.sin(pose.heading_rad)
        if along > 0 and abs(aside) <= HALF_WIDTH_M + (thing.size_m or (0.0, 0.0))[1] / 2:
            ahead.append(along)
    return min(ahead, default=None)


def stopping_distance(speed_mps: float) -> float:
    return speed_mps * REACTION_S + speed_mps**2 / (2 * DECELERATION_MPS2)


def plan(cell: ecod.Cell, pose: ecod.Pose, speed_mps: float) -> None:
    said, own_name = "", cell.name.partition("--")[0]

    def say(decision: str, reason: str) -> None:
        nonlocal said
        if decision != said:
            print(f"{decision}: {reason}", flush=True)
            said = decision

    while True:
        try:
            for map in cell.maps(timeout=MISSING_S):
                age_s = max(0.0, time.time() - map.fused_at.timestamp())
                distance = distance_ahead(map, own_name, pose, min(age_s, MISSING_S))
                if distance is not None and distance < stopping_distance(speed_mps):
                    say("BRAKE", f"an object is {distance:.1f} m ahead")
                else:
                    say("GO", "nothing is in the way")
        except ecod.Silent:
            say("BRAKE", f"no map for {MISSING_S} s")


def pose_of(place: list[float], azimuth_deg: Optional[float]) -> ecod.Pose:
    """The pose given by --pose and --azimuth."""
    if len(place) != (3 if azimuth_deg is None else 2):
        sys.exit("--pose takes X_M Y_M HEADING_DEG, or X_M Y_M with --azimuth DEG")
    if azimuth_deg is not None:
        return ecod.Pose.from_compass(place[0], place[1], azimuth_deg)
    return ecod.Pose(place[0], place[1], math.radians(place[2]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    place = "metres east and north, and the heading in degrees counter-clockwise from east"
    parser.add_argument("--pose", nargs="+", type=float, default=[0, 0, 0], metavar="NUMBER", help=place)
    compass = "heading in degrees clockwise from north, in place of the third number of --pose"
    parser.add_argument("--azimuth", type=float, metavar="DEG", help=compass)
    parser.add_argument("--speed", type=float, default=10.0, metavar="M_PER_S")
    given = parser.parse_args()
    pose = pose_of(given.pose, given.azimuth)
    with ecod.Cell() as cell:
        plan(cell, pose, given.speed)


if __name__ == "__main__":
    main()
