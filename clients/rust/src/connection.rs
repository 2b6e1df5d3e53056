//! A connection to a broker on its own thread, which re-establishes it whenever it is lost.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use ecod::model::names::NodeName;
use ecod::wire::{RejectReason, Topics};
use rumqttc::Outgoing;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{ConnectReturnCode, PubAckReason, SubscribeReasonCode};
use rumqttc::v5::{Client, Connection, ConnectionError, Event, Incoming, MqttOptions};
use uuid::Uuid;

use crate::Error;
use crate::streams::Streams;

/// State shared by the connection's thread and the program.
pub(crate) struct ConnectionState {
    /// Address of the broker as given, for messages.
    pub(crate) at: String,
    topics: Topics,
    state: Mutex<State>,
    /// Notified with every message, connection, refusal and end.
    changed: Condvar,
}

/// State of the connection.
#[derive(Default)]
pub(crate) struct State {
    pub(crate) streams: Streams,
    pub(crate) counts: BTreeMap<&'static str, u64>,
    pub(crate) is_closing: bool,
    /// The sending half while the program is logged in.
    client: Option<Client>,
    /// Outcome of the first login.
    login: Option<Result<(), Error>>,
    /// Refusal of the latest login, if the broker will also refuse the next one.
    refusal: Option<Error>,
    filters: BTreeSet<String>,
    /// Topics and filters requested from the broker on this connection.
    asked: BTreeSet<String>,
    /// Requests in progress, in order, and by packet once they are sent.
    queued: VecDeque<String>,
    unanswered: HashMap<u16, String>,
    denied: HashMap<String, String>,
    has_ended: bool,
}

/// Maximum number of messages that wait for the network; more are dropped, because late messages
/// are worthless.
const MAX_WAITING: usize = 16;

/// Topic below which receivers bring collective perception messages (CPM) of other stations.
pub(crate) const RECEIVED: &str = "cpm/received";

/// Wait before the first new attempt, doubled with every failure, and the longest.
const RETRY_MIN: Duration = Duration::from_millis(100);
const RETRY_MAX: Duration = Duration::from_secs(5);

/// Time for sending queued messages when the connection is closed.
const FLUSH_TIMEOUT: Duration = Duration::from_secs(1);

impl ConnectionState {
    /// Connects, and waits until the program is logged in.
    pub(crate) fn connect(
        at: String,
        topics: Topics,
        options: MqttOptions,
        timeout: Duration,
    ) -> Result<Arc<Self>, Error> {
        let shared = Arc::new(Self {
            at,
            topics,
            state: Mutex::default(),
            changed: Condvar::new(),
        });
        let thread = Arc::clone(&shared);
        let spawned = thread::Builder::new()
            .name("ecod-client".to_owned())
            .spawn(move || thread.run(&options));
        spawned.map_err(|error| {
            Error::Unreachable(format!("no thread for the connection: {error}"))
        })?;
        let waited = shared
            .changed
            .wait_timeout_while(shared.state(), timeout, |state| state.login.is_none());
        let (mut state, _) = waited.unwrap_or_else(PoisonError::into_inner);
        let late = || {
            Err(Error::Unreachable(format!(
                "{} does not answer the login within {timeout:?}",
                shared.at
            )))
        };
        let login = state.login.clone().unwrap_or_else(late);
        state.is_closing = login.is_err();
        drop(state);
        shared.changed.notify_all();
        login.map(|()| shared)
    }

    pub(crate) fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for a change, for at most so long.
    pub(crate) fn wait<'a>(
        &self,
        state: MutexGuard<'a, State>,
        patience: Duration,
    ) -> MutexGuard<'a, State> {
        self.changed
            .wait_timeout(state, patience)
            .unwrap_or_else(PoisonError::into_inner)
            .0
    }

    /// Sends queued messages, and ends the connection and all iterators over messages.
    pub(crate) fn close(&self) {
        let mut state = self.state();
        state.is_closing = true;
        if let Some(client) = state.client.take()
            && client.try_disconnect().is_ok()
        {
            self.changed.notify_all();
            let ended = self
                .changed
                .wait_timeout_while(state, FLUSH_TIMEOUT, |state| !state.has_ended);
            drop(ended);
        }
        self.changed.notify_all();
    }

    /// Transfers messages until the program closes the connection.
    fn run(&self, options: &MqttOptions) {
        let mut wait = RETRY_MIN;
        loop {
            // Each connection has a new client, because messages queued in the last one are too
            // old.
            let (client, mut connection) = Client::new(options.clone(), MAX_WAITING);
            let began = Instant::now();
            let lost = self.carry(&client, &mut connection);
            let mut state = self.state();
            if state.client.take().is_some() && !state.is_closing {
                log::warn!(
                    "connection to {} lost: {lost}; trying again, reports are dropped until then",
                    self.at
                );
            }
            // A broker that admits the program and then ends the connection is not contacted more
            // and more often.
            wait = if began.elapsed() > RETRY_MAX {
                RETRY_MIN
            } else {
                (2 * wait).min(RETRY_MAX)
            };
            let pause = wait.mul_f64(0.25 + f64::from(Uuid::new_v4().as_bytes()[0]) / 1024.0);
            let waited = self
                .changed
                .wait_timeout_while(state, pause, |state| !state.is_closing);
            let (mut state, _) = waited.unwrap_or_else(PoisonError::into_inner);
            if state.is_closing {
                state.has_ended = true;
                self.changed.notify_all();
                return;
            }
        }
    }

    /// Sends and receives until the connection ends; returns the reason.
    fn carry(&self, client: &Client, connection: &mut Connection) -> String {
        loop {
            let event = match connection.recv() {
                Ok(Ok(event)) => event,
                Ok(Err(error)) => {
                    let reason = with_causes(&error);
                    self.record_failure(&error, &reason);
                    return reason;
                }
                Err(_) => return "closed".to_owned(),
            };
            let mut state = self.state();
            match event {
                Event::Incoming(Incoming::ConnAck(_)) => state.begin(client),
                Event::Incoming(Incoming::Publish(message)) => {
                    self.on_message(&mut state, &message.topic, &message.payload);
                }
                Event::Incoming(Incoming::SubAck(answer)) => {
                    let refused = answer
                        .return_codes
                        .iter()
                        .find(|code| !matches!(code, SubscribeReasonCode::Success(_)));
                    state.record_answer(answer.pkid, refused.map(|code| format!("{code:?}")));
                }
                Event::Incoming(Incoming::PubAck(answer)) => {
                    let text = answer
                        .properties
                        .and_then(|properties| properties.reason_string);
                    let refusal = match answer.reason {
                        PubAckReason::Success => None,
                        PubAckReason::NoMatchingSubscribers => state
                            .asks_boxes(answer.pkid)
                            .then(|| "only nodes place boxes, connect to a node".to_owned()),
                        reason => Some(text.unwrap_or_else(|| format!("{reason:?}"))),
                    };
                    state.record_answer(answer.pkid, refusal);
                }
                Event::Outgoing(Outgoing::Publish(packet) | Outgoing::Subscribe(packet))
                    if packet != 0 =>
                {
                    let asked = state.queued.pop_front();
                    asked.and_then(|asked| state.unanswered.insert(packet, asked));
                }
                Event::Outgoing(Outgoing::Disconnect) => return "closed".to_owned(),
                _ => continue,
            }
            // The connection was closed during the request.
            if state.is_closing
                && state.client.take().is_some()
                && let Err(error) = client.try_disconnect()
            {
                log::warn!("cannot close the connection to {}: {error}", self.at);
            }
            drop(state);
            self.changed.notify_all();
        }
    }

    /// Processes a message. An unusable one is counted, and the first of its kind is logged.
    fn on_message(&self, state: &mut State, topic: &[u8], payload: &[u8]) {
        let text = std::str::from_utf8(topic).ok();
        let received = text.and_then(|topic| topic.strip_prefix(&self.topics.filter(RECEIVED)));
        let receiver =
            received.and_then(|receiver| NodeName::new(receiver.strip_prefix('/')?).ok());
        let taken = match receiver {
            Some(receiver) => state.streams.on_cpm(receiver, payload),
            None => {
                let parsed = text.and_then(|topic| self.topics.parse(topic));
                state.streams.on_message(parsed, payload, Instant::now())
            }
        };
        let Err(reason) = taken else { return };
        let count = state.counts.entry(reason.as_str()).or_default();
        *count += 1;
        // Old rounds are normal after a reconnection.
        if *count == 1 && reason != RejectReason::Superseded {
            let topic = String::from_utf8_lossy(topic);
            log::warn!("not taken from {topic}: {reason}; others like it are only counted");
        }
    }

    fn record_failure(&self, error: &ConnectionError, reason: &str) {
        let mut state = self.state();
        let refusal = match error {
            ConnectionError::ConnectionRefused(code) => {
                let check = "check node name (`node` or ECOD_NAME), certificate, user and password";
                let text = format!("{} refuses the login: {code:?}; {check}", self.at);
                log::warn!("{text}");
                state.refusal = is_final(*code).then(|| Error::Refused(text.clone()));
                Error::Refused(text)
            }
            _ => Error::Unreachable(format!(
                "cannot log in at {}: {reason}; is a node or broker there that speaks MQTT 5, {}?",
                self.at,
                "and do both speak TLS (then the port is 8883) or neither, with certificates of the cell"
            )),
        };
        state.login.get_or_insert(Err(refusal));
        drop(state);
        self.changed.notify_all();
    }
}

impl State {
    /// Records that the program is logged in.
    fn begin(&mut self, client: &Client) {
        self.refusal = None;
        self.client = Some(client.clone());
        self.login.get_or_insert(Ok(()));
        self.asked.clear();
        self.queued.clear();
        self.unanswered.clear();
        self.denied.clear();
        self.filters
            .clone()
            .iter()
            .for_each(|filter| self.subscribe(filter));
    }

    pub(crate) fn is_connected(&self) -> bool {
        self.client.is_some()
    }

    /// Subscribes to messages, on this connection and all later ones.
    pub(crate) fn subscribe(&mut self, filter: &str) {
        self.filters.insert(filter.to_owned());
        let Some(client) = &self.client else { return };
        if !self.asked.contains(filter) && client.try_subscribe(filter, QoS::AtLeastOnce).is_ok() {
            self.request(filter);
        }
    }

    /// Sends a message if that is possible at once; returns whether it was sent.
    pub(crate) fn publish(&mut self, topic: &str, payload: Vec<u8>) -> bool {
        let Some(client) = &self.client else {
            return false;
        };
        // The first message requests an acknowledgement, because a refusal by the broker is not
        // visible otherwise.
        let is_question = !self.asked.contains(topic);
        let qos = if is_question {
            QoS::AtLeastOnce
        } else {
            QoS::AtMostOnce
        };
        let is_sent = client.try_publish(topic, qos, false, payload).is_ok();
        if is_sent && is_question {
            self.request(topic);
        }
        is_sent
    }

    /// Returns a refusal of the broker: of the login, or of this topic or filter. Each refusal of a
    /// topic is returned once.
    pub(crate) fn check_refusal(&mut self, topic: &str, at: &str) -> Result<(), Error> {
        if let Some(refusal) = &self.refusal {
            return Err(refusal.clone());
        }
        let Some(reason) = self.denied.remove(topic) else {
            return Ok(());
        };
        self.asked.remove(topic);
        let remedy = "do name and certificate or user allow it?";
        Err(Error::Refused(format!(
            "the broker at {at} refuses {topic}: {reason}; {remedy}"
        )))
    }

    fn request(&mut self, topic: &str) {
        self.asked.insert(topic.to_owned());
        self.queued.push_back(topic.to_owned());
    }

    /// True if a packet checks whether the broker accepts boxes.
    fn asks_boxes(&self, packet: u16) -> bool {
        self.unanswered
            .get(&packet)
            .is_some_and(|topic| topic.contains("/boxes/"))
    }

    fn record_answer(&mut self, packet: u16, refusal: Option<String>) {
        if let (Some(topic), Some(reason)) = (self.unanswered.remove(&packet), refusal) {
            log::warn!("the broker refuses {topic}: {reason}");
            self.denied.insert(topic, reason);
        }
    }
}

/// True if a broker that refuses a login so will refuse the next one.
fn is_final(code: ConnectReturnCode) -> bool {
    use ConnectReturnCode::{
        BadAuthenticationMethod, BadClientId, BadUserNamePassword, Banned, NotAuthorized,
    };
    use ConnectReturnCode::{
        ClientIdentifierNotValid, MalformedPacket, ProtocolError, RefusedProtocolVersion,
    };
    matches!(
        code,
        BadAuthenticationMethod
            | BadClientId
            | BadUserNamePassword
            | Banned
            | NotAuthorized
            | ClientIdentifierNotValid
            | MalformedPacket
            | ProtocolError
            | RefusedProtocolVersion
            | ConnectReturnCode::UnsupportedProtocolVersion
    )
}

/// An error's text together with the texts of its causes.
fn with_causes(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    for cause in
        std::iter::successors(error.source(), |cause| cause.source()).map(ToString::to_string)
    {
        if !text.contains(&cause) {
            text = format!("{text}: {cause}");
        }
    }
    text
}
