"""Objects that a YOLOX model finds in the photographs beside, by ONNX Runtime, as JSON.

Decoding is YOLOX's own (demo/ONNXRuntime, utils/boxes.py) and shares nothing with the node's. Needs numpy, onnxruntime
and opencv-python-headless:

    python3 photos.py yolox_nano.onnx > photos.json
"""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import onnxruntime

THRESHOLD, OVERLAP = 0.3, 0.5


def found(session, image):
    _, _, height, width = session.get_inputs()[0].shape
    scale = min(height / image.shape[0], width / image.shape[1])
    small = cv2.resize(image, (int(image.shape[1] * scale), int(image.shape[0] * scale)), interpolation=cv2.INTER_LINEAR)
    canvas = np.full((height, width, 3), 114, np.uint8)
    canvas[: small.shape[0], : small.shape[1]] = small
    planes = canvas.transpose(2, 0, 1)[None].astype(np.float32)
    rows = session.run(None, {session.get_inputs()[0].name: planes})[0][0].astype(np.float64)
    cells, strides = [], []
    for stride in (8, 16, 32):
        y, x = np.mgrid[0 : height // stride, 0 : width // stride]
        cells.append(np.stack([x.ravel(), y.ravel()], 1))
        strides.append(np.full((x.size, 1), stride))
    cells, strides = np.concatenate(cells), np.concatenate(strides)
    middles, sizes = (rows[:, :2] + cells) * strides, np.exp(rows[:, 2:4]) * strides
    boxes = np.concatenate([middles - sizes / 2, middles + sizes / 2], 1) / scale
    boxes = np.clip(boxes, 0, [image.shape[1], image.shape[0]] * 2)
    scores = rows[:, 4:5] * rows[:, 5:]
    kept = []
    for row in sorted(np.flatnonzero(scores.max(1) >= THRESHOLD), key=lambda row: -scores[row].max()):
        label, box = int(scores[row].argmax()), boxes[row]
        if all(other["class"] != label or overlap(other["box"], box) <= OVERLAP for other in kept):
            kept.append({"class": label, "score": float(scores[row, label]), "box": box.tolist()})
    return kept


def overlap(a, b):
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    shared = max(width, 0) * max(height, 0)
    return shared / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - shared)


session = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
photographs = sorted((Path(__file__).parent.parent / "photos").glob("*.jpg"))
print(json.dumps({path.stem: found(session, cv2.imread(str(path))) for path in photographs}, indent=1))
