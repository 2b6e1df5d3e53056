//! Refusals of whole clients.

use std::io;

use crate::telemetry::counters::Event;

/// Reason for which a client was refused or cut off.
#[derive(Debug, thiserror::Error)]
pub(super) enum ClientRejection {
    #[error("left without a word, as nodes do that only test the port")]
    Left,
    #[error("no login in time")]
    TimedOut,
    #[error("no login before many newer connections of its address")]
    Evicted,
    #[error("not trusted: {0}")]
    Untrusted(String),
    #[error("not an MQTT login, or a packet of too many filters")]
    Malformed,
    #[error("protocol level {0} is not one of MQTT 3.1, 3.1.1 and 5")]
    UnknownVersion(u8),
    #[error("as many clients as allowed are connected")]
    Full,
    #[error("as many clients as allowed are connected of this certificate or address")]
    Crowded,
    #[error("does not read what it gets, or does not end what it begins")]
    Stalled,
    #[error("connection lost: {0}")]
    Lost(#[from] io::Error),
    #[error("certificate no longer valid: {0}")]
    CertificateInvalidated(rustls::Error),
}

impl ClientRejection {
    /// The event by which it is counted.
    pub(super) fn event(&self) -> Option<Event> {
        match self {
            Self::Left => None,
            Self::TimedOut => Some(Event::ClientTimedOut),
            Self::Evicted => Some(Event::ClientThrottled),
            Self::Untrusted(_) => Some(Event::ClientUntrusted),
            Self::Malformed | Self::UnknownVersion(_) | Self::Lost(_) => {
                Some(Event::ClientMalformed)
            }
            Self::Full | Self::Crowded => Some(Event::ClientsFull),
            Self::Stalled => Some(Event::ClientStalled),
            Self::CertificateInvalidated(_) => Some(Event::ClientExpelled),
        }
    }
}
