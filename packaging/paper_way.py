"""The paper's way of fusion as a short program: one process that keeps the last report of each vehicle in a dictionary, and fuses them by PACE
(Algorithm 2 of arXiv 2506.06474) every period. `make compare` measures ECOD beside it. It speaks ECOD's topics in JSON, so both get the
same messages.

    paper_way.py CONFIG PORT

CONFIG is a configuration of ECOD in TOML, of which cell, landmarks, `fusion.round.period_s` (tau) and `fusion.pace.gate_m` (delta) count. PORT is
a broker's on this machine.
"""

import json
import math
import sys
import threading
import time
import tomllib
from typing import Any, Optional

import paho.mqtt.client as mqtt

MAX_AGE_S = 1.0

Report = dict[str, Any]
Landmark = dict[str, Any]


def fuse_landmark(landmark: Landmark, reports: list[Report], gate_m: float) -> dict[str, Any]:
    """Label, confidence and position of a landmark: the label with the greatest sum of confidences, sum of squares over sum, and mean."""
    near = [
        (found, report["node"])
        for report in reports
        for found in report["objects"]
        if math.hypot(found["x_m"] - landmark["x_m"], found["y_m"] - landmark["y_m"]) <= gate_m
    ]
    weights: dict[str, float] = {}
    for found, _ in near:
        weights[found["label"]] = weights.get(found["label"], 0.0) + found["confidence"]
    label: Optional[str] = min(weights, key=lambda name: (-weights[name], name), default=None)
    total = sum(weights.values())
    return {
        "id": landmark["id"],
        "label": label,
        "confidence": sum(found["confidence"] ** 2 for found, _ in near) / total if total else 0.0,
        "x_m": sum(found["x_m"] for found, _ in near) / len(near) if near else landmark["x_m"],
        "y_m": sum(found["y_m"] for found, _ in near) / len(near) if near else landmark["y_m"],
        "contributors": sorted({node for _, node in near}),
    }


def fuse(landmarks: list[Landmark], reports: list[Report], gate_m: float) -> list[dict[str, Any]]:
    return [fuse_landmark(landmark, reports, gate_m) for landmark in landmarks]


def main() -> None:
    with open(sys.argv[1], "rb") as file:
        config = tomllib.load(file)
    topics = f"ecod/v1/{config['cell']}"
    period_s, gate_m = config["fusion"]["round"]["period_s"], config["fusion"]["pace"]["gate_m"]
    reports: dict[str, Report] = {}
    lock = threading.Lock()

    def on_connect(client: mqtt.Client, *_: Any) -> None:
        client.subscribe(f"{topics}/detections/+")

    def on_message(_client: mqtt.Client, _userdata: Any, message: mqtt.MQTTMessage) -> None:
        report = json.loads(message.payload)
        with lock:
            reports[report["node"]] = report

    client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
    client.on_connect, client.on_message = on_connect, on_message
    client.connect("127.0.0.1", int(sys.argv[2]))
    client.loop_start()
    epoch, number, due = int(time.time()), 0, time.monotonic()
    while True:
        due = max(due + period_s, time.monotonic())
        time.sleep(max(due - time.monotonic(), 0))
        now_us, number = int(time.time() * 1e6), number + 1
        with lock:
            recent = [report for report in reports.values() if report["captured_at_us"] > now_us - MAX_AGE_S * 1e6]
        fused = {
            "schema": 1,
            "aggregator": "paper-way",
            "epoch": epoch,
            "round": number,
            "fused_at_us": now_us,
            "oldest_capture_us": min((report["captured_at_us"] for report in recent), default=None),
            "landmarks": fuse(config["landmarks"], recent, gate_m),
            "objects": [],
        }
        client.publish(f"{topics}/global_detections", json.dumps(fused))


if __name__ == "__main__":
    main()
