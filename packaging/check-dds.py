"""Takes what `ecod-interop ros2-live` publishes, as a node of ROS does, and publishes detections for it."""

import math
import sys
import time
from dataclasses import dataclass

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float64, int32, sequence, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    position: Point
    orientation: Quaternion


@dataclass
class PoseStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    header: Header
    pose: Pose


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovariance_"):
    pose: Pose
    covariance: array[float64, 36]


@dataclass
class ObjectHypothesis(IdlStruct, typename="vision_msgs::msg::dds_::ObjectHypothesis_"):
    class_id: str
    score: float64


@dataclass
class ObjectHypothesisWithPose(IdlStruct, typename="vision_msgs::msg::dds_::ObjectHypothesisWithPose_"):
    hypothesis: ObjectHypothesis
    pose: PoseWithCovariance


@dataclass
class BoundingBox3D(IdlStruct, typename="vision_msgs::msg::dds_::BoundingBox3D_"):
    center: Pose
    size: Vector3


@dataclass
class Detection3D(IdlStruct, typename="vision_msgs::msg::dds_::Detection3D_"):
    header: Header
    results: sequence[ObjectHypothesisWithPose]
    bbox: BoundingBox3D
    id: str


@dataclass
class Detection3DArray(IdlStruct, typename="vision_msgs::msg::dds_::Detection3DArray_"):
    header: Header
    detections: sequence[Detection3D]


@dataclass
class Point2D(IdlStruct, typename="vision_msgs::msg::dds_::Point2D_"):
    x: float64
    y: float64


@dataclass
class Pose2D(IdlStruct, typename="vision_msgs::msg::dds_::Pose2D_"):
    position: Point2D
    theta: float64


@dataclass
class BoundingBox2D(IdlStruct, typename="vision_msgs::msg::dds_::BoundingBox2D_"):
    center: Pose2D
    size_x: float64
    size_y: float64


@dataclass
class Detection2D(IdlStruct, typename="vision_msgs::msg::dds_::Detection2D_"):
    header: Header
    results: sequence[ObjectHypothesisWithPose]
    bbox: BoundingBox2D
    id: str


@dataclass
class Detection2DArray(IdlStruct, typename="vision_msgs::msg::dds_::Detection2DArray_"):
    header: Header
    detections: sequence[Detection2D]


@dataclass
class RegionOfInterest(IdlStruct, typename="sensor_msgs::msg::dds_::RegionOfInterest_"):
    x_offset: uint32
    y_offset: uint32
    height: uint32
    width: uint32
    do_rectify: bool


@dataclass
class CameraInfo(IdlStruct, typename="sensor_msgs::msg::dds_::CameraInfo_"):
    header: Header
    height: uint32
    width: uint32
    distortion_model: str
    d: sequence[float64]
    k: array[float64, 9]
    r: array[float64, 9]
    p: array[float64, 12]
    binning_x: uint32
    binning_y: uint32
    roi: RegionOfInterest


@dataclass
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    transforms: sequence[TransformStamped]


# The default of ROS nodes.
DEFAULT = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(10))

NO_TURN = Quaternion(0.0, 0.0, 0.0, 1.0)
IDENTITY = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


def header(frame):
    now = time.time_ns()
    return Header(Time(now // 10**9, now % 10**9), frame)


def hypothesis(label, score):
    covariance = [0.0] * 36
    covariance[0] = covariance[7] = covariance[14] = 0.04
    return ObjectHypothesisWithPose(
        ObjectHypothesis(label, score), PoseWithCovariance(Pose(Point(0.0, 0.0, 0.0), NO_TURN), covariance)
    )


def in_space(frame, label, x, y, z):
    box = BoundingBox3D(Pose(Point(x, y, z), NO_TURN), Vector3(4.0, 1.8, 1.5))
    return Detection3DArray(header(frame), [Detection3D(header(frame), [hypothesis(label, 0.9)], box, "")])


def in_picture(frame, label, x, y, width, height):
    box = BoundingBox2D(Pose2D(Point2D(x, y), 0.0), width, height)
    return Detection2DArray(header(frame), [Detection2D(header(frame), [hypothesis(label, 0.9)], box, "")])


def optics(frame):
    k = [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]
    p = [500.0, 0.0, 320.0, 0.0, 0.0, 500.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    roi = RegionOfInterest(0, 0, 0, 0, False)
    return CameraInfo(header(frame), 480, 640, "plumb_bob", [0.0] * 5, k, IDENTITY, p, 0, 0, roi)


def main():
    kind, label, x, y = sys.argv[1], sys.argv[2], float(sys.argv[3]), float(sys.argv[4])
    participant = DomainParticipant(0)

    def reader(name, message):
        return DataReader(participant, Topic(participant, "rt/" + name, message), qos=DEFAULT)

    def writer(name, message):
        return DataWriter(participant, Topic(participant, "rt/" + name, message), qos=DEFAULT)

    maps, transforms = reader("ecod/map/detections", Detection3DArray), reader("tf", TFMessage)
    reports = reader("ecod/euclid_2/detections", Detection3DArray)
    detections = writer("detections", Detection2DArray if kind == "pictures" else Detection3DArray)
    infos = writer("camera_info", CameraInfo)
    poses = writer("camera_pose", PoseStamped)
    began, waiting = time.monotonic(), {"map", "report", "transform"}
    while waiting and time.monotonic() < began + 40:
        if kind == "map":
            detections.write(in_space("map", label, x, y, 0.75))
        elif kind == "optical":
            # 10 m ahead of the camera, 2 m to its right.
            detections.write(in_space("front_camera_optical_frame", label, 2.0, 0.0, 10.0))
        elif kind == "driving":
            # As before, of a camera that swings by 2 m along its axis, to the north.
            ahead = 2.0 * math.sin(time.monotonic() - began)
            north = Quaternion(0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
            poses.write(PoseStamped(header("map"), Pose(Point(5.0, 1.0 + ahead, 0.75), north)))
            detections.write(in_space("front_camera_optical_frame", label, 2.0, 0.0, 10.0 - ahead))
        else:
            # 1.5 m high and 10 m ahead, 2 m to the right.
            infos.write(optics("front"))
            detections.write(in_picture("front", "2", 420.0, 240.0, 10.0, 75.0))
        for sample in maps.take(N=100):
            for found in sample.detections:
                at = found.bbox.center.position
                if found.results[0].hypothesis.class_id == label and abs(at.x - x) < 0.3 and abs(at.y - y) < 0.3:
                    waiting.discard("map")
        for sample in reports.take(N=100):
            (car,) = sample.detections
            assert sample.header.frame_id == "map" and (car.bbox.center.position.x, car.bbox.center.position.y) == (30.0, 40.0)
            waiting.discard("report")
        for sample in transforms.take(N=100):
            if any(one.child_frame_id == "euclid_2_camera_optical" for one in sample.transforms):
                waiting.discard("transform")
        time.sleep(0.1)
    if waiting:
        sys.exit(f"{kind}: nothing of {sorted(waiting)} within 40 s")
    print(f"{kind}: taken and given after {time.monotonic() - began:.1f} s")


if __name__ == "__main__":
    main()
