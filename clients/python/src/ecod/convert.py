"""Objects of a report from what detectors give. Positions are metres in the cell's frame, one row for each detection."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Optional

from .codec import is_list, number_of, numbers_of
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

    `positions` and `velocities` are [east, north]. `covariances` are [xx, xy, yy], or symmetric matrices of 2 × 2.
    Raises `Invalid` with the row for values of another shape and for numbers that are not finite.
    """
    number = _rows("labels", labels)
    for name, array in (
        ("confidences", confidences),
        ("positions", positions),
        ("covariances", covariances),
        ("velocities", velocities),
    ):
        if array is not None and _rows(name, array) != number:
            raise Invalid(f"{name} has {len(array)} rows, labels has {number}")
    objects = []
    for row in range(number):
        x_m, y_m = numbers_of(positions[row], "east north", f"positions[{row}]")
        velocity = None
        if velocities is not None:
            east, north = numbers_of(velocities[row], "east north", f"velocities[{row}]")
            velocity = (east, north)
        objects.append(
            PerceivedObject(
                label=str(labels[row]),
                confidence=number_of(confidences[row], f"confidences[{row}]"),
                x_m=x_m,
                y_m=y_m,
                covariance_m2=None if covariances is None else _covariance(covariances[row], f"covariances[{row}]"),
                velocity_mps=velocity,
            )
        )
    return objects


def from_supervision(detections: Any, positions: Any, *, names: Optional[Mapping[int, str]] = None) -> list[PerceivedObject]:
    """Objects from `supervision.Detections`, whose boxes stand at `positions`.

    Labels are the detections' own class names, or those of `names` by class.
    """
    missing = [name for name in ("confidence", "class_id", "data") if not hasattr(detections, name)]
    if missing:
        raise Invalid(f"{type(detections).__name__} has no {missing[0]}: it must be supervision.Detections")
    if detections.confidence is None:
        raise Invalid("the detections have no confidence")
    labels: Optional[Iterable[Any]] = detections.data.get("class_name")
    if names is not None and detections.class_id is not None:
        try:
            labels = [names[int(number)] for number in detections.class_id]
        except (LookupError, TypeError, ValueError) as error:
            raise Invalid(f"`names` must have a name for every class of the detections: {error!r}") from None
    if labels is None:
        raise Invalid("the detections have no class names; give them as `names`, by class")
    return from_arrays(list(labels), detections.confidence, positions)


def _rows(name: str, array: Any) -> int:
    if not is_list(array):
        raise Invalid(f"{name} must be a list or an array with one row for each detection, not {type(array).__name__}")
    return len(array)


def _covariance(given: Any, place: str) -> tuple[float, float, float]:
    if is_list(given) and len(given) == 2:
        xx, xy = numbers_of(given[0], "xx xy", f"{place}[0]")
        yx, yy = numbers_of(given[1], "xy yy", f"{place}[1]")
        # Filters in float16 and float32 leave rounding errors.
        if abs(xy - yx) > 1e-3 * (abs(xx) + abs(yy)):
            raise Invalid(f"{place}: a covariance is a symmetric matrix, but has {xy} and {yx} beside its diagonal")
        return xx, (xy + yx) / 2, yy
    xx, xy, yy = numbers_of(given, "xx xy yy", place)
    return xx, xy, yy
