"""Real brokers and real nodes, each on free ports of its own, ended by their process."""

from __future__ import annotations

import contextlib
import getpass
import os
import random
import shutil
import socket
import subprocess
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Optional, TypeVar

import pytest
from paho.mqtt import client as mqtt
from paho.mqtt.enums import CallbackAPIVersion

T = TypeVar("T")

ROOT = Path(__file__).resolve().parents[3]

# Seconds until anything that must happen has happened, also where other work leaves a test a few percent of a processor.
SOON = 90.0


def free_port() -> int:
    """A port below those that the system gives to clients: one of these could take it before the server, even our own probe."""
    while True:
        port = random.SystemRandom().randrange(10_000, 32_000)
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", port))
            return port


def wait_for(condition: Callable[[], Any], timeout: float = SOON) -> Any:
    """What the condition gives, as soon as that is something."""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        found = condition()
        if found:
            return found
        time.sleep(0.02)
    raise AssertionError("it did not come true in time")


def until(messages: Iterable[T], condition: Callable[[T], Any], timeout: float = SOON) -> T:
    """The first of the messages for which the condition holds."""
    deadline = time.monotonic() + timeout
    for message in messages:
        if condition(message):
            return message
        assert time.monotonic() < deadline, f"it did not come true in time: {message}"
    raise AssertionError("the messages ended")


def program() -> str:
    """The program `ecod-node`."""
    given = os.environ.get("NODE_PROGRAM", str(ROOT / "target/debug/ecod-node"))
    assert Path(given).is_file(), f"{given} is missing: run `make python-client-check`, or give NODE_PROGRAM"
    return given


class Server:
    """A process that listens on a port of its own, and can be killed and started again on the same."""

    def __init__(self, command: Callable[[int], list[str]], directory: Path, env: Optional[dict[str, str]] = None) -> None:
        self.port = free_port()
        self.address = f"127.0.0.1:{self.port}"
        self.command = command(self.port)
        self.env = {name: value for name, value in os.environ.items() if not name.startswith("ECOD_")} | (env or {})
        self.log = directory / f"{self.port}.log"
        self.start()

    def start(self) -> None:
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(self.command, stdout=log, stderr=log, env=self.env)
        wait_for(self.listens)

    def listens(self) -> bool:
        assert self.process.poll() is None, self.log.read_text()
        try:
            socket.create_connection(("127.0.0.1", self.port), timeout=1).close()
        except OSError:
            return False
        return True

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture(autouse=True)
def _plain_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in os.environ:
        if name.startswith("ECOD_"):
            monkeypatch.delenv(name)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Server]]:
    """Starts servers, and kills them at the end of the test."""
    servers: list[Server] = []

    def run(command: Callable[[int], list[str]], env: Optional[dict[str, str]] = None) -> Server:
        servers.append(Server(command, tmp_path, env))
        return servers[-1]

    yield run
    for server in servers:
        server.kill()


@pytest.fixture
def mosquitto(start: Callable[..., Server], tmp_path: Path) -> Callable[..., Server]:
    def run(*lines: str) -> Server:
        configuration = tmp_path / f"{uuid.uuid4().hex}.conf"

        def command(port: int) -> list[str]:
            configuration.write_text("\n".join([f"listener {port} 127.0.0.1", f"user {getpass.getuser()}", *(lines or ["allow_anonymous true"]), ""]))
            # Debian has it where not every user's path leads.
            found = shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin")
            assert found, "mosquitto is missing: install Debian's package of that name"
            return [found, "-c", str(configuration)]

        return start(command)

    return run


@pytest.fixture
def broker(mosquitto: Callable[..., Server]) -> Server:
    return mosquitto()


@pytest.fixture
def cell_name() -> str:
    """A cell that no other test or program on this machine speaks of."""
    return f"lot-{uuid.uuid4().hex[:12]}"


@pytest.fixture
def edge(start: Callable[..., Server], cell_name: str, tmp_path: Path) -> Callable[..., Server]:
    """An edge with two known locations and a broker of its own; settings by the environment."""

    def run(*, config: str = "", **settings: str) -> Server:
        env = {
            "ECOD_MEMBERSHIP__BIND": "127.0.0.1:0",
            "ECOD_MEMBERSHIP__MULTICAST__ENABLED": "false",
            "ECOD_DASHBOARD__ENABLED": "false",
            "ECOD_CELL": cell_name,
            **settings,
        }
        file = tmp_path / "edge.toml"
        file.write_text(LANDMARKS + config)
        return start(lambda port: [program(), "--config", str(file), "--role", "edge", "--listen", f"127.0.0.1:{port}"], env)

    return run


LANDMARKS = """
[[landmarks]]
id = "slot-0"
x_m = 0.0
y_m = 0.0

[[landmarks]]
id = "slot-1"
x_m = 2.5
y_m = 0.0
"""


class Publisher:
    """A plain MQTT client, which publishes any payload."""

    def __init__(self, address: str, cell: str) -> None:
        host, _, port = address.partition(":")
        self.root = f"ecod/v1/{cell}"
        self.client = mqtt.Client(CallbackAPIVersion.VERSION2, protocol=mqtt.MQTTv5)
        self.client.connect(host, int(port))
        self.client.loop_start()

    def say(self, topic: str, payload: bytes, retain: bool = False) -> None:
        self.client.publish(f"{self.root}/{topic}", payload, qos=1, retain=retain).wait_for_publish(10)

    def close(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()


@pytest.fixture
def publisher(broker: Server, cell_name: str) -> Iterator[Publisher]:
    publisher = Publisher(broker.address, cell_name)
    yield publisher
    publisher.close()
