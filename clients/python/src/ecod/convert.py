"""Objects and boxes of reports from what detectors give.

Positions are metres in the cell's frame, boxes pixels of the image, one row for each detection.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Optional

from .codec import is_list, number_of, numbers_of
from .errors import Invalid
from .messages import PerceivedObject, PixelBox


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
    return from_arrays(_labels_of(detections, names), detections.confidence, positions)


def boxes_from_supervision(detections: Any, *, names: Optional[Mapping[int, str]] = None) -> list[PixelBox]:
    """Boxes from `supervision.Detections`, for `Cell.report_boxes`.

    Labels are the detections' own class names, or those of `names` by class.
    """
    labels = _labels_of(detections, names)
    if not hasattr(detections, "xyxy"):
        raise Invalid(f"{type(detections).__name__} has no xyxy: it must be supervision.Detections")
    return _boxes(labels, detections.confidence, detections.xyxy)


def boxes_from_ultralytics(result: Any) -> list[PixelBox]:
    """Boxes from one of the results of an `ultralytics` model, or from its `summary()`, for `Cell.report_boxes`."""
    if isinstance(result, list):
        try:
            edges = [[item["box"][name] for name in ("x1", "y1", "x2", "y2")] for item in result]
            return _boxes([item["name"] for item in result], [item["confidence"] for item in result], edges)
        except (LookupError, TypeError) as error:
            raise Invalid(f"the list must be a summary() of ultralytics, or give one result instead of all: {error!r}") from None
    found, names = getattr(result, "boxes", None), getattr(result, "names", None)
    if found is None or names is None:
        raise Invalid(f"{type(result).__name__} has no boxes with names: it must be one result of a detector of ultralytics")
    classes, confidences, edges = (values.tolist() for values in (found.cls, found.conf, found.xyxy))
    try:
        labels = [names[int(number)] for number in classes]
    except LookupError as error:
        raise Invalid(f"`names` of the result must have a name for every class: {error!r}") from None
    return _boxes(labels, confidences, edges)


def boxes_from_coco(results: Iterable[Mapping[str, Any]], categories: Iterable[Mapping[str, Any]], image_id: Any = None) -> list[PixelBox]:
    """Boxes of one image from results in COCO's JSON, for `Cell.report_boxes`.

    `results` have `bbox` [x, y, width, height], `score`, `category_id` and `image_id`; `categories` are those of the
    annotations, with `id` and `name`. Without an `image_id`, all results must be of one image.
    """
    try:
        names = {category["id"]: category["name"] for category in categories}
        chosen = [item for item in results if image_id is None or item["image_id"] == image_id]
        images = {item.get("image_id") for item in chosen}
        if len(images) > 1:
            raise Invalid(f"the results are of {len(images)} images; give the `image_id` of one")
        labels = [names[item["category_id"]] for item in chosen]
        boxes = [numbers_of(item["bbox"], "x y width height", f"results[{row}].bbox") for row, item in enumerate(chosen)]
        scores = [item["score"] for item in chosen]
    except (LookupError, TypeError) as error:
        raise Invalid(f"the results must be COCO's, with a category for each: {error!r}") from None
    return _boxes(labels, scores, [[x, y, x + width, y + height] for x, y, width, height in boxes])


def _boxes(labels: list[Any], confidences: Any, edges: Any) -> list[PixelBox]:
    """Boxes from rows of labels, confidences and edges [left, top, right, bottom]."""
    boxes = []
    for row, label in enumerate(labels):
        x_min, y_min, x_max, y_max = numbers_of(edges[row], "left top right bottom", f"boxes[{row}]")
        boxes.append(PixelBox(str(label), number_of(confidences[row], f"confidences[{row}]"), x_min, y_min, x_max, y_max))
    return boxes


def _labels_of(detections: Any, names: Optional[Mapping[int, str]]) -> list[Any]:
    """The label of each of `supervision.Detections`, which must have confidences."""
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
    return list(labels)


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
