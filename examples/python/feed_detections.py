#!/usr/bin/env python3
"""Feeds the detections of any detector into a cell and prints what the cell agrees on.

    pip install paho-mqtt
    my_detector | feed_detections.py --broker 192.168.1.10:1883 --cell lot-1 --node euclid --pose 1 6 -90

Standard input has a JSON object a line, one for each frame, frames without detections too:

    {"objects": [{"label": "car", "confidence": 0.93, "x_m": 0.2, "y_m": 0.1}], "seen": ["slot-0", "slot-1"]}

`objects` are in the cell's frame, metres east and north; one with a `landmark` is also a vote on what is there. `seen` names
the known locations that were in view; leave it out if the detector does not know. What else may be said of an object is in
docs/protocol.md. When the input ends, the program waits for the answer to the last frame. Lines that are no frames are told of
and skipped.

A cell with certificates takes the node's own, as `ecod-node pki issue NODE --role cav` makes it:

    ... --broker 192.168.1.10:8883 --ca ca.pem --cert euclid.pem --key euclid.key

A broker with passwords takes `--user`, and the password from `--password` or, better, from ECOD_MQTT__PASSWORD.
"""

import argparse
import json
import math
import os
import ssl
import sys
import threading
import time

import paho.mqtt.client as mqtt

# How long the broker may take to let this client in, and the cell to answer the last frame, in seconds.
LOGIN_S = 10.0
LAST_ANSWER_S = 1.0

# By this name brokers of a cell are known, at whatever address.
BROKER_NAME = "broker.ecod.internal"


class Vehicle:
    """A vehicle of a cell: reports frames, prints maps and verdicts."""

    def __init__(self, cell, node, pose):
        self.root = f"ecod/v1/{cell}"
        self.node = node
        self.pose = pose
        self.seq = 0
        self.unsent = 0
        # What the broker said to the login, for the main thread: what the client's own raises, nobody hears of.
        self.answered = threading.Event()
        self.refusal = None
        self.client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        self.client.on_connect = self.on_connect
        self.client.on_message = self.on_message

    def on_connect(self, client, _userdata, _flags, reason, _properties):
        if reason.is_failure:
            self.refusal = str(reason)
        else:
            # Anew on every connection: the broker may have forgotten.
            client.subscribe([(f"{self.root}/global_detections", 0), (f"{self.root}/global_verdicts", 0)])
        self.answered.set()

    def on_message(self, _client, _userdata, message):
        # The first byte tells JSON from CBOR, which this example does not read.
        if not message.payload.startswith(b"{"):
            return
        payload = json.loads(message.payload)
        head = f"{payload['aggregator']} round {payload['round']}"
        if message.topic.endswith("/global_detections"):
            print("map     ", head, *map(described, payload["landmarks"]), *map(placed, payload["objects"]), sep="  ")
        else:
            print("verdicts", head, *map(judged, payload["verdicts"]), sep="  ")
        sys.stdout.flush()

    def log_in(self):
        """Waits until the broker has let this client in."""
        if not self.answered.wait(LOGIN_S):
            sys.exit("the broker does not let this client in")
        self.leave_if_refused()

    def leave_if_refused(self):
        if self.refusal is not None:
            sys.exit(f"the broker refuses: {self.refusal}")

    def report(self, frame):
        """Publishes what one frame showed; its `captured_at_us` is now unless it says otherwise."""
        self.leave_if_refused()
        self.seq += 1
        report = {"schema": 1, "node": self.node, "seq": self.seq, "captured_at_us": time.time_ns() // 1000}
        if self.pose:
            x_m, y_m, heading_deg = self.pose
            report["pose"] = {"x_m": x_m, "y_m": y_m, "heading_rad": math.radians(heading_deg)}
        report.update(frame)
        sent = self.client.publish(f"{self.root}/detections/{self.node}", json.dumps(report))
        self.unsent += sent.rc != mqtt.MQTT_ERR_SUCCESS
        votes = [detection for detection in report["objects"] if detection.get("landmark")]
        if votes:
            self.client.publish(f"{self.root}/vote_detections/{self.node}", json.dumps({**report, "objects": votes}))


class CellContext(ssl.SSLContext):
    """TLS with a broker that is known by a name and not by its address."""

    broker_name = BROKER_NAME

    def wrap_socket(self, *args, **kwargs):
        return super().wrap_socket(*args, **{**kwargs, "server_hostname": self.broker_name})


def context(given):
    """TLS by the files that were given."""
    tls = CellContext(ssl.PROTOCOL_TLS_CLIENT)
    tls.broker_name = given.broker_name
    try:
        tls.load_verify_locations(given.ca)
    except OSError as error:
        sys.exit(f"cannot use {given.ca}: {error}")
    try:
        if given.cert:
            tls.load_cert_chain(given.cert, given.key)
    except OSError as error:
        sys.exit(f"cannot use {given.cert} with {given.key}: {error}")
    return tls


def frame_of(line):
    """The frame in a line of input; ValueError where there is none."""
    frame = json.loads(line)
    objects = frame.get("objects") if isinstance(frame, dict) else None
    if not isinstance(objects, list) or not all(isinstance(detection, dict) for detection in objects):
        raise ValueError("no JSON object with a list `objects`")
    return frame


def described(landmark):
    if landmark["label"] is None:
        return f"{landmark['id']}: {'empty' if landmark.get('observers') else 'unknown'}"
    return f"{landmark['id']}: {landmark['label']} {landmark['confidence']:.2f}"


def placed(thing):
    return f"{thing['label']} at ({thing['x_m']:.1f}, {thing['y_m']:.1f})"


def judged(verdict):
    return f"{verdict['landmark']}: {verdict['label']} by {verdict['margin']:.2f}"


def arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--broker", default="127.0.0.1:1883", metavar="HOST:PORT", help="the leader's, or the cell's external one")
    parser.add_argument("--cell", default="cell")
    parser.add_argument("--node", required=True, help="name of this vehicle, unique in the cell")
    parser.add_argument("--pose", nargs=3, type=float, metavar=("X_M", "Y_M", "HEADING_DEG"), help="where the camera is")
    parser.add_argument("--user", help="for a broker with passwords")
    parser.add_argument("--password", default=os.environ.get("ECOD_MQTT__PASSWORD"), help="default $ECOD_MQTT__PASSWORD")
    parser.add_argument("--ca", metavar="FILE", help="whose certificates a broker must show; speaks TLS (PEM)")
    parser.add_argument("--cert", metavar="FILE", help="this vehicle's certificate (PEM)")
    parser.add_argument("--key", metavar="FILE", help="the key of --cert (PEM)")
    parser.add_argument("--broker-name", default=BROKER_NAME, help="name in the broker's certificate (default: %(default)s)")
    given = parser.parse_args()
    if not given.broker.rpartition(":")[2].isdigit():
        parser.error(f"--broker is HOST:PORT, not {given.broker}")
    if (given.cert or given.key) and not (given.ca and given.cert and given.key):
        parser.error("--ca, --cert and --key go together")
    return given


def main():
    given = arguments()
    host, _, port = given.broker.rpartition(":")
    vehicle = Vehicle(given.cell, given.node, given.pose)
    if given.user:
        vehicle.client.username_pw_set(given.user, given.password)
    if given.ca:
        vehicle.client.tls_set_context(context(given))
    try:
        vehicle.client.connect(host, int(port))
    except OSError as error:
        sys.exit(f"cannot reach {given.broker}: {error}")
    vehicle.client.loop_start()
    vehicle.log_in()
    for number, line in enumerate(sys.stdin.buffer, 1):
        try:
            frame = frame_of(line)
        except ValueError as error:
            print(f"line {number} skipped: {error}", file=sys.stderr)
            continue
        vehicle.report(frame)
    time.sleep(LAST_ANSWER_S)
    vehicle.client.disconnect()
    vehicle.client.loop_stop()
    if vehicle.unsent:
        sys.exit(f"{vehicle.unsent} of {vehicle.seq} frames were not sent: no connection to {given.broker}")


if __name__ == "__main__":
    main()
