"""A program's part in a cell."""

from __future__ import annotations

import logging
import os
import re
import socket
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields
from datetime import datetime
from typing import Any, Optional, TypeVar, Union

from .codec import Rejected, checked, encode, is_list
from .connection import Connection, host_and_port, log, tls_context
from .errors import Invalid, Silent
from .geo import Origin
from .messages import SCHEMA_VERSION, BoxReport, Camera, CellDescription, FieldOfView, GlobalMap, Mount, NodeStatus, ObjectReport
from .messages import PerceivedObject, PixelBox, Pose, Reputations, Verdicts, is_name
from .streams import Stream

M = TypeVar("M")
Objects = Iterable[Union[PerceivedObject, Mapping[str, Any]]]
Boxes = Iterable[Union[PixelBox, Mapping[str, Any]]]
AnyPose = Union[Pose, tuple[float, float, float]]
Time = Union[datetime, float]

# Names in the certificates of a cell's brokers and of nodes' doors, at every address.
BROKER_NAME, DOOR_NAME = "broker.ecod.internal", "door.ecod.internal"

# Largest report by default: `mqtt.max_payload_bytes` of nodes.
MAX_REPORT_BYTES = 256 * 1024

# Silence in seconds after which the log names possible causes.
SILENCE_S = 10.0


class Cell:
    """A connection to a cell, which is made anew whenever it is lost.

    `broker` is the HOST:PORT of a node or broker (`ECOD_BROKER`, default localhost:1883, with `ca` port 8883). `cell` is
    the cell's name (`ECOD_CELL`, default `cell`). The program reports as `<node>--<part>`, or as `node` itself if `part`
    is empty; `node` is `ECOD_NAME` or the machine's host name by default. `ca`, `cert` and `key` are PEM files for TLS;
    `broker_name` is the name in the broker's certificate, None for the host. Without them `ECOD_TLS__CA`,
    `ECOD_TLS__CERTIFICATE` and `ECOD_TLS__KEY` are those of the node beside which the program runs. `user` and `password`
    are `ECOD_MQTT__USER` and `ECOD_MQTT__PASSWORD` by default.

    Raises `Unreachable` or `Refused` unless the broker lets the program in within `timeout` seconds.
    """

    def __init__(
        self,
        broker: Optional[str] = None,
        cell: Optional[str] = None,
        *,
        node: Optional[str] = None,
        part: str = "python",
        ca: Optional[str] = None,
        cert: Optional[str] = None,
        key: Optional[str] = None,
        broker_name: Optional[str] = BROKER_NAME,
        user: Optional[str] = None,
        password: Optional[str] = None,
        timeout: float = 10.0,
    ) -> None:
        env = os.environ.get
        if not (ca or cert or key) and env("ECOD_TLS__CA"):
            ca, cert, key = (env(f"ECOD_TLS__{name}") for name in ("CA", "CERTIFICATE", "KEY"))
            broker_name = DOOR_NAME if broker_name == BROKER_NAME else broker_name
        address = host_and_port(broker or env("ECOD_BROKER") or "localhost", 8883 if ca else 1883)
        self.cell = _name("cell", cell or env("ECOD_CELL") or "cell")
        node = node or env("ECOD_NAME") or re.sub("[^A-Za-z0-9_]", "-", socket.gethostname().split(".")[0])
        self.name = _name("node", f"{node}--{part}" if part else node)
        self.counts: Counter[str] = Counter()
        """What was not taken, by the reasons in docs/protocol.md, and reports that were not sent: `unsent`."""

        self._root = f"ecod/v1/{self.cell}/"
        self._sending = threading.Lock()
        self._seq: Counter[str] = Counter()
        self._maps = Stream(GlobalMap, "global_detections")
        self._verdicts = Stream(Verdicts, "global_verdicts")
        self._reputations = Stream(Reputations, "reputations", is_retained=True)
        self._statuses = Stream(NodeStatus, "nodes/+", is_retained=True, has_rounds=False)
        self._descriptions = Stream(CellDescription, "cell", is_retained=True, has_rounds=False)
        if not ca and (cert or key):
            raise Invalid("cert and key need `ca`, the file with the certificates that a broker must show")
        tls = tls_context(ca, cert, key, broker_name or address[0]) if ca else None
        login = (user or env("ECOD_MQTT__USER"), password or env("ECOD_MQTT__PASSWORD"))
        # With certificates a cell's broker accepts only ids of this form, so that clients cannot end each other's sessions.
        # Without certificates, the broker would treat such ids as ids of nodes.
        client_id = f"{self.name}-{uuid.uuid4().hex[: 32 if tls else 16]}"
        self._connection = Connection(address, client_id, tls, login, self._take, timeout)

    def maps(self, timeout: Optional[float] = None) -> Iterator[GlobalMap]:
        """The maps of the cell, from now on: always the newest, whatever a slow reader has missed.

        Maps that are not later by epoch and round than the one before are dropped. Waits while none comes, at most
        `timeout` seconds (`Silent`). Raises `Refused` when the broker refuses. Ends when the cell is closed.
        """
        return self._read(self._maps, timeout)

    def verdicts(self, timeout: Optional[float] = None) -> Iterator[Verdicts]:
        """The verdicts of the cell, by the rules of `maps`."""
        return self._read(self._verdicts, timeout)

    def reputations(self, timeout: Optional[float] = None) -> Iterator[Reputations]:
        """The trust in each vehicle: the present state first, then by the rules of `maps`."""
        return self._read(self._reputations, timeout)

    def statuses(self, timeout: Optional[float] = None) -> Iterator[NodeStatus]:
        """The statuses of the nodes: the present ones first, then every change; the newest of each node."""
        return self._read(self._statuses, timeout)

    def description(self, timeout: float = 10.0) -> CellDescription:
        """The settings that all nodes of the cell share, as they are now; version 0 if there are none.

        A node always sends its description to the programs beside it. Other brokers send none in a cell without a
        description: raises `Silent` when nothing comes within `timeout` seconds, and `Refused` when the broker refuses.
        """
        for description in self._read(self._descriptions, timeout):
            return description
        raise Silent(f"the connection to {self._connection.at} is closed")

    def origin(self, timeout: float = 10.0) -> Optional[Origin]:
        """The place of the cell's maps on Earth, None if the cell's description has none. Raises as `description`.

        It may change while the cell runs; asking for it with every map costs little.
        """
        return Origin.of(self.description(timeout).text)

    def report(
        self,
        objects: Objects,
        *,
        captured_at: Optional[Time] = None,
        pose: Optional[AnyPose] = None,
        seen: Optional[Iterable[str]] = None,
        view: Optional[FieldOfView] = None,
        frame_yaw_rate_radps: Optional[float] = None,
    ) -> bool:
        """Reports what one frame shows, for the map. A frame without objects is a report, too.

        `captured_at` is a datetime with time zone, or Unix seconds; default now. `pose` is the camera's, east and north in
        metres and heading in radians. `seen` names the known locations in view. `frame_yaw_rate_radps` is for a cell whose
        frame turns with a vehicle. Gives whether the report was sent:
        without a connection it is dropped and counted. Raises `Invalid` for values that the protocol does not allow, and
        `Refused` when the broker refused an earlier report.
        """
        return self._report("detections", _listed("objects", objects), captured_at, pose, seen, view, frame_yaw_rate_radps)

    def report_boxes(
        self,
        boxes: Boxes,
        *,
        camera: Camera,
        pose: AnyPose,
        mount: Optional[Mount] = None,
        captured_at: Optional[Time] = None,
        moving: Optional[bool] = None,
    ) -> bool:
        """Reports the boxes that a detector found in one image; the node at which the program is connected places them on the map.

        The node projects them as it does the boxes of its own camera: by the foot of a box on the ground and by the usual
        size of its label, with a covariance. `camera` is the image's size and optics. With a `mount`, `pose` is the
        vehicle's; without one it is the camera's, perhaps with height, pitch and roll. `moving=False` is a camera that is
        fixed at the road and no object of the map. An image without boxes is a report, too.

        A box that gives no position, such as one above the horizon, is left out; the node counts it as `not_placed` and
        states the reason on `nodes/<node>/clients`. The rest is as in `report`. Brokers other than those of nodes do not
        place boxes: raises `Refused` if the broker answers that no program receives them.
        """
        listed: list[PixelBox] = checked(list[PixelBox], _listed("boxes", boxes), "boxes")
        for index, box in enumerate(listed):
            flaw = box.flaw_in(camera)
            if flaw:
                raise Invalid(f"not sent: boxes[{index}]: {flaw}")
        given: Pose = checked(Pose, _pose(pose), "pose")
        place = given if mount is None else mount.camera_pose(given)

        def report(seq: int) -> BoxReport:
            return BoxReport(SCHEMA_VERSION, self.name, seq, micros(captured_at), place, camera, listed, moving)

        return self._send("boxes", report, len(listed))

    def vote(
        self,
        objects: Objects,
        *,
        captured_at: Optional[Time] = None,
        pose: Optional[AnyPose] = None,
        seen: Optional[Iterable[str]] = None,
    ) -> bool:
        """Votes on what is at known locations, for the verdicts: objects name their `landmark`. The rest is as in `report`."""
        listed = _listed("objects", objects)
        for place, item in enumerate(listed):
            if not isinstance(item, (PerceivedObject, Mapping)):
                raise Invalid(f"not sent: objects[{place}]: {item!r} must be PerceivedObject")
            if not (item.get("landmark") if isinstance(item, Mapping) else item.landmark):
                raise Invalid(f"not sent: objects[{place}].landmark: is missing, a vote is on a known location")
        return self._report("vote_detections", listed, captured_at, pose, seen, None)

    def close(self) -> None:
        """Ends the connection, and with it all loops over messages."""
        self._connection.close()

    def __enter__(self) -> Cell:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def _read(self, stream: Stream[M], timeout: Optional[float]) -> Iterator[M]:
        self._connection.subscribe(self._root + stream.topic)
        return self._iterate(stream, 0 if stream.is_retained else stream.number, timeout)

    def _iterate(self, stream: Stream[M], number: int, timeout: Optional[float]) -> Iterator[M]:
        while True:
            with self._connection.changed:
                entry = self._wait(stream, number, timeout)
            if entry is None:
                return
            number, message = entry
            yield message

    def _wait(self, stream: Stream[M], number: int, timeout: Optional[float]) -> Optional[tuple[int, M]]:
        """The next payload of a stream, or None when the cell is closed."""
        began = time.monotonic()
        is_told = False
        while not self._connection.closing.is_set():
            entry = stream.after(number)
            if entry is not None:
                return entry
            self._connection.raise_if_refused(self._root + stream.topic)
            waited = time.monotonic() - began
            silence = f"nothing on {self._root}{stream.topic} from {self._connection.at} for {waited:.1f} s; "
            if not self._connection.is_connected:
                silence += "no connection"
            elif number and not stream.has_rounds:
                silence += "nothing has changed since the last"
            else:
                silence += "does a node lead the cell (argument `cell` or ECOD_CELL)?"
            if timeout is not None and waited >= timeout:
                raise Silent(silence)
            if waited >= SILENCE_S and not is_told:
                is_told = True
                log.warning("%s", silence)
            self._connection.changed.wait(1.0 if timeout is None else min(1.0, timeout - waited))
        return None

    def _report(
        self,
        topic: str,
        objects: list[Any],
        captured_at: Optional[Time],
        pose: Optional[AnyPose],
        seen: Optional[Iterable[str]],
        view: Optional[FieldOfView],
        frame_yaw_rate_radps: Optional[float] = None,
    ) -> bool:
        seen = None if seen is None else _listed("seen", seen)

        def report(seq: int) -> ObjectReport:
            return ObjectReport(
                SCHEMA_VERSION,
                self.name,
                seq,
                micros(captured_at),
                objects,
                _pose(pose),
                seen,
                view,
                frame_yaw_rate_radps=frame_yaw_rate_radps,
            )

        return self._send(topic, report, len(objects))

    def _send(self, topic: str, report: Callable[[int], Any], entries: int) -> bool:
        """Sends the report with the next number of the topic."""
        full_topic = f"{self._root}{topic}/{self.name}"
        with self._sending:
            seq = self._seq[topic] + 1
            payload = encode(report(seq))
            if len(payload) > MAX_REPORT_BYTES:
                raise Invalid(f"not sent: {len(payload)} bytes with {entries} objects, at most {MAX_REPORT_BYTES}")
            self._connection.raise_if_refused(full_topic)
            self._seq[topic] = seq
            is_sent = self._connection.publish(full_topic, payload)
            if not is_sent:
                self.counts["unsent"] += 1
            return is_sent

    def _take(self, topic: str, payload: bytes) -> None:
        """Takes a message from the broker: the newest of its kind counts, an unusable one is counted and logged once."""
        head, _, node = topic[len(self._root) :].partition("/")
        for stream in (self._maps, self._verdicts, self._reputations, self._statuses, self._descriptions):
            if stream.topic.partition("/")[0] == head:
                try:
                    stream.take(node, payload, self._connection.changed)
                except Rejected as rejected:
                    reason, text = rejected.args
                    self.counts[reason] += 1
                    if reason not in stream.told:
                        stream.told.add(reason)
                        # An order that is not kept is usual after a reconnection.
                        level = logging.INFO if reason in ("superseded", "repeated") else logging.WARNING
                        log.log(level, "not taken from %s, %s: %s; others like it are only counted", topic, reason, text)


def _pose(given: Any) -> Any:
    """A pose in place of its numbers in a tuple, list or array."""
    if not is_list(given):
        return given
    if not 3 <= len(given) <= len(fields(Pose)):
        raise Invalid(f"not sent: pose: {given!r} must be the numbers x_m, y_m, heading_rad")
    return Pose(*given)


def _listed(name: str, items: Any) -> list[Any]:
    """The items of anything that has several."""
    if isinstance(items, (str, bytes, Mapping)) or not isinstance(items, Iterable):
        raise Invalid(f"not sent: {name}: {items!r} must be a list")
    return list(items)


def micros(moment: Optional[Time]) -> int:
    """Unix microseconds of a datetime with time zone or of Unix seconds; default now."""
    if moment is None:
        return time.time_ns() // 1000
    if isinstance(moment, datetime):
        if moment.tzinfo is None:
            raise Invalid(f"not sent: captured_at {moment} has no time zone; datetime.now(timezone.utc) has one")
        moment = moment.timestamp()
    try:
        since_1970_us = round(moment * 1e6)
    except (ValueError, OverflowError, TypeError):
        raise Invalid(f"not sent: captured_at {moment!r} must be a datetime or Unix seconds") from None
    if since_1970_us >= 2**53:
        raise Invalid(f"not sent: captured_at {moment!r} must be Unix seconds; this looks like milliseconds or less")
    return since_1970_us


def _name(what: str, name: str) -> str:
    if not is_name(name):
        raise Invalid(f"{what} name {name!r} must be 1 to 64 of A-Z a-z 0-9 _ -")
    return name
