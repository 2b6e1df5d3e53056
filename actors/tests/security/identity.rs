//! Memberships that prove certificates, on real sockets: a holder of the key alone, or a revoked node, is no member.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ecod::wire::Role;
use ecod_actors::actors::membership::{Membership, MembershipArguments};
use ecod_actors::messages::membership::MembershipMessage;
use ecod_actors::platform::clock;
use ecod_actors::platform::secret::Secret;
use ecod_actors::transport::gossip::{
    FrameCounters, FrameEvent, Member, MembershipConfig, MembershipEvent,
};
use ecod_actors::transport::pki::{Credentials, TlsConfig};
use ractor::{Actor, ActorRef, call_t};
use tokio::sync::watch;
use tokio::time::{Instant, sleep};

use crate::fixture::{DAY, GONE_WITHIN, Pki, SOON, node};

struct Node {
    actor: ActorRef<MembershipMessage>,
    address: SocketAddr,
    events: Arc<Mutex<Vec<MembershipEvent>>>,
    counters: Arc<FrameCounters>,
    members: watch::Receiver<Vec<Member>>,
}

impl Node {
    async fn start(name: &str, files: Option<&TlsConfig>, seed: Option<SocketAddr>) -> Self {
        let mut config = MembershipConfig {
            key: Some(Secret::new("5e".repeat(32))),
            bind: Some(SocketAddr::from((Ipv4Addr::LOCALHOST, 0))),
            seeds: seed.iter().map(ToString::to_string).collect(),
            // Patient, as the machine that runs this may be busy.
            probe_ms: 200,
            reply_ms: 80,
            suspect_ms: 600,
            ..MembershipConfig::default()
        };
        config.multicast.enabled = false;
        let (events, counters) = (
            Arc::<Mutex<Vec<_>>>::default(),
            Arc::<FrameCounters>::default(),
        );
        let (sink, (sender, members)) = (Arc::clone(&events), watch::channel(Vec::new()));
        let arguments = MembershipArguments {
            name: node(name),
            cell: node("lot"),
            run: clock::now().micros(),
            role: Role::Edge,
            broker: None,
            credentials: files
                .map(|files| Arc::new(Credentials::load(files, &node(name)).unwrap())),
            config,
            events: Arc::new(move |event| sink.lock().unwrap().push(event)),
            members: sender,
            counters: Arc::clone(&counters),
        };
        let (actor, _) = Actor::spawn(None, Membership, arguments).await.unwrap();
        let address = call_t!(actor, |reply| MembershipMessage::Address { reply }, 5000).unwrap();
        Self {
            actor,
            address,
            events,
            counters,
            members,
        }
    }

    fn sees(&self) -> Vec<(String, Role)> {
        self.members
            .borrow()
            .iter()
            .map(|member| (member.name.to_string(), member.role))
            .collect()
    }
}

async fn until(what: &str, mut holds: impl FnMut() -> bool) {
    let deadline = Instant::now() + SOON;
    while !holds() {
        assert!(Instant::now() < deadline, "{what}");
        sleep(Duration::from_millis(10)).await;
    }
}

/// All declare to be an edge; what others see is what their certificates allow.
#[tokio::test]
async fn nodes_meet_by_their_certificates_and_whoever_has_the_key_alone_meets_nobody() {
    let mut pki = Pki::new();
    let [edge, euclid] = [
        pki.issue("edge", Role::Edge, DAY),
        pki.issue("euclid", Role::Auto, DAY),
    ];
    let edge = Node::start("edge", Some(&edge), None).await;
    let bare = Node::start("gauss", None, Some(edge.address)).await;
    let mut elsewhere = Pki::new();
    let strange = TlsConfig {
        ca: pki.authority.ca(),
        ..elsewhere.issue("zeno", Role::Edge, DAY)
    };
    let strange = TlsConfig {
        revocation_list: None,
        ..strange
    };
    let strange = Node::start("zeno", Some(&strange), Some(edge.address)).await;
    let euclid = Node::start("euclid", Some(&euclid), Some(edge.address)).await;
    until("they meet", || {
        edge.sees().len() == 1 && euclid.sees().len() == 1
    })
    .await;
    until("the others are counted", || {
        edge.counters.get(FrameEvent::Uncertified) > 1
            && edge.counters.get(FrameEvent::Untrusted) > 1
    })
    .await;
    assert_eq!(
        edge.sees(),
        [("euclid".to_owned(), Role::Auto)],
        "as its certificate says"
    );
    assert_eq!(euclid.sees(), [("edge".to_owned(), Role::Edge)]);
    assert!(bare.sees().is_empty() && strange.sees().is_empty());
    for node in [edge, bare, strange, euclid] {
        node.actor.stop(None);
    }
}

#[tokio::test]
async fn a_revoked_node_is_down_soon_after_the_list_is_written() {
    let mut pki = Pki::new();
    let [edge, euclid] = [
        pki.issue("edge", Role::Edge, DAY),
        pki.issue("euclid", Role::Auto, DAY),
    ];
    let edge = Node::start("edge", Some(&edge), None).await;
    let euclid = Node::start("euclid", Some(&euclid), Some(edge.address)).await;
    until("they meet", || {
        edge.sees().len() == 1 && euclid.sees().len() == 1
    })
    .await;
    pki.authority.revoke(&node("euclid"), clock::now()).unwrap();
    let written = Instant::now();
    let is_down = |event: &MembershipEvent| {
        *event
            == MembershipEvent::Down {
                name: node("euclid"),
            }
    };
    until("it is down", || {
        edge.events.lock().unwrap().iter().any(is_down)
    })
    .await;
    println!("down {:?} after the list was written", written.elapsed());
    assert!(written.elapsed() < GONE_WITHIN, "{:?}", written.elapsed());
    assert_eq!(edge.counters.get(FrameEvent::Expelled), 1);
    sleep(Duration::from_secs(2)).await;
    assert!(edge.sees().is_empty(), "it does not come back");
    edge.actor.stop(None);
    euclid.actor.stop(None);
}
