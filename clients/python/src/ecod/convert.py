"""Objects of a report from what detectors give. Positions are metres in the cell's frame, one row for each detection."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Optional

from .errors import Invalid
from .messages import PerceivedObject


def from_arrays(
    labels: Any,
    confidences: Any,
    positions: Any,
    *,
    covariances: Optional[Any] = None,
    velocities: Optional[Any] = None,
) -> list[PerceivedObject]:
    """Objects from numpy arrays or lists of equal length.

    `positions` and `velocities` are [east, north]. `covariances` are [xx, xy, yy], or matrices of 2 × 2.
    """
    number = len(labels)
    for name, array in (
        ("confidences", confidences),
        ("positions", positions),
        ("covariances", covariances),
        ("velocities", velocities),
    ):
        if array is not None and len(array) != number:
            raise Invalid(f"{name} has {len(array)} rows, labels has {number}")
    return [
        PerceivedObject(
            label=str(labels[row]),
            confidence=float(confidences[row]),
            x_m=float(positions[row][0]),
            y_m=float(positions[row][1]),
            covariance_m2=None if covariances is None else _covariance(covariances[row]),
            velocity_mps=None if velocities is None else (float(velocities[row][0]), float(velocities[row][1])),
        )
        for row in range(number)
    ]


def from_supervision(detections: Any, positions: Any, *, names: Optional[Mapping[int, str]] = None) -> list[PerceivedObject]:
    """Objects from `supervision.Detections`, whose boxes stand at `positions`.

    Labels are the detections' own class names, or those of `names` by class.
    """
    if detections.confidence is None:
        raise Invalid("the detections have no confidence")
    labels: Optional[Iterable[Any]] = detections.data.get("class_name")
    if names is not None and detections.class_id is not None:
        labels = [names[int(number)] for number in detections.class_id]
    if labels is None:
        raise Invalid("the detections have no class names; give them as `names`, by class")
    return from_arrays(list(labels), detections.confidence, positions)


def _covariance(given: Any) -> tuple[float, float, float]:
    xx, xy, yy = given if len(given) == 3 else (given[0][0], given[0][1], given[1][1])
    return float(xx), float(xy), float(yy)
