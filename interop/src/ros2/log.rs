//! Logs of a node as MCAP of profile `ros2`.

use std::collections::BTreeMap;
use std::io::{Seek, Write};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, Limits, decode, decode_report};
use mcap::records::MessageHeader;
use mcap::{Compression, McapError, MessageStream, WriteOptions, Writer};
use serde::{Deserialize, Serialize};

use super::camera::{CameraInfo, RosImage};
use super::messages::{Definition, Header, RosTime, encode};
use super::{RosSink, put_map, put_report, ros_name};

/// A log that cannot be converted.
#[derive(Debug, thiserror::Error)]
pub enum ConversionError {
    /// It is no MCAP, or the output cannot be written.
    #[error(transparent)]
    Mcap(#[from] McapError),
    /// A message that has no form in CDR.
    #[error(transparent)]
    Cdr(#[from] cdr_encoding::Error),
}

/// Messages read and written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Conversion {
    /// Messages written.
    pub written: u64,
    /// Messages of other channels, which have no form in ROS.
    pub passed_over: u64,
    /// Messages that are not as a node writes them.
    pub unusable: u64,
    /// True if the log ends in the middle, as that of a killed node does.
    pub is_cut: bool,
}

/// The picture of a log, as Foxglove has it.
#[derive(Deserialize)]
struct LoggedImage {
    frame_id: String,
    data: String,
    format: String,
}

/// The optics of a log's pictures, as Foxglove has them.
#[derive(Deserialize)]
#[serde(rename_all = "UPPERCASE")]
struct LoggedOptics {
    #[serde(rename = "frame_id")]
    frame_id: String,
    #[serde(rename = "width")]
    width: u32,
    #[serde(rename = "height")]
    height: u32,
    #[serde(rename = "distortion_model")]
    distortion_model: String,
    d: Vec<f64>,
    k: [f64; 9],
    r: [f64; 9],
    p: [f64; 12],
}

/// Writes a log as MCAP of profile `ros2`.
///
/// # Errors
/// [`ConversionError`] if this is no log, or the output cannot be written.
pub fn convert<W: Write + Seek>(log: &[u8], output: W) -> Result<Conversion, ConversionError> {
    let options = WriteOptions::new().profile("ros2").compression(Some(Compression::Zstd));
    let mut output = RosLogWriter { writer: Writer::with_options(output, options)?, channels: BTreeMap::new() };
    let mut done = Conversion::default();
    for message in MessageStream::new_with_options(log, mcap::read::Options::IgnoreEndMagic.into())? {
        let message = match message {
            Ok(message) => message,
            Err(error @ McapError::BadMagic) => return Err(error.into()),
            Err(_) => {
                done.is_cut = true;
                break;
            }
        };
        let at = Stamps { log: message.log_time, publish: message.publish_time };
        let (kind, name) = message.channel.topic.split_once('/').unwrap_or((&message.channel.topic, ""));
        let mut output = TimedOutput { output: &mut output, at };
        let is_written = match kind {
            "global_detections" => output.map(&message.data)?,
            "detections" => output.report(name, &message.data)?,
            "camera" => output.image(name, &message.data)?,
            "camera_calibration" => output.optics(name, &message.data)?,
            _ => {
                done.passed_over += 1;
                continue;
            }
        };
        *(if is_written { &mut done.written } else { &mut done.unusable }) += 1;
    }
    output.writer.finish()?;
    Ok(done)
}

/// Times of a log's message in nanoseconds.
#[derive(Clone, Copy)]
struct Stamps {
    log: u64,
    publish: u64,
}

struct RosLogWriter<W: Write + Seek> {
    writer: Writer<W>,
    channels: BTreeMap<String, u16>,
}

/// The output for the messages of one time.
struct TimedOutput<'a, W: Write + Seek> {
    output: &'a mut RosLogWriter<W>,
    at: Stamps,
}

impl<W: Write + Seek> TimedOutput<'_, W> {
    fn map(&mut self, data: &[u8]) -> Result<bool, ConversionError> {
        let Ok(map) = decode::<GlobalMap>(data, &Limits::default()) else { return Ok(false) };
        put_map(&map, self).map(|()| true)
    }

    fn report(&mut self, node: &str, data: &[u8]) -> Result<bool, ConversionError> {
        let Ok(node) = NodeName::new(node) else { return Ok(false) };
        let Ok(report) = decode_report(data, &node, &Limits::default()) else { return Ok(false) };
        put_report(&report, self).map(|()| true)
    }

    fn image(&mut self, camera: &str, data: &[u8]) -> Result<bool, ConversionError> {
        let Ok(image) = serde_json::from_slice::<LoggedImage>(data) else { return Ok(false) };
        let Ok(bytes) = STANDARD.decode(image.data) else { return Ok(false) };
        let Some(header) = self.header(&image.frame_id) else { return Ok(false) };
        self.put(&camera_topic(camera, "compressed"), &RosImage { header, format: image.format, data: bytes })?;
        Ok(true)
    }

    fn optics(&mut self, camera: &str, data: &[u8]) -> Result<bool, ConversionError> {
        let Ok(LoggedOptics { frame_id, width, height, distortion_model, d, k, r, p }) = serde_json::from_slice(data)
        else {
            return Ok(false);
        };
        let Some(header) = self.header(&frame_id) else { return Ok(false) };
        let info = CameraInfo { header, height, width, distortion_model, d, k, r, p, ..CameraInfo::default() };
        self.put(&camera_topic(camera, "camera_info"), &info)?;
        Ok(true)
    }

    /// The header of a picture in the frame of a log, which earlier versions named by the node alone.
    fn header(&self, frame: &str) -> Option<Header> {
        let node = NodeName::new(frame.strip_suffix("/optical").unwrap_or(frame)).ok()?;
        let stamp = RosTime::of(Timestamp(self.at.publish / 1000));
        Some(Header { stamp, frame_id: format!("{}_camera_optical", ros_name(&node)) })
    }
}

/// The topic of the only camera, or of one with a name.
fn camera_topic(camera: &str, kind: &str) -> String {
    match NodeName::new(camera) {
        Ok(name) => format!("/ecod/camera/{}/{kind}", ros_name(&name)),
        Err(_) => format!("/ecod/camera/{kind}"),
    }
}

impl<W: Write + Seek> RosSink for TimedOutput<'_, W> {
    type Error = ConversionError;

    fn put<M: Serialize + Definition>(&mut self, topic: &str, message: &M) -> Result<(), ConversionError> {
        let RosLogWriter { writer, channels } = self.output;
        let channel_id = match channels.get(topic) {
            Some(id) => *id,
            None => {
                let schema = writer.add_schema(M::NAME, "ros2msg", M::definition().as_bytes())?;
                let id = writer.add_channel(schema, topic, "cdr", &BTreeMap::new())?;
                channels.insert(topic.to_owned(), id);
                id
            }
        };
        // CDR, little-endian.
        let mut data = vec![0, 1, 0, 0];
        data.extend(encode(message)?);
        let Stamps { log: log_time, publish: publish_time } = self.at;
        let header = MessageHeader { channel_id, sequence: 0, log_time, publish_time };
        Ok(writer.write_to_known_channel(&header, &data)?)
    }
}
