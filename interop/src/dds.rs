//! Live topics of ROS 2, by DDS: a cell's messages for ROS, and a detector's messages from ROS as
//! reports.
//!
//! ```text
//! global_detections -> /ecod/map/detections, /ecod/map/markers
//! detections/<node> -> /ecod/<node>/detections, /tf
//! a detector's topic -> detections/<node>--ros2
//! ```

mod detections;

use std::collections::BTreeMap;
use std::net::{IpAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use ecod::perception::pose_history::PoseHistory;
use ecod_client::{Cell, Error, GlobalMap, ObjectReport, Settings};
use futures::channel::oneshot;
use futures::executor::block_on_stream;
use futures::future::ready;
use futures::stream::{BoxStream, select_all};
use futures::{FutureExt, StreamExt};
use rustdds::bytes::Bytes;
use rustdds::no_key::{DataReader, DataWriter, SerializerAdapter};
use rustdds::policy::{History, Reliability};
use rustdds::{
    DomainParticipant, DomainParticipantBuilder, QosPolicies, QosPolicyBuilder,
    RepresentationIdentifier, Topic, TopicKind,
};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::carrying::{Carry, RefusalCounts, is_within, lock, until_one_ends};
use crate::ros2::{
    CameraInfo, Definition, Detection2DArray, Detection3DArray, PoseStamped, RosMessage, RosSink,
    encode, put_map, put_report,
};
pub use detections::{InputRefusal, RosCamera};
use detections::{RefusedInput, place_in_pictures, pose_in_map};

/// Part of the node's name in which detections are reported.
const PART: &str = "ros2";

/// Number of samples of a topic that are kept for slow readers, the default of ROS.
const DEPTH: i32 = 10;

/// Silence after which a topic is closed, for example when its vehicle has left.
const SILENCE: Duration = Duration::from_secs(60);

/// Maximum difference between a stamp and this machine's time.
const MAX_STAMP_DIFFERENCE: Duration = Duration::from_secs(10);

/// The last domain that has ports of UDP.
pub const MAX_DOMAIN: u16 = 232;

/// Time after which silent topics of the detector are logged.
const PATIENCE: Duration = Duration::from_secs(10);

/// Domain, network and input of a bridge.
#[derive(Debug, Clone, Default)]
pub struct RosSettings {
    /// Number of the domain, `ROS_DOMAIN_ID`, at most [`MAX_DOMAIN`].
    pub domain: u16,
    /// Addresses of this machine's networks; empty for all.
    pub networks: Vec<IpAddr>,
    /// Topics of a detector, if its detections are to be reported.
    pub input: Option<DetectorTopics>,
    /// Topic of `geometry_msgs/PoseStamped` with the poses of a detector's camera that moves.
    pub pose_topic: Option<String>,
    /// Camera of the detector whose detections are read.
    pub camera: RosCamera,
}

impl RosSettings {
    /// All topics that are read from ROS.
    fn taken(&self) -> impl Iterator<Item = &String> {
        let (detections, optics) = match &self.input {
            Some(DetectorTopics::InSpace(topic)) => (Some(topic), None),
            Some(DetectorTopics::InPictures(topic, optics)) => (Some(topic), Some(optics)),
            None => (None, None),
        };
        detections.into_iter().chain(optics).chain(&self.pose_topic)
    }
}

/// Topics of a detector, such as `/detections`.
#[derive(Debug, Clone)]
pub enum DetectorTopics {
    /// `vision_msgs/Detection3DArray`.
    InSpace(String),
    /// `vision_msgs/Detection2DArray`, and the `sensor_msgs/CameraInfo` of its pictures.
    InPictures(String, String),
}

/// A bridge that cannot continue.
#[derive(Debug, thiserror::Error)]
pub enum RosBridgeError {
    /// The DDS domain cannot be joined, or a topic is not possible there.
    #[error("DDS: {0}; is the domain right, and the network up?")]
    Dds(String),
    /// A domain beyond the last.
    #[error("domain {0} must be a number from 0 to {MAX_DOMAIN}")]
    Domain(u16),
    /// A network to which this machine does not belong.
    #[error("network {0}: no address of this machine; `ip address` shows them")]
    Network(IpAddr),
    /// A topic below `/ecod`, which a bridge publishes. If it were reported, the cell's messages
    /// would confirm themselves.
    #[error(
        "{0} is not a detector topic: topics below /ecod are published by bridges, so the cell would receive its own objects as reports"
    )]
    OwnTopic(String),
    /// The cell cannot be joined.
    #[error(transparent)]
    Cell(#[from] Error),
}

impl RosBridgeError {
    fn dds(error: impl std::fmt::Display) -> Self {
        Self::Dds(error.to_string())
    }
}

/// A bridge that runs in addition to a node.
pub struct RosBridge {
    cell: Cell,
    camera: RosCamera,
    input: Option<DetectorTopics>,
    pose_topic: Option<String>,
    participant: DomainParticipant,
    /// Ends the loop over the detector's messages when dropped.
    closing: Mutex<Option<oneshot::Sender<()>>>,
    closed: Mutex<Option<oneshot::Receiver<()>>>,
    inputs: Mutex<Vec<DetectorInput>>,
    refusals: RefusalCounts<InputRefusal>,
}

/// A topic that is read from ROS.
struct DetectorInput {
    topic: String,
    kind: &'static str,
    has_received: Arc<AtomicBool>,
}

/// A message of a detector.
enum Taken {
    InSpace(Detection3DArray),
    InPicture(Detection2DArray),
    Optics(Box<CameraInfo>),
    Pose(PoseStamped),
    /// The time for the detector to start is over.
    Patience,
    Closed,
}

impl RosBridge {
    /// Connects to a cell and joins a domain.
    ///
    /// # Errors
    /// Returns a [`RosBridgeError`] if either fails, or an input topic belongs to a bridge.
    pub fn connect(settings: Settings, ros: RosSettings) -> Result<Self, RosBridgeError> {
        if let Some(own) = ros
            .taken()
            .find(|topic| topic.trim_start_matches('/').starts_with("ecod/"))
        {
            return Err(RosBridgeError::OwnTopic(own.clone()));
        }
        if ros.domain > MAX_DOMAIN {
            return Err(RosBridgeError::Domain(ros.domain));
        }
        if let Some(other) = ros
            .networks
            .iter()
            .find(|address| UdpSocket::bind((**address, 0)).is_err())
        {
            return Err(RosBridgeError::Network(*other));
        }
        let cell = Cell::connect(Settings {
            part: PART.to_owned(),
            ..settings
        })?;
        let mut participant = DomainParticipantBuilder::new(ros.domain);
        if !ros.networks.is_empty() {
            participant = participant.with_only_networks(ros.networks);
        }
        let participant = participant.build().map_err(RosBridgeError::dds)?;
        let (closing, closed) = oneshot::channel();
        Ok(Self {
            cell,
            camera: ros.camera,
            input: ros.input,
            pose_topic: ros.pose_topic,
            participant,
            closing: Mutex::new(Some(closing)),
            closed: Mutex::new(Some(closed)),
            inputs: Mutex::default(),
            refusals: RefusalCounts::default(),
        })
    }

    /// Transfers messages until the bridge is closed.
    ///
    /// # Errors
    /// Returns a [`RosBridgeError`] if the node's broker refuses the bridge, or DDS refuses a
    /// topic.
    pub fn run(&self) -> Result<(), RosBridgeError> {
        let mut carry: Vec<Carry<'_, RosBridgeError>> = vec![
            Box::new(|| self.send_maps()),
            Box::new(|| self.send_reports()),
        ];
        if self.input.is_some() {
            carry.push(Box::new(|| self.process_detections()));
        }
        until_one_ends(carry, || self.close())
    }

    /// Ends the connections, and thereby [`RosBridge::run`].
    pub fn close(&self) {
        self.cell.close();
        lock(&self.closing).take();
    }

    /// Messages and objects of the detector that were not reported, by reason.
    pub fn refusals(&self) -> BTreeMap<InputRefusal, u64> {
        self.refusals.counts()
    }

    fn send_maps(&self) -> Result<(), RosBridgeError> {
        let mut topics = LiveTopics {
            participant: &self.participant,
            topics: BTreeMap::new(),
        };
        for map in self.cell.maps() {
            let map: &GlobalMap = &*map?;
            put_map(map, &mut topics)?;
        }
        Ok(())
    }

    fn send_reports(&self) -> Result<(), RosBridgeError> {
        let mut topics = LiveTopics {
            participant: &self.participant,
            topics: BTreeMap::new(),
        };
        for report in self.cell.reports() {
            let report: &ObjectReport = &*report?;
            put_report(report, &mut topics)?;
        }
        Ok(())
    }

    fn process_detections(&self) -> Result<(), RosBridgeError> {
        let Some(closed) = lock(&self.closed).take() else {
            return Ok(());
        };
        let (over, patience) = oneshot::channel();
        thread::spawn(move || {
            thread::sleep(PATIENCE);
            // The bridge may be closed.
            let _ = over.send(());
        });
        let mut streams = vec![closed.map(|_| Taken::Closed).into_stream().boxed()];
        streams.push(patience.map(|_| Taken::Patience).into_stream().boxed());
        match &self.input {
            Some(DetectorTopics::InSpace(topic)) => streams.push(self.read(topic, Taken::InSpace)?),
            Some(DetectorTopics::InPictures(topic, optics)) => {
                streams.push(self.read(topic, Taken::InPicture)?);
                streams.push(self.read(optics, |info| Taken::Optics(Box::new(info)))?);
            }
            None => {}
        }
        if let Some(topic) = &self.pose_topic {
            streams.push(self.read(topic, Taken::Pose)?);
        }
        let mut optics = None;
        let mut poses = self.pose_topic.as_ref().map(|_| PoseHistory::default());
        for taken in block_on_stream(select_all(streams)) {
            let placed = match taken {
                Taken::Patience => {
                    self.report_silence();
                    continue;
                }
                Taken::InSpace(detections) => self.camera.place(&detections, poses.as_ref()),
                Taken::InPicture(detections) => {
                    place_in_pictures(&self.camera, &detections, optics.as_deref(), poses.as_ref())
                }
                Taken::Optics(info) => {
                    optics = Some(info);
                    continue;
                }
                Taken::Pose(stamped) => {
                    if let Some(poses) = &mut poses {
                        self.on_pose(&stamped, poses);
                    }
                    continue;
                }
                Taken::Closed => break,
            };
            let (frame, unplaced) = match placed {
                Ok((frame, _)) if !is_within(frame.captured_at, MAX_STAMP_DIFFERENCE) => {
                    self.record(InputRefusal::BadTime.with(seconds(frame.captured_at)));
                    continue;
                }
                Ok(placed) => placed,
                Err(refusal) => {
                    self.record(refusal);
                    continue;
                }
            };
            unplaced
                .into_iter()
                .for_each(|refusal| self.record(refusal));
            match self.cell.report(frame) {
                Err(Error::Invalid(cause)) => self.record(InputRefusal::Report.with(cause)),
                sent => drop(sent?),
            }
        }
        Ok(())
    }

    /// Processes a pose of the camera, if its time is current and later than the previous poses.
    fn on_pose(&self, stamped: &PoseStamped, poses: &mut PoseHistory) {
        let taken = pose_in_map(stamped).and_then(|(at, pose)| {
            let is_near = is_within(
                SystemTime::UNIX_EPOCH + Duration::from_micros(at.micros()),
                MAX_STAMP_DIFFERENCE,
            );
            let is_taken = is_near && poses.push(at, pose);
            if is_taken {
                Ok(())
            } else {
                Err(InputRefusal::BadPoseTime.into())
            }
        });
        if let Err(refusal) = taken {
            self.record(refusal);
        }
    }

    /// Messages of a topic of ROS; undecodable ones are counted.
    fn read<M: RosMessage + DeserializeOwned + Send + 'static>(
        &self,
        name: &str,
        taken: fn(M) -> Taken,
    ) -> Result<BoxStream<'_, Taken>, RosBridgeError> {
        // A best-effort reader also receives from reliable writers.
        let qos = qos(Reliability::BestEffort);
        let topic = ros_topic::<M>(&self.participant, name, &qos)?;
        let subscriber = self
            .participant
            .create_subscriber(&qos)
            .map_err(RosBridgeError::dds)?;
        let reader: DataReader<M> = subscriber
            .create_datareader_no_key_cdr(&topic, Some(qos))
            .map_err(RosBridgeError::dds)?;
        let has_received = Arc::new(AtomicBool::new(false));
        lock(&self.inputs).push(DetectorInput {
            topic: name.to_owned(),
            kind: M::NAME,
            has_received: Arc::clone(&has_received),
        });
        let samples = reader.async_sample_stream().filter_map(move |sample| {
            has_received.store(true, Ordering::Relaxed);
            let taken = match sample {
                Ok(sample) => Some(taken(sample.into_value())),
                Err(error) => {
                    self.record(InputRefusal::Malformed.with(error));
                    None
                }
            };
            ready(taken)
        });
        Ok(samples.boxed())
    }

    /// Logs the topics on which no message has arrived.
    fn report_silence(&self) {
        for DetectorInput {
            topic,
            kind,
            has_received,
        } in lock(&self.inputs).iter()
        {
            if !has_received.load(Ordering::Relaxed) {
                log::warn!(
                    "no message on {topic} in {PATIENCE:?}: check topic, type ({kind}), domain and network of the publisher"
                );
            }
        }
    }

    /// Counts an input that is not reported.
    fn record(&self, refused: RefusedInput) {
        let RefusedInput { refusal, detail } = refused;
        if let Some((refusal, count)) = self.refusals.record(refusal, refusal) {
            log::warn!("not reported from ROS: {refusal}{detail}; {count} so far");
        }
    }
}

/// A time, for the log.
fn seconds(time: SystemTime) -> String {
    let since_1970 = time
        .duration_since(SystemTime::UNIX_EPOCH)
        .unwrap_or_default();
    format!("{:.3} s since 1970", since_1970.as_secs_f64())
}

fn qos(reliability: Reliability) -> QosPolicies {
    QosPolicyBuilder::new()
        .reliability(reliability)
        .history(History::KeepLast { depth: DEPTH })
        .build()
}

/// The DDS topic of a topic of ROS, with the names that ROS gives to both topic and type.
fn ros_topic<M: RosMessage>(
    participant: &DomainParticipant,
    name: &str,
    qos: &QosPolicies,
) -> Result<Topic, RosBridgeError> {
    let kind = M::NAME
        .replace('/', "::")
        .replace("::msg::", "::msg::dds_::")
        + "_";
    let name = format!("rt/{}", name.trim_start_matches('/'));
    participant
        .create_topic(name, kind, qos, TopicKind::NoKey)
        .map_err(RosBridgeError::dds)
}

/// Topics of a domain for publishing, each announced with its first message.
struct LiveTopics<'a> {
    participant: &'a DomainParticipant,
    topics: BTreeMap<String, LiveTopic>,
}

struct LiveTopic {
    writer: DataWriter<Encoded, Encoded>,
    said_at: Instant,
    is_failing: bool,
}

/// A message in CDR, little-endian.
struct Encoded(Vec<u8>);

impl SerializerAdapter<Encoded> for Encoded {
    type Error = std::convert::Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(message: &Encoded) -> Result<Bytes, Self::Error> {
        Ok(Bytes::copy_from_slice(&message.0))
    }
}

impl RosSink for LiveTopics<'_> {
    type Error = RosBridgeError;

    fn put<M: Serialize + Definition>(
        &mut self,
        name: &str,
        message: &M,
    ) -> Result<(), RosBridgeError> {
        let now = Instant::now();
        if !self.topics.contains_key(name) {
            self.topics
                .retain(|_, topic| now.duration_since(topic.said_at) < SILENCE);
            let qos = qos(Reliability::Reliable {
                max_blocking_time: rustdds::Duration::ZERO,
            });
            let topic = ros_topic::<M>(self.participant, name, &qos)?;
            let publisher = self
                .participant
                .create_publisher(&qos)
                .map_err(RosBridgeError::dds)?;
            let writer = publisher
                .create_datawriter_no_key(&topic, Some(qos))
                .map_err(RosBridgeError::dds)?;
            self.topics.insert(
                name.to_owned(),
                LiveTopic {
                    writer,
                    said_at: now,
                    is_failing: false,
                },
            );
        }
        let Some(topic) = self.topics.get_mut(name) else {
            return Ok(());
        };
        topic.said_at = now;
        let encoded = Encoded(encode(message).map_err(RosBridgeError::dds)?);
        let sent = topic.writer.write(encoded, None);
        if let Some(error) = sent.as_ref().err().filter(|_| !topic.is_failing) {
            log::warn!("messages on {name} are lost until DDS takes them again: {error}");
        }
        topic.is_failing = sent.is_err();
        Ok(())
    }
}
