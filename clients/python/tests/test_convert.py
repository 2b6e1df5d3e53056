"""Objects from numpy arrays and from supervision."""

from __future__ import annotations

import numpy as np
import pytest
import supervision

import ecod


def test_arrays_become_objects() -> None:
    matrices = np.array([[[1.0, 0.5], [0.5, 2.0]], [[3.0, 0.0], [0.0, 4.0]]])
    made = ecod.from_arrays(["car", "cup"], np.array([0.9, 0.5], np.float32), np.eye(2), covariances=matrices, velocities=-np.eye(2))
    assert made == [
        ecod.PerceivedObject("car", pytest.approx(0.9), 1.0, 0.0, covariance_m2=(1.0, 0.5, 2.0), velocity_mps=(-1.0, 0.0)),
        ecod.PerceivedObject("cup", 0.5, 0.0, 1.0, covariance_m2=(3.0, 0.0, 4.0), velocity_mps=(0.0, -1.0)),
    ]
    assert ecod.from_arrays([], [], np.empty((0, 2))) == []
    with pytest.raises(ecod.Invalid, match="positions has 1 rows, labels has 2"):
        ecod.from_arrays(["car", "cup"], [0.9, 0.5], np.zeros((1, 2)))


def test_detections_of_supervision_become_objects() -> None:
    boxes = np.array([[0.0, 0.0, 1.0, 1.0], [1.0, 1.0, 2.0, 2.0]])
    found = supervision.Detections(
        boxes, confidence=np.array([0.9, 0.5]), class_id=np.array([2, 7]), data={"class_name": np.array(["car", "truck"])}
    )
    positions = np.array([[1.0, 2.0], [3.0, 4.0]])
    expected = [ecod.PerceivedObject("car", 0.9, 1.0, 2.0), ecod.PerceivedObject("truck", 0.5, 3.0, 4.0)]
    assert ecod.from_supervision(found, positions) == expected
    unnamed = supervision.Detections(boxes, confidence=np.array([0.9, 0.5]), class_id=np.array([2, 7]))
    assert ecod.from_supervision(unnamed, positions, names={2: "car", 7: "truck"}) == expected
    assert ecod.from_supervision(found[np.array([False, False])], positions[:0]) == []
    with pytest.raises(ecod.Invalid, match="names"):
        ecod.from_supervision(unnamed, positions)
    with pytest.raises(ecod.Invalid, match="no confidence"):
        ecod.from_supervision(supervision.Detections(boxes), positions)
