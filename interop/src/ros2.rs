//! Logs of a node as MCAP of profile `ros2`, without ROS code on this side.
//!
//! Frames are those of REP 103 and REP 105: `map` is the cell's frame, x east and y north unless the cell's origin is rotated.
//! `<node>_camera` is a camera, x along its axis and z up; `<node>_camera_optical` the same camera, z along its axis and x right.

mod messages;

use std::collections::BTreeMap;
use std::io::{Seek, Write};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, Limits, decode, decode_report};
use mcap::records::MessageHeader;
use mcap::{Compression, MessageStream, WriteOptions, Writer};
use serde::{Deserialize, Serialize};

use messages::{Definition, Detection3DArray, Header, MarkerArray, RosImage, RosTime, TFMessage};

/// A log that cannot be converted.
#[derive(Debug, thiserror::Error)]
pub enum ConversionError {
    /// It cannot be read as MCAP from some place on, or the output not written.
    #[error(transparent)]
    Mcap(#[from] mcap::McapError),
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
    frame_id: NodeName,
    data: String,
    format: String,
}

/// Writes a log as MCAP of profile `ros2`.
///
/// # Errors
/// [`ConversionError`] if nothing can be read, or the output not written.
pub fn convert<W: Write + Seek>(log: &[u8], output: W) -> Result<Conversion, ConversionError> {
    let options = WriteOptions::new().profile("ros2").compression(Some(Compression::Zstd));
    let mut output = RosLogWriter { writer: Writer::with_options(output, options)?, channels: BTreeMap::new() };
    let mut done = Conversion::default();
    for message in MessageStream::new_with_options(log, mcap::read::Options::IgnoreEndMagic.into())? {
        let Ok(message) = message else {
            done.is_cut = true;
            break;
        };
        let at = Stamps { log: message.log_time, publish: message.publish_time };
        let (kind, node) = message.channel.topic.split_once('/').unwrap_or((&message.channel.topic, ""));
        let is_written = match kind {
            "global_detections" => output.map(at, &message.data)?,
            "detections" => output.report(at, node, &message.data)?,
            "camera" => output.image(at, &message.data)?,
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

impl<W: Write + Seek> RosLogWriter<W> {
    fn map(&mut self, at: Stamps, data: &[u8]) -> Result<bool, ConversionError> {
        let Ok(map) = decode::<GlobalMap>(data, &Limits::default()) else { return Ok(false) };
        self.write(at, "/ecod/map/detections", &Detection3DArray::of_map(&map))?;
        self.write(at, "/ecod/map/markers", &MarkerArray::of_map(&map))?;
        Ok(true)
    }

    fn report(&mut self, at: Stamps, node: &str, data: &[u8]) -> Result<bool, ConversionError> {
        let Ok(node) = NodeName::new(node) else { return Ok(false) };
        let Ok(report) = decode_report(data, &node, &Limits::default()) else { return Ok(false) };
        self.write(at, &format!("/ecod/{}/detections", ros_name(&node)), &Detection3DArray::of_report(&report))?;
        if let Some(pose) = report.pose {
            let camera = format!("{}_camera", ros_name(&node));
            self.write(at, "/tf", &TFMessage::of_pose(Header::in_map(report.captured_at_us), camera, pose))?;
        }
        Ok(true)
    }

    fn image(&mut self, at: Stamps, data: &[u8]) -> Result<bool, ConversionError> {
        let Ok(image) = serde_json::from_slice::<LoggedImage>(data) else { return Ok(false) };
        let Ok(bytes) = STANDARD.decode(image.data) else { return Ok(false) };
        let stamp = RosTime::of(Timestamp(at.publish / 1000));
        let header = Header { stamp, frame_id: format!("{}_camera_optical", ros_name(&image.frame_id)) };
        self.write(at, "/ecod/camera/compressed", &RosImage { header, format: image.format, data: bytes })?;
        Ok(true)
    }

    fn write<M: Serialize + Definition>(
        &mut self,
        at: Stamps,
        topic: &str,
        message: &M,
    ) -> Result<(), ConversionError> {
        let channel_id = match self.channels.get(topic) {
            Some(id) => *id,
            None => {
                let schema = self.writer.add_schema(M::NAME, "ros2msg", M::definition().as_bytes())?;
                let id = self.writer.add_channel(schema, topic, "cdr", &BTreeMap::new())?;
                self.channels.insert(topic.to_owned(), id);
                id
            }
        };
        // CDR, little-endian.
        let mut data = vec![0, 1, 0, 0];
        data.extend(cdr_encoding::to_vec::<M, byteorder::LittleEndian>(message)?);
        let header = MessageHeader { channel_id, sequence: 0, log_time: at.log, publish_time: at.publish };
        Ok(self.writer.write_to_known_channel(&header, &data)?)
    }
}

/// A node's name as names in ROS allow it: letters, digits and `_`, no digit first.
fn ros_name(node: &NodeName) -> String {
    let name = node.as_str().replace('-', "_");
    if name.starts_with(|first: char| first.is_ascii_digit()) { format!("_{name}") } else { name }
}
