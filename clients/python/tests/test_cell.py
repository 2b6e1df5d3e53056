"""A program's part in a cell, at a real broker."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import queue
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import SOON, Publisher, Server, free_port, wait_for
from test_codec import MAP

import ecod
from ecod import connection, streams

CAR = ecod.PerceivedObject("car", 0.9, 1.0, 2.0, landmark="slot-0")

LARGE = ecod.PerceivedObject("car", 0.9, 1.0, 2.0, scores={f"class {number} of many": 0.125 for number in range(12)})


def map_of(epoch: int, round: int, aggregator: str = "edge") -> bytes:
    return json.dumps({**MAP, "aggregator": aggregator, "epoch": epoch, "round": round}).encode()


def status(node: str, state: str = "following") -> bytes:
    ident = "01a1fca2-b074-775a-88b5-e92725a307f1"
    return json.dumps({"schema": 1, "node": node, "id": ident, "role": "cav", "state": state, "epoch": 1, "version": "0.1"}).encode()


@pytest.fixture
def cell(broker: Server, cell_name: str) -> Iterator[ecod.Cell]:
    with ecod.Cell(broker.address, cell_name, node="euclid", part="lidar") as cell:
        yield cell


@pytest.fixture
def heard(publisher: Publisher) -> queue.Queue[tuple[str, dict[str, Any]]]:
    """The topics and payloads of reports that arrive at the broker."""
    arrived: queue.Queue[tuple[str, dict[str, Any]]] = queue.Queue()
    subscribed = threading.Event()
    publisher.client.on_message = lambda _client, _userdata, message: arrived.put((message.topic, json.loads(message.payload)))
    publisher.client.on_subscribe = lambda *_: subscribed.set()
    publisher.client.subscribe([(f"{publisher.root}/detections/+", 0), (f"{publisher.root}/vote_detections/+", 0)])
    assert subscribed.wait(10)
    return arrived


def listen(cell: ecod.Cell, publisher: Publisher) -> Iterator[ecod.GlobalMap]:
    """The maps of a cell, once the broker sends them."""
    maps = cell.maps(timeout=SOON)
    rounds = iter(range(1, 10_000))
    wait_for(lambda: publisher.say("global_detections", map_of(0, next(rounds))) or cell._maps.number)
    publisher.say("global_detections", map_of(0, 10_000))
    wait_for(lambda: next(maps).round == 10_000)
    return maps


def test_maps_come_in_order_and_older_and_repeated_ones_never(
    cell: ecod.Cell, publisher: Publisher, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    maps = listen(cell, publisher)
    for epoch, round, is_new in [(3, 7, True), (3, 7, False), (3, 6, False), (2, 9, False), (3, 8, True), (4, 1, True), (3, 9, False)]:
        publisher.say("global_detections", map_of(epoch, round))
        if is_new:
            map = next(maps)
            assert (map.epoch, map.round) == (epoch, round)
    # Two may begin to lead in the same term; the later name goes first.
    publisher.say("global_detections", map_of(4, 9, "atlas"))
    publisher.say("global_detections", map_of(4, 1, "galileo"))
    assert next(maps).aggregator == "galileo"
    wait_for(lambda: cell.counts == {"repeated": 2, "superseded": 3})
    assert [record.levelno for record in caplog.records if "superseded" in record.message] == [logging.INFO]


def test_a_cell_that_begins_anew_is_heard_after_a_silence(
    cell: ecod.Cell, publisher: Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    maps = listen(cell, publisher)
    publisher.say("global_detections", map_of(9, 9))
    wait_for(lambda: next(maps).epoch == 9)
    publisher.say("global_detections", map_of(1, 1))
    wait_for(lambda: cell.counts["superseded"])
    monkeypatch.setattr(streams, "FORGET_S", 0.0)
    publisher.say("global_detections", map_of(1, 2))
    assert (next(maps).epoch, cell.counts["superseded"]) == (1, 1)


def test_a_slow_reader_gets_the_newest_map_and_keeps_nothing_else(cell: ecod.Cell, publisher: Publisher) -> None:
    slow, quick = listen(cell, publisher), cell.maps(timeout=SOON)
    for round in range(1, 201):
        publisher.say("global_detections", map_of(1, round))
    wait_for(lambda: cell._maps._last == (1, "edge", 200))
    assert [next(reader).round for reader in (slow, quick)] == [200, 200], "each reader has its own place"
    assert len(cell._maps._newest) == 1
    with pytest.raises(ecod.Silent, match="nothing on ecod/v1/lot-.*/global_detections from 127.0.0.1:.* does a node lead the cell"):
        next(cell.maps(timeout=0.3))


def test_unusable_messages_are_counted_and_told_of_once(
    cell: ecod.Cell, publisher: Publisher, caplog: pytest.LogCaptureFixture
) -> None:
    statuses = cell.statuses(timeout=SOON)
    maps = listen(cell, publisher)  # The broker answers in order: it sends statuses, too.
    for payload in [b"{", b'{"schema":1}', b"\x00", b"\xec" + bytes(32), json.dumps({**MAP, "schema": 2}).encode(), b"[" * 9999] * 3:
        publisher.say("global_detections", payload)
    publisher.say("nodes/gauss", status("euclid"))
    publisher.say("nodes/gauss", b"")
    publisher.say("nodes/gauss", status("gauss"))
    publisher.say("global_detections", map_of(1, 1))
    assert next(maps).round == 1 and next(statuses).node == "gauss"
    assert cell.counts == {"malformed": 12, "signed": 3, "unknown_schema": 3, "node_mismatch": 1}
    told = [record.getMessage() for record in caplog.records]
    assert [sum(reason in text for text in told) for reason in cell.counts] == [1, 1, 1, 1], told
    assert all(f"{publisher.root}/" in text for text in told)


def test_statuses_are_the_present_ones_first_and_then_changes(
    cell: ecod.Cell, publisher: Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    for node in ("gauss", "riemann"):
        publisher.say(f"nodes/{node}", status(node), retain=True)
    first = cell.statuses(timeout=SOON)
    assert {next(first).node, next(first).node} == {"gauss", "riemann"}
    publisher.say("nodes/gauss", status("gauss", "offline"))
    assert next(first).state == "offline"
    again = cell.statuses(timeout=SOON)
    assert [(it.node, it.state) for it in (next(again), next(again))] == [("riemann", "following"), ("gauss", "offline")]
    monkeypatch.setattr(streams, "MAX_NODES", 5)
    for number in range(20):
        publisher.say(f"nodes/n{number}", status(f"n{number}"))
    wait_for(lambda: "n19" in cell._statuses._newest)
    assert list(cell._statuses._newest) == [f"n{number}" for number in range(15, 20)]
    for node in ("gauss", "riemann"):
        publisher.say(f"nodes/{node}", b"", retain=True)
    with pytest.raises(ecod.Silent, match="nothing has changed since the last"):
        for _ in cell.statuses(timeout=0.5):
            pass


def test_verdicts_and_reputations_are_read(cell: ecod.Cell, publisher: Publisher) -> None:
    reputations = {"schema": 1, "epoch": 3, "round": 88, "reputations": {"euclid": {"score": 0.62, "correct": 410, "incorrect": 22}}}
    publisher.say("reputations", json.dumps(reputations).encode(), retain=True)
    assert next(cell.reputations(timeout=SOON)).reputations["euclid"].correct == 410
    verdict = {"landmark": "ball", "label": None, "score": 0, "margin": 0, "votes": {"cup": 0.12}, "contributors": ["euclid"]}
    verdicts = {"schema": 1, "aggregator": "edge", "epoch": 3, "round": 8, "fused_at_us": 1_500_000, "verdicts": [verdict]}
    rounds = cell.verdicts(timeout=SOON)

    def say() -> int:
        verdicts["round"] = int(str(verdicts["round"])) + 1
        publisher.say("global_verdicts", json.dumps(verdicts).encode())
        return cell._verdicts.number

    wait_for(say)
    got = next(rounds)
    assert got.verdicts[0].votes == {"cup": 0.12} and got.fused_at == datetime(1970, 1, 1, 0, 0, 1, 500000, timezone.utc)
    publisher.say("reputations", b"", retain=True)


def test_reports_and_votes_are_published_under_the_name_of_the_part(cell: ecod.Cell, heard: Any, cell_name: str) -> None:
    before = time.time_ns() // 1000
    assert cell.report([CAR], pose=(1.0, 6.0, -1.5), seen=["slot-0", "slot-1"], view=ecod.FieldOfView(60.0, 6.28))
    assert cell.report([], captured_at=1795239884.987159)
    moment = datetime(2026, 11, 21, 6, 44, 44, 987159, timezone(timedelta(hours=1)))
    assert cell.vote([{"label": "car", "confidence": 1, "x_m": 0, "y_m": 0, "landmark": "slot-0"}], captured_at=moment)
    (topic, first), (_, second), (vote_topic, vote) = (heard.get(timeout=SOON) for _ in range(3))
    assert (topic, vote_topic) == (
        f"ecod/v1/{cell_name}/detections/euclid--lidar",
        f"ecod/v1/{cell_name}/vote_detections/euclid--lidar",
    )
    assert before <= first["captured_at_us"] <= time.time_ns() // 1000
    assert (first["seq"], first["node"], first["pose"]["y_m"], first["seen"]) == (1, "euclid--lidar", 6.0, ["slot-0", "slot-1"])
    assert (second["seq"], second["objects"], second["captured_at_us"]) == (2, [], 1795239884987159)
    assert (vote["seq"], vote["captured_at_us"]) == (1, 1795239884987159)


def test_values_that_are_not_allowed_are_not_sent_and_cost_no_number(cell: ecod.Cell, heard: Any) -> None:
    for text, send in {
        r"objects\[0\].x_m: nan must be a finite number": lambda: cell.report([ecod.PerceivedObject("car", 0.9, math.nan, 0.0)]),
        "pose.heading_rad: inf": lambda: cell.report([CAR], pose=(0.0, 0.0, math.inf)),
        r"seen\[0\]: ''": lambda: cell.report([CAR], seen=[""]),
        "has no time zone": lambda: cell.report([CAR], captured_at=datetime(2026, 1, 1)),
        "captured_at nan must be": lambda: cell.report([CAR], captured_at=math.nan),
        "captured_at 1795239884987159 must be Unix seconds; this looks like milliseconds": lambda: cell.report([CAR], captured_at=1795239884987159),
        r"objects\[1\].landmark: is missing": lambda: cell.vote([CAR, ecod.PerceivedObject("car", 0.9, 0.0, 0.0)]),
        "objects: .* must have at most 1024 entries": lambda: cell.report([CAR] * 1025),
        "bytes with 1024 objects, at most 262144": lambda: cell.report([LARGE] * 1024),
    }.items():
        with pytest.raises(ecod.Invalid, match=f"not sent: .*{text}|not sent: {text}"):
            send()
    assert cell.report([CAR])
    assert heard.get(timeout=SOON)[1]["seq"] == 1


def test_arguments_of_the_wrong_shape_are_not_sent(cell: ecod.Cell) -> None:
    car = ecod.PerceivedObject("car", 0.9, x_m=1, y_m=2)
    wrong: list[tuple[str, dict[str, Any]]] = [
        ("pose: .* x_m, y_m, heading_rad", {"pose": (1, 2)}),
        ("pose", {"pose": np.eye(3)}),
        ("pose.y_m", {"pose": (1, math.nan, 2)}),
        ("pose", {"pose": 5}),
        ("objects", {"objects": None}),
        ("objects", {"objects": car}),
        ("objects.0.", {"objects": [5]}),
        ("seen", {"seen": "slot-1"}),
        ("seen", {"seen": 5}),
        ("view", {"view": (10, 1)}),
    ]
    for place, named in wrong:
        with pytest.raises(ecod.Invalid, match=f"not sent: {place}"):
            cell.report(**{"objects": [car], **named})
    for objects in (None, [5], "ab"):
        with pytest.raises(ecod.Invalid, match="not sent: objects"):
            cell.vote(objects)  # type: ignore[arg-type]
    assert cell.report([car], pose=np.array([1.0, 2, 3]))  # type: ignore[arg-type]


def test_defaults_come_from_the_environment(broker: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ECOD_BROKER", broker.address)
    monkeypatch.setattr(socket, "gethostname", lambda: "pi.4.local")
    with ecod.Cell() as cell:
        assert (cell.cell, cell.name) == ("cell", "pi--python")
    monkeypatch.setenv("ECOD_CELL", "lot-1")
    monkeypatch.setenv("ECOD_NAME", "euclid")
    with ecod.Cell(part="") as cell:
        assert (cell.cell, cell.name) == ("lot-1", "euclid")
    assert connection.host_and_port("localhost", 1883) == ("localhost", 1883)
    assert connection.host_and_port("[::1]:1884", 1883) == ("::1", 1884)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("broker 'host:port' must be HOST:PORT", {"broker": "host:port"}),
        ("broker 'mqtt://host' must be HOST:PORT", {"broker": "mqtt://host"}),
        ("broker ':1883' must be HOST:PORT", {"broker": ":1883"}),
        (r"broker '\*\*\*@host:1883' must be HOST:PORT; a login is `user` and `password`", {"broker": "mqtt://user:geh/eim1@host:1883"}),
        ("broker 'mqtt://host' must be HOST:PORT", {"broker": "mqtt://host?password=geheim1"}),
        (r"broker '\*\*\*@host' must be HOST:PORT; a login is `user` and `password`", {"broker": "user:geheim1@host"}),
        ("cell name 'a/b' must be 1 to 64", {"cell": "a/b"}),
        ("node name 'euclid--#' must be 1 to 64", {"node": "euclid", "part": "#"}),
        ("cert and key need `ca`", {"cert": "euclid.pem"}),
        ("cannot use ca '/nowhere/ca.pem'", {"ca": "/nowhere/ca.pem"}),
    ],
)
def test_arguments_that_cannot_be_meant_are_refused(text: str, named: dict[str, Any]) -> None:
    with pytest.raises(ecod.Invalid, match=text):
        ecod.Cell(**named)


def test_the_connection_is_made_anew_after_the_broker_is_killed(
    cell: ecod.Cell, broker: Server, cell_name: str, caplog: pytest.LogCaptureFixture
) -> None:
    maps, statuses = cell.maps(timeout=SOON), cell.statuses(timeout=SOON)
    assert cell.report([CAR])
    broker.kill()
    wait_for(lambda: not cell.report([CAR]))
    assert cell.counts["unsent"] >= 1
    wait_for(lambda: f"connection to {broker.address} lost" in caplog.text)
    with pytest.raises(ecod.Silent, match="no connection"):
        next(cell.verdicts(timeout=0.1))
    broker.start()
    wait_for(lambda: cell.report([CAR]))
    publisher = Publisher(broker.address, cell_name)
    rounds = iter(range(1, 10_000))
    wait_for(lambda: publisher.say("global_detections", map_of(1, next(rounds))) or cell._maps.number)
    assert next(maps).epoch == 1
    publisher.say("nodes/gauss", status("gauss"), retain=True)
    assert next(statuses).node == "gauss"
    publisher.close()


def test_a_broker_that_stands_still_gets_no_late_reports(cell: ecod.Cell, broker: Server, heard: Any) -> None:
    assert cell.report([CAR])
    heard.get(timeout=SOON)
    os.kill(broker.process.pid, signal.SIGSTOP)
    try:
        # 200 KB each: the kernel takes some, the client sixteen.
        sent = [cell.report([LARGE] * 500) for _ in range(100)]
        assert not sent[-1] and sum(sent) < 90 and cell.counts["unsent"] == sent.count(False)
    finally:
        os.kill(broker.process.pid, signal.SIGCONT)
    wait_for(lambda: cell.report([]), 30)


def test_nobody_at_the_address_is_told_with_the_address_and_the_remedy() -> None:
    port = free_port()
    with pytest.raises(ecod.Unreachable, match=f"cannot connect to localhost:{port} .*ECOD_BROKER.*refused.*is a node or a broker.* 8883, and takes `ca`"):
        ecod.Cell(f"localhost:{port}")


class Peer:
    """A server that answers every connection's first bytes with bytes of its own, and then every later packet."""

    def __init__(self, *answers: bytes) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.listener.getsockname()[1]}"
        self.connections: list[float] = []
        self.answers = answers
        threading.Thread(target=self.serve, daemon=True).start()

    def serve(self) -> None:
        while True:
            try:
                stream, _ = self.listener.accept()
            except OSError:
                return
            self.connections.append(time.monotonic())
            threading.Thread(target=self.answer, args=[stream], daemon=True).start()

    def answer(self, stream: socket.socket) -> None:
        with stream, contextlib.suppress(ConnectionError):
            for answer in self.answers:
                if not stream.recv(4096):
                    return
                stream.sendall(answer)
            while stream.recv(4096):
                pass


ACCEPTED = b"\x20\x03\x00\x00\x00"


@pytest.mark.parametrize(
    "answer", [b"", b"HTTP/1.1 400 Bad Request\r\n\r\n", b"\x20\x02\x00", b"\xff" * 64], ids=["none", "HTTP", "truncated", "junk"]
)
def test_a_server_that_is_no_broker_is_told(answer: bytes) -> None:
    peer = Peer(answer)
    began = time.monotonic()
    with pytest.raises(ecod.Unreachable, match=f"{peer.address} .*(speak MQTT 5)"):
        ecod.Cell(peer.address, timeout=0.5)
    assert time.monotonic() - began < 5
    peer.listener.close()


@pytest.mark.parametrize("answer", [ACCEPTED + b"\x30\x03\xff\xff\x00", ACCEPTED + b"\x00\x00"], ids=["overlong topic", "no packet"])
def test_what_is_not_understood_ends_the_connection_and_not_the_program(answer: bytes, caplog: pytest.LogCaptureFixture) -> None:
    peer = Peer(answer)
    with ecod.Cell(peer.address):
        wait_for(lambda: len(peer.connections) >= 6)
    assert peer.address in caplog.text
    gaps = [later - earlier for earlier, later in zip(peer.connections, peer.connections[1:])]
    assert sum(gaps[:5]) > 0.05 + 0.1 + 0.2 + 0.4 + 0.8, "the broker is asked less and less often"
    peer.listener.close()


def test_a_subscription_that_is_refused_is_raised() -> None:
    peer = Peer(ACCEPTED, b"\x90\x04\x00\x01\x00\x87")
    with ecod.Cell(peer.address, "lot-1") as cell:
        with pytest.raises(ecod.Refused, match=f"{peer.address} refuses ecod/v1/lot-1/global_detections: Not authorized"):
            next(cell.maps(timeout=SOON))
    peer.listener.close()


def passwords(directory: Path, user: str, password: str) -> Path:
    file = directory / f"{user}.passwords"
    subprocess.run(["mosquitto_passwd", "-b", "-c", str(file), user, password], check=True, capture_output=True)
    return file


def test_a_wrong_password_is_refused_and_the_right_one_taken(
    mosquitto: Callable[..., Server], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broker = mosquitto("allow_anonymous false", f"password_file {passwords(tmp_path, 'ada', 'hush4711')}")
    for login in ({}, {"user": "ada", "password": "wrong"}):
        with pytest.raises(ecod.Refused, match=f"{broker.address} refuses the login: Not authorized; check .*certificate, user and password"):
            ecod.Cell(broker.address, **login)
    with ecod.Cell(broker.address, user="ada", password="hush4711"):
        pass
    monkeypatch.setenv("ECOD_MQTT__USER", "ada")
    monkeypatch.setenv("ECOD_MQTT__PASSWORD", "hush4711")
    with ecod.Cell(broker.address) as cell:
        maps = cell.maps()
        broker.kill()
        passwords(tmp_path, "ada", "new")
        broker.start()
        with pytest.raises(ecod.Refused, match="Not authorized"):
            next(maps)
        with pytest.raises(ecod.Refused, match="Not authorized"):
            cell.report([CAR])
        broker.kill()
        passwords(tmp_path, "ada", "hush4711")
        broker.start()
        wait_for(lambda: cell._connection.is_connected)
        assert cell.report([CAR]), "it is let in again"


def test_reports_that_the_broker_does_not_allow_are_raised_and_logged(
    mosquitto: Callable[..., Server], tmp_path: Path, cell_name: str, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "acl").write_text(f"topic read #\ntopic write ecod/v1/{cell_name}/detections/euclid\n")
    broker = mosquitto("allow_anonymous true", f"acl_file {tmp_path / 'acl'}")
    with ecod.Cell(broker.address, cell_name, node="euclid") as cell:
        for _ in range(2):
            assert cell.report([CAR])
            wait_for(lambda: cell._connection._denied)
            with pytest.raises(ecod.Refused, match=f"refuses ecod/v1/{cell_name}/detections/euclid--python: Not authorized"):
                cell.report([CAR])
    assert "Not authorized" in caplog.text
    with ecod.Cell(broker.address, cell_name, node="euclid", part="") as cell:
        assert all(cell.report([CAR]) for _ in range(5)) and not cell._connection._denied


def test_closing_ends_the_loops_of_other_threads(broker: Server) -> None:
    cell = ecod.Cell(broker.address)
    got: list[ecod.GlobalMap] = []
    reader = threading.Thread(target=lambda: got.extend(cell.maps()))
    reader.start()
    cell.close()
    reader.join(timeout=SOON)
    assert not reader.is_alive() and got == [] and not cell.report([])
    cell.close()


@pytest.mark.parametrize("_again", range(20))
def test_what_was_reported_before_closing_arrives(broker: Server, cell_name: str, heard: Any, _again: int) -> None:
    with ecod.Cell(broker.address, cell_name) as cell:
        assert all(cell.report([CAR] * 200) for _ in range(10))
    assert [heard.get(timeout=SOON)[1]["seq"] for _ in range(10)] == list(range(1, 11))
