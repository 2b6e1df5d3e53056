#!/usr/bin/env python3
"""Feeds the detections of any detector into a cell and prints what the cell agrees on.

    pip install paho-mqtt
    my_detector | feed_detections.py --broker 192.168.1.10:1883 --cell lot-1 --node euclid --pose 1 6 -90

Standard input has a JSON object a line, one for each frame, frames without detections too:

    {"objects": [{"label": "car", "confidence": 0.93, "x_m": 0.2, "y_m": 0.1}], "seen": ["slot-0", "slot-1"]}

`objects` are in the cell's frame, metres east and north; one with a `landmark` is also a vote on what is there. `seen` names
the known locations that were in view; leave it out if the detector does not know. What else may be said of an object is in
docs/protocol.md. When the input ends, the program waits for the answer to the last frame.
"""

import argparse
import json
import math
import sys
import time

import paho.mqtt.client as mqtt

# How long the cell may take to answer the last frame, in seconds.
LAST_ANSWER_S = 1.0


class Vehicle:
    """A vehicle of a cell: reports frames, prints maps and verdicts."""

    def __init__(self, cell, node, pose):
        self.root = f"ecod/v1/{cell}"
        self.node = node
        self.pose = pose
        self.seq = 0
        self.client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        self.client.on_connect = self.on_connect
        self.client.on_message = self.on_message

    def on_connect(self, client, _userdata, _flags, reason, _properties):
        if reason.is_failure:
            sys.exit(f"the broker refuses: {reason}")
        # Anew on every connection: the broker may have forgotten.
        client.subscribe([(f"{self.root}/global_detections", 0), (f"{self.root}/global_verdicts", 0)])

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

    def report(self, frame):
        """Publishes what one frame showed; its `captured_at_us` is now unless it says otherwise."""
        self.seq += 1
        report = {"schema": 1, "node": self.node, "seq": self.seq, "captured_at_us": time.time_ns() // 1000}
        if self.pose:
            x_m, y_m, heading_deg = self.pose
            report["pose"] = {"x_m": x_m, "y_m": y_m, "heading_rad": math.radians(heading_deg)}
        report.update(frame)
        self.client.publish(f"{self.root}/detections/{self.node}", json.dumps(report))
        votes = [detection for detection in report["objects"] if detection.get("landmark")]
        if votes:
            self.client.publish(f"{self.root}/vote_detections/{self.node}", json.dumps({**report, "objects": votes}))


def described(landmark):
    if landmark["label"] is None:
        return f"{landmark['id']}: {'empty' if landmark.get('observers') else 'unknown'}"
    return f"{landmark['id']}: {landmark['label']} {landmark['confidence']:.2f}"


def placed(thing):
    return f"{thing['label']} at ({thing['x_m']:.1f}, {thing['y_m']:.1f})"


def judged(verdict):
    return f"{verdict['landmark']}: {verdict['label']} by {verdict['margin']:.2f}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--broker", default="127.0.0.1:1883", metavar="HOST:PORT", help="the leader's, or the cell's external one")
    parser.add_argument("--cell", default="cell")
    parser.add_argument("--node", required=True, help="name of this vehicle, unique in the cell")
    parser.add_argument("--pose", nargs=3, type=float, metavar=("X_M", "Y_M", "HEADING_DEG"), help="where the camera is")
    arguments = parser.parse_args()
    host, _, port = arguments.broker.rpartition(":")
    vehicle = Vehicle(arguments.cell, arguments.node, arguments.pose)
    try:
        vehicle.client.connect(host, int(port))
    except OSError as error:
        sys.exit(f"cannot reach {arguments.broker}: {error}")
    vehicle.client.loop_start()
    for line in sys.stdin:
        vehicle.report(json.loads(line))
    time.sleep(LAST_ANSWER_S)
    vehicle.client.disconnect()
    vehicle.client.loop_stop()


if __name__ == "__main__":
    main()
