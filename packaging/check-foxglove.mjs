// Reads a log by Foxglove's MCAP library, and holds what is drawn against Foxglove's published schemas and the layout.

import assert from "node:assert/strict";
import { open, readFile } from "node:fs/promises";

import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";
import published from "@foxglove/schemas/jsonschema.js";
import Ajv from "ajv";

const [log, layoutFile] = process.argv.slice(2);
const ajv = new Ajv({ strict: false });
const validators = new Map();
const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(await open(log)),
  decompressHandlers: await loadDecompressHandlers(),
});

/** All messages by topic, each held against the schema of its channel's name. */
const messages = new Map();
for await (const { channelId, data } of reader.readMessages()) {
  const channel = reader.channelsById.get(channelId);
  const schema = reader.schemasById.get(channel.schemaId);
  const message = JSON.parse(new TextDecoder().decode(data));
  if (schema.name.startsWith("foxglove.")) {
    const name = schema.name.slice("foxglove.".length);
    if (!validators.has(name)) {
      assert.ok(published[name], `${schema.name} is published`);
      const own = JSON.parse(new TextDecoder().decode(schema.data));
      for (const [field, { contentEncoding }] of Object.entries(published[name].properties)) {
        assert.equal(own.properties[field]?.contentEncoding, contentEncoding, `${schema.name}.${field}`);
      }
      validators.set(name, ajv.compile(published[name]));
    }
    const validate = validators.get(name);
    assert.ok(validate(message), `${channel.topic}: ${ajv.errorsText(validate.errors)}`);
  }
  messages.set(channel.topic, [...(messages.get(channel.topic) ?? []), message]);
}
for (const name of ["SceneUpdate", "FrameTransform", "Log", "CompressedImage", "CameraCalibration", "ImageAnnotations"]) {
  assert.ok(validators.has(name), `the log has ${name}`);
}

const frames = new Set(messages.get("tf").map((transform) => transform.child_frame_id));
for (const picture of messages.get("camera")) {
  const bytes = Buffer.from(picture.data, "base64");
  assert.deepEqual([...bytes.subarray(0, 3)], [0xff, 0xd8, 0xff], "a picture is a JPEG file");
  assert.ok(frames.has(picture.frame_id), `the frame ${picture.frame_id} is known`);
  const isOfPicture = ({ timestamp: { sec, nsec } }) => sec === picture.timestamp.sec && nsec === picture.timestamp.nsec;
  assert.ok(messages.get("camera_calibration").some(isOfPicture), "a picture has its optics");
  assert.ok(messages.get("camera_boxes").some(({ points }) => points.every(isOfPicture)), "a picture has its boxes");
}

const { configById, layout } = JSON.parse(await readFile(layoutFile, "utf8"));
const panels = (node) => (typeof node === "string" ? [node] : [...panels(node.first), ...panels(node.second)]);
assert.deepEqual(panels(layout).sort(), Object.keys(configById).sort(), "each panel is laid out");
const { imageTopic, calibrationTopic, annotations } = configById["Image!ecod"].imageMode;
const shown = [imageTopic, calibrationTopic, ...Object.keys(annotations), configById["RosOut!ecod"].topicToRender];
for (const topic of [...shown, ...Object.keys(configById["3D!ecod"].topics)]) {
  assert.ok(messages.has(topic), `the layout's topic ${topic} is in the log`);
}
for (const { value } of configById["Plot!ecod"].paths) {
  const [topic, ...fields] = value.split(".");
  const last = messages.get(topic).at(-1);
  assert.equal(typeof fields.reduce((part, field) => part[field], last), "number", `${value} is a number`);
}
console.log(`${messages.size} topics; ${[...validators.keys()].sort().join(", ")} are as published`);
