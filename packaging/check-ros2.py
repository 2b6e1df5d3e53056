"""Reads logs of profile ros2 by mcap-ros2-support, has rosbags write each message again to equal bytes, and compares the definitions
in the logs with the definitions of ROS 2 Humble."""

import collections
import sys

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore


def read(path, counts):
    seen = set()
    store, humble = get_typestore(Stores.EMPTY), get_typestore(Stores.ROS2_HUMBLE)
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            if schema.name not in seen:
                seen.add(schema.name)
                types = get_types_from_msg(schema.data.decode(), schema.name)
                for name, (_, fields) in types.items():
                    # vision_msgs is no part of it.
                    assert name.startswith("vision_msgs/") or fields == humble.fielddefs[name][1], name
                store.register({name: fields for name, fields in types.items() if name not in store.types})
            again = store.serialize_cdr(store.deserialize_cdr(message.data, schema.name), schema.name)
            assert bytes(again) == message.data, channel.topic
            counts[channel.topic] += 1
            if channel.topic == "/ecod/euclid_2/detections":
                (car,) = decoded.detections
                assert decoded.header.frame_id == "map" and car.results[0].hypothesis.class_id == "car"
                assert abs(car.results[0].hypothesis.score - 0.93) < 1e-9
                assert car.bbox.center.position.x == 12.5 and car.bbox.center.position.y == -3.0
            if channel.topic == "/ecod/map/detections":
                for found in decoded.detections:
                    # All reports state cars, so the score is the probability of the object.
                    (hypothesis,) = (result.hypothesis for result in found.results)
                    assert hypothesis.class_id == "car" and 0 < hypothesis.score < 1, hypothesis
            if channel.topic == "/tf":
                transform, optical = decoded.transforms
                assert transform.child_frame_id == "euclid_2_camera" and transform.transform.translation.y == 6.0
                assert abs(transform.transform.rotation.z + 0.7068) < 1e-3
                # An optical frame's z axis is the camera's x axis (REP 103).
                q = optical.transform.rotation
                assert 2 * (q.x * q.z + q.w * q.y) == 1 and optical.header.frame_id == transform.child_frame_id
            if channel.topic == "/ecod/camera/camera_info":
                assert (decoded.width, decoded.height, decoded.distortion_model) == (640, 480, "plumb_bob")
                assert decoded.header.frame_id == "cam_1_camera_optical" and list(decoded.d)[:2] == [-0.3, 0.1]
                assert decoded.k[0] == decoded.p[0] == 554.25 and decoded.k[5] == decoded.p[6] == 240.0


def main():
    counts = collections.Counter()
    for path in sys.argv[1:]:
        read(path, counts)
    assert len(counts) == 6, counts
    print(*(f"{topic} {count}" for topic, count in sorted(counts.items())), sep="\n")


if __name__ == "__main__":
    main()
