//! Encoding of log entries as JSON messages: the payloads themselves, and drawings of them for
//! viewers.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::time::Duration;

use ecod::aggregator::Command;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::LandmarkConfig;
use ecod::replay::{JournalEntry, JournalEvent};
use ecod::wire::{ObjectReport, ReportKind, Topic, WirePose};
use mcap::McapResult;
use serde::Serialize;

use super::channels::{CounterReading, LeadershipChange, SchemaName};
use super::foxglove::picture::{CameraCalibration, CompressedImage, ImageAnnotations};
use super::foxglove::scene::{SceneEntity, SceneStyle, SceneUpdate};
use super::foxglove::{FrameTransform, Level, Log};
use super::log_sender::{CapturedPicture, LogEntry, LogItem};
use crate::transport::mqtt::LinkState;

/// A message of a channel, as JSON.
#[derive(Debug, Clone, Copy)]
pub(crate) struct EncodedMessage<'a> {
    pub(crate) schema: SchemaName,
    pub(crate) topic: &'a str,
    /// Time of receipt by the node.
    pub(crate) at: Timestamp,
    /// Time of capture, or of the end of the round.
    pub(crate) made_at: Timestamp,
    pub(crate) json: &'a [u8],
}

/// Destination of messages: a file or the live viewers.
pub(crate) trait MessageSink {
    /// Processes a message.
    ///
    /// # Errors
    /// Returns an error if it cannot be kept; the remaining messages of its entry are then skipped.
    fn put(&mut self, message: EncodedMessage<'_>) -> McapResult<()>;
}

/// Encodes entries on behalf of the recording node.
pub(crate) struct EntryEncoder {
    node: NodeName,
    drawable: bool,
    style: SceneStyle,
    /// Latest frame of each vehicle that was drawn, and whether the vehicle reports for PACE.
    drawn: BTreeMap<NodeName, (Timestamp, bool)>,
    /// Recent vehicles, each with the time of its entry, and the time at which all were last drawn.
    vehicles: BTreeMap<NodeName, (Timestamp, SceneEntity)>,
    vehicles_drawn_at: Timestamp,
    /// Buffer reused for every message.
    json: Vec<u8>,
}

impl EntryEncoder {
    /// Creates an encoder. With `drawable` it also draws entries of a cell with these landmarks.
    pub(crate) fn new(node: NodeName, landmarks: &[LandmarkConfig], drawable: bool) -> Self {
        Self {
            node,
            drawable,
            style: SceneStyle::of(landmarks),
            drawn: BTreeMap::new(),
            vehicles: BTreeMap::new(),
            vehicles_drawn_at: Timestamp::default(),
            json: Vec::new(),
        }
    }

    /// Writes the messages of an entry.
    pub(crate) fn write(
        &mut self,
        LogEntry { at, item }: &LogEntry,
        sink: &mut impl MessageSink,
    ) -> McapResult<()> {
        let at = *at;
        let node = self.node.clone();
        let mut output = Output {
            encoder: self,
            at,
            sink,
        };
        match item {
            LogItem::Report(kind, report) => {
                let vehicle = &report.node;
                let captured_at = report.captured_at_us;
                output.put(
                    SchemaName::ObjectReport,
                    kind.topic(vehicle.clone()),
                    captured_at,
                    report,
                )?;
                if !output.encoder.is_to_be_drawn(*kind, vehicle, captured_at) {
                    return Ok(());
                }
                let topic = format_args!("scene/{vehicle}");
                output.draw(SchemaName::SceneUpdate, topic, captured_at, |style| {
                    style.report(report)
                })?;
                let Some(pose) = report.pose else {
                    return Ok(());
                };
                if let Some(vehicles) = output.encoder.vehicles(at, vehicle, &pose, report) {
                    output.draw(
                        SchemaName::SceneUpdate,
                        "scene/vehicles",
                        captured_at,
                        |_| vehicles,
                    )?;
                }
                let transform = |_: &SceneStyle| FrameTransform::of(vehicle, pose, captured_at);
                output.draw(SchemaName::FrameTransform, "tf", captured_at, transform)
            }
            LogItem::Journal(event) => {
                if let JournalEvent::Command(Command::Configure { landmarks, .. }) = event {
                    output.encoder.style = SceneStyle::of(landmarks);
                }
                output.journal(event)
            }
            LogItem::Round(_) => Ok(()),
            LogItem::Map(map) => {
                output.put(
                    SchemaName::GlobalMap,
                    Topic::GlobalDetections,
                    map.fused_at_us,
                    map,
                )?;
                output.draw(
                    SchemaName::SceneUpdate,
                    "scene/map",
                    map.fused_at_us,
                    |style| style.map(map),
                )
            }
            LogItem::Verdicts(verdicts) => output.put(
                SchemaName::Verdicts,
                Topic::GlobalVerdicts,
                verdicts.fused_at_us,
                verdicts,
            ),
            LogItem::Reputations(reputations) => {
                output.put(SchemaName::Reputations, Topic::Reputations, at, reputations)
            }
            LogItem::Share(share) => output.put(
                SchemaName::LedgerShare,
                Topic::Ledger(share.node.clone()),
                at,
                share,
            ),
            LogItem::Status(status) => output.put(
                SchemaName::NodeStatus,
                Topic::Nodes(status.node.clone()),
                at,
                status,
            ),
            LogItem::Leadership(leadership) => {
                let change = LeadershipChange::new(node, at, leadership);
                output.put(SchemaName::Leadership, "node/leadership", at, &change)?;
                output.log(Level::Info, || change.in_words())
            }
            LogItem::Link(broker, state) => {
                let level = if *state == LinkState::Up {
                    Level::Info
                } else {
                    Level::Warning
                };
                output.log(level, || {
                    format!("link to {broker} is {state:?}").to_lowercase()
                })
            }
            LogItem::Counters(snapshot) => {
                let named = |counts: &BTreeMap<&str, u64>| {
                    counts.iter().map(|(k, v)| ((*k).to_owned(), *v)).collect()
                };
                let [events, rejects, shed] =
                    [&snapshot.events, &snapshot.rejects, &snapshot.shed].map(named);
                let reading = CounterReading {
                    node,
                    at_us: at,
                    events,
                    rejects,
                    shed,
                };
                output.put(SchemaName::Counters, "node/counters", at, &reading)
            }
            LogItem::Picture(picture) => output.picture(picture),
        }
    }

    /// All recent vehicles including this one, if it is time to draw them: a viewer that starts in
    /// the middle of a log only has the last message.
    fn vehicles(
        &mut self,
        at: Timestamp,
        vehicle: &NodeName,
        pose: &WirePose,
        report: &ObjectReport,
    ) -> Option<SceneUpdate> {
        self.vehicles
            .retain(|_, (drawn_at, _)| at.since(*drawn_at) < VEHICLE_SHOWN_FOR);
        if self.vehicles.len() < MAX_DRAWN {
            self.vehicles.insert(
                vehicle.clone(),
                (at, self.style.vehicle(vehicle, pose, report)),
            );
        }
        if at.since(self.vehicles_drawn_at) < VEHICLES_PERIOD {
            return None;
        }
        self.vehicles_drawn_at = at;
        let vehicles = self.vehicles.values().map(|(_, entity)| entity.clone());
        Some(SceneUpdate::new(report.captured_at_us, vehicles))
    }

    /// True for the first report of a frame: a vehicle is drawn once, although reports of both
    /// kinds arrive over several brokers. Votes do not contain all objects; they are drawn if a
    /// vehicle sends no other reports.
    fn is_to_be_drawn(
        &mut self,
        kind: ReportKind,
        vehicle: &NodeName,
        captured_at: Timestamp,
    ) -> bool {
        if !self.drawable {
            return false;
        }
        if self.drawn.len() >= MAX_DRAWN && !self.drawn.contains_key(vehicle) {
            self.drawn.clear();
        }
        let (last, has_detections) = self.drawn.entry(vehicle.clone()).or_default();
        *has_detections |= kind == ReportKind::Detections;
        let is_best = kind == ReportKind::Detections || !*has_detections;
        is_best && std::mem::replace(last, captured_at) != captured_at
    }

    /// Writes an input of the aggregator.
    pub(crate) fn journal(
        &mut self,
        at: Timestamp,
        event: &JournalEvent,
        sink: &mut impl MessageSink,
    ) -> McapResult<()> {
        Output {
            encoder: self,
            at,
            sink,
        }
        .journal(event)
    }
}

/// Maximum number of vehicles whose latest frame is stored; when it is exceeded, all are dropped.
const MAX_DRAWN: usize = 4096;

/// Time between two drawings of all vehicles, and time for which a silent vehicle is included.
const VEHICLES_PERIOD: Duration = Duration::from_millis(100);
const VEHICLE_SHOWN_FOR: Duration = Duration::from_secs(1);

/// The sink of one entry.
struct Output<'a, S> {
    encoder: &'a mut EntryEncoder,
    at: Timestamp,
    sink: &'a mut S,
}

impl<S: MessageSink> Output<'_, S> {
    fn journal(&mut self, event: &JournalEvent) -> McapResult<()> {
        let entry = JournalEntry {
            at_us: self.at,
            event: event.clone(),
        };
        self.put(SchemaName::JournalEntry, "node/journal", self.at, &entry)
    }

    /// A picture with the optics and the boxes of its time.
    fn picture(&mut self, picture: &CapturedPicture) -> McapResult<()> {
        let made_at = picture.captured_at;
        let topic = |root: &str| {
            picture
                .camera
                .as_ref()
                .map_or_else(|| root.to_owned(), |name| format!("{root}/{name}"))
        };
        if let Some(calibration) = CameraCalibration::of(picture) {
            self.put(
                SchemaName::CameraCalibration,
                topic("camera_calibration"),
                made_at,
                &calibration,
            )?;
        }
        let boxes = |_: &SceneStyle| ImageAnnotations::of(picture);
        self.draw(
            SchemaName::ImageAnnotations,
            topic("camera_boxes"),
            made_at,
            boxes,
        )?;
        let optical = |_: &SceneStyle| FrameTransform::optical(&picture.reporter, made_at);
        self.draw(SchemaName::FrameTransform, "tf", made_at, optical)?;
        // Viewers draw the messages that they already have over a picture when it arrives.
        self.put(
            SchemaName::CompressedImage,
            topic("camera"),
            made_at,
            &CompressedImage::of(picture),
        )
    }

    fn log(&mut self, level: Level, message: impl FnOnce() -> String) -> McapResult<()> {
        let timestamp = self.at.into();
        let name = self.encoder.node.to_string();
        let log = |_: &SceneStyle| Log {
            timestamp,
            level,
            message: message(),
            name,
            file: String::new(),
            line: 0,
        };
        self.draw(SchemaName::Log, "log", self.at, log)
    }

    fn draw<T: Serialize>(
        &mut self,
        schema: SchemaName,
        topic: impl Display,
        made_at: Timestamp,
        drawing: impl FnOnce(&SceneStyle) -> T,
    ) -> McapResult<()> {
        if !self.encoder.drawable {
            return Ok(());
        }
        let drawing = drawing(&self.encoder.style);
        self.put(schema, topic, made_at, &drawing)
    }

    fn put(
        &mut self,
        schema: SchemaName,
        topic: impl Display,
        made_at: Timestamp,
        message: &impl Serialize,
    ) -> McapResult<()> {
        let json = &mut self.encoder.json;
        json.clear();
        serde_json::to_writer(&mut *json, message).map_err(std::io::Error::from)?;
        self.sink.put(EncodedMessage {
            schema,
            topic: &topic.to_string(),
            at: self.at,
            made_at,
            json,
        })
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use ecod::model::geometry::Pose;
    use serde_json::Value;

    use super::*;

    #[derive(Default)]
    struct Messages(Vec<(String, Value)>);

    impl MessageSink for Messages {
        fn put(&mut self, message: EncodedMessage<'_>) -> McapResult<()> {
            self.0.push((
                message.topic.to_owned(),
                serde_json::from_slice(message.json).unwrap(),
            ));
            Ok(())
        }
    }

    fn report(node: &str, at: u64) -> ObjectReport {
        let pose = Some(Pose::new(0.0, 0.0, 0.0).into());
        ObjectReport {
            pose,
            ..ObjectReport::new(NodeName::new(node).unwrap(), at, Timestamp(at))
        }
    }

    fn write(
        encoder: &mut EntryEncoder,
        sink: &mut Messages,
        kind: ReportKind,
        node: &str,
        at: u64,
    ) {
        let entry = LogEntry {
            at: Timestamp(at),
            item: LogItem::Report(kind, Arc::new(report(node, at))),
        };
        encoder.write(&entry, sink).unwrap();
    }

    #[test]
    fn frame_is_drawn_once() {
        let mut encoder = EntryEncoder::new(NodeName::from_static("recorder"), &[], true);
        let mut messages = Messages::default();
        let mut write =
            |kind, node: &str, at: u64| write(&mut encoder, &mut messages, kind, node, at);
        for at in 1..=10 {
            for _ in 0..2 {
                write(ReportKind::VoteDetections, "euclid", at);
                write(ReportKind::Detections, "euclid", at);
            }
            write(ReportKind::VoteDetections, "voter", at);
        }
        let count = |topic: &str| {
            messages
                .0
                .iter()
                .filter(|(known, _)| known == topic)
                .count()
        };
        assert_eq!(
            [count("scene/euclid"), count("scene/voter"), count("tf")],
            [10, 10, 20]
        );
        assert_eq!(
            [count("detections/euclid"), count("vote_detections/euclid")],
            [20, 20],
            "each report is kept"
        );
    }

    #[test]
    fn last_drawing_includes_all_reports() {
        let mut encoder = EntryEncoder::new(NodeName::from_static("recorder"), &[], true);
        let mut messages = Messages::default();
        for round in 20..40 {
            write(
                &mut encoder,
                &mut messages,
                ReportKind::Detections,
                "euclid",
                100_000 * round,
            );
            if round < 25 {
                write(
                    &mut encoder,
                    &mut messages,
                    ReportKind::Detections,
                    "gauss",
                    100_000 * round + 30_000,
                );
            }
        }
        let drawn = |(topic, update): &(String, Value)| {
            (topic == "scene/vehicles").then(|| update["entities"].as_array().unwrap().len())
        };
        let drawn: Vec<usize> = messages.0.iter().filter_map(drawn).collect();
        assert_eq!(drawn[..3], [1, 2, 2]);
        assert_eq!(
            (drawn.len(), drawn.last()),
            (20, Some(&1)),
            "{drawn:?}: a removed object disappears"
        );
    }
}
