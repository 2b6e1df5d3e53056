"""Values of the wrong shape, type or range: each is taken or refused as `Invalid` with its place, before anything is sent."""

from __future__ import annotations

import math
from collections.abc import Callable
from decimal import Decimal
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import ecod
from ecod.cell import micros
from ecod.codec import encode
from ecod.geo import Origin


def sent(**fields: Any) -> bytes:
    """The payload of a report whose only object has these fields."""
    car = ecod.PerceivedObject(**{"label": "car", "confidence": 0.9, "x_m": 1, "y_m": 2, **fields})
    return encode(ecod.ObjectReport(1, "edge", 1, 1, [car]))


def convert(**arrays: Any) -> Any:
    return ecod.from_arrays(**{"labels": ["car"], "confidences": [0.9], "positions": [[1, 2]], **arrays})


EQUATOR = Origin(0, 0)
NAMELESS = SimpleNamespace(confidence=[0.9], class_id=[7], data={})

INVALID: list[tuple[str, Callable[[], Any]]] = [
    ("label", lambda: sent(label="\ud800")),
    ("label", lambda: sent(label=b"car")),
    ("label", lambda: sent(label="car\u202e")),
    ("label", lambda: sent(label="\ufdfa" * 4)),
    ("x_m", lambda: sent(x_m=10**400)),
    ("x_m", lambda: sent(x_m=np.array(1.0))),
    ("x_m", lambda: sent(x_m=Decimal(1))),
    ("x_m", lambda: sent(x_m=math.nan)),
    ("x_m", lambda: sent(x_m=True)),
    ("covariance_m2", lambda: sent(covariance_m2={1, 2, 3})),
    ("covariance_m2", lambda: sent(covariance_m2=np.eye(2))),
    ("size_m", lambda: sent(size_m=(1, 2, 3))),
    ("scores", lambda: sent(scores=[("car", 0.5)])),
    ("captured_at", lambda: micros("now")),  # type: ignore[arg-type]
    ("covariances.0.", lambda: convert(covariances=np.array([np.eye(3)]))),
    ("covariances.0.", lambda: convert(covariances=[[1, 0, 0, 1]])),
    ("covariances.0.", lambda: convert(covariances=[1.0])),
    ("symmetric", lambda: convert(covariances=[[[1, 0.5], [0, 1]]])),
    ("positions.0.", lambda: convert(positions=[[1]])),
    ("positions.0.", lambda: convert(positions=[[1, 2, 3]])),
    ("positions.0.", lambda: convert(positions=[1])),
    ("positions.0..1.", lambda: convert(positions=[[1, math.inf]])),
    ("velocities.0.", lambda: convert(velocities=[[1, 2, 3]])),
    ("confidences.0.", lambda: convert(confidences=["0.9"])),
    ("confidences.0.", lambda: convert(confidences=[None])),
    ("confidences must be a list", lambda: convert(confidences=0.9)),
    ("labels must be a list", lambda: convert(labels="car")),
    ("labels must be a list", lambda: convert(labels=None)),
    ("names", lambda: ecod.from_supervision(NAMELESS, [[1, 2]], names={0: "car"})),
    ("supervision.Detections", lambda: ecod.from_supervision(5, [[1, 2]])),
    ("latitude_deg: 179.9", lambda: Origin(0, 179.9999).to_map(179.9, 0.1)),
    ("latitude_deg", lambda: EQUATOR.to_map(math.nan, 0)),
    ("latitude_deg", lambda: EQUATOR.to_map("0", "1")),  # type: ignore[arg-type]
    ("longitude_deg", lambda: EQUATOR.to_map(0, 400)),
    ("height_m", lambda: EQUATOR.to_map(0, 0, math.inf)),
    ("latitude_deg", lambda: Origin(None, 0)),  # type: ignore[arg-type]
    ("rotation_rad", lambda: Origin(0, 0, 0, math.nan)),
    ("x_m", lambda: EQUATOR.to_wgs84("1", 2)),  # type: ignore[arg-type]
    ("y_m", lambda: EQUATOR.to_wgs84(1, math.nan)),
    ("azimuth_deg", lambda: EQUATOR.pose(0, 0, math.nan)),
    ("azimuth_deg: 450", lambda: EQUATOR.pose(0, 0, 450)),
]


@pytest.mark.parametrize("place, call", INVALID)
def test_what_cannot_be_meant_is_invalid_with_its_place(place: str, call: Callable[[], Any]) -> None:
    with pytest.raises(ecod.Invalid, match=place):
        call()


def test_numbers_of_every_library_are_taken() -> None:
    assert sent(x_m=np.float32(1.5), covariance_m2=np.array([1.0, 0, 1]), size_m=[4, 2]) == sent(
        x_m=1.5, covariance_m2=(1, 0, 1), size_m=(4, 2)
    )
    assert convert(positions=np.array([[1, 2]]), confidences=np.array([0.9])) == convert()
    assert convert(covariances=np.eye(2)[None]) == convert(covariances=[(1, 0, 1)])
    assert EQUATOR.to_map(np.float64(0.001), 0) == EQUATOR.to_map(0.001, 0)


def test_unicode_forms_of_a_label_are_one() -> None:
    cafe = sent(label="caf\u00e9")
    assert sent(label="cafe\u0301") == cafe
    assert sent(label="\uff43\uff41\uff46\u00e9") == cafe
    assert sent(label="x", scores={"cafe\u0301": 0.5}) == sent(label="x", scores={"caf\u00e9": 0.5})
