#!/usr/bin/env python3
"""Reports what YOLO sees in a camera that stands still.

    pip install './clients/python[supervision]' ultralytics
    yolo_loop.py --source 0 --homography ground.txt --pose 1 6 -90

`ground.txt` has the 3 × 3 matrix that takes pixels (u, v, 1) to metres east and north in the cell's frame, such as
cv2.findHomography makes of four marks on the ground. Any detector with a converter to supervision takes YOLO's place.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from typing import Any, Optional

import numpy as np

import ecod


def on_the_ground(homography: Any, boxes: Any, height: int, width: int) -> Any:
    """Positions in metres of boxes [left, top, right, bottom] in pixels: of the middle of their lower edge, NaN in the sky.

    The lower edge of the picture shows the ground.
    """
    feet = np.stack([(boxes[:, 0] + boxes[:, 2]) / 2, boxes[:, 3], np.ones(len(boxes))])
    x, y, w = homography @ feet
    w = np.where(w * (homography[2] @ [width / 2, height, 1]) > 0, w, np.nan)
    return np.stack([x / w, y / w], axis=1)


def pose_of(place: list[float], azimuth_deg: Optional[float]) -> ecod.Pose:
    """The pose given by --pose and --azimuth."""
    if len(place) != (3 if azimuth_deg is None else 2):
        sys.exit("--pose takes X_M Y_M HEADING_DEG, or X_M Y_M with --azimuth DEG")
    if azimuth_deg is not None:
        return ecod.Pose.from_compass(place[0], place[1], azimuth_deg)
    return ecod.Pose(place[0], place[1], math.radians(place[2]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default="0", help="number of a camera, a file or a URL")
    parser.add_argument("--weights", default="yolo11n.pt")
    parser.add_argument("--homography", required=True, metavar="FILE")
    place = "metres east and north, and the heading in degrees counter-clockwise from east"
    parser.add_argument("--pose", nargs="+", type=float, required=True, metavar="NUMBER", help=place)
    compass = "heading in degrees clockwise from north, in place of the third number of --pose"
    parser.add_argument("--azimuth", type=float, metavar="DEG", help=compass)
    given = parser.parse_args()

    import cv2
    import supervision
    from ultralytics import YOLO

    model = YOLO(given.weights)
    homography = np.loadtxt(given.homography).reshape(3, 3)
    pose = pose_of(given.pose, given.azimuth)
    camera: Any = cv2.VideoCapture(int(given.source) if given.source.isdigit() else given.source)
    with ecod.Cell(part="yolo") as cell:
        while True:
            is_read, frame = camera.read()
            captured_at = time.time()
            if not is_read:
                break
            found = supervision.Detections.from_ultralytics(model(frame, verbose=False)[0])
            positions = on_the_ground(homography, found.xyxy, *frame.shape[:2])
            is_placed = np.isfinite(positions).all(axis=1)
            objects = ecod.from_supervision(found[is_placed], positions[is_placed])
            cell.report(objects, captured_at=captured_at, pose=pose)


if __name__ == "__main__":
    main()
