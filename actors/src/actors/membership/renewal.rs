//! Renewal of certificates over the membership: of the node's own, and of other nodes' where the
//! key of the cell's CA is at hand.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;

use crate::messages::membership::RenewalOutcome;
use crate::platform::clock;
use crate::platform::throttle::KeyedThrottle;
use crate::transport::pki::{Credentials, NewKey, RenewalMessage, renew};

/// Renewals of one node. It decides what to send and what to do beside the membership, whose task
/// must not wait for disks.
pub(super) struct Renewals {
    credentials: Arc<Credentials>,
    /// Name of this member: the node's, or an observer's.
    name: NodeName,
    /// The node's next key, and when a certificate for it was last requested.
    own: Option<(Arc<NewKey>, Timestamp)>,
    /// The last request of each node that was answered by a certificate, and that certificate.
    answered: BTreeMap<NodeName, (Vec<u8>, Vec<u8>)>,
    requests: KeyedThrottle<NodeName>,
    /// Nodes whose requests are being decided.
    in_work: BTreeSet<NodeName>,
    /// True while this node's own files are being replaced.
    is_replacing: bool,
}

/// What follows from a message or from the time.
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

/// Time in which a request should be answered.
const ANSWER_TIME: Duration = Duration::from_secs(5);

/// Requests that a node may send at once, and then one per interval.
const REQUESTS: u32 = 4;
const REQUEST_INTERVAL: Duration = Duration::from_secs(1);

/// Nodes whose last answer is stored.
const MAX_ANSWERED: usize = 1024;

/// Most bytes of another node's reason that are shown.
const MAX_REASON: usize = 120;

const NO_HOLDER: &str = "no node that has the key of the cell's CA answers";

impl Renewals {
    pub(super) fn new(credentials: Arc<Credentials>, name: NodeName) -> Self {
        Self {
            credentials,
            name,
            own: None,
            answered: BTreeMap::new(),
            requests: KeyedThrottle::new(REQUESTS, REQUEST_INTERVAL),
            in_work: BTreeSet::new(),
            is_replacing: false,
        }
    }

    /// Requests a new certificate when the node's own ends soon. Observers share their node's
    /// certificate and leave that to the node.
    pub(super) fn check(&mut self, now: Timestamp) -> Option<RenewalStep> {
        let current = self.credentials.current();
        let is_due = current.identity.due_for_renewal(clock::wall()).is_some();
        if !is_due || *current.identity.name() != self.name {
            if self.own.take().is_some() {
                self.credentials.set_unrenewed(None);
            }
            return None;
        }
        let whole = current.identity.expires().since(current.identity.begins());
        let [least, most] = REQUEST_INTERVALS;
        let interval = (whole / REQUESTS_PER_VALIDITY).clamp(least, most);
        if let Some((_, requested_at)) = &self.own {
            let waited = now.since(*requested_at);
            if waited >= ANSWER_TIME && self.credentials.unrenewed().is_none() {
                self.credentials.set_unrenewed(Some(NO_HOLDER.to_owned()));
            }
            if waited < interval {
                return None;
            }
        }
        if self.is_replacing || self.credentials.is_clock_wrong() {
            return None;
        }
        let key = match self.own.take() {
            Some((key, _)) => key,
            None => Arc::new(NewKey::generate().ok()?),
        };
        self.own = Some((Arc::clone(&key), now));
        let request = key.request.clone();
        if self.credentials.authority().is_some() {
            return self.on_request(self.name.clone(), current.certificate(), request, now);
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
        match message {
            RenewalMessage::Request(request) => self.on_request(from, certificate, request, now),
            RenewalMessage::Renewed(renewed) => {
                let (key, _) = self.own.as_ref().filter(|_| !self.is_replacing)?;
                let (key, credentials) = (Arc::clone(key), Arc::clone(&self.credentials));
                self.is_replacing = true;
                Some(RenewalStep::Work(Box::new(move || {
                    let installed = key.install(&renewed, &credentials);
                    RenewalOutcome::Replaced(installed.map_err(|error| error.to_string()))
                })))
            }
            RenewalMessage::Refused(mut reason) => {
                if self.own.is_some() {
                    reason.truncate(reason.floor_char_boundary(MAX_REASON));
                    self.credentials
                        .set_unrenewed(Some(format!("{from} does not renew it: {reason}")));
                }
                None
            }
        }
    }

    fn on_request(
        &mut self,
        from: NodeName,
        certificate: &[u8],
        request: Vec<u8>,
        now: Timestamp,
    ) -> Option<RenewalStep> {
        let is_node = *self.credentials.current().identity.name() == self.name;
        let directory = self.credentials.authority().filter(|_| is_node)?;
        if !self.requests.allow(&from, now) || self.credentials.is_clock_wrong() {
            return None;
        }
        match self.answered.get(&from) {
            Some((before, renewed)) if *before == request => {
                let again = RenewalMessage::Renewed(renewed.clone());
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
                self.answered.insert(to.clone(), (request, renewed.clone()));
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
                self.credentials.set_unrenewed(Some(reason));
                None
            }
        }
    }
}
