"""Measures ECOD and the paper's way, packaging/paper_way.py, under the same reports, and prints a table in Markdown.

    compare.py NODE LAB WORK [--vehicles N] [--seconds S] [--kills N] [--verdicts N] [--write-table FILE]

One MQTT client sends the reports of all vehicles, another receives the maps; all processes run on loopback, at ports that the system chooses.
Every vehicle reports ten objects of 32 landmarks every 90 to 110 ms, so that reports meet all phases of a fusion every 100 ms.
"""

import argparse
import contextlib
import json
import os
import pathlib
import random
import shutil
import socket
import statistics
import subprocess
import sys
import sysconfig
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Optional

import paho.mqtt
import paho.mqtt.client as mqtt
import paper_way

PACKAGING = pathlib.Path(__file__).resolve().parent
CELL = "compare"
PERIODS_S = (0.09, 0.11)
WARM_UP_S = 2.0
PATIENCE_S = 15.0
RESTART_AFTER_S = 1.0
LANDMARKS = [{"id": f"slot-{n}", "x_m": 3.0 * n, "y_m": 0.0} for n in range(32)]
COMMON = f"""
cell = "{CELL}"
mqtt.encoding = "json"
dashboard.enabled = false
membership.multicast.enabled = false
fusion.algorithms = "pace"
fusion.round.period_s = 0.1
fusion.pace.gate_m = 0.5
"""
SCENES = ["pace_setup1.json", "pace_setup2.json"]
MB = 1_000_000
RUNNING: list[subprocess.Popen] = []


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def start(work: pathlib.Path, name: str, *command: Any) -> subprocess.Popen:
    with open(work / f"{name}.log", "a", encoding="utf-8") as log:
        process = subprocess.Popen([str(part) for part in command], stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    RUNNING.append(process)
    return process


def stop(process: subprocess.Popen) -> None:
    process.kill()
    process.wait()


def mosquitto(work: pathlib.Path) -> tuple[subprocess.Popen, int]:
    program = shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin")
    if not program:
        sys.exit("mosquitto is not installed")
    port, config = free_port(), work / "mosquitto.conf"
    config.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\npersistence false\nset_tcp_nodelay true\n", encoding="utf-8")
    return start(work, "mosquitto", program, "-c", config), port


class Node:
    """A node of ECOD, by default an edge."""

    def __init__(self, program: str, work: pathlib.Path, broker: Optional[int], name: str = "edge", seed: Optional[int] = None) -> None:
        self.program, self.work, self.name = program, work, name
        self.door, self.gossip = free_port(), free_port(socket.SOCK_DGRAM)
        lines = [
            f'name = "{name}"',
            f'role = "{"edge" if name == "edge" else "auto"}"',
            f'listen = "127.0.0.1:{self.door}"',
            f'membership.bind = "127.0.0.1:{self.gossip}"',
            f'membership.seeds = ["127.0.0.1:{seed}"]' if seed else "",
            f'mqtt.broker = "127.0.0.1:{broker}"' if broker else "",
            COMMON,
            *(f'[[landmarks]]\nid = "{place["id"]}"\nx_m = {place["x_m"]}\ny_m = {place["y_m"]}' for place in LANDMARKS),
        ]
        self.config = work / f"{name}.toml"
        self.config.write_text("\n".join(lines) + "\n", encoding="utf-8")

    def start(self) -> subprocess.Popen:
        return start(self.work, self.name, self.program, "--config", self.config)


def connected(port: int, on_message: Optional[Callable[..., None]] = None) -> mqtt.Client:
    """A client of the broker at this port; its thread runs."""
    client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
    ready = threading.Event()
    client.on_subscribe = lambda *_: ready.set()
    client.on_connect = lambda client, *_: client.subscribe(f"ecod/v1/{CELL}/global_detections")
    if on_message:
        client.on_message = on_message
    end = time.monotonic() + PATIENCE_S
    while True:
        try:
            client.connect("127.0.0.1", port)
            break
        except OSError:
            if time.monotonic() > end:
                raise
            time.sleep(0.05)
    client.loop_start()
    if not ready.wait(PATIENCE_S):
        sys.exit(f"the broker at port {port} does not answer")
    return client


def reports(vehicles: int, tick: int, captured_at_us: int) -> list[tuple[str, str]]:
    """Topics and payloads of one tick."""
    messages = []
    for vehicle in range(vehicles):
        places = [LANDMARKS[(vehicle + n) % len(LANDMARKS)] for n in range(10)]
        objects = [
            {"label": "ABCD123", "confidence": 0.931, "x_m": place["x_m"] + 0.1, "y_m": place["y_m"] - 0.05, "covariance_m2": [0.01, 0.001, 0.01]}
            for place in places
        ]
        report = {
            "schema": 1,
            "node": f"cav-{vehicle}",
            "seq": tick,
            "captured_at_us": captured_at_us,
            "objects": objects,
            "seen": [place["id"] for place in places],
        }
        messages.append((f"ecod/v1/{CELL}/detections/cav-{vehicle}", json.dumps(report)))
    return messages


class Traffic:
    """Vehicles that report until they are stopped, and the maps that answer."""

    def __init__(self, port: int, vehicles: int) -> None:
        self.vehicles = vehicles
        self.sent: list[tuple[int, float]] = []
        self.maps: list[tuple[float, str, int]] = []
        self.stopping = threading.Event()
        self.clients = [connected(port), connected(port, self.on_map)]
        self.clients[0].unsubscribe(f"ecod/v1/{CELL}/global_detections")
        self.thread = threading.Thread(target=self.send)
        self.thread.start()

    def on_map(self, _client: mqtt.Client, _userdata: Any, message: mqtt.MQTTMessage) -> None:
        at, received = time.monotonic(), json.loads(message.payload)
        self.maps.append((at, received["aggregator"], received.get("oldest_capture_us") or 0))

    def send(self) -> None:
        due, tick, last, chance = time.monotonic(), 0, 0.0, random.Random(1)
        while not self.stopping.is_set():
            due, tick = due + chance.uniform(*PERIODS_S), tick + 1
            captured_at_us = int((time.time() + due - time.monotonic()) * 1e6)
            messages = reports(self.vehicles, tick, captured_at_us)
            time.sleep(max(due - time.monotonic(), 0))
            for topic, payload in messages:
                last = time.monotonic()
                self.clients[0].publish(topic, payload)
            self.sent.append((captured_at_us, last))

    def latencies_ms(self, since: float) -> list[float]:
        """From the last report of each tick to the first map whose reports are all of that tick or later."""
        found, maps, index = [], sorted(self.maps), 0
        for captured_at_us, last in self.sent:
            while index < len(maps) and maps[index][2] < captured_at_us:
                index += 1
            if index < len(maps) and last > since:
                found.append(1000 * (maps[index][0] - last))
        return found

    def wait_for_map(self, aggregator: Optional[str] = None, after: float = 0.0) -> float:
        """Time of the first map after `after`, by this aggregator if one is given."""
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            for at, name, _ in reversed(self.maps):
                if at > after and aggregator in (None, name):
                    return min(at for at, name, _ in self.maps if at > after and aggregator in (None, name))
            time.sleep(0.01)
        sys.exit(f"no map of {aggregator or 'any aggregator'} came; see the logs in the working directory")

    def stop(self) -> None:
        self.stopping.set()
        self.thread.join()
        for client in self.clients:
            client.disconnect()
            client.loop_stop()


@contextlib.contextmanager
def traffic(port: int, vehicles: int) -> Iterator[Traffic]:
    running = Traffic(port, vehicles)
    try:
        yield running
    finally:
        running.stop()


def processor_s(process: subprocess.Popen) -> float:
    """Time that the threads of a process were on a processor."""
    threads = pathlib.Path(f"/proc/{process.pid}/task").glob("*/schedstat")
    return sum(int(thread.read_text().split()[0]) for thread in threads) / 1e9


def resident_mb(process: subprocess.Popen) -> float:
    status = pathlib.Path(f"/proc/{process.pid}/status").read_text(encoding="utf-8")
    return int(status.split("VmRSS:")[1].split()[0]) * 1024 / MB


def quantile(values: list[float], share: float) -> float:
    return sorted(values)[min(int(share * len(values)), len(values) - 1)]


def load_figures(port: int, processes: list[subprocess.Popen], vehicles: int, seconds: float) -> dict[str, str]:
    """Latency of maps, and costs of the processes, under the reports of the vehicles."""
    with traffic(port, vehicles) as running:
        running.wait_for_map()
        time.sleep(WARM_UP_S)
        since, ticks = time.monotonic(), len(running.sent)
        before = sum(map(processor_s, processes))
        time.sleep(seconds)
        spent_ms = 1000 * (sum(map(processor_s, processes)) - before)
        ticks = len(running.sent) - ticks
        memory = sum(map(resident_mb, processes))
        time.sleep(0.5)
        latencies = running.latencies_ms(since)
    return {
        "latency": f"{quantile(latencies, 0.5):.1f}; {quantile(latencies, 0.99):.1f} ms",
        "processor": f"{spent_ms / ticks:.1f} ms",
        "memory": f"{memory:.1f} MB",
    }


def gaps_paper(way: Callable[[], subprocess.Popen], running: subprocess.Popen, port: int, kills: int) -> str:
    """Longest time from a kill, with a restart by hand after a second, to the next map."""
    longest = 0.0
    with traffic(port, 4) as vehicles:
        for _ in range(kills):
            vehicles.wait_for_map(after=time.monotonic())
            stop(running)
            last = max(at for at, _, _ in vehicles.maps)
            time.sleep(RESTART_AFTER_S)
            running = way()
            longest = max(longest, vehicles.wait_for_map(after=time.monotonic()) - last - RESTART_AFTER_S)
    stop(running)
    return f"until a restart, then {longest:.2f} s"


def gaps_ecod(program: str, work: pathlib.Path, broker: Optional[int], kills: int) -> str:
    """Longest time between the maps of a killed edge and of its successor; programs are at the successor's local broker."""
    edge = Node(program, work, broker)
    successor = Node(program, work, broker, "standby", edge.gossip)
    running, standby = edge.start(), successor.start()
    longest = 0.0
    with traffic(successor.door, 4) as vehicles:
        for _ in range(kills):
            vehicles.wait_for_map("edge", after=time.monotonic())
            time.sleep(WARM_UP_S)
            stop(running)
            killed = time.monotonic()
            time.sleep(0.005)
            last = max(at for at, name, _ in vehicles.maps if name == "edge")
            longest = max(longest, vehicles.wait_for_map("standby", after=killed) - last)
            running = edge.start()
    stop(running)
    stop(standby)
    return f"{longest:.2f} s"


def accuracy(lab: str, work: pathlib.Path, verdicts: int) -> dict[str, str]:
    """Mean share of right spots over the paper's parking lots, by the same reports of rendered cameras."""
    scores: dict[str, list[float]] = {"ecod": [], "paper": []}
    for file in SCENES:
        path = PACKAGING.parent / "examples/testbed" / file
        testbed = json.loads(path.read_text(encoding="utf-8"))
        camera = testbed["camera"]
        frames = round(camera["submission_interval_s"] / camera["capture_interval_s"])
        for scene in testbed["scenes"]:
            out, lines = work / "scene.json", work / "reports.jsonl"
            subprocess.run(
                [lab, "testbed", "--scenes", path, "--scene", scene["name"], "--verdicts", str(verdicts), "--output", out, "--reports", lines],
                check=True,
                stdout=subprocess.DEVNULL,
            )
            scores["ecod"].append(json.loads(out.read_text())["scenes"][0]["pace_accuracy_pct"])
            reported = [json.loads(line) for line in lines.read_text(encoding="utf-8").splitlines()]
            # What the vehicles capture in one submission interval of the testbed.
            size = frames * len(scene["cavs"])
            rounds = [reported[first : first + size] for first in range(0, len(reported), size)]
            scores["paper"].append(paper_accuracy(scene, rounds, testbed["placard"]["empty_text"]))
    return {name: f"{statistics.mean(values):.2f} %" for name, values in scores.items()}


def paper_accuracy(scene: dict[str, Any], rounds: list[list[dict[str, Any]]], empty: str) -> float:
    """Right spots in percent. A free spot with a placard must have the placard's text, another free spot no label."""
    inch_m, gate_m = 0.0254, 0.032
    right = 0
    for reported in rounds:
        for spot in scene["spots"]:
            labels = []
            for kind in ("occupied_placard", "empty_placard"):
                if spot.get(kind):
                    x, y = spot[kind]
                    labels.append(paper_way.fuse_landmark({"id": "", "x_m": x * inch_m, "y_m": y * inch_m}, reported, gate_m)["label"])
            label = next((label for label in labels if label), None)
            right += label == (spot["truth"] or (empty if spot.get("empty_placard") else None))
    return 100 * right / (len(rounds) * len(scene["spots"]))


def disk_mb(*paths: pathlib.Path, without: tuple[str, ...] = ()) -> float:
    files = [file for path in paths for file in ([path] if path.is_file() else path.rglob("*"))]
    return sum(file.stat().st_size for file in files if file.is_file() and not set(without) & set(file.parts)) / MB


def disk(program: str, work: pathlib.Path) -> dict[str, str]:
    stripped = work / "ecod-node-stripped"
    subprocess.run(["strip", "-o", stripped, program], check=True)
    broker = pathlib.Path(shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin") or "")
    own = disk_mb(PACKAGING / "paper_way.py", pathlib.Path(paho.mqtt.__file__).parent, without=("__pycache__",))
    library = pathlib.Path(sysconfig.get_paths()["stdlib"])
    python = disk_mb(library, pathlib.Path(sys.executable).resolve(), without=("__pycache__", "site-packages", "dist-packages"))
    return {
        "paper": f"{own:.1f} MB, Python {python:.0f} MB, mosquitto {disk_mb(broker):.1f} MB",
        "ecod": f"{disk_mb(stripped):.1f} MB",
        "ecod and mosquitto": f"{disk_mb(stripped):.1f} MB, mosquitto {disk_mb(broker):.1f} MB",
    }


def machine() -> str:
    info = pathlib.Path("/proc/cpuinfo").read_text(encoding="utf-8")
    model = next((line.split(": ")[1] for line in info.splitlines() if line.startswith("model name")), "unknown")
    return f"{os.cpu_count()} cores of {model}, load {os.getloadavg()[0]:.1f} before the run"


def write_table(path: pathlib.Path, table: str) -> None:
    """Replaces the text between the markers of the table."""
    begin, end = "<!-- compare table begin -->\n", "<!-- compare table end -->"
    before, rest = path.read_text(encoding="utf-8").split(begin)
    path.write_text(before + begin + table + end + rest.split(end)[1], encoding="utf-8")


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("node", metavar="NODE", help="the program ecod-node, without camera")
    parser.add_argument("lab", metavar="LAB", help="the program ecod-lab")
    parser.add_argument("work", metavar="WORK", type=pathlib.Path, help="directory for configurations and logs")
    parser.add_argument("--vehicles", type=int, default=32, metavar="N", help="vehicles that report (32)")
    parser.add_argument("--seconds", type=float, default=60, metavar="S", help="time for which each column is measured (60)")
    parser.add_argument("--kills", type=int, default=5, metavar="N", help="kills of each aggregator (5)")
    parser.add_argument("--verdicts", type=int, default=20, metavar="N", help="maps judged in each parking lot (20)")
    parser.add_argument("--write-table", type=pathlib.Path, metavar="FILE", help="also put the table between its markers in this text")
    return parser.parse_args()


def main() -> None:
    options = arguments()
    work, program = options.work, options.node
    about = machine()
    print(f"{about}; {options.vehicles} vehicles, {options.seconds:.0f} s, {options.kills} kills", file=sys.stderr)
    columns: dict[str, dict[str, str]] = {}

    broker, port = mosquitto(work)
    config = Node(program, work, port).config

    def way() -> subprocess.Popen:
        return start(work, "paper-way", sys.executable, PACKAGING / "paper_way.py", config, port)

    connected(port).disconnect()
    running = way()
    columns["paper"] = load_figures(port, [running, broker], options.vehicles, options.seconds)
    columns["paper"]["gap"] = gaps_paper(way, running, port, options.kills)
    print("the paper's way:", columns["paper"], file=sys.stderr)

    node = Node(program, work, port).start()
    columns["ecod and mosquitto"] = load_figures(port, [node, broker], options.vehicles, options.seconds)
    stop(node)
    columns["ecod and mosquitto"]["gap"] = gaps_ecod(program, work, port, options.kills)
    stop(broker)
    print("ECOD with mosquitto:", columns["ecod and mosquitto"], file=sys.stderr)

    edge = Node(program, work, None)
    node = edge.start()
    columns["ecod"] = load_figures(edge.door, [node], options.vehicles, options.seconds)
    stop(node)
    columns["ecod"]["gap"] = gaps_ecod(program, work, None, options.kills)
    print("ECOD with its own broker:", columns["ecod"], file=sys.stderr)

    right = accuracy(options.lab, work, options.verdicts)
    sizes = disk(program, work)
    for name, figures in columns.items():
        figures["accuracy"] = right["paper" if name == "paper" else "ecod"]
        figures["disk"] = sizes[name]
    rows = {
        "latency": "last report to map: p50; p99",
        "processor": "processor time per round of reports, broker included",
        "memory": "resident memory, broker included",
        "gap": f"longest gap of {options.kills} kills",
        "accuracy": "right spots on the paper's parking lots",
        "disk": "size on disk",
    }
    order = ["paper", "ecod and mosquitto", "ecod"]
    table = "| | paper's way in Python, mosquitto | ECOD, mosquitto | ECOD, its own broker |\n|---|---|---|---|\n"
    table += "".join(f"| {text} | " + " | ".join(columns[name][key] for name in order) + " |\n" for key, text in rows.items())
    print(table + f"\n{about}")
    if options.write_table:
        write_table(options.write_table, table)


try:
    main()
finally:
    for process in RUNNING:
        if process.poll() is None:
            stop(process)
