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
import time
from typing import Any

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default="0", help="number of a camera, a file or a URL")
    parser.add_argument("--weights", default="yolo11n.pt")
    parser.add_argument("--homography", required=True, metavar="FILE")
    parser.add_argument("--pose", nargs=3, type=float, required=True, metavar=("X_M", "Y_M", "HEADING_DEG"))
    given = parser.parse_args()

    import cv2
    import supervision
    from ultralytics import YOLO

    model = YOLO(given.weights)
    homography = np.loadtxt(given.homography).reshape(3, 3)
    pose = ecod.Pose(given.pose[0], given.pose[1], math.radians(given.pose[2]))
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
