//! Logs of a node as MCAP of profile `ros2`.

use std::collections::{BTreeMap, HashMap};
use std::io::{Read, Seek, Write};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, Limits, decode, decode_report};
use mcap::records::{MessageHeader, Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{Compression, McapError, WriteOptions, Writer};
use serde::{Deserialize, Serialize};

use super::camera::{CameraInfo, RosImage};
use super::messages::{Definition, Header, RosTime, encode};
use super::{RosSink, put_map, put_report, ros_name};

/// Maximum length of a record: a chunk, or a map of the largest cells.
const MAX_RECORD_BYTES: usize = 1 << 28;

/// A log that cannot be converted.
#[derive(Debug, thiserror::Error)]
pub enum ConversionError {
    /// It has no MCAP's first bytes.
    #[error("is no MCAP, as logs of nodes are")]
    NoLog,
    /// The output would be empty.
    #[error("no map, report or picture of a node is there, {0} messages of other kinds")]
    Empty(u64),
    /// It cannot be read.
    #[error(transparent)]
    Unreadable(#[from] std::io::Error),
    /// The output cannot be written.
    #[error(transparent)]
    Mcap(#[from] McapError),
    /// A message that has no form in CDR.
    #[error(transparent)]
    Cdr(#[from] cdr_encoding::Error),
}

/// Messages read and written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Conversion {
    /// Number of messages that were written.
    pub written: u64,
    /// Messages of other channels, which have no equivalent in ROS.
    pub passed_over: u64,
    /// Messages that differ from the form in which a node writes them.
    pub unusable: u64,
    /// Number of logs that end early, like the log of a killed node, or are damaged.
    pub cut: u64,
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

/// Logs of a node, written as one MCAP of profile `ros2`.
pub struct RosLog<W: Write + Seek> {
    output: RosLogWriter<W>,
    done: Conversion,
}

impl<W: Write + Seek> RosLog<W> {
    /// Begins an MCAP.
    ///
    /// # Errors
    /// Returns a [`ConversionError`] if the output cannot be written.
    pub fn new(output: W) -> Result<Self, ConversionError> {
        let options = WriteOptions::new()
            .profile("ros2")
            .compression(Some(Compression::Zstd));
        let output = RosLogWriter {
            writer: Writer::with_options(output, options)?,
            channels: BTreeMap::new(),
        };
        Ok(Self {
            output,
            done: Conversion::default(),
        })
    }

    /// Writes the messages of a log.
    ///
    /// # Errors
    /// Returns a [`ConversionError`] if this is not a log, or the output cannot be written.
    pub fn add(&mut self, mut log: impl Read) -> Result<(), ConversionError> {
        let options = LinearReaderOptions::default()
            .with_skip_end_magic(true)
            .with_record_length_limit(MAX_RECORD_BYTES);
        let mut reader = LinearReader::new_with_options(options);
        let mut topics = HashMap::<u16, String>::new();
        let mut is_complete = false;
        while let Some(event) = reader.next_event() {
            let record = match event {
                Ok(LinearReadEvent::ReadRequest(wanted)) => {
                    let read = log.read(reader.insert(wanted))?;
                    reader.notify_read(read);
                    continue;
                }
                Ok(LinearReadEvent::Record {
                    opcode: op::DATA_END,
                    ..
                }) => {
                    is_complete = true;
                    break;
                }
                Ok(LinearReadEvent::Record { opcode, data }) => mcap::parse_record(opcode, data),
                Err(McapError::BadMagic) => return Err(ConversionError::NoLog),
                Err(error) => Err(error),
            };
            match record {
                Ok(Record::Channel(channel)) => drop(topics.insert(channel.id, channel.topic)),
                Ok(Record::Message { header, data }) => {
                    let topic = topics
                        .get(&header.channel_id)
                        .map(String::as_str)
                        .unwrap_or_default();
                    let at = Stamps {
                        log: header.log_time,
                        publish: header.publish_time,
                    };
                    self.put(topic, at, &data)?;
                }
                Ok(_) => {}
                Err(error) => {
                    log::warn!("a log is damaged, what is behind that is left out: {error}");
                    break;
                }
            }
        }
        self.done.cut += u64::from(!is_complete);
        Ok(())
    }

    fn put(&mut self, topic: &str, at: Stamps, data: &[u8]) -> Result<(), ConversionError> {
        let (kind, name) = topic.split_once('/').unwrap_or((topic, ""));
        let mut output = TimedOutput {
            output: &mut self.output,
            at,
        };
        let is_written = match kind {
            "global_detections" => output.map(data)?,
            "detections" => output.report(name, data)?,
            "camera" => output.image(name, data)?,
            "camera_calibration" => output.optics(name, data)?,
            _ => {
                self.done.passed_over += 1;
                return Ok(());
            }
        };
        *(if is_written {
            &mut self.done.written
        } else {
            &mut self.done.unusable
        }) += 1;
        Ok(())
    }

    /// Ends the MCAP.
    ///
    /// # Errors
    /// Returns a [`ConversionError`] if it cannot be written, or no message of a node's log was
    /// found.
    pub fn finish(mut self) -> Result<Conversion, ConversionError> {
        self.output.writer.finish()?;
        if self.done.written == 0 {
            Err(ConversionError::Empty(self.done.passed_over))
        } else {
            Ok(self.done)
        }
    }
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
        let Ok(map) = decode::<GlobalMap>(data, &Limits::default()) else {
            return Ok(false);
        };
        put_map(&map, self).map(|()| true)
    }

    fn report(&mut self, node: &str, data: &[u8]) -> Result<bool, ConversionError> {
        let Ok(node) = NodeName::new(node) else {
            return Ok(false);
        };
        let Ok(report) = decode_report(data, &node, &Limits::default()) else {
            return Ok(false);
        };
        put_report(&report, self).map(|()| true)
    }

    fn image(&mut self, camera: &str, data: &[u8]) -> Result<bool, ConversionError> {
        let Ok(image) = serde_json::from_slice::<LoggedImage>(data) else {
            return Ok(false);
        };
        let Ok(bytes) = STANDARD.decode(image.data) else {
            return Ok(false);
        };
        let Some(header) = self.header(&image.frame_id) else {
            return Ok(false);
        };
        self.put(
            &camera_topic(camera, "compressed"),
            &RosImage {
                header,
                format: image.format,
                data: bytes,
            },
        )?;
        Ok(true)
    }

    fn optics(&mut self, camera: &str, data: &[u8]) -> Result<bool, ConversionError> {
        let Ok(LoggedOptics {
            frame_id,
            width,
            height,
            distortion_model,
            d,
            k,
            r,
            p,
        }) = serde_json::from_slice(data)
        else {
            return Ok(false);
        };
        let Some(header) = self.header(&frame_id) else {
            return Ok(false);
        };
        let info = CameraInfo {
            header,
            height,
            width,
            distortion_model,
            d,
            k,
            r,
            p,
            ..CameraInfo::default()
        };
        self.put(&camera_topic(camera, "camera_info"), &info)?;
        Ok(true)
    }

    /// The header of a picture in the frame of a log, which earlier versions named by the node
    /// alone.
    fn header(&self, frame: &str) -> Option<Header> {
        let node = NodeName::new(frame.strip_suffix("/optical").unwrap_or(frame)).ok()?;
        let stamp = RosTime::of(Timestamp(self.at.publish / 1000));
        Some(Header {
            stamp,
            frame_id: format!("{}_camera_optical", ros_name(&node)),
        })
    }
}

/// The topic of the only camera, or of a named camera.
fn camera_topic(camera: &str, kind: &str) -> String {
    match NodeName::new(camera) {
        Ok(name) => format!("/ecod/camera/{}/{kind}", ros_name(&name)),
        Err(_) => format!("/ecod/camera/{kind}"),
    }
}

impl<W: Write + Seek> RosSink for TimedOutput<'_, W> {
    type Error = ConversionError;

    fn put<M: Serialize + Definition>(
        &mut self,
        topic: &str,
        message: &M,
    ) -> Result<(), ConversionError> {
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
        let Stamps {
            log: log_time,
            publish: publish_time,
        } = self.at;
        let header = MessageHeader {
            channel_id,
            sequence: 0,
            log_time,
            publish_time,
        };
        Ok(writer.write_to_known_channel(&header, &data)?)
    }
}
