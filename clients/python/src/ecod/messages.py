"""Payloads of a cell, with the names of their JSON Schemas.

Times are Unix microseconds, lengths metres, angles radians counter-clockwise from east. Positions are in the cell's
east-north frame. Fields stand in the order of the compact encoding (docs/protocol.md), which has no names.
"""

from __future__ import annotations

import math
import re
import sys
import unicodedata
import uuid
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone
from typing import Annotated, Any, Callable, Literal, NamedTuple, Optional

from .errors import Invalid

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SCHEMA_VERSION = 1


class Rule(NamedTuple):
    """A condition on a field's value, its wording, and the form in which the value is kept."""

    holds: Callable[[Any], bool]
    text: str
    form: Callable[[Any], Any] = lambda value: value


# Marks a field that the compact encoding gives in whole millimetres.
MILLIMETRES = "millimetres"


def _between(low: float, high: float) -> Rule:
    return Rule(lambda value: low <= value <= high, f"must be from {low:g} to {high:g}")


def _at_most(number: int) -> Rule:
    return Rule(lambda items: len(items) <= number, f"must have at most {number} entries")


# Characters that control a device, break lines or change the direction of other text.
CONTROLS = re.compile("[\0-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def _is_label(text: str) -> bool:
    try:
        return 1 <= len(text.encode()) <= 64 and not CONTROLS.search(text)
    except UnicodeEncodeError:  # half of a character, which no encoding has
        return False


def _is_uuid(text: str) -> bool:
    try:
        return bool(uuid.UUID(text))
    except ValueError:
        return False


def _is_covariance(covariance: tuple[float, float, float]) -> bool:
    xx, xy, yy = covariance
    return math.isfinite(xx * yy) and xx >= 0 and yy >= 0 and xy * xy <= xx * yy * (1 + 1e-9)


def is_name(text: str) -> bool:
    """Whether nodes and cells may have this name."""
    return re.fullmatch("[A-Za-z0-9_-]{1,64}", text) is not None


Schema = Annotated[int, Rule(lambda value: value == SCHEMA_VERSION, "is unknown: this package reads version 1")]
Count = Annotated[int, Rule(lambda value: 0 <= value < 2**53, "must be from 0 to 2⁵³ − 1")]
Name = Annotated[str, Rule(is_name, "must be 1 to 64 of A-Z a-z 0-9 _ -")]
Label = Annotated[
    str,
    Rule(
        _is_label,
        "must have 1 to 64 bytes in UTF-8 and no control characters",
        # As nodes compare labels.
        lambda text: unicodedata.normalize("NFKC", text),
    ),
]
Uuid = Annotated[str, Rule(_is_uuid, "must be a UUID")]
Hash = Annotated[str, Rule(lambda text: re.fullmatch("[0-9a-f]{64}", text) is not None, "must be 64 hexadecimal digits")]
Fraction = Annotated[float, _between(0, 1)]
Metres = Annotated[float, _between(-1e8, 1e8), MILLIMETRES]
Size = Annotated[float, _between(0, 1e5)]
Height = Annotated[float, _between(0, 1e5), MILLIMETRES]
Speed = Annotated[float, _between(-1e4, 1e4)]
# A full turn, with room for its rounding to four decimals or 32 bits; exact in 32 bits.
TURN_BOUND = 13_176_827 / 2_097_152
Angle = Annotated[float, Rule(lambda value: abs(value) <= TURN_BOUND, "must be from -2π to 2π: angles are in radians")]
OpeningAngle = Annotated[float, Rule(lambda value: 0 <= value <= TURN_BOUND, "must be from 0 to 2π: angles are in radians")]
Heading = Annotated[
    float,
    Rule(
        lambda value: abs(value) <= TURN_BOUND,
        "must be from -2π to 2π: headings are in radians counter-clockwise from east, and `Pose.from_compass` takes degrees",
    ),
]
YawRate = Annotated[float, _between(-100, 100)]
Score = Annotated[float, _between(-1e9, 1e9)]
Margin = Annotated[float, _between(0, 1e9)]
Amount = Annotated[float, _between(0, 2**53 - 1)]
Covariance = Annotated[tuple[float, float, float], Rule(_is_covariance, "must be a covariance [xx, xy, yy]")]


def time_of(micros: int) -> datetime:
    """The time of a field whose name ends in `_us`, in UTC."""
    return datetime(1970, 1, 1, tzinfo=timezone.utc) + timedelta(microseconds=micros)


def check_azimuth(azimuth_deg: float) -> None:
    """Raises `Invalid` beyond ±360°."""
    if not abs(azimuth_deg) <= 360:
        raise Invalid(f"azimuth_deg: {azimuth_deg!r} must be from -360 to 360, degrees clockwise from north")


@dataclass(frozen=True)
class Pose:
    """Pose of a camera or a vehicle (`WirePose` in the schema). The heading is in radians, counter-clockwise from east."""

    x_m: Metres
    y_m: Metres
    heading_rad: Heading
    height_m: Optional[Height] = None
    """Above the ground."""
    pitch_rad: Optional[Angle] = None
    """Below the horizon."""
    roll_rad: Optional[Angle] = None
    """Leaning to the right."""

    @classmethod
    def from_compass(cls, x_m: float, y_m: float, azimuth_deg: float) -> Pose:
        """A pose from a heading in degrees clockwise from the map's north, which is its y axis.

        It is true north unless the cell's `[origin]` rotates the map; `geo.Origin.pose` takes latitude and longitude.
        Raises `Invalid` for an azimuth beyond ±360°.
        """
        check_azimuth(azimuth_deg)
        return cls(x_m, y_m, math.remainder(math.radians(90 - azimuth_deg), math.tau))


@dataclass(frozen=True)
class Mount:
    """Mount of a camera on its vehicle, by the names of `camera.mount` in a node's configuration.

    Metres ahead and to the left of the vehicle's reference point, and above the ground; degrees counter-clockwise from
    the vehicle's heading (`pan_deg`), below the horizon (`pitch_deg`), and leaning to the camera's right (`roll_deg`).
    Without a height objects are ranged by their size only.
    """

    height_m: Optional[float] = None
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    pan_deg: float = 0.0
    forward_m: float = 0.0
    left_m: float = 0.0

    def camera_pose(self, vehicle: Pose) -> Pose:
        """Pose of the camera for a pose of its vehicle."""
        c, s = math.cos(vehicle.heading_rad), math.sin(vehicle.heading_rad)
        return Pose(
            vehicle.x_m + c * self.forward_m - s * self.left_m,
            vehicle.y_m + s * self.forward_m + c * self.left_m,
            math.remainder(vehicle.heading_rad + math.radians(self.pan_deg), math.tau),
            self.height_m,
            math.radians(self.pitch_deg),
            math.radians(self.roll_deg),
        )


@dataclass(frozen=True)
class FieldOfView:
    """Range and opening angle of a sensor, centred on the heading of the pose."""

    range_m: Size
    angle_rad: OpeningAngle


@dataclass(frozen=True)
class PerceivedObject:
    """A detection with its position in the cell's frame."""

    label: Label
    confidence: Fraction
    x_m: Metres
    y_m: Metres
    covariance_m2: Optional[Covariance] = None
    landmark: Optional[Label] = None
    velocity_mps: Optional[tuple[Speed, Speed]] = None
    heading_rad: Optional[Heading] = None
    size_m: Optional[tuple[Size, Size]] = None
    scores: Annotated[dict[Label, Fraction], _at_most(256)] = field(default_factory=dict)


@dataclass(frozen=True)
class ObjectReport:
    """The detections of one vehicle in one frame."""

    schema: Schema
    node: Name
    seq: Count
    captured_at_us: Count
    objects: Annotated[list[PerceivedObject], _at_most(1024)]
    pose: Optional[Pose] = None
    seen: Optional[Annotated[list[Label], _at_most(1024)]] = None
    view: Optional[FieldOfView] = None
    # Maximum error of the stamp, from a node with the cell's time. Programs leave it out.
    clock_error_us: Optional[Count] = None
    # Counter-clockwise rate of a turning frame, such as a frame that is fixed to a vehicle.
    frame_yaw_rate_radps: Optional[YawRate] = None
    moving: Optional[bool] = None


@dataclass(frozen=True)
class Camera:
    """Size, optics and accuracy of a camera (`BoxCamera` in the schema).

    The names are those of `camera.optics`, calibration files and `camera.projection` of a node.

    The optics are a field of view in degrees or, from a calibration, focal lengths and principal point in pixels, perhaps
    with OpenCV's coefficients of distortion. `from_calibration` reads them from a file. The standard deviations have the
    defaults of a node's camera, with 3 pixels for the edges of boxes.
    """

    width_px: int
    height_px: int
    horizontal_fov_deg: Optional[float] = None
    vertical_fov_deg: Optional[float] = None
    fx: Optional[float] = None
    fy: Optional[float] = None
    cx: Optional[float] = None
    cy: Optional[float] = None
    distortion: list[float] = field(default_factory=list)
    pixel_sigma_px: Optional[float] = None
    heading_sigma_rad: Optional[float] = None
    tilt_sigma_rad: Optional[float] = None
    height_sigma_m: Optional[float] = None
    position_sigma_m: Optional[float] = None

    def __post_init__(self) -> None:
        calibrated = [self.fx, self.fy, self.cx, self.cy]
        if self.horizontal_fov_deg is None and None in calibrated:
            raise Invalid("camera: needs horizontal_fov_deg, or fx, fy, cx and cy of a calibration")
        if self.horizontal_fov_deg is not None and (calibrated != [None] * 4 or self.distortion):
            raise Invalid("camera: has horizontal_fov_deg and values of a calibration, and must have one of the two")

    @classmethod
    def from_calibration(cls, path: str) -> Camera:
        """The camera of a file that `ecod-node calibrate` has written. Raises `Invalid` for another file."""
        try:
            with open(path, "rb") as file:
                found = tomllib.load(file)
            size = found["image_width"], found["image_height"]
            return cls(*size, **{name: found[name] for name in ("fx", "fy", "cx", "cy", "distortion")})
        except (tomllib.TOMLDecodeError, LookupError) as error:
            raise Invalid(f"{path} is no calibration of `ecod-node calibrate`: {error!r}") from None


@dataclass(frozen=True)
class PixelBox:
    """A box that a detector found: its label, confidence and edges in pixels, x to the right and y downwards."""

    label: Label
    confidence: Fraction
    x_min: float
    y_min: float
    x_max: float
    y_max: float

    def flaw_in(self, camera: Camera) -> Optional[str]:
        """Why the box cannot be of an image of this camera, if so. Detectors may exceed the image by 2 % of its size."""
        edges = [self.x_min, self.y_min, self.x_max, self.y_max]
        if not (self.x_min < self.x_max and self.y_min < self.y_max):
            return f"has no area: {edges}"
        width, height = camera.width_px, camera.height_px
        is_inside = -0.02 * width <= self.x_min and self.x_max <= 1.02 * width and -0.02 * height <= self.y_min
        if is_inside and self.y_max <= 1.02 * height:
            return None
        return f"is outside the image of {width}x{height} pixels: {edges}; `camera` must have the size of the image in which it was found"


@dataclass(frozen=True)
class BoxReport:
    """The boxes of one image, which the node whose broker receives them places on the map."""

    schema: Schema
    node: Name
    seq: Count
    captured_at_us: Count
    pose: Pose
    camera: Camera
    boxes: Annotated[list[PixelBox], _at_most(1024)]
    # False of a camera that is fixed at the road.
    moving: Optional[bool] = None


@dataclass(frozen=True)
class LabelReading:
    """Nodes that read a label at a known location."""

    label: Label
    nodes: list[Name]


@dataclass(frozen=True)
class LandmarkState:
    """The agreed state of one known location."""

    id: Label
    label: Optional[Label]
    confidence: Fraction
    x_m: Metres
    y_m: Metres
    contributors: list[Name]
    observers: list[Name] = field(default_factory=list)
    # Recent readings by node, also in a cell that votes.
    readings: list[LabelReading] = field(default_factory=list)

    @property
    def is_empty(self) -> bool:
        """Whether the location is known to be empty; without a label it is otherwise unknown."""
        return self.label is None and bool(self.observers)


@dataclass(frozen=True)
class FusedObject:
    """An object at no known location, at the time of fusion."""

    id: Uuid
    label: Label
    confidence: Fraction
    x_m: Metres
    y_m: Metres
    covariance_m2: Covariance
    contributors: list[Name]
    existence: Optional[Fraction] = None
    velocity_mps: Optional[tuple[Speed, Speed]] = None
    heading_rad: Optional[Heading] = None
    size_m: Optional[tuple[Size, Size]] = None
    age_s: Optional[Amount] = None
    first_seen_us: Optional[Count] = None
    vehicle: Optional[Name] = None
    scores: dict[Label, Fraction] = field(default_factory=dict)


@dataclass(frozen=True)
class PoseCorrection:
    """The estimated error of a vehicle's positions."""

    about_m: tuple[Metres, Metres]
    dx_m: Metres
    dy_m: Metres
    dheading_rad: Angle
    pairs: Amount


@dataclass(frozen=True)
class NeighbourObject:
    """An object of a neighbouring cell, in this cell's frame."""

    cell: Name
    age_s: Amount
    object: FusedObject


@dataclass(frozen=True)
class GlobalMap:
    """The fused map of one round (PACE)."""

    schema: Schema
    aggregator: Name
    epoch: Count
    round: Count
    fused_at_us: Count
    oldest_capture_us: Optional[Count]
    landmarks: list[LandmarkState]
    objects: list[FusedObject]
    pose_corrections: dict[Name, PoseCorrection] = field(default_factory=dict)
    neighbour_objects: list[NeighbourObject] = field(default_factory=list)

    @property
    def fused_at(self) -> datetime:
        """Time when the round closed, by the aggregator's clock, in UTC."""
        return time_of(self.fused_at_us)


@dataclass(frozen=True)
class Verdict:
    """The agreed label of one known location."""

    landmark: Label
    label: Optional[Label]
    score: Score
    margin: Margin
    votes: dict[Label, Score]
    contributors: list[Name]


@dataclass(frozen=True)
class Verdicts:
    """The verdicts of one round (VOTE)."""

    schema: Schema
    aggregator: Name
    epoch: Count
    round: Count
    fused_at_us: Count
    verdicts: list[Verdict]

    @property
    def fused_at(self) -> datetime:
        """Time when the round closed, by the aggregator's clock, in UTC."""
        return time_of(self.fused_at_us)


@dataclass(frozen=True)
class Reputation:
    """The trust in one vehicle and its evidence."""

    score: Fraction
    correct: Count
    incorrect: Count


@dataclass(frozen=True)
class Reputations:
    """The trust in each vehicle."""

    schema: Schema
    aggregator: Optional[Name]
    epoch: Count
    round: Count
    reputations: dict[Name, Reputation]


@dataclass(frozen=True)
class CellDescription:
    """The settings that all nodes of a cell share, as TOML; version 0 without any."""

    schema: Schema
    version: Count
    hash: Hash
    set_by: Name
    text: str


@dataclass(frozen=True)
class DescriptionStatus:
    """A node's description of its cell; `problem` is the reason why the node does not use it."""

    version: Count
    hash: Hash
    problem: Optional[str]


@dataclass(frozen=True)
class Trouble:
    """A present trouble of a node, or of a vehicle as the node sees it; without `about` it is the node's own."""

    kind: Label
    about: Optional[Label]
    cause: str
    remedy: str


@dataclass(frozen=True)
class NodeStatus:
    """A node's status, published by itself, or `offline` by its broker."""

    schema: Schema
    node: Name
    id: Uuid
    role: Literal["auto", "cav", "edge"]
    state: Literal["following", "aggregating", "offline"]
    epoch: Count
    aggregator: Optional[Name]
    fit: Optional[bool]
    version: Label
    description: Optional[DescriptionStatus]
    troubles: list[Trouble] = field(default_factory=list)
    page: Optional[Label] = None
    # Nodes that are not missed when they are absent: itself after an orderly stop, and those that an operator dismissed.
    dismissed: Annotated[list[Name], _at_most(16)] = field(default_factory=list)
