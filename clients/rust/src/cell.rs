//! A program's connection to a cell.

use std::collections::{BTreeMap, HashMap};
use std::env;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime};

use ecod::leadership::BrokerAddress;
use ecod::model::names::{LandmarkId, NodeName, PART_MARK};
use ecod::model::origin::GeographicOrigin;
use ecod::model::time::Timestamp;
use ecod::wire::{
    BoxCamera, BoxReport, CellDescription, Encoding, FieldOfView, Flaw, GlobalMap, Limits,
    NodeStatus, ObjectReport, PerceivedObject, PixelBox, ReportKind, Reputations, SCHEMA_VERSION,
    Topic, Topics, Verdicts, WirePose, encode, encode_boxes,
};
use rumqttc::Transport;
use rumqttc::v5::MqttOptions;
use uuid::Uuid;

use crate::connection::{ConnectionState, RECEIVED};
use crate::streams::{CpmMessage, MessageStream, Streams};
use crate::{Error, Tls};

/// Address of a cell, and identity of the program.
#[derive(Debug, Clone)]
pub struct Settings {
    /// HOST:PORT of a node or broker; the default port is 1883, or 8883 with `tls`.
    pub broker: String,
    /// Name of the cell.
    pub cell: String,
    /// Name of the program's node. The program reports as `<node>--<part>`.
    pub node: String,
    /// Name of the program at its node. If empty, the program reports as the node itself, which
    /// then must not report.
    pub part: String,
    /// User at an external broker, and password.
    pub login: Option<(String, String)>,
    /// Certificates; `None` for plaintext.
    pub tls: Option<Tls>,
    /// Time for the first login, and for the answer to [`Cell::description`].
    pub timeout: Duration,
}

impl Default for Settings {
    /// Settings by the environment: `ECOD_BROKER` (default `localhost`), `ECOD_CELL` (`cell`),
    /// `ECOD_NAME` (the machine's host name), `ECOD_MQTT__USER` and `ECOD_MQTT__PASSWORD`;
    /// `ECOD_TLS__CA`, `ECOD_TLS__CERTIFICATE` and `ECOD_TLS__KEY` are the files of the program's
    /// node. The part is `rust`, the timeout 10 s.
    fn default() -> Self {
        let setting = |name| env::var(name).ok().filter(|value| !value.is_empty());
        let or = |name, default: &str| setting(name).unwrap_or_else(|| default.to_owned());
        let identity = setting("ECOD_TLS__CERTIFICATE").zip(setting("ECOD_TLS__KEY"));
        let tls = setting("ECOD_TLS__CA").map(|ca| Tls {
            ca: ca.into(),
            identity: identity.map(|(certificate, key)| (certificate.into(), key.into())),
            broker_name: Some(Tls::DOOR_NAME.to_owned()),
        });
        Self {
            broker: or("ECOD_BROKER", "localhost"),
            cell: or("ECOD_CELL", "cell"),
            node: setting("ECOD_NAME").unwrap_or_else(host_name),
            part: "rust".to_owned(),
            login: setting("ECOD_MQTT__USER").map(|user| (user, or("ECOD_MQTT__PASSWORD", ""))),
            tls,
            timeout: Duration::from_secs(10),
        }
    }
}

/// Content of one frame. A frame without objects is a report, too.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Time of the picture, not of the detection.
    pub captured_at: SystemTime,
    /// Detections with their positions in the cell's frame.
    pub objects: Vec<PerceivedObject>,
    /// Pose of the camera. With it, the reporting vehicle itself is on the map.
    pub pose: Option<WirePose>,
    /// Names of the landmarks in view, occupied or empty; `None` if they were not determined.
    pub seen: Option<Vec<LandmarkId>>,
    /// Field of view from the pose.
    pub view: Option<FieldOfView>,
    /// Yaw rate in radians per second, counter-clockwise, if the cell's frame turns with a vehicle.
    pub frame_yaw_rate_radps: Option<f64>,
}

impl Frame {
    /// Objects of a frame that was captured now.
    pub fn new(objects: Vec<PerceivedObject>) -> Self {
        Self {
            captured_at: SystemTime::now(),
            objects,
            pose: None,
            seen: None,
            view: None,
            frame_yaw_rate_radps: None,
        }
    }
}

/// Boxes in one image. An image without boxes is a report, too.
#[derive(Debug, Clone, PartialEq)]
pub struct BoxFrame {
    /// Time of the image, not of the detection.
    pub captured_at: SystemTime,
    /// The boxes, in pixels of the image.
    pub boxes: Vec<PixelBox>,
    /// Size, optics and accuracy of the camera.
    pub camera: BoxCamera,
    /// Pose of the camera with its height, pitch and roll. For a camera on a vehicle,
    /// [`Mount::stated_pose`](ecod::perception::camera::Mount::stated_pose) gives it.
    pub pose: WirePose,
    /// `Some(false)` for a camera that is fixed at the road and no object of the map.
    pub moving: Option<bool>,
}

/// A connection to a cell, which is re-established whenever it is lost. Its methods may be called
/// from any thread.
pub struct Cell {
    name: NodeName,
    topics: Topics,
    shared: Arc<ConnectionState>,
    /// Number of reports on each topic so far.
    sent: Mutex<HashMap<Topic, u64>>,
    timeout: Duration,
}

/// An endless iterator over messages, returned by [`Cell::maps`] and similar methods.
///
/// A slow reader gets the newest message next and no backlog. The iterator ends when the cell is
/// closed.
pub struct Messages<M> {
    shared: Arc<ConnectionState>,
    filter: String,
    stream: fn(&Streams) -> &MessageStream<M>,
    number: u64,
    timeout: Option<Duration>,
}

/// Keep-alive, equal to the default of nodes.
const KEEP_ALIVE: Duration = Duration::from_secs(5);

/// Maximum number of unacknowledged messages. Only requests need an acknowledgement, and they are
/// sent one at a time.
const MAX_UNDER_WAY: u16 = 16;

/// Silence after which the log gives a hint about the cause.
const SILENCE: Duration = Duration::from_secs(10);

/// Longest wait of a reader between two checks of its timeout.
const PATIENCE: Duration = Duration::from_secs(1);

/// Room in a packet for topic and header in bytes.
const HEADER_BYTES: usize = 4096;

impl Cell {
    /// Connects to a cell.
    ///
    /// # Errors
    /// Returns [`Error::Invalid`] for settings that no broker could accept, and
    /// [`Error::Unreachable`] or [`Error::Refused`] if the broker does not admit the program within
    /// the timeout.
    pub fn connect(settings: Settings) -> Result<Self, Error> {
        let invalid = |error: &dyn std::fmt::Display| Error::Invalid(error.to_string());
        let part = if settings.part.is_empty() {
            String::new()
        } else {
            format!("{PART_MARK}{}", settings.part)
        };
        let name = NodeName::new(settings.node + &part).map_err(|error| invalid(&error))?;
        let cell = NodeName::new(&settings.cell).map_err(|error| invalid(&error))?;
        let default_port = if settings.tls.is_some() { 8883 } else { 1883 };
        let address = broker_address(&settings.broker, default_port)?;
        // With TLS the host is compared with the name in the certificate, which has no brackets.
        let host = if settings.tls.is_some() {
            address.host().trim_matches(['[', ']'])
        } else {
            address.host()
        };
        // With certificates a cell's broker accepts only ids of this form, so that a program cannot
        // end another's session. Without, it treats them as ids of nodes.
        let mut run = Uuid::new_v4().simple().to_string();
        if settings.tls.is_none() {
            run.truncate(16);
        }
        let mut options = MqttOptions::new(format!("{name}-{run}"), host, address.port());
        let limits = Limits::default();
        options.set_keep_alive(KEEP_ALIVE).set_clean_start(true);
        options.set_connection_timeout(settings.timeout.as_secs().clamp(1, 10));
        // Memory is allocated for each, by default 14 MB.
        options.set_outgoing_inflight_upper_limit(MAX_UNDER_WAY);
        options.set_max_packet_size(u32::try_from(limits.map_bytes + HEADER_BYTES).ok());
        let mut network = rumqttc::NetworkOptions::new();
        // Otherwise small messages wait for acknowledgements.
        network.set_tcp_nodelay(true);
        options.set_network_options(network);
        if let Some((user, password)) = settings.login {
            options.set_credentials(user, password);
        }
        if let Some(tls) = &settings.tls {
            options.set_transport(Transport::tls_with_config(tls.client()?.into()));
        }
        let topics = Topics::new(&cell);
        let shared = ConnectionState::connect(
            address.to_string(),
            topics.clone(),
            options,
            settings.timeout,
        )?;
        Ok(Self {
            name,
            topics,
            shared,
            sent: Default::default(),
            timeout: settings.timeout,
        })
    }

    /// The name in which the program reports.
    pub fn name(&self) -> &NodeName {
        &self.name
    }

    /// The maps of the cell, from now on. A map that is not later than the last one by epoch and
    /// round is dropped.
    pub fn maps(&self) -> Messages<GlobalMap> {
        self.read("global_detections", |streams| &streams.maps, false)
    }

    /// The verdicts of the cell, by the rules of [`Cell::maps`].
    pub fn verdicts(&self) -> Messages<Verdicts> {
        self.read("global_verdicts", |streams| &streams.verdicts, false)
    }

    /// The reputation of each vehicle: the current state first, then by the rules of
    /// [`Cell::maps`].
    pub fn reputations(&self) -> Messages<Reputations> {
        self.read("reputations", |streams| &streams.reputations, true)
    }

    /// The statuses of the nodes: the current ones first, then every change.
    pub fn statuses(&self) -> Messages<NodeStatus> {
        self.read("nodes/+", |streams| &streams.statuses, true)
    }

    /// The reports of all vehicles for the map, from now on: of each vehicle the newest.
    pub fn reports(&self) -> Messages<ObjectReport> {
        self.read("detections/+", |streams| &streams.reports, false)
    }

    /// The collective perception messages (CPM) of other stations, from now on: of each receiver
    /// the newest.
    pub fn received_cpms(&self) -> Messages<CpmMessage> {
        self.read(&format!("{RECEIVED}/+"), |streams| &streams.foreign, false)
    }

    /// Publishes a collective perception message (CPM) on `cpm/<level>`, as [`Cell::report`] does a
    /// report.
    ///
    /// # Errors
    /// Returns [`Error::Refused`] if the broker refused the login or an earlier message there.
    pub fn publish_cpm(&self, level: &str, payload: Vec<u8>) -> Result<bool, Error> {
        self.publish(&self.topics.cpm(level), payload)
    }

    /// The current settings that all nodes of the cell share; version 0 if there are none.
    ///
    /// # Errors
    /// Returns [`Error::Silent`] if no description arrives within the timeout. A node always sends
    /// it to its local programs, but other brokers have none in a cell without a description.
    /// Returns [`Error::Refused`] if the broker refuses the subscription.
    pub fn description(&self) -> Result<Arc<CellDescription>, Error> {
        let mut descriptions = self
            .read("cell", |streams| &streams.descriptions, true)
            .timeout(self.timeout);
        let closed = || {
            Err(Error::Silent(format!(
                "the connection to {} is closed",
                self.shared.at
            )))
        };
        descriptions.next().unwrap_or_else(closed)
    }

    /// The place of the cell's maps on Earth, if the cell's description has one. It may change
    /// while the cell runs.
    ///
    /// # Errors
    /// Returns the errors of [`Cell::description`], and [`Error::Invalid`] for an unreadable
    /// description.
    pub fn origin(&self) -> Result<Option<GeographicOrigin>, Error> {
        let description = self.description()?;
        let invalid = |error: &dyn std::fmt::Display| {
            Error::Invalid(format!(
                "the description of the cell has no usable [origin]: {error}"
            ))
        };
        let settings: toml::Table = description.text.parse().map_err(|error| invalid(&error))?;
        let Some(origin) = settings.get("origin") else {
            return Ok(None);
        };
        let origin: GeographicOrigin =
            origin.clone().try_into().map_err(|error| invalid(&error))?;
        origin.validate().map_err(|error| invalid(&error))?;
        Ok(Some(origin))
    }

    /// Reports a frame, for the map. Returns true if it was sent; without a connection it is
    /// dropped and counted. This method does not block.
    ///
    /// # Errors
    /// Returns [`Error::Invalid`] for values that the protocol does not allow, and
    /// [`Error::Refused`] if the broker refused the login or an earlier report.
    pub fn report(&self, frame: Frame) -> Result<bool, Error> {
        self.send(ReportKind::Detections, frame)
    }

    /// Reports the boxes of a detector in one image. The node at which the program is connected
    /// places them on the map, as it does the boxes of its own camera.
    ///
    /// A box that gives no position, such as one above the horizon, is left out; the node counts it
    /// as `not_placed`, and states the reason on `nodes/<node>/clients`. Returns as
    /// [`Cell::report`] does.
    ///
    /// # Errors
    /// Returns [`Error::Invalid`] for values that the protocol does not allow, such as a box outside
    /// the image, and [`Error::Refused`] if the broker refused the login or earlier boxes, or does
    /// not belong to a node and answers that there is no receiver.
    pub fn report_boxes(&self, image: BoxFrame) -> Result<bool, Error> {
        let BoxFrame {
            captured_at,
            boxes,
            camera,
            pose,
            moving,
        } = image;
        let number = boxes.len();
        let captured_at_us = micros(captured_at)?;
        self.send_next(Topic::Boxes(self.name.clone()), number, |seq| {
            let report = BoxReport {
                schema: SCHEMA_VERSION,
                node: self.name.clone(),
                seq,
                captured_at_us,
                pose,
                camera,
                boxes,
                moving,
            };
            report
                .check(&Limits::default())
                .map_err(|flaw| Error::Invalid(format!("not sent: {flaw}")))?;
            Ok(encode_boxes(&report))
        })
    }

    /// Votes on the labels at landmarks, for the verdicts: objects name their `landmark`.
    ///
    /// # Errors
    /// Returns the errors of [`Cell::report`], and an error if an object names no landmark.
    pub fn vote(&self, frame: Frame) -> Result<bool, Error> {
        if let Some(place) = frame
            .objects
            .iter()
            .position(|object| object.landmark.is_none())
        {
            return Err(Error::Invalid(format!(
                "not sent: objects[{place}] names no landmark, as a vote must"
            )));
        }
        self.send(ReportKind::VoteDetections, frame)
    }

    /// Messages that were not accepted, by the reasons in `docs/protocol.md`, and reports that were
    /// not sent: `unsent`.
    pub fn counts(&self) -> BTreeMap<&'static str, u64> {
        self.shared.state().counts.clone()
    }

    /// Ends the connection and all iterators over messages. Dropping the cell has the same effect.
    pub fn close(&self) {
        self.shared.close();
    }

    fn read<M>(
        &self,
        level: &str,
        stream: fn(&Streams) -> &MessageStream<M>,
        is_retained: bool,
    ) -> Messages<M> {
        let filter = self.topics.filter(level);
        let mut state = self.shared.state();
        state.subscribe(&filter);
        let number = if is_retained {
            0
        } else {
            stream(&state.streams).number()
        };
        drop(state);
        Messages {
            shared: Arc::clone(&self.shared),
            filter,
            stream,
            number,
            timeout: None,
        }
    }

    fn send(&self, kind: ReportKind, frame: Frame) -> Result<bool, Error> {
        let objects = frame.objects.len();
        let captured_at = micros(frame.captured_at)?;
        self.send_next(kind.topic(self.name.clone()), objects, |seq| {
            let report = ObjectReport {
                pose: frame.pose,
                objects: frame.objects,
                seen: frame.seen,
                view: frame.view,
                frame_yaw_rate_radps: frame.frame_yaw_rate_radps,
                ..ObjectReport::new(self.name.clone(), seq, captured_at)
            };
            check(&report)?;
            Ok(encode(&report, Encoding::Json))
        })
    }

    /// Sends the report with the next number of the topic.
    fn send_next(
        &self,
        topic: Topic,
        objects: usize,
        encoded: impl FnOnce(u64) -> Result<Vec<u8>, Error>,
    ) -> Result<bool, Error> {
        let path = self.topics.path(&topic);
        let Ok(mut sent) = self.sent.lock() else {
            return Ok(false);
        };
        let seq = sent.entry(topic).or_default();
        let payload = encoded(*seq + 1)?;
        let bytes = payload.len();
        let at_most = Limits::default().payload_bytes;
        if bytes > at_most {
            return Err(Error::Invalid(format!(
                "not sent: {bytes} bytes with {objects} objects, at most {at_most}"
            )));
        }
        let is_sent = self.publish(&path, payload)?;
        *seq += 1;
        Ok(is_sent)
    }

    fn publish(&self, topic: &str, payload: Vec<u8>) -> Result<bool, Error> {
        let mut state = self.shared.state();
        state.check_refusal(topic, &self.shared.at)?;
        let is_sent = state.publish(topic, payload);
        if !is_sent {
            *state.counts.entry("unsent").or_default() += 1;
        }
        Ok(is_sent)
    }
}

impl Drop for Cell {
    fn drop(&mut self) {
        self.close();
    }
}

impl<M> Messages<M> {
    /// The same iterator, in which silence of this length returns [`Error::Silent`]. A vehicle
    /// should stop in this case.
    #[must_use]
    pub fn timeout(mut self, silence: Duration) -> Self {
        self.timeout = Some(silence);
        self
    }
}

impl<M> Iterator for Messages<M> {
    type Item = Result<Arc<M>, Error>;

    /// Waits for the next message. After an error, iteration may continue.
    fn next(&mut self) -> Option<Self::Item> {
        let began = Instant::now();
        let mut is_reported = false;
        let mut state = self.shared.state();
        while !state.is_closing {
            // Subscribed again after a refusal.
            state.subscribe(&self.filter);
            if let Some((number, message)) = (self.stream)(&state.streams).after(self.number) {
                self.number = number;
                return Some(Ok(message));
            }
            if let Err(refusal) = state.check_refusal(&self.filter, &self.shared.at) {
                return Some(Err(refusal));
            }
            let waited = began.elapsed();
            let remedy = if !state.is_connected() {
                "no connection"
            } else if self.number > 0 && self.filter.ends_with("/nodes/+") {
                // A status is sent only when it changes.
                "nothing has changed since the last"
            } else {
                "does a node lead the cell of this name?"
            };
            let silence = || {
                format!(
                    "nothing on {} from {} for {waited:.1?}; {remedy}",
                    self.filter, self.shared.at
                )
            };
            if self.timeout.is_some_and(|timeout| waited >= timeout) {
                return Some(Err(Error::Silent(silence())));
            }
            if waited >= SILENCE && !is_reported {
                is_reported = true;
                // Maps are expected without end, and a lost connection has a remedy; vehicles and
                // other stations may be silent for good reason.
                let is_fault = !state.is_connected() || self.filter.contains("/global_");
                log::log!(
                    if is_fault {
                        log::Level::Warn
                    } else {
                        log::Level::Debug
                    },
                    "{}",
                    silence()
                );
            }
            let left = self.timeout.map_or(PATIENCE, |timeout| {
                timeout.saturating_sub(waited).min(PATIENCE)
            });
            state = self.shared.wait(state, left);
        }
        None
    }
}

/// The current time by this machine's clock, for comparison with a message's `fused_at_us`.
pub fn now() -> Timestamp {
    Timestamp::default() + SystemTime::UNIX_EPOCH.elapsed().unwrap_or_default()
}

/// Checks a report, and names the field that is not allowed.
fn check(report: &ObjectReport) -> Result<(), Error> {
    let limits = Limits::default();
    report.validate(&limits).map_err(|reason| {
        // JSON has no form for numbers that are not finite.
        let flaw = Flaw::of_report(&encode(report, Encoding::Cbor), reason, &limits);
        Error::Invalid(format!("not sent: {flaw}"))
    })
}

/// The time as payloads state it.
fn micros(captured_at: SystemTime) -> Result<Timestamp, Error> {
    let since_epoch = captured_at
        .duration_since(SystemTime::UNIX_EPOCH)
        .map_err(|_| Error::Invalid("not sent: captured_at is before 1970".to_owned()))?;
    Ok(Timestamp::default() + since_epoch)
}

/// The parts of HOST:PORT; the port may be absent.
fn broker_address(text: &str, default_port: u16) -> Result<BrokerAddress, Error> {
    let address = text
        .parse::<BrokerAddress>()
        .or_else(|error| format!("{text}:{default_port}").parse().map_err(|_| error));
    address.map_err(|error| Error::Invalid(error.to_string()))
}

/// The machine's name without its domain, limited to characters allowed in names of nodes, by the
/// same rule as for nodes.
fn host_name() -> String {
    let system = rustix::system::uname();
    let host = system.nodename().to_string_lossy();
    let allowed = |c: char| {
        if c.is_ascii_alphanumeric() || c == '_' {
            c
        } else {
            '-'
        }
    };
    host.split('.')
        .next()
        .unwrap_or_default()
        .chars()
        .map(allowed)
        .collect()
}
