"""A program's part in a cell of real nodes."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from conftest import SOON, Server, program, until, wait_for

import ecod

CAR = ecod.PerceivedObject("car", 0.9, 0.1, 0.2, landmark="slot-0", covariance_m2=(0.01, 0.0, 0.01))


def agreed(cell: ecod.Cell, node: str = "euclid") -> ecod.GlobalMap:
    """The first map with the car, and the empty place beside it, that this node's program reports and votes for."""

    def is_agreed(map: ecod.GlobalMap) -> bool:
        cell.report([CAR], pose=(1.0, 6.0, -1.57), seen=["slot-0", "slot-1"])
        cell.vote([CAR])
        car, empty = map.landmarks
        return car.label == "car" and node in car.contributors and empty.is_empty

    return until(cell.maps(timeout=SOON), is_agreed)


@pytest.mark.parametrize("encoding", ["json", "cbor", "compact"])
def test_a_node_takes_reports_and_its_messages_are_read(edge: Callable[..., Server], cell_name: str, encoding: str) -> None:
    node = edge(ECOD_MQTT__ENCODING=encoding)
    with ecod.Cell(node.address, cell_name, node="euclid") as cell:
        map = agreed(cell)
        first, second = map.landmarks
        assert (first.id, first.contributors, first.observers) == ("slot-0", ["euclid"], ["euclid"])
        assert (first.x_m, first.y_m) == pytest.approx((0.1, 0.2), abs=0.01) and first.confidence > 0.5
        assert (second.label, second.x_m, second.y_m) == (None, 2.5, 0.0)
        assert abs(map.fused_at.timestamp() - time.time()) < SOON
        assert (map.aggregator, map.schema) == ("edge", 1)

        def is_voted(message: ecod.Verdicts) -> bool:
            cell.vote([CAR])
            verdict = message.verdicts[0]
            return (verdict.landmark, verdict.label, list(verdict.votes)) == ("slot-0", "car", ["car"])

        until(cell.verdicts(timeout=SOON), is_voted)
        assert next(cell.reputations(timeout=SOON)).aggregator == "edge"
        status = next(cell.statuses(timeout=SOON))
        assert (status.node, status.role, status.state) == ("edge", "edge", "aggregating") and len(status.id) == 36
        assert not cell.counts, cell.counts


@pytest.mark.parametrize("encoding", ["json", "cbor", "compact"])
def test_tracks_of_a_node_are_read(edge: Callable[..., Server], cell_name: str, encoding: str) -> None:
    node = edge(ECOD_MQTT__ENCODING=encoding, ECOD_FUSION__TRACKS__MODE="on")
    with ecod.Cell(node.address, cell_name, node="euclid") as cell:
        began = time.time()

        def tracks(map: ecod.GlobalMap) -> list[ecod.FusedObject]:
            now = time.time()
            x_m = 20 + 5 * (now - began)
            position = (x_m, 3.0, (0.01, 0.0, 0.01))
            car = ecod.PerceivedObject("car", 0.9, *position, velocity_mps=(5.0, 0.0), size_m=(5.0, 2.0), scores={"car": 0.9})
            cell.report([car], pose=(0.0, 0.0, 0.0), view=ecod.FieldOfView(100.0, 6.28), captured_at=now)
            return [thing for thing in map.objects if (thing.velocity_mps or (0.0, 0.0))[0] > 3.0]

        map = until(cell.maps(timeout=SOON), tracks)
        (track,) = tracks(map)
        assert {thing.vehicle for thing in map.objects} == {None, "euclid"}, "who reports is there, too"
        assert track.label == "car" and track.contributors == ["euclid"] and len(track.id) == 36
        assert track.velocity_mps == pytest.approx((5.0, 0.0), abs=2.0) and track.y_m == pytest.approx(3.0, abs=0.5)
        assert track.first_seen_us is not None and abs(track.first_seen_us / 1e6 - began) < SOON
        assert not cell.counts, cell.counts


@pytest.mark.parametrize("encoding", ["json", "cbor", "compact"])
def test_a_position_of_a_map_is_one_on_earth_by_the_origin_of_the_cell(
    edge: Callable[..., Server], cell_name: str, encoding: str, tmp_path: Path
) -> None:
    node = edge(ECOD_MQTT__ENCODING=encoding)

    def describe(text: str) -> None:
        file = tmp_path / "cell.toml"
        file.write_text(text)
        subprocess.run(
            [program(), "cell", "set", str(file), "--cell", cell_name, "--door", node.address], check=True, capture_output=True
        )

    with ecod.Cell(node.address, cell_name, node="edge") as cell:
        assert cell.origin() is None and cell.description().version == 0
        describe("[origin]\nlatitude_deg = 52.2296756\nlongitude_deg = 21.0122287\nheight_m = 113\n")
        origin = wait_for(cell.origin)
        assert origin == ecod.geo.Origin(52.2296756, 21.0122287, 113.0) and cell.description().set_by == "edge"
        # As PROJ has it, for 12.4 m east and 3.1 m south.
        cell.report([CAR], pose=origin.pose(52.22964774062, 21.01241017960, 180.0))
        place = agreed(cell, "edge").landmarks[0]
        latitude, longitude, height = origin.to_wgs84(place.x_m, place.y_m)
        assert (latitude, longitude) == pytest.approx((52.2296774, 21.0122302), abs=2e-7) and height == pytest.approx(113.0, abs=1e-3)
        # A vehicle without a node sends its request to the leader's broker.
        with ecod.Cell(node.address, cell_name, node="euclid") as elsewhere:
            assert elsewhere.origin() == origin
        describe("[fusion.pace]\ngate_m = 0.5\n")
        wait_for(lambda: cell.origin() is None)
        assert not cell.counts, cell.counts


def test_a_refusal_says_what_the_node_says(edge: Callable[..., Server], cell_name: str) -> None:
    node = edge(ECOD_MQTT__MAX_PAYLOAD_BYTES="256")
    with ecod.Cell(node.address, cell_name, node="euclid") as cell:

        def report_at_length() -> bool:
            for _ in range(20):
                cell.report([CAR] * 200)
                time.sleep(0.05)
            return False

        with pytest.raises(ecod.Refused, match=r"\d+ bytes on .*/detections/euclid--python, at most 256"):
            wait_for(report_at_length)


def test_maps_go_on_after_the_node_is_killed_and_started_again(edge: Callable[..., Server], cell_name: str) -> None:
    node = edge()
    with ecod.Cell(node.address, cell_name, node="euclid") as cell:
        agreed(cell)
        node.kill()
        wait_for(lambda: not cell.report([CAR]))
        node.start()
        # Its terms begin anew, as it has no `state_dir`.
        assert agreed(cell).landmarks[0].contributors == ["euclid"]


@pytest.fixture
def pki(tmp_path: Path, cell_name: str) -> Callable[..., dict[str, str]]:
    """Issues certificates of the cell; gives the files as arguments of `Cell`."""
    directory = tmp_path / "pki"

    def run(*arguments: str) -> None:
        subprocess.run([program(), "pki", *arguments, "--dir", str(directory)], check=True, capture_output=True)

    def issue(name: str, role: str) -> dict[str, str]:
        if not directory.exists():
            run("init", "--cell", cell_name)
        run("issue", name, "--role", role)
        return {
            "ca": str(directory / "ca.pem"),
            "cert": str(directory / "nodes" / f"{name}.pem"),
            "key": str(directory / "nodes" / f"{name}.key"),
        }

    return issue


def test_a_cell_with_certificates_takes_a_program_by_its_own(
    edge: Callable[..., Server], cell_name: str, pki: Callable[..., dict[str, Any]]
) -> None:
    own, other = pki("edge", "edge"), pki("euclid", "cav")
    node = edge(ECOD_TLS__CA=own["ca"], ECOD_TLS__CERTIFICATE=own["cert"], ECOD_TLS__KEY=own["key"])
    with ecod.Cell(node.address, cell_name, node="euclid", part="", **other) as cell:
        assert agreed(cell).landmarks[0].contributors == ["euclid"]
    with ecod.Cell(node.address, cell_name, node="euclid", part="lidar", **other) as cell:
        assert agreed(cell).landmarks[0].contributors == ["euclid"]
    with ecod.Cell(node.address, cell_name, node="edge", part="lidar", **own) as cell:
        assert "edge" in agreed(cell, "edge").landmarks[0].contributors
    with pytest.raises(ecod.Refused, match=rf"{node.address} refuses the login: Not authorized; check node name \(argument `node` or ECOD_NAME\), certificate"):
        ecod.Cell(node.address, cell_name, node="gauss", part="", **other)
    with pytest.raises(ecod.Unreachable, match=f"no TLS with {node.address} .*broker.example.*check .*`broker_name`"):
        ecod.Cell(node.address, cell_name, node="euclid", broker_name="broker.example", **other)
    with pytest.raises(ecod.Unreachable, match=f"{node.address} .*`cert` and `key` are not given"):
        ecod.Cell(node.address, cell_name, node="euclid", ca=other["ca"], timeout=3.0)
    with pytest.raises(ecod.Unreachable, match=f"{node.address} .*without TLS.* takes `ca`, `cert` and `key`"):
        ecod.Cell(node.address, cell_name, node="euclid", timeout=3.0)


def test_certificates_of_the_environment_are_those_of_the_programs_node(
    start: Callable[..., Server], cell_name: str, pki: Callable[..., dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    own = pki("euclid", "cav")  # Its certificate has the name of a door alone.
    files = {"ECOD_TLS__CA": own["ca"], "ECOD_TLS__CERTIFICATE": own["cert"], "ECOD_TLS__KEY": own["key"]}

    def command(port: int) -> list[str]:
        return [program(), "--name", "euclid", "--role", "cav", "--cell", cell_name, "--listen", f"127.0.0.1:{port}", "--no-dashboard"]

    node = start(command, {"ECOD_MEMBERSHIP__BIND": "127.0.0.1:0", "ECOD_MEMBERSHIP__MULTICAST__ENABLED": "false", **files})
    for name, value in {"ECOD_BROKER": node.address, "ECOD_CELL": cell_name, "ECOD_NAME": "euclid", **files}.items():
        monkeypatch.setenv(name, value)
    with ecod.Cell() as cell:
        assert next(cell.statuses(timeout=SOON)).node == "euclid"
