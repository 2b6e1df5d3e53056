//! Non-blocking queries of a node's parts.

use std::time::Duration;

use ecod::leadership::health::HealthSample;
use ecod::leadership::node::Input;
use ecod::leadership::timers::ANSWER_STEPS;
use ractor::{ActorRef, ActorStatus};

use super::Parts;
use crate::messages::broker::BrokerMessage;
use crate::messages::fuser::FuserMessage;
use crate::messages::gateway::GatewayMessage;
use crate::messages::leader_election::LeaderElectionMessage;
use crate::platform::clock;
use crate::transport::broker::BrokerHealth;
use crate::transport::pki::Credentials;

/// Time before the end of the node's certificate in which another candidate should lead: far more
/// than a handover takes and clocks of a cell differ.
const CERTIFICATE_MARGIN: Duration = Duration::from_secs(60);

/// True if a certificate ends within [`CERTIFICATE_MARGIN`].
pub(super) fn ends_soon(credentials: &Credentials) -> bool {
    let expires = credentials.current().identity.expires();
    clock::wall() + CERTIFICATE_MARGIN > expires
}

/// Queries broker, gateway and fuser, and sends their answers to the election.
pub(super) fn ask_parts(
    parts: &Parts,
    certificate_ends: bool,
    election: ActorRef<LeaderElectionMessage>,
) {
    let broker = parts.broker.clone();
    let gateway = parts.gateway.clone();
    let fuser = parts.fuser.clone();
    let fuser_runs = parts
        .fuser
        .get()
        .is_some_and(|fuser| fuser.get_status() == ActorStatus::Running);
    let contradicts = parts.shared.borrow().contradicts;
    tokio::spawn(async move {
        let (health, links, timeliness) = tokio::join!(
            broker.ask(|reply| BrokerMessage::Health { reply }, ANSWER_STEPS),
            gateway.ask(|reply| GatewayMessage::Links { reply }, ANSWER_STEPS),
            fuser.ask(|reply| FuserMessage::Timeliness { reply }, ANSWER_STEPS),
        );
        let rejects_reports = timeliness.is_some_and(|timeliness| !timeliness.is_usable());
        let broker_serves = matches!(health, Some(BrokerHealth::Serving(_)));
        let sample = HealthSample {
            broker_serves,
            links,
            fuser_runs,
            rejects_reports,
            contradicts,
            certificate_ends,
        };
        let input = Input::PartsAnswered { sample };
        if election
            .cast(LeaderElectionMessage::Record { input })
            .is_err()
        {
            tracing::debug!("the election ended before its parts answered");
        }
    });
}

/// The load of the last minute on all processors, 0 to 100 %; `None` if the system does not provide
/// it.
pub(super) fn load_percent() -> Option<u8> {
    let text = std::fs::read_to_string("/proc/loadavg").ok()?;
    let load: f64 = text.split_whitespace().next()?.parse().ok()?;
    let processors = std::thread::available_parallelism().ok()?.get() as f64;
    Some((load / processors * 100.0).clamp(0.0, 100.0) as u8)
}
