"""Payloads in all encodings: what is taken, and what is not sent or not taken and why."""

from __future__ import annotations

import json
import math
import re
import sys
from dataclasses import replace
from typing import Any

import cbor2
import numpy as np
import pytest

import ecod
from ecod.codec import MAX_BYTES, Rejected, decode, encode

# The examples of docs/protocol.md.
MAP: dict[str, Any] = {
    "schema": 1, "aggregator": "edge", "epoch": 1795239882, "round": 21,
    "fused_at_us": 1795239884994166, "oldest_capture_us": 1795239884987159,
    "landmarks": [
        {"id": "slot-0", "label": "car", "confidence": 0.9594223345349845, "x_m": 0.19999999999999998, "y_m": 0.1,
         "contributors": ["euclid"], "observers": ["euclid"]},
        {"id": "slot-1", "label": None, "confidence": 0.0, "x_m": 2.5, "y_m": 0.0, "contributors": []},
    ],
    "objects": [
        {"id": "5ac5c32d-62b5-8d3a-9e0c-0d3c4f1f7a11", "label": "car", "confidence": 0.93, "x_m": 12.4, "y_m": -3.1,
         "covariance_m2": [0.04, 0.0, 0.04], "contributors": ["euclid", "gauss"], "existence": 0.96,
         "scores": {"car": 0.97, "truck": 0.03}, "velocity_mps": [8.2, 0.1], "heading_rad": 0.01, "size_m": [4.5, 1.8],
         "age_s": 0.05, "first_seen_us": 1795239880000000},
    ],
}  # fmt: skip

REPORT = ecod.ObjectReport(
    schema=1,
    node="euclid",
    seq=412,
    captured_at_us=1732154400123456,
    objects=[ecod.PerceivedObject("car", 0.93, 0.25, 0.48, covariance_m2=(0.0004, 0.0, 0.0001), landmark="slot-0")],
    pose=ecod.Pose(0.61, 0.46, 2.88),
    seen=["slot-0", "slot-1"],
)


def read(payload: Any) -> ecod.GlobalMap:
    message = decode(ecod.GlobalMap, payload if isinstance(payload, bytes) else json.dumps(payload).encode())
    assert isinstance(message, ecod.GlobalMap)
    return message


def test_a_map_is_read_with_unknown_fields_ignored() -> None:
    plain = read(MAP)
    later = {**MAP, "weather": {"rain": 1}, "objects": [{**MAP["objects"][0], "colour": "red"}]}
    assert read(later) == plain
    assert plain.fused_at.isoformat() == "2026-11-21T05:44:44.994166+00:00"
    assert not plain.landmarks[1].is_empty, "nobody looked"
    assert plain.objects[0].velocity_mps == (8.2, 0.1) and plain.objects[0].scores["truck"] == 0.03
    assert plain.objects[0].vehicle is None and plain.pose_corrections == {}


def test_cbor_with_names_is_read() -> None:
    named = json.loads(json.dumps(MAP))
    named["objects"][0]["id"] = bytes.fromhex("5ac5c32d62b58d3a9e0c0d3c4f1f7a11")
    assert read(cbor2.dumps(named)) == read(MAP)
    with pytest.raises(Rejected, match="malformed"):
        read(cbor2.dumps(named)[:-3])


def test_compact_cbor_is_read() -> None:
    landmarks = [["slot-0", "car", 0.9594223345349845, 200, 100, ["euclid"], ["euclid"]], ["slot-1", None, 0, 2500, 0, []]]
    ident = bytes.fromhex("5ac5c32d62b58d3a9e0c0d3c4f1f7a11")
    scores = {"car": 0.97, "truck": 0.03}
    item = [ident, "car", 0.93, 12400, -3100, [0.04, 0, 0.04], ["euclid", "gauss"], 0.96, [8.2, 0.1], 0.01, [4.5, 1.8]]
    item += [0.05, 1795239880000000, None, scores, "of a later version"]
    compact = [1, "edge", 1795239882, 21, 1795239884994166, 1795239884987159, landmarks, [item]]
    assert read(cbor2.dumps(compact)) == replace(read(MAP), landmarks=[replace(read(MAP).landmarks[0], x_m=0.2), read(MAP).landmarks[1]])
    status = decode(ecod.NodeStatus, cbor2.dumps([1, "edge", ident, 2, 1, 7, None, True, "0.1.0"]))
    assert (status.role, status.state, status.aggregator, status.fit) == ("edge", "aggregating", None, True)
    assert status.description is None
    status = decode(ecod.NodeStatus, cbor2.dumps([1, "edge", ident, 2, 1, 7, None, True, "0.1.0", [3, bytes(32)]]))
    assert status.description == ecod.DescriptionStatus(3, "00" * 32, None) and status.troubles == []
    trouble = ["clock_off", "late", "refused, its clock is 5.0 s ahead", "run a time service"]
    status = decode(ecod.NodeStatus, cbor2.dumps([1, "edge", ident, 2, 1, 7, None, True, "0.1.0", None, [trouble]]))
    assert status.troubles == [ecod.Trouble(*trouble)]


def spoilt(**changes: Any) -> dict[str, Any]:
    return {**MAP, "objects": [{**MAP["objects"][0], **changes}]}


DEEP = b'{"schema":' + b"[" * 100_000

FLAWS = {
    "empty array": (b"[]", "malformed"),
    "no map": (b'{"schema":1}', "malformed: aggregator: is missing"),
    "truncated": (json.dumps(MAP).encode()[:-1], "malformed"),
    "not UTF-8": (json.dumps(MAP).encode().replace(b"euclid", b"\xff\xfe"), "malformed"),
    "null": (b"null", "malformed"),
    "deep": (DEEP, "malformed"),
    "deep CBOR": (b"\x81" * 100_000, "malformed"),
    "long": (b" " * (MAX_BYTES + 1), "too_large"),
    "version": ({**MAP, "schema": 2}, "unknown_schema"),
    "signed": (b"\xec" + bytes(40), "signed"),
    "not a number": (json.dumps(spoilt(x_m=math.nan)).encode(), r"malformed: objects\[0\].x_m: nan must be a finite number"),
    "beyond numbers": (json.dumps(MAP).replace("12.4", "1e999").encode(), "x_m: inf must be a finite"),
    "beyond floats": (json.dumps(MAP).replace("12.4", "9" * 400).encode(), "malformed"),
    "text for a number": (spoilt(x_m="1"), r"x_m: '1' must be a finite number"),
    "true for a number": (spoilt(x_m=True), r"x_m: True must be a finite number"),
    "far": (spoilt(x_m=1e9), "x_m: 1000000000.0 must be from -1e"),
    "confidence": (spoilt(confidence=1.1), "confidence: 1.1 must be from 0 to 1"),
    "label": (spoilt(label="a\nb"), "label: 'a.nb' must have 1 to 64 bytes"),
    "name": (spoilt(contributors=["a/b"]), r"contributors\[0\]: 'a/b' must be 1 to 64"),
    "no covariance": (spoilt(covariance_m2=[1, 2, 1]), "must be a covariance"),
    "short covariance": (spoilt(covariance_m2=[1, 2]), "must be a list of 3"),
    "id": (spoilt(id="7"), "must be a UUID"),
    "text for a list": (spoilt(contributors="euclid"), "must be a list"),
    "list for a dictionary": (spoilt(scores=[1]), "must be an object"),
    "fraction of a round": ({**MAP, "round": 1.5}, "round: 1.5 must be a whole number"),
    "round below 0": ({**MAP, "round": -1}, "round: -1 must be from 0"),
    "round beyond": ({**MAP, "round": 2**53}, "must be from 0"),
}


@pytest.mark.parametrize("name", FLAWS)
def test_a_flaw_of_others_has_its_reason_and_place(name: str) -> None:
    payload, reason = FLAWS[name]
    with pytest.raises(Rejected) as rejected:
        read(payload)
    text = ": ".join(rejected.value.args)
    assert re.search(reason, text), text


def test_cbor_without_cbor2_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cbor2", None)
    with pytest.raises(Rejected, match=r"pip install 'ecod\[cbor\]'"):
        read(cbor2.dumps(MAP))


def test_a_report_is_sent_without_absent_fields() -> None:
    assert json.loads(encode(REPORT)) == {
        "schema": 1, "node": "euclid", "seq": 412, "captured_at_us": 1732154400123456,
        "objects": [{"label": "car", "confidence": 0.93, "x_m": 0.25, "y_m": 0.48, "covariance_m2": [0.0004, 0.0, 0.0001],
                     "landmark": "slot-0"}],
        "pose": {"x_m": 0.61, "y_m": 0.46, "heading_rad": 2.88},
        "seen": ["slot-0", "slot-1"],
    }  # fmt: skip
    assert json.loads(encode(replace(REPORT, objects=[], seen=[], pose=None))).keys() == {
        "schema", "node", "seq", "captured_at_us", "objects", "seen",
    }  # fmt: skip


def test_numbers_of_numpy_and_dictionaries_are_sent_as_plain_numbers() -> None:
    odd: Any = ecod.PerceivedObject(
        str(np.str_("car")), np.float32(0.5), np.int64(3), np.float64(0.25), covariance_m2=np.array([1, 0, 1])  # type: ignore[arg-type]
    )
    as_dict: Any = {"label": "car", "confidence": 0.5, "x_m": 3, "y_m": 0.25, "covariance_m2": [1, 0, 1]}
    assert encode(replace(REPORT, objects=[odd])) == encode(replace(REPORT, objects=[as_dict]))


OWN_FLAWS = {
    "x_m: nan must be a finite number": {"x_m": math.nan},
    "y_m: -inf must be a finite number": {"y_m": -math.inf},
    "x_m: is missing, must be a finite number": {"x_m": None},
    "y_m: '3' must be a finite number": {"y_m": "3"},
    r"confidence: 93\.0 must be from 0 to 1": {"confidence": 93},
    "label: '' must have 1 to 64 bytes": {"label": ""},
    "label: 'é": {"label": "é" * 33},
    "landmark: 7 must be text": {"landmark": 7},
    "covariance_m2: .* must be a covariance": {"covariance_m2": (-1.0, 0.0, 1.0)},
    r"velocity_mps\[1\]: nan": {"velocity_mps": (0.0, math.nan)},
    r"size_m\[0\]: -1.0 must be from 0 to 100000": {"size_m": (-1.0, 1.0)},
    r"scores\['cup'\]: 2.0 must be from 0 to 1": {"scores": {"cup": 2.0}},
}


@pytest.mark.parametrize("text", OWN_FLAWS)
def test_a_flaw_of_a_report_is_not_sent(text: str) -> None:
    flawed = {"label": "car", "confidence": 0.5, "x_m": 0.0, "y_m": 0.0, **OWN_FLAWS[text]}
    sound = ecod.PerceivedObject("car", 0.5, 0.0, 0.0)
    with pytest.raises(ecod.Invalid, match=r"^not sent: objects\[1\]\." + text):
        encode(replace(REPORT, objects=[sound, ecod.PerceivedObject(**flawed)]))
