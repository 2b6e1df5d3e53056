//! Renewal of certificates over the membership: each node requests its own, and nodes that have the
//! key of the cell's CA issue the certificates of other nodes.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;

use crate::messages::membership::RenewalOutcome;
use crate::platform::clock;
use crate::platform::throttle::KeyedThrottle;
use crate::telemetry::troubles::quoted;
use crate::transport::pki::{Credentials, NewKey, RenewalMessage, renew};

/// Renewals of one node. It decides what to send, and which work with files runs outside the
/// membership's task, which must not wait for disks.
pub(super) struct Renewals {
    credentials: Arc<Credentials>,
    /// Name of this member: the node's, or an observer's.
    name: NodeName,
    /// The renewal of the node's own certificate, while it is due.
    own: Option<PendingRenewal>,
    /// The last request of each node that was answered by a certificate.
    answered: BTreeMap<NodeName, AnsweredRequest>,
    messages: KeyedThrottle<NodeName>,
    /// Nodes whose requests are being decided.
    in_work: BTreeSet<NodeName>,
    /// True while this node's own files are being replaced.
    is_replacing: bool,
}

/// A key of this node that has no certificate yet.
struct PendingRenewal {
    key: Arc<NewKey>,
    /// Time of the first request.
    since: Timestamp,
    /// Time of the last request.
    requested_at: Timestamp,
    /// Why the last answer has not led to a new certificate.
    refusal: Option<String>,
}

struct AnsweredRequest {
    request: Vec<u8>,
    certificate: Vec<u8>,
}

/// An effect of a message or of a due time.
pub(super) enum RenewalStep {
    /// Send a message to a node, which may be this one.
    Send(NodeName, RenewalMessage),
    /// Send a message to all nodes.
    SendToAll(RenewalMessage),
    /// Work that reads and writes files, for another thread.
    Work(Box<dyn FnOnce() -> RenewalOutcome + Send>),
}

/// Least and most time between two requests for one certificate.
const REQUEST_INTERVALS: [Duration; 2] = [Duration::from_secs(2), Duration::from_secs(60)];

/// Part of a certificate's validity between two requests, within these limits.
const REQUESTS_PER_VALIDITY: u32 = 1000;

/// Time in which a certificate should arrive. Until then a refusal is not shown, because another
/// node may issue one.
const ANSWER_TIME: Duration = Duration::from_secs(5);

/// Messages that a node may send at once, and then one per interval.
const MESSAGES: u32 = 4;
const MESSAGE_INTERVAL: Duration = Duration::from_secs(1);

/// Nodes whose last answer is stored.
const MAX_ANSWERED: usize = 1024;

const NO_HOLDER: &str = "no node that has the key of the cell's CA answers";
const WRONG_CLOCK: &str = "this machine's clock is wrong";

impl Renewals {
    pub(super) fn new(credentials: Arc<Credentials>, name: NodeName) -> Self {
        Self {
            credentials,
            name,
            own: None,
            answered: BTreeMap::new(),
            messages: KeyedThrottle::new(MESSAGES, MESSAGE_INTERVAL),
            in_work: BTreeSet::new(),
            is_replacing: false,
        }
    }

    /// Requests a new certificate when the node's own ends soon. Observers share the certificate
    /// of their node, which requests the new one.
    pub(super) fn check(&mut self, now: Timestamp) -> Option<RenewalStep> {
        let current = self.credentials.current();
        let is_due = current.identity.due_for_renewal(clock::wall()).is_some();
        if *current.identity.name() != self.name {
            return None;
        }
        if !is_due {
            self.own = None;
            self.credentials.set_unrenewed(None);
            return None;
        }
        if self.is_replacing {
            return None;
        }
        if self.credentials.is_clock_wrong() {
            self.own = None;
            self.credentials.set_unrenewed(Some(WRONG_CLOCK.to_owned()));
            return None;
        }
        let whole = current.identity.expires().since(current.identity.begins());
        let [least, most] = REQUEST_INTERVALS;
        let interval = (whole / REQUESTS_PER_VALIDITY).clamp(least, most);
        let request = match &mut self.own {
            Some(pending) => {
                if now.since(pending.since) >= ANSWER_TIME {
                    let reason = pending.refusal.as_deref().unwrap_or(NO_HOLDER);
                    self.credentials.set_unrenewed(Some(reason.to_owned()));
                }
                if now.since(pending.requested_at) < interval {
                    return None;
                }
                pending.requested_at = now;
                pending.key.request.clone()
            }
            none => {
                let pending = none.insert(PendingRenewal {
                    key: Arc::new(NewKey::generate().ok()?),
                    since: now,
                    requested_at: now,
                    refusal: None,
                });
                self.credentials.set_unrenewed(None);
                pending.key.request.clone()
            }
        };
        if self.credentials.authority().is_some() {
            return self.on_request(self.name.clone(), current.certificate(), request);
        }
        Some(RenewalStep::SendToAll(RenewalMessage::Request(request)))
    }

    /// Processes a message of a node that has proven a certificate.
    pub(super) fn on_message(
        &mut self,
        from: NodeName,
        certificate: &[u8],
        message: RenewalMessage,
        now: Timestamp,
    ) -> Option<RenewalStep> {
        if !self.messages.allow(&from, now) {
            return None;
        }
        match message {
            RenewalMessage::Request(request) => self.on_request(from, certificate, request),
            RenewalMessage::Renewed(renewed) => {
                let pending = self.own.as_ref().filter(|_| !self.is_replacing)?;
                if !pending.key.is_in(&renewed) {
                    return None;
                }
                let key = Arc::clone(&pending.key);
                let credentials = Arc::clone(&self.credentials);
                self.is_replacing = true;
                Some(RenewalStep::Work(Box::new(move || {
                    let installed = key.install(&renewed, &credentials);
                    RenewalOutcome::Replaced(installed.map_err(|error| error.to_string()))
                })))
            }
            RenewalMessage::Refused(reason) => {
                if let Some(pending) = &mut self.own {
                    let reason = quoted(&reason);
                    pending.refusal = Some(format!("{from} does not renew it: {reason}"));
                }
                None
            }
        }
    }

    /// Handles the request of a node, or of this node itself, for a renewed certificate. Only a
    /// node that has the key of the CA and a correct clock answers. A repeated request gets the
    /// same certificate again; a request that is being processed is ignored.
    fn on_request(
        &mut self,
        from: NodeName,
        certificate: &[u8],
        request: Vec<u8>,
    ) -> Option<RenewalStep> {
        let is_node = *self.credentials.current().identity.name() == self.name;
        let directory = self.credentials.authority().filter(|_| is_node)?;
        if self.credentials.is_clock_wrong() {
            return None;
        }
        match self.answered.get(&from) {
            Some(before) if before.request == request => {
                let again = RenewalMessage::Renewed(before.certificate.clone());
                return Some(RenewalStep::Send(from, again));
            }
            _ => {}
        }
        if !self.in_work.insert(from.clone()) {
            return None;
        }
        let certificate = certificate.to_vec();
        Some(RenewalStep::Work(Box::new(move || {
            let answer = renew(&directory, &certificate, request.clone());
            RenewalOutcome::Answered {
                to: from,
                request,
                answer,
            }
        })))
    }

    /// Processes the end of work.
    pub(super) fn on_outcome(&mut self, outcome: RenewalOutcome) -> Option<RenewalStep> {
        match &outcome {
            RenewalOutcome::Answered { to, .. } => _ = self.in_work.remove(to),
            RenewalOutcome::Replaced(_) => self.is_replacing = false,
        }
        match outcome {
            RenewalOutcome::Answered {
                to,
                request,
                answer: Ok(renewed),
            } => {
                tracing::info!(node = %to, "certificate renewed");
                if self.answered.len() >= MAX_ANSWERED {
                    self.answered.clear();
                }
                let answered = AnsweredRequest {
                    request,
                    certificate: renewed.clone(),
                };
                self.answered.insert(to.clone(), answered);
                Some(RenewalStep::Send(to, RenewalMessage::Renewed(renewed)))
            }
            RenewalOutcome::Answered {
                to,
                answer: Err(reason),
                ..
            } => {
                tracing::warn!(node = %to, reason, "certificate not renewed");
                Some(RenewalStep::Send(to, RenewalMessage::Refused(reason)))
            }
            RenewalOutcome::Replaced(Ok(())) => {
                tracing::info!("this node's certificate was renewed");
                self.own = None;
                self.credentials.set_unrenewed(None);
                None
            }
            RenewalOutcome::Replaced(Err(reason)) => {
                tracing::debug!(reason, "this node's certificate was not renewed");
                if let Some(pending) = &mut self.own {
                    pending.refusal = Some(reason);
                }
                None
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use ecod::wire::Role;

    use super::*;
    use crate::transport::pki::Authority;

    const DAY: Duration = Duration::from_secs(86_400);
    const EUCLID: NodeName = NodeName::from_static("euclid");
    const GAUSS: NodeName = NodeName::from_static("gauss");
    const NOW: Timestamp = Timestamp(1_000_000_000);

    /// The renewals of `euclid`, whose certificate has one day left, in a directory without the
    /// key of the CA.
    fn renewals(directory: &tempfile::TempDir) -> Renewals {
        let now = clock::wall();
        let cell = NodeName::from_static("lot");
        let mut authority = Authority::init(directory.path(), &cell, now).unwrap();
        authority
            .issue(&EUCLID, Role::Auto, 10 * DAY, now - 9 * DAY)
            .unwrap();
        let files = authority.tls_of(&EUCLID);
        Renewals::new(Credentials::load(&files, &EUCLID).unwrap().into(), EUCLID)
    }

    fn has_asked(step: Option<&RenewalStep>) -> bool {
        matches!(
            step,
            Some(RenewalStep::SendToAll(RenewalMessage::Request(_)))
        )
    }

    #[test]
    fn junk_ignored_and_refusal_shown() {
        let directory = tempfile::tempdir().unwrap();
        let mut renewals = renewals(&directory);
        let credentials = Arc::clone(&renewals.credentials);
        assert!(has_asked(renewals.check(NOW).as_ref()));
        let other = credentials.current().certificate().to_vec();
        for message in [
            RenewalMessage::Renewed(vec![0; 100]),
            RenewalMessage::Renewed(other),
            RenewalMessage::Refused("it was revoked".into()),
        ] {
            assert!(renewals.on_message(GAUSS, &[], message, NOW).is_none());
        }
        _ = renewals.check(NOW + Duration::from_secs(1));
        assert_eq!(credentials.unrenewed(), None);
        _ = renewals.check(NOW + ANSWER_TIME);
        assert_eq!(
            credentials.unrenewed().as_deref(),
            Some("gauss does not renew it: “it was revoked”")
        );
    }

    #[test]
    fn refusal_is_quoted_and_cut() {
        let directory = tempfile::tempdir().unwrap();
        let mut renewals = renewals(&directory);
        let credentials = Arc::clone(&renewals.credentials);
        _ = renewals.check(NOW);
        let reason = format!("{}\u{202E}\n", "é".repeat(118)).repeat(2);
        let message = RenewalMessage::Refused(reason);
        assert!(renewals.on_message(GAUSS, &[], message, NOW).is_none());
        _ = renewals.check(NOW + ANSWER_TIME);
        let shown = format!("gauss does not renew it: “{}  …”", "é".repeat(118));
        assert_eq!(credentials.unrenewed(), Some(shown));
    }

    #[test]
    fn wrong_clock_reported_until_corrected() {
        let directory = tempfile::tempdir().unwrap();
        let mut renewals = renewals(&directory);
        let credentials = Arc::clone(&renewals.credentials);
        credentials.set_clock_wrong(true);
        assert!(renewals.check(NOW).is_none());
        assert_eq!(credentials.unrenewed().as_deref(), Some(WRONG_CLOCK));
        credentials.set_clock_wrong(false);
        assert!(has_asked(renewals.check(NOW).as_ref()));
        assert_eq!(credentials.unrenewed(), None);
    }
}
