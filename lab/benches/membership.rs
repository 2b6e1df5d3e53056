//! Costs of an idle cell's membership: packets and processor time of each node, all in this one process.
//!
//! The goals are 60 packets/s and 1.5 % of a core. `NODES` (32) nodes gossip on loopback without multicast for
//! `SECONDS` (10), after they have all met.

#[path = "../../benches/figures.rs"]
mod figures;

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use ecod::model::names::NodeName;
use ecod::wire::Role;
use ecod_actors::actors::membership::{Membership, MembershipArguments};
use ecod_actors::messages::membership::MembershipMessage;
use ecod_actors::platform::clock;
use ecod_actors::platform::secret::Secret;
use ecod_actors::transport::gossip::{
    FrameCounters, FrameEvent, Member, MembershipConfig, MembershipEvent, MulticastConfig,
};
use ractor::{Actor, call_t};
use tokio::sync::watch;

use figures::Figures;

#[tokio::main(flavor = "multi_thread", worker_threads = 2)]
async fn main() {
    let number = |key, default| {
        std::env::var(key)
            .ok()
            .and_then(|text| text.parse().ok())
            .unwrap_or(default)
    };
    let nodes: u64 = number("NODES", 32);
    let seconds: u64 = number("SECONDS", 10);
    let downs = Arc::<AtomicU64>::default();
    let mut seeds = Vec::new();
    let mut counters = Vec::new();
    let mut members = Vec::new();
    for node in 0..nodes {
        let (sender, receiver) = watch::channel(Vec::<Member>::new());
        let counted = Arc::<FrameCounters>::default();
        let seen = Arc::clone(&downs);
        let arguments = MembershipArguments {
            name: NodeName::new(format!("node-{node}")).expect("a number makes a name"),
            cell: NodeName::from_static("bench"),
            run: clock::now().micros(),
            role: Role::Auto,
            broker: None,
            credentials: None,
            config: MembershipConfig {
                key: Some(Secret::new("5e".repeat(32))),
                bind: Some(SocketAddr::from((Ipv4Addr::LOCALHOST, 0))),
                seeds: seeds.clone(),
                multicast: MulticastConfig {
                    enabled: false,
                    ..MulticastConfig::default()
                },
                ..MembershipConfig::default()
            },
            events: Arc::new(move |event| {
                seen.fetch_add(
                    u64::from(matches!(event, MembershipEvent::Down { .. })),
                    Ordering::Relaxed,
                );
            }),
            members: sender,
            counters: Arc::clone(&counted),
        };
        let (actor, _) = Actor::spawn(None, Membership, arguments)
            .await
            .expect("a free port of loopback is there");
        let address = call_t!(actor, |reply| MembershipMessage::Address { reply }, 5000)
            .expect("the actor answers");
        if seeds.is_empty() {
            seeds.push(address.to_string());
        }
        counters.push(counted);
        members.push(receiver);
    }
    let started = Instant::now();
    for members in &mut members {
        let complete = |members: &Vec<Member>| members.len() as u64 == nodes - 1;
        members.wait_for(complete).await.expect("the actor runs");
    }
    println!(
        "{nodes} nodes all met {} ms after the last had started",
        started.elapsed().as_millis()
    );
    tokio::time::sleep(Duration::from_secs(5)).await;
    let sum = |event| {
        counters
            .iter()
            .map(|counters| counters.get(event))
            .sum::<u64>()
    };
    let counts = || [sum(FrameEvent::Sent), sum(FrameEvent::Received)];
    let before = counts();
    let processor = processor_time();
    let down = downs.load(Ordering::Relaxed);
    tokio::time::sleep(Duration::from_secs(seconds)).await;
    let per_node = |n: f64| n / (nodes * seconds) as f64;
    let [sent, received] = std::array::from_fn(|at| per_node((counts()[at] - before[at]) as f64));
    let percent = 100.0 * per_node((processor_time() - processor).as_secs_f64());
    println!(
        "per node: {sent:.1} packets/s sent, {received:.1} received, {percent:.2} % of a core"
    );
    let mut figures = Figures::new("membership");
    figures.insert("nodes", nodes.into());
    figures.insert("received_per_s", received.into());
    figures.goal("sent_per_s", sent, 60.0, " packets/s");
    figures.goal("processor_percent", percent, 1.5, " %");
    figures.goal(
        "given_up_by_mistake",
        (downs.load(Ordering::Relaxed) - down) as f64,
        0.0,
        "",
    );
    figures.save();
}

/// User and system time of this process, by Linux's clock ticks of 10 ms.
fn processor_time() -> Duration {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields = stat
        .rsplit_once(')')
        .map_or("", |(_, fields)| fields)
        .split_whitespace();
    let ticks: u64 = fields
        .skip(11)
        .take(2)
        .filter_map(|ticks| ticks.parse::<u64>().ok())
        .sum();
    Duration::from_millis(ticks * 10)
}
