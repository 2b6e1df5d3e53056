//! Messages of the election, exchanged between the nodes of a cell.

use minicbor::{Decode, Encode};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::leadership::election::clock_stamps::ClockStamps;
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::wire::{self, DescriptionStamp, Encoding, Limits, RejectReason, Role};

/// Maximum number of successors that a leader names, the standby first.
pub const MAX_SUCCESSORS: usize = 3;

/// Maximum number of nodes in a message at whose brokers its sender cannot log in.
pub const MAX_NO_LOGIN: usize = 4;

/// Largest term accepted from the wire: the largest integer that every JSON reader represents
/// exactly.
pub const MAX_TERM: u64 = (1 << 53) - 1;

/// Maximum increase of the highest term within
/// [`TERM_WINDOW`](crate::leadership::timers::TERM_WINDOW). A cell uses one term per change of
/// leader, so it cannot get this far ahead of a node. A forged term near [`MAX_TERM`] would
/// otherwise end elections for good.
pub const MAX_TERM_STEP: u64 = 1 << 20;

/// Maximum term that a node without any term accepts from another node; it may be joining a cell
/// that has run for long.
pub(crate) const MAX_FIRST_TERM: u64 = 1 << 40;

/// Maximum step by which one message raises the number of the last round: more rounds than a cell
/// publishes in years. A node that has just started accepts any number up to [`MAX_ROUND`].
pub(super) const MAX_ROUND_STEP: u64 = 1 << 32;

/// Largest round number accepted from the wire. A leader that reaches it starts over: rounds are
/// ordered by epoch first.
pub const MAX_ROUND: u64 = 1 << 52;

/// Maximum size of an encoded message in bytes. It fits one Ethernet frame together with the
/// membership's seal.
pub const MAX_MESSAGE_BYTES: usize = 1200;

/// One election message. Messages may be lost, repeated, delayed and re-ordered in transit.
///
/// The transport must authenticate the sender, because the election relies on [`Self::from`].
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct ElectionMessage {
    /// Major version of the message, [`wire::SCHEMA_VERSION`].
    #[n(0)]
    pub schema: u32,
    /// The sender.
    #[n(1)]
    pub from: NodeName,
    /// Identifies the sender's run by its start time, in Unix microseconds by the sender's clock.
    #[n(2)]
    pub run: u64,
    /// Sequence number within the run; it increases with every message to any addressee.
    #[n(3)]
    pub seq: u64,
    /// The sender's properties as a candidate.
    #[serde(rename = "standing")]
    #[n(4)]
    pub candidacy: Candidacy,
    /// The highest term that the sender has seen in use.
    #[n(5)]
    pub term: u64,
    /// The epoch that the sender follows or leads; absent while it has no leader.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(8)]
    pub epoch: Option<Epoch>,
    /// True if the sender recently received a message of the addressee, because links may work in
    /// one direction only.
    #[n(6)]
    pub hears_you: bool,
    /// The content.
    #[n(7)]
    pub body: Body,
    /// Stamps for comparing the nodes' clocks; absent from nodes of earlier versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(9)]
    pub clock: Option<Box<ClockStamps>>,
    /// The sender's description of the cell, version 0 without one; absent from nodes of earlier
    /// versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(10)]
    pub description: Option<Box<DescriptionStamp>>,
}

/// A node's properties as a candidate, which define its rank among possible leaders.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, Encode, Decode, JsonSchema,
)]
pub struct Candidacy {
    /// The role with which the node was started.
    #[n(0)]
    pub role: Role,
    /// The node's configured priority; a higher value leads first.
    #[n(1)]
    pub priority: u8,
    /// The node's processor load in quarters, damped.
    #[n(2)]
    pub load: u8,
    /// True if broker, fuser and gateway all work.
    #[n(3)]
    pub fit: bool,
}

/// A leader's sign of life: how long it has led, under its signature. Other nodes can pass it on
/// but cannot create one.
#[derive(
    Debug, Clone, Default, PartialEq, Eq, Hash, Serialize, Deserialize, Encode, Decode, JsonSchema,
)]
pub struct LifeSign {
    /// Time in ms for which the leader had led when it sent this, by its own clock.
    #[n(0)]
    pub led_ms: u64,
    /// The leader's signature in base64 over cell, epoch and `led_ms`; absent in a cell without
    /// certificates. The transport adds and verifies it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(1)]
    pub signature: Option<Box<str>>,
}

/// The election protocol. In a quiet cell with a leader:
///
/// ```text
/// leader    -> successor   Beat      every beat_ms          successor -> leader   Status
/// leader    -> others      Beat      every idle_beat_ms     other     -> leader   Status
/// ```
///
/// A node without a leader, or whose leader has missed two beats, sends `Ask` to the other nodes.
/// The leader answers `Beat`, a node that receives the leader's beats answers `LeaderEvidence`, and
/// any other node `Status`. A claim to lead is a `Beat` of a higher epoch:
///
/// ```text
/// seeker    -> all         Ask
/// follower  -> leader      Ask                where its last sign of life is old
/// follower  -> seeker      LeaderEvidence     "received 12 ms ago", with its last sign of life
/// claimant  -> all         Beat      epoch + 1, after = the epoch it succeeds
/// ```
///
/// Handover, during which the old leader continues to publish:
///
/// ```text
/// leader     -> challenger  Offer                 every beat_ms until Ready
/// challenger -> leader      Ready                 broker and fuser run, state is there
/// leader     -> challenger  Yield { last_round }  right after that round; repeated
/// challenger -> all         Beat                  epoch + 1, first round last_round + 1: the old leader stops
/// ```
///
/// A leader that cannot continue sends `Resign` to all nodes.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize, Encode, Decode, JsonSchema)]
#[serde(rename_all = "snake_case")]
#[cbor(flat)]
pub enum Body {
    /// The sender's state: a greeting, or the answer to a beat.
    #[n(0)]
    Status {
        /// The highest epoch that has ended according to the sender: the epoch of a leader whose
        /// broker refused it, or the epoch that the sender has lost when it refuses a beat of a
        /// lower epoch.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[n(0)]
        over: Option<Epoch>,
        /// Current or former leader and standby at whose brokers the sender cannot log in; at most
        /// [`MAX_NO_LOGIN`].
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        #[cbor(n(1), default)]
        no_login: Vec<NodeName>,
    },
    /// Question: which node leads, and which nodes receive its beats?
    #[n(1)]
    Ask {
        /// Number of the question, increasing within the sender's run.
        #[n(0)]
        ask: u64,
    },
    /// The sender receives the leader of its epoch: the answer to [`Body::Ask`].
    #[serde(rename = "vouch")]
    #[n(2)]
    LeaderEvidence {
        /// Number of the question.
        #[n(0)]
        ask: u64,
        /// Time since the sender last received the leader, in ms.
        #[n(1)]
        age_ms: u64,
        /// The last sign of life of the leader of the sender's epoch.
        #[n(2)]
        life: LifeSign,
    },
    /// The sender leads: its sign of life.
    #[n(3)]
    Beat {
        /// Time until the next beat to the addressee, in ms.
        #[n(0)]
        every_ms: u64,
        /// Number of the last published round.
        #[n(1)]
        round: u64,
        /// Number of followers from which the leader receives messages.
        #[n(2)]
        followers: u8,
        /// The epoch that this one succeeded, if any.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[n(3)]
        after: Option<Epoch>,
        /// The next leaders, the standby first; at most [`MAX_SUCCESSORS`].
        #[n(4)]
        successors: Vec<NodeName>,
        /// The leader's sign of life.
        #[n(5)]
        life: LifeSign,
    },
    /// Request to prepare for leading in the sender's place, sent to the challenger.
    #[n(4)]
    Offer,
    /// The challenger is ready; sent to the leader.
    #[n(5)]
    Ready,
    /// Permission to lead from the next round on, sent to the challenger.
    #[n(6)]
    Yield {
        /// The last round published by the leader.
        #[n(0)]
        last_round: u64,
    },
    /// The sender has stopped leading; sent to all nodes.
    #[n(7)]
    Resign {
        /// The epoch that has ended.
        #[n(0)]
        epoch: Epoch,
        /// The last round published in it.
        #[n(1)]
        last_round: u64,
    },
}

impl LifeSign {
    /// Maximum length of a signature in base64.
    const MAX_SIGNATURE: usize = 128;

    /// The bytes that the leader of `epoch` signs in a cell with certificates.
    pub fn signed_bytes(&self, cell: &NodeName, epoch: &Epoch) -> Vec<u8> {
        let header = b"ecod leader alive 1\0";
        let names = [cell.as_str(), epoch.leader.as_str()].map(str::as_bytes);
        let numbers = [epoch.term, self.led_ms].map(u64::to_be_bytes);
        [
            &header[..],
            names[0],
            b"\0",
            names[1],
            b"\0",
            &numbers[0],
            &numbers[1],
        ]
        .concat()
    }

    fn is_plausible(&self) -> bool {
        let signature = self.signature.as_ref();
        self.led_ms <= wire::MAX_INTEGER
            && signature.is_none_or(|text| text.len() <= Self::MAX_SIGNATURE)
    }
}

impl wire::Payload for ElectionMessage {
    fn schema(&self) -> u32 {
        self.schema
    }

    fn to_bytes(&self, encoding: Encoding) -> Vec<u8> {
        wire::codec::write(self, encoding)
    }

    fn from_bytes(bytes: &[u8]) -> Result<Self, RejectReason> {
        wire::codec::read(bytes)
    }
}

impl ElectionMessage {
    /// Encodes the message in this encoding; [`Self::decode`] reads all encodings.
    pub fn encode(&self, encoding: Encoding) -> Vec<u8> {
        wire::encode(self, encoding)
    }

    /// Decodes a message and checks every value in it.
    ///
    /// # Errors
    /// Returns [`RejectReason::TooLarge`], [`RejectReason::UnknownSchema`], or
    /// [`RejectReason::Malformed`], also for values that no node sends.
    pub fn decode(bytes: &[u8]) -> Result<Self, RejectReason> {
        let limits = Limits {
            payload_bytes: MAX_MESSAGE_BYTES,
            ..Limits::default()
        };
        let message: Self = wire::decode(bytes, &limits)?;
        if message.is_plausible() {
            Ok(message)
        } else {
            Err(RejectReason::Malformed)
        }
    }

    /// The highest term among the epochs in the message.
    pub(super) fn highest_epoch(&self) -> u64 {
        let of_body = match &self.body {
            Body::Status { over, .. } => over.as_ref(),
            Body::Beat { after, .. } => after.as_ref(),
            Body::Resign { epoch, .. } => Some(epoch),
            Body::Ask { .. }
            | Body::LeaderEvidence { .. }
            | Body::Offer
            | Body::Ready
            | Body::Yield { .. } => None,
        };
        of_body
            .into_iter()
            .chain(&self.epoch)
            .map(|epoch| epoch.term)
            .max()
            .unwrap_or(0)
    }

    /// True if a node can have sent these values: epochs no higher than the stated term, a beat and a
    /// resignation only of the sender's own epoch, and all numbers within their limits.
    fn is_plausible(&self) -> bool {
        let known =
            |epoch: &Option<Epoch>| epoch.as_ref().is_none_or(|epoch| epoch.term <= self.term);
        let body = match &self.body {
            Body::Status { over, no_login } => known(over) && no_login.len() <= MAX_NO_LOGIN,
            Body::Beat {
                every_ms,
                after,
                successors,
                round,
                life,
                ..
            } => {
                let leads = self
                    .epoch
                    .as_ref()
                    .is_some_and(|epoch| epoch.leader == self.from);
                leads
                    && known(after)
                    && successors.len() <= MAX_SUCCESSORS
                    && (1..=60_000).contains(every_ms)
                    && *round <= MAX_ROUND
                    && life.is_plausible()
            }
            Body::LeaderEvidence { life, .. } => life.is_plausible(),
            Body::Resign { epoch, last_round } => {
                epoch.term <= self.term && epoch.leader == self.from && *last_round <= MAX_ROUND
            }
            Body::Yield { last_round } => *last_round <= MAX_ROUND,
            Body::Ask { .. } | Body::Offer | Body::Ready => true,
        };
        let clock = self.clock.as_ref().is_none_or(|clock| clock.is_plausible());
        body && clock && self.term <= MAX_TERM && known(&self.epoch)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::leadership::election::AnsweredStamps;
    use crate::model::time::Timestamp;
    use crate::wire::{ContentHash, SCHEMA_VERSION};

    fn beat(term: u64, leader: &str) -> ElectionMessage {
        ElectionMessage {
            schema: SCHEMA_VERSION,
            from: NodeName::new("edge").unwrap(),
            run: 1_732_154_400_000_000,
            seq: 9,
            candidacy: Candidacy {
                role: Role::Edge,
                priority: 100,
                load: 1,
                fit: true,
            },
            term,
            epoch: Some(Epoch::new(4, NodeName::new(leader).unwrap())),
            hears_you: true,
            body: Body::Beat {
                every_ms: 40,
                round: 88,
                followers: 31,
                after: None,
                successors: vec![],
                life: LifeSign::default(),
            },
            clock: None,
            description: None,
        }
    }

    #[test]
    fn messages_round_trip_and_fit_packet() {
        let mut message = beat(4, "edge");
        let long = NodeName::new("x".repeat(64)).unwrap();
        if let Body::Beat {
            successors,
            after,
            life,
            ..
        } = &mut message.body
        {
            *life = LifeSign {
                led_ms: wire::MAX_INTEGER,
                signature: Some("x".repeat(96).into()),
            };
            *successors = vec![long.clone(), long.clone(), long.clone()];
            *after = Some(Epoch::new(3, long));
        }
        let latest = Timestamp(wire::MAX_INTEGER);
        let answers = Some(AnsweredStamps {
            sent_us: latest,
            received_us: latest,
        });
        message.clock = Some(
            ClockStamps {
                sent_us: latest,
                answers,
                wall_us: Some(latest),
                cell_us: Some(latest),
            }
            .into(),
        );
        let hash = ContentHash([u8::MAX; 32]);
        message.description = Some(
            DescriptionStamp {
                version: wire::MAX_INTEGER,
                hash,
            }
            .into(),
        );
        for encoding in [Encoding::Json, Encoding::Cbor, Encoding::Compact] {
            let bytes = message.encode(encoding);
            assert!(bytes.len() <= MAX_MESSAGE_BYTES, "{}", bytes.len());
            assert_eq!(ElectionMessage::decode(&bytes), Ok(message.clone()));
        }
    }

    /// Names in the code may change; names on the wire may not.
    #[test]
    fn the_wire_keeps_its_names() {
        let epoch = || Epoch::new(4, NodeName::from_static("edge"));
        for (body, expected) in [
            (
                Body::Status {
                    over: Some(epoch()),
                    no_login: Vec::new(),
                },
                r#"{"status":{"over":{"term":4,"leader":"edge"}}}"#,
            ),
            (
                Body::Status {
                    over: None,
                    no_login: vec![NodeName::from_static("edge")],
                },
                r#"{"status":{"no_login":["edge"]}}"#,
            ),
            (Body::Ask { ask: 7 }, r#"{"ask":{"ask":7}}"#),
            (
                Body::LeaderEvidence {
                    ask: 7,
                    age_ms: 12,
                    life: LifeSign {
                        led_ms: 900,
                        signature: None,
                    },
                },
                r#"{"vouch":{"ask":7,"age_ms":12,"life":{"led_ms":900}}}"#,
            ),
            (
                Body::Beat {
                    every_ms: 50,
                    round: 88,
                    followers: 3,
                    after: None,
                    successors: Vec::new(),
                    life: LifeSign {
                        led_ms: 900,
                        signature: Some("MEU=".into()),
                    },
                },
                concat!(
                    r#"{"beat":{"every_ms":50,"round":88,"followers":3,"successors":[],"#,
                    r#""life":{"led_ms":900,"signature":"MEU="}}}"#
                ),
            ),
            (Body::Offer, r#""offer""#),
            (Body::Ready, r#""ready""#),
            (
                Body::Yield { last_round: 88 },
                r#"{"yield":{"last_round":88}}"#,
            ),
            (
                Body::Resign {
                    epoch: epoch(),
                    last_round: 88,
                },
                r#"{"resign":{"epoch":{"term":4,"leader":"edge"},"last_round":88}}"#,
            ),
        ] {
            let message = ElectionMessage {
                body,
                ..beat(4, "edge")
            };
            let json = String::from_utf8(message.encode(Encoding::Json)).unwrap();
            let envelope = concat!(
                r#"{"schema":1,"from":"edge","run":1732154400000000,"seq":9,"#,
                r#""standing":{"role":"edge","priority":100,"load":1,"fit":true},"#,
                r#""term":4,"epoch":{"term":4,"leader":"edge"},"hears_you":true,"body":"#,
            );
            assert_eq!(json, format!("{envelope}{expected}}}"));
        }
        let life = LifeSign {
            led_ms: 900,
            signature: None,
        };
        let compact = ElectionMessage {
            body: Body::LeaderEvidence {
                ask: 7,
                age_ms: 12,
                life,
            },
            ..beat(4, "edge")
        };
        let compact: String = compact
            .encode(Encoding::Compact)
            .iter()
            .map(|byte| format!("{byte:02x}"))
            .collect();
        assert_eq!(
            compact,
            "890164656467651b000627629fb54800098402186401f504f58402070c8119038482046465646765"
        );
    }

    #[test]
    fn implausible_messages_are_refused() {
        let refused = |message: ElectionMessage| {
            ElectionMessage::decode(&message.encode(Encoding::Cbor)).unwrap_err()
        };
        assert_eq!(
            refused(beat(3, "edge")),
            RejectReason::Malformed,
            "an epoch beyond the sender's term"
        );
        assert_eq!(
            refused(beat(4, "euclid")),
            RejectReason::Malformed,
            "a beat in another's name"
        );
        assert_eq!(
            refused(beat(MAX_TERM + 1, "edge")),
            RejectReason::Malformed,
            "a term beyond all bounds"
        );
        let endless = Body::Yield {
            last_round: MAX_ROUND + 1,
        };
        let reason = refused(ElectionMessage {
            body: endless,
            ..beat(4, "edge")
        });
        assert_eq!(reason, RejectReason::Malformed, "a round beyond all bounds");
        assert_eq!(
            refused(ElectionMessage {
                schema: 2,
                ..beat(4, "edge")
            }),
            RejectReason::UnknownSchema
        );
    }
}
