//! Evidence of others: what it costs, and where it goes.

use std::net::{Ipv4Addr, SocketAddr};

use ecod::leadership::Position;
use ecod::model::time::Timestamp;
use ecod::wire::LedgerEntry;

use super::*;
use crate::messages::actor_slot::listening;

fn name(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

fn member(node: &str, role: Role) -> Member {
    Member { name: name(node), run: 1, gossip: SocketAddr::from((Ipv4Addr::LOCALHOST, 1)), broker: None, role }
}

fn counted(epoch: u64, aggregator: &str) -> LedgerEntry {
    let (aggregator, node, label) = (name(aggregator), name("gauss"), "cup".into());
    LedgerEntry { epoch, aggregator, node, label, correct: 0, incorrect: 1 }
}

fn share(from: &str, leads: Option<u64>, entries: Vec<LedgerEntry>) -> Delivery<Arc<LedgerShare>> {
    let share = LedgerShare { schema: SCHEMA_VERSION, node: name(from), epoch: leads, entries, marks: Vec::new() };
    Delivery::local(Arc::new(share), Timestamp(0))
}

#[tokio::test]
async fn evidence_of_others_is_judged_counted_and_answered() {
    let (gateway, mut published) = listening::slot().await;
    let members = [("edge", Role::Edge), ("mallory", Role::Cav)].map(|(node, role)| member(node, role)).to_vec();
    let epoch = Some(Epoch::new(7, name("edge")));
    let leadership = Leadership { position: Position::Following, epoch, standby: None, term: 7 };
    let counters = Arc::<Counters>::default();
    let mut keeper = ReputationKeeperState::new(ReputationKeeperArguments {
        name: name("euclid"),
        cell: name("lot"),
        reputation: ReputationConfig::default(),
        config: ReputationKeeperConfig::default(),
        reputations: SharedReputations::new(true),
        file: None,
        newest: watch::channel(None).1,
        members: watch::channel(members).1,
        leadership: watch::channel(leadership).1,
        gateway: gateway.clone(),
        fuser: ActorSlot::default(),
        counters: Arc::clone(&counters),
    });
    let own = Evidence { node: name("gauss"), label: "cup".into(), correct: true };
    keeper.arguments.reputations.open().ledger.record(3, &name("euclid"), &own);

    keeper.merge(&share("mallory", None, vec![counted(7, "mallory")]));
    keeper.merge(&share("edge", Some(7), vec![counted(7, "edge"), counted(8, "edge")]));
    assert_eq!(counters.rejects(RejectReason::NotCandidate), 1);
    assert_eq!(counters.rejects(RejectReason::UnknownTerm), 1);
    assert_eq!(counters.events(Event::LedgerMerged), 1);
    assert_eq!(keeper.arguments.reputations.open().ledger.totals()[&name("gauss")], (1, 1));
    assert!(keeper.unsaved && keeper.unadopted);

    gateway.get().unwrap().drain_and_wait(None).await.unwrap();
    let Ok(GatewayMessage::PublishShare { share }) = published.try_recv() else { panic!("the leader is told") };
    assert_eq!(share.entries.len(), 2, "a node that has led tells a new leader all it knows");
}
