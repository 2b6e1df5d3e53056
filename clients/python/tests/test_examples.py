"""The examples, run as users run them."""

from __future__ import annotations

import contextlib
import json
import math
import os
import runpy
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import SOON, Server, until, wait_for
from test_cell import passwords
from test_codec import MAP
from test_node import pki  # noqa: F401, a fixture

import ecod
from ecod.codec import decode

EXAMPLES = Path(__file__).parents[1] / "examples"

# What a detector of any kind writes about a frame.
FRAME = '{"objects":[{"label":"car","confidence":0.9,"x_m":0.1,"y_m":0.1,"landmark":"slot-0"}],"seen":["slot-0","slot-1"]}'


@contextlib.contextmanager
def example(name: str, *arguments: str, **settings: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, str(EXAMPLES / name), *arguments],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, **settings},
    )  # fmt: skip
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def feed(broker: str, *arguments: str, cell: str = "lot-1", lines: list[str]) -> tuple[int, str]:
    """Runs the feeding example on ten lines a second; gives how it ended, and what it said."""
    named = ["--broker", broker, "--cell", cell, "--node", "euclid", "--pose", "1", "6", "-90", *arguments]
    with example("feed_detections.py", *named) as process:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it may have left
            for line in lines:
                process.stdin.write(line + "\n")
                process.stdin.flush()
                time.sleep(0.1)
        out, err = process.communicate(timeout=SOON)
        return process.returncode, out + err


@pytest.mark.parametrize("name", ["feed_detections.py", "yolo_loop.py", "brake_planner.py"])
def test_a_heading_is_given_by_degrees_of_either_kind(name: str) -> None:
    pose_of: Callable[..., Any] = runpy.run_path(str(EXAMPLES / name))["pose_of"]
    for south in (pose_of([1.0, 6.0, -90.0], None), pose_of([1.0, 6.0], 180.0)):
        assert (south.x_m, south.y_m, south.heading_rad) == pytest.approx((1.0, 6.0, -math.pi / 2))
    for place, azimuth_deg in (([1.0, 6.0], None), ([1.0, 6.0, 90.0], 180.0)):
        with pytest.raises(SystemExit, match="X_M Y_M with --azimuth DEG"):
            pose_of(place, azimuth_deg)


def test_a_detector_may_run_without_a_pose() -> None:
    pose_of: Callable[..., Any] = runpy.run_path(str(EXAMPLES / "feed_detections.py"))["pose_of"]
    assert pose_of(None, None) is None
    with pytest.raises(SystemExit, match="X_M Y_M with --azimuth DEG"):
        pose_of(None, 180.0)


def leads(edge: Server, cell_name: str, **settings: Any) -> None:
    """Waits for the edge's first map."""
    with ecod.Cell(edge.address, cell_name, **settings) as cell:
        next(cell.maps(timeout=SOON))


def was_fed(code: int, said: str) -> bool:
    """True unless the program failed. On a busy machine the connection may take a frame too slowly, which the program states."""
    return code == 0 or (code == 1 and said.rstrip().endswith("frames were not sent: the broker is gone or takes them too slowly"))


def test_a_detector_feeds_a_cell_and_what_is_agreed_on_is_printed(edge: Callable[..., Server], cell_name: str) -> None:
    junk = ["loading model", '{"seen":["slot-0"]}', "[1]", FRAME.replace("0.1", "NaN")]
    node = edge()
    leads(node, cell_name)
    code, said = feed(node.address, cell=cell_name, lines=[FRAME] * 3 + junk + [FRAME] * 17)
    assert was_fed(code, said), said
    for parts in (["map ", "slot-0: car 0.", "slot-1: empty"], ["verdicts ", "edge round ", "slot-0: car by "]):
        assert any(all(part in line for part in parts) for line in said.splitlines()), said
    assert [said.count(f"line {number} skipped: ") for number in range(3, 9)] == [0, 1, 1, 1, 1, 0], said
    assert said.count("skipped") == 4, said


def test_a_detector_feeds_a_cell_with_certificates_by_its_own(
    edge: Callable[..., Server], cell_name: str, pki: Callable[..., dict[str, str]]  # noqa: F811
) -> None:
    own, other = pki("edge", "edge"), pki("euclid", "cav")
    node = edge(ECOD_TLS__CA=own["ca"], ECOD_TLS__CERTIFICATE=own["cert"], ECOD_TLS__KEY=own["key"])
    files = [word for name, file in other.items() for word in (f"--{name}", file)]
    leads(node, cell_name, node="euclid", part="watch", **other)
    code, said = feed(node.address, *files, cell=cell_name, lines=[FRAME] * 15)
    assert was_fed(code, said) and "slot-0: car 0." in said, said
    code, said = feed(node.address, *files, "--broker-name", "broker.example", cell=cell_name, lines=[FRAME])
    assert code == 1 and f"no TLS with {node.address}" in said, said


def test_a_detector_is_told_that_the_broker_refuses_or_is_gone(mosquitto: Callable[..., Server], tmp_path: Path) -> None:
    broker = mosquitto("allow_anonymous false", f"password_file {passwords(tmp_path, 'ada', 'hush4711')}")
    code, said = feed(broker.address, "--user", "ada", "--password", "wrong", lines=[FRAME])
    assert code == 1 and "refuses the login: Not authorized" in said, said
    code, said = feed(broker.address, "--user", "ada", "--password", "hush4711", lines=[FRAME] * 3)
    assert code == 0, said

    logins = broker.log.read_text().count(" as euclid-")

    class Gone(list[str]):
        def __iter__(self) -> Iterator[str]:
            yield from [FRAME] * 20
            wait_for(lambda: broker.log.read_text().count(" as euclid-") > logins)
            yield from [FRAME] * 2
            broker.kill()
            yield from [FRAME] * 10

    code, said = feed(broker.address, "--user", "ada", "--password", "hush4711", lines=Gone())
    assert code == 1 and "of 32 frames were not sent" in said, said


def test_the_planner_brakes_for_an_object_ahead_and_without_maps(edge: Callable[..., Server], cell_name: str) -> None:
    node = edge(ECOD_FUSION__TRACKS__MODE="on")
    at = {"ECOD_BROKER": node.address, "ECOD_CELL": cell_name, "ECOD_NAME": "gauss"}
    with example("brake_planner.py", "--pose", "0", "0", "--azimuth", "90", "--speed", "10", **at) as planner:
        said: list[str] = []
        threading.Thread(target=lambda: said.extend(iter(planner.stdout.readline, "")), daemon=True).start()  # type: ignore[union-attr]
        wait_for(lambda: said[-1:] == ["GO: nothing is in the way\n"])
        with ecod.Cell(node.address, cell_name, node="gauss") as own, ecod.Cell(node.address, cell_name, node="euclid") as other:

            def seen_at(x_m: float) -> Callable[[ecod.GlobalMap], bool]:
                def report(map: ecod.GlobalMap) -> bool:
                    own.report([], pose=(0.5, 0.0, 0.0))
                    other.report([ecod.PerceivedObject("car", 0.9, x_m, 0.5, (0.01, 0.0, 0.01))], pose=(30.0, 20.0, -1.57))
                    return any(not thing.vehicle and abs(thing.x_m - x_m) < 0.5 for thing in map.objects)

                return report

            until(own.maps(timeout=SOON), seen_at(25.0))
            near = seen_at(15.0)
            until(own.maps(timeout=SOON), lambda map: near(map) and any(line.startswith("BRAKE: an object is 1") for line in said))
            # The object goes away, and then the edge.
            until(own.maps(timeout=SOON), seen_at(60.0))
            wait_for(lambda: own.report([], pose=(0.5, 0.0, 0.0)) and said[-1].startswith("GO"))
        node.kill()
        wait_for(lambda: said[-1] == "BRAKE: no map for 0.5 s\n")


def test_the_planner_knows_its_way_from_beside_it() -> None:
    planner = runpy.run_path(str(EXAMPLES / "brake_planner.py"))
    distance: Callable[..., Any] = planner["distance_ahead"]
    thing = MAP["objects"][0]

    def map_with(**changes: Any) -> ecod.GlobalMap:
        map: ecod.GlobalMap = decode(ecod.GlobalMap, json.dumps({**MAP, "objects": [{**thing, **changes}]}).encode())
        return map

    north = ecod.Pose(1.0, 2.0, math.pi / 2)
    still: dict[str, Any] = {"velocity_mps": None, "size_m": None}
    assert distance(map_with(x_m=2.0, y_m=12.0, **still), "gauss", north, 0.1) == pytest.approx(10.0)
    assert distance(map_with(x_m=3.0, y_m=12.0, **still), "gauss", north, 0.1) is None, "beside"
    assert distance(map_with(x_m=3.0, y_m=12.0, velocity_mps=None, size_m=[4, 2]), "gauss", north, 0.1) == pytest.approx(10.0), "wide"
    assert distance(map_with(x_m=1.0, y_m=1.0, **still), "gauss", north, 0.1) is None, "behind"
    assert distance(map_with(x_m=1.0, y_m=12.0, size_m=None, velocity_mps=[0, -10]), "gauss", north, 0.1) == pytest.approx(9.0), "nearing"
    assert distance(map_with(x_m=1.0, y_m=12.0, vehicle="gauss--lidar", **still), "gauss", north, 0.1) is None, "itself"
    assert planner["stopping_distance"](10.0) == pytest.approx(17.5)


def test_feet_of_boxes_are_placed_and_the_sky_is_not() -> None:
    place: Callable[..., Any] = runpy.run_path(str(EXAMPLES / "yolo_loop.py"))["on_the_ground"]
    # A camera 2 m above the ground, level, 100 pixels focal length, looking along x; the horizon is at v = 100.
    homography = np.array([[0.0, 0.0, 200.0], [-2.0, 0.0, 200.0], [0.0, 1.0, -100.0]])
    boxes = np.array([[90.0, 100.0, 110.0, 120.0], [190.0, 0.0, 210.0, 150.0], [0.0, 0.0, 10.0, 90.0]])
    for scale in (1.0, -0.01):
        placed = place(homography * scale, boxes, 200, 200)
        assert placed[:2] == pytest.approx(np.array([[10.0, 0.0], [4.0, -4.0]]))
        assert np.isnan(placed[2]).all()
    assert len(place(homography, boxes[:0], 200, 200)) == 0


STAND_IN = """
import time
import numpy as np

class Tensor(np.ndarray):
    def cpu(self): return self
    def numpy(self): return np.asarray(self)

def tensor(value): return np.array(value).view(Tensor)

class Boxes:
    xyxy, conf, cls, id = tensor([[0.0, 0.0, 2.0, 3.0], [0.0, 0.0, 9.0, 9.0]]), tensor([0.9, 0.8]), tensor([2.0, 2.0]), None

class Result:
    names, boxes, masks, obb = {2: "car"}, Boxes(), None, None

class YOLO:
    def __init__(self, weights): assert weights == "yolo11n.pt"
    def __call__(self, frame, verbose):
        time.sleep(0.05)
        return [Result()]
"""


def test_yolo_reports_what_it_sees(edge: Callable[..., Server], cell_name: str, tmp_path: Path) -> None:
    """The detector is a stand-in; the rest is real, also the video."""
    (tmp_path / "ultralytics.py").write_text(STAND_IN)
    np.savetxt(tmp_path / "ground.txt", np.eye(3))
    video = cv2.VideoWriter(str(tmp_path / "video.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 20, (64, 48))
    for _ in range(60):
        video.write(np.zeros((48, 64, 3), np.uint8))
    video.release()
    node = edge(ECOD_FUSION__TRACKS__MODE="on")
    env = {"ECOD_BROKER": node.address, "ECOD_CELL": cell_name, "ECOD_NAME": "euclid", "PYTHONPATH": str(tmp_path)}
    files = ["--source", str(tmp_path / "video.avi"), "--homography", str(tmp_path / "ground.txt")]
    with ecod.Cell(node.address, cell_name) as cell, example("yolo_loop.py", *files, "--pose", "1", "6", "--azimuth", "180", **env) as yolo:

        def are_there(map: ecod.GlobalMap) -> bool:
            assert yolo.poll() in (None, 0), yolo.communicate()
            return sum(not thing.vehicle for thing in map.objects) == 2

        map = until(cell.maps(timeout=SOON), are_there)
        cars = sorted((thing for thing in map.objects if not thing.vehicle), key=lambda thing: thing.x_m)
        assert [(car.label, car.contributors) for car in cars] == [("car", ["euclid"])] * 2
        assert [(car.x_m, car.y_m) for car in cars] == [pytest.approx(at, abs=0.1) for at in ((1.0, 3.0), (4.5, 9.0))]
        said = yolo.communicate(timeout=SOON)
        assert yolo.returncode == 0, said
