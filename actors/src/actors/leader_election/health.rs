//! Whether a node's parts are fit to lead.

use std::collections::BTreeMap;
use std::time::Duration;

use ecod::election::{Clock, Health};
use ecod::time::Timestamp;
use ractor::rpc::CallResult;
use ractor::{ActorRef, ActorStatus, Message, RpcReplyPort};
use tokio::time::timeout;

use super::routes::Brokers;
use super::{HEALTH_PERIOD, Parts};
use crate::messages::actor_slot::ActorSlot;
use crate::messages::broker::BrokerMessage;
use crate::messages::gateway::GatewayMessage;
use crate::messages::leader_election::{HealthSample, LeaderElectionMessage};
use crate::telemetry::counters::{Counters, Event};
use crate::transport::broker::BrokerHealth;
use crate::transport::mqtt::{BrokerAddress, DataPlane, LinkState};

/// What was last heard of the parts.
#[derive(Debug)]
pub(super) struct HealthMonitor {
    links: BTreeMap<BrokerAddress, LinkState>,
    probe: HealthSample,
    /// Time that passed while this node was awake.
    clock: Clock,
    rounds: u64,
    round_closed_at: Option<Timestamp>,
    load_percent: u8,
}

/// How long a part may take to answer: so many steps, of which a stop of the whole node takes up but one.
const ANSWER_STEP: Duration = Duration::from_millis(100);
const ANSWER_STEPS: usize = 10;

/// A look at the parts that comes later than this was held up with the node.
const TOLERANCE: Duration = Duration::from_millis(500);

/// How long a fuser may close no round, a few periods aside.
const ROUND_PATIENCE: Duration = Duration::from_secs(2);

impl HealthMonitor {
    /// Nothing is known yet.
    pub(super) fn new(now: Timestamp) -> Self {
        let clock = Clock::new(now, TOLERANCE);
        let (links, probe) = (BTreeMap::new(), HealthSample::default());
        Self { links, probe, round_closed_at: None, clock, rounds: 0, load_percent: 0 }
    }

    /// Notes a link; true when an established one has broken and nothing listens there any more.
    pub(super) fn note_link(&mut self, broker: &BrokerAddress, state: LinkState) -> bool {
        match state {
            // Whether nothing listens there is not known yet.
            LinkState::Down | LinkState::Stalled => {
                self.links.entry(broker.clone()).and_modify(|known| *known = state);
                false
            }
            LinkState::Up => {
                self.links.insert(broker.clone(), state);
                false
            }
            LinkState::Refused => self.links.remove(broker).is_some(),
        }
    }

    /// Forgets all links: the gateway makes them anew.
    pub(super) fn forget_links(&mut self) {
        self.links.clear();
    }

    /// Notes the answers. They make up for a link that came up before there was anyone to be told.
    pub(super) fn note_probe(&mut self, probe: HealthSample) {
        for (broker, state) in probe.links.iter().flatten() {
            match state {
                LinkState::Up | LinkState::Stalled => {
                    self.links.insert(broker.clone(), *state);
                }
                // That it is refused is news of its own, which may still be under way.
                LinkState::Down | LinkState::Refused => {
                    self.links.entry(broker.clone()).and_modify(|known| *known = LinkState::Down);
                }
            }
        }
        self.probe = probe;
    }

    /// Looks at what can be seen without asking; to be called every [`HEALTH_PERIOD`].
    pub(super) fn look(&mut self, counters: &Counters, now: Timestamp) {
        let due = self.clock.now() + HEALTH_PERIOD;
        let now = self.clock.advance(now, due);
        let rounds = counters.events(Event::RoundDue);
        if rounds != self.rounds {
            self.rounds = rounds;
            self.round_closed_at = Some(now);
        }
        self.load_percent = load_percent().unwrap_or(0);
    }

    /// The parts as the election wants to know them. A node that uses an external broker, its own, or both, needs one
    /// of them. A stalled link is none, but in a leader with `no_other` to lead, which would only make way for nobody.
    pub(super) fn health(&self, plane: &DataPlane, brokers: &Brokers, no_other: bool, period: Duration) -> Health {
        let external = self.is_up(plane.external.as_ref(), no_other);
        let embedded = plane.embedded && self.probe.broker_serves;
        let patience = ROUND_PATIENCE + 3 * period;
        let closes_rounds = self.round_closed_at.is_some_and(|at| self.clock.now().since(at) < patience);
        Health {
            broker: external || embedded,
            fuser: self.probe.fuser_runs && closes_rounds,
            gateway: self.probe.links.is_some()
                && (external || (embedded && self.is_up(brokers.own.as_ref(), no_other))),
            load_percent: self.load_percent,
        }
    }

    /// Whether members on other machines are reached: by the node's own broker, unless it is `private` to this machine,
    /// or by an external one for as long as there is a link to it.
    pub(super) fn reaches_others(&self, plane: &DataPlane, private: bool, no_other: bool) -> bool {
        !private || self.is_up(plane.external.as_ref(), no_other)
    }

    fn is_up(&self, broker: Option<&BrokerAddress>, no_other: bool) -> bool {
        match broker.and_then(|broker| self.links.get(broker)) {
            Some(LinkState::Up) => true,
            Some(LinkState::Stalled) => no_other,
            Some(LinkState::Down | LinkState::Refused) | None => false,
        }
    }
}

/// Asks the parts how they are, without waiting, and tells the election.
pub(super) fn probe(parts: &Parts, election: ActorRef<LeaderElectionMessage>) {
    let (broker, gateway) = (parts.broker.clone(), parts.gateway.clone());
    let fuser_runs = parts.fuser.get().is_some_and(|fuser| fuser.get_status() == ActorStatus::Running);
    tokio::spawn(async move {
        let (health, links) = tokio::join!(
            ask(&broker, |reply| BrokerMessage::Health { reply }),
            ask(&gateway, |reply| GatewayMessage::Links { reply }),
        );
        let broker_serves = matches!(health, Some(BrokerHealth::Serving(_)));
        let sample = HealthSample { broker_serves, links, fuser_runs };
        if election.cast(LeaderElectionMessage::NoteHealth { sample }).is_err() {
            tracing::debug!("the election ended before its parts answered");
        }
    });
}

async fn ask<M: Message, T: Send + 'static>(
    slot: &ActorSlot<M>,
    question: impl FnOnce(RpcReplyPort<T>) -> M,
) -> Option<T> {
    let holder = slot.get()?;
    let answer = holder.call(question, None);
    tokio::pin!(answer);
    for _ in 0..ANSWER_STEPS {
        if let Ok(answered) = timeout(ANSWER_STEP, &mut answer).await {
            return match answered.ok()? {
                CallResult::Success(value) => Some(value),
                CallResult::Timeout | CallResult::SenderError => None,
            };
        }
    }
    None
}

/// The load of the last minute on all processors, 0 to 100 %; nothing where the system does not tell.
fn load_percent() -> Option<u8> {
    let text = std::fs::read_to_string("/proc/loadavg").ok()?;
    let load: f64 = text.split_whitespace().next()?.parse().ok()?;
    let processors = std::thread::available_parallelism().ok()?.get() as f64;
    Some((load / processors * 100.0).clamp(0.0, 100.0) as u8)
}

#[cfg(test)]
mod tests {
    use ractor::{Actor, ActorProcessingErr};

    use super::*;

    const PERIOD: Duration = Duration::from_millis(100);

    fn address(port: u16) -> BrokerAddress {
        format!("127.0.0.1:{port}").parse().unwrap()
    }

    fn monitor(counters: &Counters, now: Timestamp) -> HealthMonitor {
        let mut monitor = HealthMonitor::new(now);
        monitor.note_probe(HealthSample { broker_serves: true, links: Some(BTreeMap::new()), fuser_runs: true });
        counters.count(Event::RoundDue);
        monitor.look(counters, now);
        monitor
    }

    #[test]
    fn only_an_established_link_that_broke_proves_its_process_gone() {
        let mut monitor = HealthMonitor::new(Timestamp(0));
        let broker = address(1);
        assert!(!monitor.note_link(&broker, LinkState::Refused), "never reached");
        assert!(!monitor.note_link(&broker, LinkState::Up));
        assert!(!monitor.note_link(&broker, LinkState::Down));
        assert!(monitor.note_link(&broker, LinkState::Refused));
        assert!(!monitor.note_link(&broker, LinkState::Refused), "told once");
    }

    #[test]
    fn a_node_is_fit_while_broker_link_and_rounds_work() {
        let now = Timestamp(60_000_000);
        let counters = Counters::default();
        let mut monitor = monitor(&counters, now);
        let plane = DataPlane { external: None, embedded: true };
        let brokers = Brokers { own: Some(address(1)), ..Brokers::default() };
        assert!(!monitor.health(&plane, &brokers, false, PERIOD).is_fit(), "no link to its own broker yet");
        monitor.note_link(&address(1), LinkState::Up);
        assert!(monitor.health(&plane, &brokers, false, PERIOD).is_fit());
        for looks in 1..=12 {
            monitor.look(&counters, now + HEALTH_PERIOD * looks);
        }
        assert!(!monitor.health(&plane, &brokers, false, PERIOD).fuser, "no rounds");
        monitor.note_link(&address(1), LinkState::Down);
        assert!(!monitor.health(&plane, &brokers, false, PERIOD).gateway);
    }

    #[test]
    fn a_node_that_was_stopped_does_not_blame_its_fuser() {
        let now = Timestamp(60_000_000);
        let counters = Counters::default();
        let mut monitor = monitor(&counters, now);
        let fuser = |monitor: &HealthMonitor| {
            let plane = DataPlane { external: None, embedded: true };
            monitor.health(&plane, &Brokers::default(), false, PERIOD).fuser
        };
        monitor.look(&counters, now + Duration::from_secs(10));
        assert!(fuser(&monitor), "the look may come before the fuser's next round");
        let after = |ms| now + Duration::from_secs(10) + Duration::from_millis(ms);
        (1..=8).for_each(|looks| monitor.look(&counters, after(250 * looks)));
        assert!(!fuser(&monitor), "the fuser had its time");
        counters.count(Event::RoundDue);
        monitor.look(&counters, after(2250));
        assert!(fuser(&monitor));
    }

    /// Answers a moment after the whole process was stopped.
    struct Held;

    impl Actor for Held {
        type Msg = BrokerMessage;
        type State = ();
        type Arguments = ();

        async fn pre_start(&self, _: ActorRef<BrokerMessage>, (): ()) -> Result<(), ActorProcessingErr> {
            Ok(())
        }

        async fn handle(
            &self,
            _: ActorRef<BrokerMessage>,
            message: BrokerMessage,
            (): &mut (),
        ) -> Result<(), ActorProcessingErr> {
            let BrokerMessage::Health { reply } = message else { return Ok(()) };
            // On a runtime of one thread nothing else goes on either.
            std::thread::sleep(Duration::from_millis(1500));
            tokio::time::sleep(Duration::from_millis(20)).await;
            reply.send(BrokerHealth::Stopped)?;
            Ok(())
        }
    }

    #[tokio::test]
    async fn a_part_that_was_stopped_with_the_node_is_still_waited_for() {
        let slot = ActorSlot::default();
        let (actor, _) = Actor::spawn(None, Held, ()).await.unwrap();
        slot.set(actor);
        assert_eq!(ask(&slot, |reply| BrokerMessage::Health { reply }).await, Some(BrokerHealth::Stopped));
    }

    #[test]
    fn a_link_that_came_up_unnoticed_is_found_by_asking() {
        let now = Timestamp(60_000_000);
        let mut monitor = monitor(&Counters::default(), now);
        let plane = DataPlane { external: None, embedded: true };
        let brokers = Brokers { own: Some(address(1)), ..Brokers::default() };
        let links = |state| Some(BTreeMap::from([(address(1), state)]));
        let probe = |state| HealthSample { broker_serves: true, links: links(state), fuser_runs: true };
        monitor.note_probe(probe(LinkState::Up));
        assert!(monitor.health(&plane, &brokers, false, PERIOD).is_fit());
        monitor.note_probe(probe(LinkState::Down));
        assert!(!monitor.health(&plane, &brokers, false, PERIOD).is_fit());
        assert!(monitor.note_link(&address(1), LinkState::Refused), "its end is still news");
    }

    #[test]
    fn a_broker_that_passes_nothing_on_is_none_unless_nobody_else_could_lead() {
        let now = Timestamp(60_000_000);
        let mut monitor = monitor(&Counters::default(), now);
        let brokers = Brokers { own: Some(address(1)), ..Brokers::default() };
        monitor.note_link(&address(1), LinkState::Up);
        let fit = |monitor: &HealthMonitor, no_other| {
            let plane = DataPlane { external: None, embedded: true };
            monitor.health(&plane, &brokers, no_other, PERIOD).is_fit()
        };
        assert!(fit(&monitor, false));
        assert!(!monitor.note_link(&address(1), LinkState::Stalled));
        assert_eq!((fit(&monitor, false), fit(&monitor, true)), (false, true));
        monitor.note_link(&address(1), LinkState::Down);
        assert!(!fit(&monitor, true));
        monitor.note_link(&address(1), LinkState::Stalled);
        assert!(monitor.note_link(&address(1), LinkState::Refused), "its end is still news");
    }

    #[test]
    fn an_external_broker_makes_up_for_a_private_one_only_while_it_is_there() {
        let mut monitor = HealthMonitor::new(Timestamp(0));
        let plane = DataPlane { external: Some(address(9)), embedded: true };
        let reaches = |monitor: &HealthMonitor, private| monitor.reaches_others(&plane, private, false);
        assert_eq!((reaches(&monitor, true), reaches(&monitor, false)), (false, true), "never reached");
        for (state, reached) in [(LinkState::Up, true), (LinkState::Stalled, false), (LinkState::Down, false)] {
            monitor.note_link(&address(9), state);
            assert_eq!(reaches(&monitor, true), reached, "{state:?}");
        }
    }

    #[test]
    fn with_an_external_broker_its_link_counts_and_with_both_either() {
        let now = Timestamp(60_000_000);
        let counters = Counters::default();
        let mut monitor = monitor(&counters, now);
        let brokers = Brokers { own: Some(address(1)), ..Brokers::default() };
        monitor.note_link(&address(1), LinkState::Up);
        let fit = |monitor: &HealthMonitor, embedded| {
            let plane = DataPlane { external: Some(address(9)), embedded };
            monitor.health(&plane, &brokers, false, PERIOD).is_fit()
        };
        assert!(!fit(&monitor, false));
        assert!(fit(&monitor, true), "falls back to its own");
        monitor.note_link(&address(9), LinkState::Up);
        assert!(fit(&monitor, false));
    }
}
