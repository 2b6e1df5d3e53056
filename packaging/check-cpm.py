"""Decodes messages of the example cpm_samples, checks their known values, and encodes them again to the same bytes."""

import pathlib
import re
import sys

import asn1tools

ORIGINATING_VEHICLE, ORIGINATING_RSU, PERCEIVED_OBJECTS = 1, 2, 5
INSIDE = {
    ORIGINATING_VEHICLE: "OriginatingVehicleContainer",
    ORIGINATING_RSU: "OriginatingRsuContainer",
    PERCEIVED_OBJECTS: "PerceivedObjectContainer",
}


def modules(folder):
    """The modules of a CPM without successors and inner constraints: asn1tools cannot read them, and UPER does not encode them."""
    texts = [path.read_text(errors="replace") for path in sorted(pathlib.Path(folder).rglob("*.asn"))]
    wanted = [text for text in texts if re.search(r"^CPM-|^ETSI-ITS-CDD *\{.*major-version-[34]", text, re.M)]
    for text in wanted:
        text = re.sub(r"WITH SUCCESSORS", "", text)
        yield re.sub(r"TrafficParticipantType *\([^)]*\)", "TrafficParticipantType (0..14)", text)


def check(specification, message):
    decoded = specification.decode("CollectivePerceptionMessage", message)
    inside = {}
    for container in decoded["payload"]["cpmContainers"]:
        kind, data = INSIDE[container["containerId"]], container["containerData"]
        inside[kind] = specification.decode(kind, data)
        assert specification.encode(kind, inside[kind]) == data, kind
    assert specification.encode("CollectivePerceptionMessage", decoded) == message
    return decoded["header"], decoded["payload"]["managementContainer"], inside


def main():
    specification = asn1tools.compile_string("\n".join(modules(sys.argv[1])), "uper")
    messages = [bytes.fromhex(line) for line in sys.stdin]
    report, empty, whole = [check(specification, message) for message in messages]

    header, management, inside = report
    assert header == {"protocolVersion": 2, "messageId": 14, "stationId": 1234}, header
    # 2026-11-21T05:44:42.123Z in milliseconds of TAI since 2004-01-01.
    assert management["referenceTime"] == 1_795_239_882_123 - 1_072_915_200_000 + 5_000, management
    position = management["referencePosition"]
    assert abs(position["latitude"] - 522_296_756 - 1797) < 3, position  # 20 m north
    assert abs(position["longitude"] - 210_122_287 - 1464) < 3, position  # 10 m east
    assert position["altitude"]["altitudeValue"] == 11_300, position
    assert inside["OriginatingVehicleContainer"]["orientationAngle"]["value"] == 900, inside  # east
    objects = inside["PerceivedObjectContainer"]["perceivedObjects"]
    # Twelve were seen, of which one is a vacancy sign.
    assert len(objects) == 11 and len({thing["objectId"] for thing in objects}) == 11
    for thing in objects:
        assert ("angles" in thing) == ("objectDimensionX" in thing) == ("objectDimensionY" in thing), thing
    car = objects[0]
    assert abs(car["position"]["xCoordinate"]["value"] + 1000) <= 1, car
    assert abs(car["position"]["yCoordinate"]["value"] + 2310) <= 1, car
    assert car["position"]["xCoordinate"]["confidence"] == 40, car  # 1.96 * 0.2 m
    assert car["velocity"][0] == "cartesianVelocity" and car["velocity"][1]["xVelocity"]["value"] == 820, car
    assert car["objectDimensionX"]["value"] == 45 and car["objectPerceptionQuality"] == 14, car
    assert car["classification"][0] == {"objectClass": ("vehicleSubClass", 5), "confidence": 70}, car

    assert empty[0]["stationId"] == 2**32 - 1 and empty[2]["OriginatingRsuContainer"] == {}, empty
    assert empty[2]["PerceivedObjectContainer"]["perceivedObjects"] == [], empty
    cars = whole[2]["PerceivedObjectContainer"]["perceivedObjects"]
    assert len(cars) == 255 and all(car["objectAge"] == 700 for car in cars), cars[0]
    # Last seen 250 ms before the map, at 4 m/s to the north.
    assert all(car["measurementDeltaTime"] == -250 for car in cars), cars[0]
    assert all(car["position"]["yCoordinate"]["value"] == 150 for car in cars), cars[0]
    print(f"{len(messages)} messages of {[len(message) for message in messages]} bytes decoded, and encoded to the same bytes")


if __name__ == "__main__":
    main()
