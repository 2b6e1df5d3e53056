//! Evidence of a side whose leader is gone.

use tokio::sync::mpsc;

use super::super::*;
use super::member;
use crate::messages::actor_slot::listening;
use crate::messages::leadership::Leadership;
use crate::platform::clock;

fn candidates() -> Vec<Member> {
    ["a", "b1", "b2", "leader", "other"].map(|node| member(node, Role::Auto)).to_vec()
}

/// A keeper, and what it publishes.
struct Keeper {
    state: ReputationKeeperState,
    published: mpsc::UnboundedReceiver<GatewayMessage>,
}

impl Keeper {
    async fn new(name: &'static str) -> Self {
        let (gateway, published) = listening::slot().await;
        let arguments = ReputationKeeperArguments {
            name: NodeName::from_static(name),
            cell: NodeName::from_static("lot-1"),
            reputation: ReputationConfig::default(),
            config: ReputationKeeperConfig::default(),
            book: SharedBook::new(true),
            file: None,
            newest: watch::channel(None).1,
            members: watch::channel(candidates()).1,
            leadership: watch::channel(Leadership::default()).1,
            term: watch::channel(u64::MAX).1,
            gateway,
            fuser: ActorSlot::default(),
            counters: Arc::default(),
        };
        Self { state: ReputationKeeperState::new(arguments), published }
    }

    fn name(&self) -> NodeName {
        self.state.arguments.name.clone()
    }

    fn lead(&mut self, term: u64) {
        self.state.lead(Epoch::new(term, self.name()), 0);
    }

    fn record(&mut self, term: u64, vehicle: &'static str) {
        let evidence = Evidence { node: NodeName::from_static(vehicle), label: "ABC123".into(), correct: true };
        self.state.record(Epoch::new(term, self.name()), 1, &[evidence], None);
    }

    /// Lets a share period pass and hands over what was shared since the last time; so much that nothing is on its way.
    async fn share_with(&mut self, other: &mut Self) {
        for _ in 0..self.state.arguments.config.ticks_per_snapshot() {
            self.state.tick().await;
        }
        self.hand_over(Some(other)).await;
    }

    /// Lets so much time pass that what the leader has not shared is sent.
    async fn listen_out(&mut self) {
        for _ in 0..2 * self.state.arguments.config.ticks_per_snapshot() {
            self.state.tick().await;
        }
    }

    async fn hand_over(&mut self, mut to: Option<&mut Self>) {
        // The wire has taken what was sent before this.
        self.state.publish_share(&[], &[]);
        loop {
            let share = self.next_share().await;
            let is_last = share.entries.is_empty() && share.marks.is_empty() && self.published.is_empty();
            if let Some(other) = &mut to {
                other.state.merge(&Delivery::local(Incoming::Ledger(Arc::new(share)), clock::now()));
            }
            if is_last {
                return;
            }
        }
    }

    async fn next_share(&mut self) -> LedgerShare {
        loop {
            if let GatewayMessage::PublishShare { share } = self.published.recv().await.unwrap() {
                return share;
            }
        }
    }

    fn vehicles(&self) -> Vec<String> {
        self.state.evidence().0.iter().map(|entry| entry.node.to_string()).collect()
    }
}

#[tokio::test]
async fn what_a_leader_learnt_that_died_during_a_split_reaches_the_leader_that_remains() {
    let (mut a, mut b1, mut b2) = (Keeper::new("a").await, Keeper::new("b1").await, Keeper::new("b2").await);
    a.lead(1);
    b1.lead(2);
    b1.record(2, "euclid");
    b1.share_with(&mut b2).await;
    drop(b1);
    b2.lead(3);
    // What the loser sends when the sides heal is lost: it is not yet linked to the winner's broker.
    b2.state.leads = None;
    b2.state.send_snapshot();
    b2.hand_over(None).await;
    a.lead(4);
    assert_eq!(a.vehicles(), [""; 0]);
    a.share_with(&mut b2).await;
    b2.hand_over(Some(&mut a)).await;
    assert_eq!(a.vehicles(), ["euclid"]);
}

#[tokio::test]
async fn what_only_followers_know_of_a_leader_that_is_gone_reaches_the_next() {
    let (mut a, mut b1, mut b2) = (Keeper::new("a").await, Keeper::new("b1").await, Keeper::new("b2").await);
    b1.lead(2);
    b1.record(2, "euclid");
    b1.share_with(&mut b2).await;
    drop(b1);
    a.lead(3);
    a.record(3, "gauss");
    a.share_with(&mut b2).await;
    b2.listen_out().await;
    b2.hand_over(Some(&mut a)).await;
    assert_eq!(a.vehicles(), ["euclid", "gauss"]);
    a.share_with(&mut b2).await;
    b2.listen_out().await;
    b2.state.publish_share(&[], &[]);
    assert_eq!(b2.next_share().await.entries, [], "once the leader has it, nothing more comes");
}

#[tokio::test]
async fn who_never_led_is_silent_when_it_hears_a_leader() {
    let (mut leader, mut other) = (Keeper::new("leader").await, Keeper::new("other").await);
    leader.lead(1);
    leader.record(1, "euclid");
    leader.share_with(&mut other).await;
    assert_eq!(other.vehicles(), ["euclid"]);
    other.listen_out().await;
    other.state.publish_share(&[], &[]);
    assert_eq!(other.next_share().await.entries, [], "nothing came before");
}
