//! Evidence of others: whose is taken, and what it costs.

mod healing;

use std::net::{Ipv4Addr, SocketAddr};

use ecod::reputation::MAX_LANES;
use tokio::sync::mpsc;

use super::*;
use crate::messages::actor_slot::listening;
use crate::messages::leadership::Position;

fn name(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

fn member(node: &str, role: Role) -> Member {
    Member { name: name(node), run: 1, gossip: SocketAddr::from((Ipv4Addr::LOCALHOST, 1)), broker: None, role }
}

/// The keeper of `euclid`, which follows `edge` in term 7 and has led before.
struct Scene {
    keeper: ReputationKeeperState,
    counters: Arc<Counters>,
    published: mpsc::UnboundedReceiver<GatewayMessage>,
}

impl Scene {
    async fn new() -> Self {
        let (gateway, published) = listening::slot().await;
        let roles = [("edge", Role::Edge), ("gauss", Role::Auto), ("mallory", Role::Cav)];
        let members = roles.map(|(node, role)| member(node, role)).to_vec();
        let epoch = Some(Epoch::new(7, name("edge")));
        let leadership = Leadership { position: Position::Following, epoch, standby: None };
        let counters = Arc::<Counters>::default();
        let keeper = ReputationKeeperState::new(ReputationKeeperArguments {
            name: name("euclid"),
            cell: name("lot"),
            reputation: ReputationConfig::default(),
            config: ReputationKeeperConfig::default(),
            book: SharedBook::new(true),
            file: None,
            newest: watch::channel(None).1,
            members: watch::channel(members).1,
            leadership: watch::channel(leadership).1,
            term: watch::channel(7).1,
            gateway,
            fuser: ActorSlot::default(),
            counters: Arc::clone(&counters),
        });
        let own = Evidence { node: name("gauss"), label: "cup".into(), correct: true };
        keeper.arguments.book.open().ledger.record(3, &name("euclid"), &own);
        Self { keeper, counters, published }
    }

    fn hear(&mut self, from: &str, leads: Option<u64>, entries: Vec<LedgerEntry>, at_ms: u64) {
        let share = LedgerShare { schema: SCHEMA_VERSION, node: name(from), epoch: leads, entries, marks: Vec::new() };
        let at = Timestamp(at_ms * 1000);
        self.keeper.merge(&Delivery::local(Incoming::Ledger(Arc::new(share)), at));
    }

    fn incorrect(&self, vehicle: &str) -> u64 {
        self.keeper.arguments.book.open().ledger.totals().get(&name(vehicle)).map_or(0, |(_, incorrect)| *incorrect)
    }
}

fn slander(epoch: u64, aggregator: &str, incorrect: u64) -> LedgerEntry {
    let (aggregator, node, label) = (name(aggregator), name("gauss"), "cup".into());
    LedgerEntry { epoch, aggregator, node, label, correct: 0, incorrect }
}

#[tokio::test]
async fn evidence_of_vehicles_strangers_and_later_terms_is_refused_and_counted() {
    let mut scene = Scene::new().await;
    scene.hear("mallory", None, vec![slander(7, "mallory", 1000)], 0);
    scene.hear("stranger", None, vec![slander(7, "stranger", 1000)], 0);
    assert_eq!((scene.incorrect("gauss"), scene.counters.rejects(RejectReason::NotCandidate)), (0, 2));

    scene.hear("edge", Some(7), vec![slander(7, "edge", 1), slander(8, "edge", 1000)], 0);
    assert_eq!((scene.incorrect("gauss"), scene.counters.rejects(RejectReason::UnknownTerm)), (1, 1));
    assert_eq!(scene.counters.events(Event::LedgerMerged), 1);
}

#[tokio::test]
async fn a_candidate_that_invents_lanes_does_not_displace_the_leaders() {
    let mut scene = Scene::new().await;
    let forged = (0..2 * MAX_LANES).map(|n| slander(7, &format!("forger{n:03}"), 0)).collect();
    scene.hear("gauss", None, forged, 0);
    scene.hear("edge", Some(7), vec![slander(7, "edge", 1)], 0);
    assert_eq!(scene.incorrect("gauss"), 1);
}

#[tokio::test]
async fn leaders_that_change_with_every_share_are_not_answered_each_time() {
    let mut scene = Scene::new().await;
    for at_ms in 0..1000 {
        scene.hear("gauss", Some(1 + at_ms % 7), Vec::new(), at_ms);
    }
    scene.hear("gauss", Some(u64::MAX), Vec::new(), 1000);
    scene.hear("edge", Some(7), Vec::new(), 6000);
    scene.hear("edge", Some(7), Vec::new(), 20_000);
    scene.keeper.arguments.gateway.get().unwrap().drain_and_wait(None).await.unwrap();
    let share = |message| match message {
        GatewayMessage::PublishShare { share } => Some(share),
        _ => None,
    };
    let sent: Vec<_> = std::iter::from_fn(|| scene.published.try_recv().ok()).filter_map(share).collect();
    assert_eq!(sent.len(), 2, "at once, and when some time has passed");
    assert!(sent.iter().flat_map(|share| &share.entries).all(|entry| entry.aggregator == name("euclid")));
}
