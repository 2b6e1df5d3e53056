//! Memberships that prove certificates, on real sockets: a holder of the key alone, or a revoked node, is no member.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use ecod::wire::Role;
use ecod_actors::platform::clock;
use ecod_actors::transport::gossip::{FrameEvent, MembershipConfig, MembershipEvent};
use ecod_actors::transport::pki::{Credentials, TlsConfig};
use ecod_testkit::{Member, member_config, until};
use tokio::time::{Instant, sleep};

use crate::fixture::{DAY, GONE_WITHIN, Pki, node};

/// Starts a membership that declares to be an edge.
async fn start(name: &str, files: Option<&TlsConfig>, seed: Option<SocketAddr>) -> Member {
    let config = MembershipConfig {
        // Patient, as the machine that runs this may be busy.
        probe_ms: 200,
        reply_ms: 80,
        suspect_ms: 600,
        ..member_config(seed.as_slice())
    };
    Member::start(name, config, |arguments| {
        arguments.role = Role::Edge;
        arguments.credentials =
            files.map(|files| Arc::new(Credentials::load(files, &node(name)).unwrap()));
    })
    .await
}

fn seen_by(node: &Member) -> Vec<(String, Role)> {
    node.members
        .borrow()
        .iter()
        .map(|member| (member.name.to_string(), member.role))
        .collect()
}

/// All declare to be an edge; other nodes use the roles that the certificates allow.
#[tokio::test]
async fn nodes_join_only_with_certificates() {
    let mut pki = Pki::new();
    let edge = pki.issue("edge", Role::Edge, DAY);
    let euclid = pki.issue("euclid", Role::Auto, DAY);
    let edge = start("edge", Some(&edge), None).await;
    let bare = start("gauss", None, Some(edge.address)).await;
    let mut elsewhere = Pki::new();
    let strange = TlsConfig {
        ca: pki.authority.ca(),
        ..elsewhere.issue("zeno", Role::Edge, DAY)
    };
    let strange = TlsConfig {
        revocation_list: None,
        ..strange
    };
    let strange = start("zeno", Some(&strange), Some(edge.address)).await;
    let euclid = start("euclid", Some(&euclid), Some(edge.address)).await;
    until("both nodes are members", || {
        seen_by(&edge).len() == 1 && seen_by(&euclid).len() == 1
    })
    .await;
    until("the others are counted", || {
        edge.counters.get(FrameEvent::Uncertified) > 1
            && edge.counters.get(FrameEvent::Untrusted) > 1
    })
    .await;
    assert_eq!(
        seen_by(&edge),
        [("euclid".to_owned(), Role::Auto)],
        "as in its certificate"
    );
    assert_eq!(seen_by(&euclid), [("edge".to_owned(), Role::Edge)]);
    assert!(seen_by(&bare).is_empty() && seen_by(&strange).is_empty());
    for node in [edge, bare, strange, euclid] {
        node.actor.stop(None);
    }
}

#[tokio::test]
async fn revoked_node_goes_down_soon() {
    let mut pki = Pki::new();
    let edge = pki.issue("edge", Role::Edge, DAY);
    let euclid = pki.issue("euclid", Role::Auto, DAY);
    let edge = start("edge", Some(&edge), None).await;
    let euclid = start("euclid", Some(&euclid), Some(edge.address)).await;
    until("both nodes are members", || {
        seen_by(&edge).len() == 1 && seen_by(&euclid).len() == 1
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
    assert!(seen_by(&edge).is_empty(), "it does not come back");
    edge.actor.stop(None);
    euclid.actor.stop(None);
}
