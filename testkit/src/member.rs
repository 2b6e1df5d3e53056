//! Memberships of nodes, without the rest of the nodes.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};

use ecod::model::names::NodeName;
use ecod::wire::Role;
use ecod_actors::actors::membership::{Membership, MembershipArguments};
use ecod_actors::messages::membership::MembershipMessage;
use ecod_actors::platform::clock;
use ecod_actors::platform::secret::Secret;
use ecod_actors::transport::gossip::{FrameCounters, MembershipConfig, MembershipEvent};
use ractor::{Actor, ActorRef, call_t};
use tokio::sync::watch;

use crate::config::{loopback, name};

/// A node's membership on real sockets, and its events.
pub struct Member {
    /// Name of the node.
    pub name: NodeName,
    /// Actor that runs the membership.
    pub actor: ActorRef<MembershipMessage>,
    /// Address of the gossip socket.
    pub address: SocketAddr,
    /// All events so far.
    pub events: Arc<Mutex<Vec<MembershipEvent>>>,
    /// All living nodes except this one.
    pub members: watch::Receiver<Vec<ecod_actors::transport::gossip::Member>>,
    /// Counters of its datagrams.
    pub counters: Arc<FrameCounters>,
}

/// A membership on a free port of loopback, without multicast, with the common key of the tests.
pub fn member_config(seeds: &[SocketAddr]) -> MembershipConfig {
    let mut config = MembershipConfig {
        key: Some(Secret::new("5e".repeat(32))),
        bind: Some(loopback()),
        seeds: seeds.iter().map(ToString::to_string).collect(),
        ..MembershipConfig::default()
    };
    config.multicast.enabled = false;
    config
}

impl Member {
    /// Starts a candidate of the cell `lot` without certificates; `adjust` changes its arguments.
    ///
    /// # Panics
    /// Panics if the membership cannot start.
    pub async fn start(
        node: &str,
        config: MembershipConfig,
        adjust: impl FnOnce(&mut MembershipArguments),
    ) -> Self {
        let events = Arc::<Mutex<Vec<_>>>::default();
        let sink = Arc::clone(&events);
        let counters = Arc::<FrameCounters>::default();
        let (sender, members) = watch::channel(Vec::new());
        let mut arguments = MembershipArguments {
            name: name(node),
            cell: NodeName::from_static("lot"),
            run: clock::now().micros(),
            role: Role::Auto,
            broker: None,
            credentials: None,
            config,
            events: Arc::new(move |event| sink.lock().unwrap().push(event)),
            members: sender,
            counters: Arc::clone(&counters),
        };
        adjust(&mut arguments);
        let (actor, _) = Actor::spawn(None, Membership, arguments).await.unwrap();
        let address = call_t!(actor, |reply| MembershipMessage::Address { reply }, 5000).unwrap();
        Self {
            name: name(node),
            actor,
            address,
            events,
            members,
            counters,
        }
    }
}
