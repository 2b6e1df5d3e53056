"""Boxes in pixels: what is sent, what detectors give, and their way onto the map of a real node."""

from __future__ import annotations

import math
import queue
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import supervision
from conftest import SOON, Server, until
from test_cell import cell, heard  # noqa: F401, fixtures

import ecod

CAMERA = ecod.Camera(1000, 1000, fx=1000, fy=1000, cx=500, cy=400, tilt_sigma_rad=0.005)

# A person of usual size 5 m ahead of CAMERA, which is 1.3 m above the ground and level.
PERSON = ecod.PixelBox("person", 0.9, 450, 320, 550, 660)


def test_boxes_of_a_program_are_on_the_map_of_a_node(edge: Callable[..., Server], cell_name: str) -> None:
    """The camera stands south of slot-0, and looks to its left on a vehicle that heads east."""
    node = edge()
    with ecod.Cell(node.address, cell_name, node="euclid", part="yolo") as cell:  # noqa: F811

        def shows_the_person(map: ecod.GlobalMap) -> bool:
            vehicle, mount = ecod.Pose.from_compass(-0.5, -5.0, 90), ecod.Mount(height_m=1.3, pan_deg=90, forward_m=0.5)
            cell.report_boxes([PERSON], camera=CAMERA, mount=mount, pose=vehicle)
            return map.landmarks[0].label == "person"

        place = until(cell.maps(timeout=SOON), shows_the_person).landmarks[0]
        assert place.contributors == ["euclid"]
        assert (place.x_m, place.y_m) == pytest.approx((0.0, 0.0), abs=0.4)
        assert not cell.counts, cell.counts


def test_a_node_refuses_what_the_client_does_not_check(edge: Callable[..., Server], cell_name: str) -> None:
    node = edge()
    with ecod.Cell(node.address, cell_name, node="euclid") as cell:  # noqa: F811
        wide = ecod.Camera(1000, 1000, horizontal_fov_deg=400)
        with pytest.raises(ecod.Refused, match="camera.horizontal_fov_deg: is 400, and must be a number from 1 to 175"):
            for _ in cell.maps(timeout=SOON):
                cell.report_boxes([], camera=wide, pose=(0, 0, 0))


def test_a_broker_that_is_no_node_places_no_boxes(cell: ecod.Cell) -> None:  # noqa: F811
    with pytest.raises(ecod.Refused, match="only nodes place boxes"):
        for _ in range(200):
            cell.report_boxes([PERSON], camera=CAMERA, pose=(0, 0, 0))
            cell._connection.closing.wait(0.05)


def test_what_no_camera_can_show_is_not_sent(cell: ecod.Cell) -> None:  # noqa: F811
    for box, expected in (
        (ecod.PixelBox("car", 0.9, 10, 10, 10, 20), r"boxes\[0\]: has no area"),
        (ecod.PixelBox("car", 0.9, 10, math.nan, 30, 20), r"boxes\[0\].y_min: nan must be a finite number"),
        (ecod.PixelBox("car", 0.9, 10, 10, 1280, 20), r"boxes\[0\]: is outside the image of 1000x1000 pixels"),
        (ecod.PixelBox("car", 90, 10, 10, 30, 20), r"boxes\[0\].confidence: 90"),
        ({"label": "car", "confidence": 0.9}, r"boxes\[0\].x_min: is missing"),
    ):
        with pytest.raises(ecod.Invalid, match=f"not sent: {expected}"):
            cell.report_boxes([box], camera=CAMERA, pose=(0, 0, 0))  # type: ignore[list-item]
    with pytest.raises(ecod.Invalid, match="needs horizontal_fov_deg, or fx, fy, cx and cy"):
        ecod.Camera(640, 480)
    with pytest.raises(ecod.Invalid, match="one of the two"):
        ecod.Camera(640, 480, 62.2, distortion=[0.1, 0, 0, 0])


def test_headings_in_degrees_are_refused_by_name(cell: ecod.Cell, heard: queue.Queue[tuple[str, Any]]) -> None:  # noqa: F811
    for report in (
        lambda: cell.report([], pose=(1.0, 6.0, -90.0)),
        lambda: cell.report_boxes([], camera=CAMERA, pose=ecod.Pose(1.0, 6.0, -90.0)),
    ):
        with pytest.raises(ecod.Invalid, match=r"pose.heading_rad: -90.0 .* radians counter-clockwise from east.*Pose.from_compass"):
            report()
    car = ecod.PerceivedObject("car", 0.9, 1.0, 2.0, heading_rad=90.0)
    for place, report in (
        (r"objects\[0\].heading_rad: 90.0 .* counter-clockwise from east", lambda: cell.report([car])),
        ("pose.pitch_rad: 10.0 .* in radians", lambda: cell.report([], pose=ecod.Pose(1.0, 6.0, 0.0, pitch_rad=10.0))),
        ("view.angle_rad: 62.2 .* in radians", lambda: cell.report([], pose=(1, 6, 0), view=ecod.FieldOfView(60.0, 62.2))),
    ):
        with pytest.raises(ecod.Invalid, match=place):
            report()
    for azimuth_deg, heading_rad in ((0, math.pi / 2), (90, 0.0), (180, -math.pi / 2), (-90, math.pi)):
        pose = ecod.Pose.from_compass(1.0, 6.0, azimuth_deg)
        assert math.cos(pose.heading_rad - heading_rad) == pytest.approx(1.0), azimuth_deg
        cell.report([], pose=pose)
        assert heard.get(timeout=SOON)[1]["pose"]["heading_rad"] == pose.heading_rad
    with pytest.raises(ecod.Invalid, match="azimuth_deg: 400"):
        ecod.Pose.from_compass(0, 0, 400)


def test_a_mount_gives_the_pose_of_the_camera() -> None:
    vehicle = ecod.Pose(1.0, 2.0, math.pi / 2)
    pose = ecod.Mount(height_m=1.1, pitch_deg=4.0, roll_deg=-1.0, pan_deg=180.0, forward_m=-2.0, left_m=0.5).camera_pose(vehicle)
    assert (pose.x_m, pose.y_m) == pytest.approx((0.5, 0.0))
    assert math.cos(pose.heading_rad + math.pi / 2) == pytest.approx(1.0)
    assert (pose.height_m, pose.pitch_rad, pose.roll_rad) == pytest.approx((1.1, math.radians(4), math.radians(-1)))


def test_a_calibration_of_the_node_gives_the_camera(tmp_path: Path) -> None:
    file = tmp_path / "calibration.toml"
    sizes = "image_width = 640\nimage_height = 480\nfx = 500.0\nfy = 501.0\ncx = 320.0\ncy = 240.0\n"
    file.write_text(f"{sizes}distortion = [-0.1, 0.01, 0.0, 0.0, 0.0]\nrms_px = 0.3\nimages = ['a.png']\n")
    expected = ecod.Camera(640, 480, fx=500.0, fy=501.0, cx=320.0, cy=240.0, distortion=[-0.1, 0.01, 0.0, 0.0, 0.0])
    assert ecod.Camera.from_calibration(str(file)) == expected
    file.write_text("fx = 500.0\n")
    with pytest.raises(ecod.Invalid, match="is no calibration"):
        ecod.Camera.from_calibration(str(file))


EDGES = np.array([[10.0, 20.5, 110.0, 90.0], [200.0, 40.0, 240.0, 120.0]], np.float32)

EXPECTED = [ecod.PixelBox("car", 0.9375, 10.0, 20.5, 110.0, 90.0), ecod.PixelBox("person", 0.5, 200.0, 40.0, 240.0, 120.0)]


class Boxes:
    """`ultralytics.engine.results.Boxes` as its reference documents it: columns that are tensors, which have tolist()."""

    xyxy, conf, cls = EDGES, np.array([0.9375, 0.5], np.float32), np.array([2.0, 0.0], np.float32)


class Results:
    """`ultralytics.engine.results.Results` of a detector."""

    boxes, names, orig_shape = Boxes(), {0: "person", 2: "car"}, (480, 640)

    def summary(self) -> list[dict[str, Any]]:
        """As documented for `Results.summary()`."""
        return [
            {"name": "car", "class": 2, "confidence": 0.9375, "box": {"x1": 10.0, "y1": 20.5, "x2": 110.0, "y2": 90.0}},
            {"name": "person", "class": 0, "confidence": 0.5, "box": {"x1": 200.0, "y1": 40.0, "x2": 240.0, "y2": 120.0}},
        ]


def test_results_of_ultralytics_become_boxes() -> None:
    assert ecod.boxes_from_ultralytics(Results()) == EXPECTED
    assert ecod.boxes_from_ultralytics(Results().summary()) == EXPECTED
    with pytest.raises(ecod.Invalid, match="one result instead of all"):
        ecod.boxes_from_ultralytics([Results()])
    with pytest.raises(ecod.Invalid, match="has no boxes"):
        ecod.boxes_from_ultralytics(EDGES)


def test_detections_of_supervision_become_boxes() -> None:
    columns: dict[str, Any] = {"confidence": np.array([0.9375, 0.5]), "class_id": np.array([2, 0])}
    found = supervision.Detections(EDGES, data={"class_name": np.array(["car", "person"])}, **columns)
    assert ecod.boxes_from_supervision(found) == EXPECTED
    unnamed = supervision.Detections(EDGES, **columns)
    assert ecod.boxes_from_supervision(unnamed, names={0: "person", 2: "car"}) == EXPECTED
    assert ecod.boxes_from_supervision(supervision.Detections.empty(), names={}) == []
    with pytest.raises(ecod.Invalid, match="names"):
        ecod.boxes_from_supervision(unnamed)


def test_results_of_coco_become_boxes() -> None:
    categories = [{"id": 1, "name": "person", "supercategory": "person"}, {"id": 3, "name": "car", "supercategory": "vehicle"}]
    results = [
        {"image_id": 7, "category_id": 3, "bbox": [10.0, 20.5, 100.0, 69.5], "score": 0.9375},
        {"image_id": 7, "category_id": 1, "bbox": [200.0, 40.0, 40.0, 80.0], "score": 0.5},
        {"image_id": 8, "category_id": 1, "bbox": [0.0, 0.0, 1.0, 1.0], "score": 0.4},
    ]
    assert ecod.boxes_from_coco(results, categories, image_id=7) == EXPECTED
    assert ecod.boxes_from_coco(results[:2], categories) == EXPECTED
    with pytest.raises(ecod.Invalid, match="of 2 images; give the `image_id`"):
        ecod.boxes_from_coco(results, categories)
    with pytest.raises(ecod.Invalid, match="a category for each: KeyError"):
        ecod.boxes_from_coco(results[:1], categories[:1])
