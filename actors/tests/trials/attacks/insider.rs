//! An attacker that is a member, as far as it is admitted, and sends arbitrary messages there.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use bytes::Bytes;
use ecod::leadership::election::{Body, Candidacy, ElectionMessage};
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::wire::{DescriptionStamp, Encoding, Role, SCHEMA_VERSION};
use ecod_actors::actors::membership::{Membership, MembershipArguments};
use ecod_actors::messages::membership::MembershipMessage;
use ecod_actors::platform::clock;
use ecod_actors::platform::secret::Secret;
use ecod_actors::transport::gossip::{FrameCounters, FrameEvent, Member, MembershipConfig};
use ecod_actors::transport::pki::Credentials;
use ractor::{Actor, ActorRef};
use tokio::sync::watch;
use tokio::time::sleep;

use crate::attacks::cell::{CELL, Target};

/// Time in which a cell admits a node, if it does.
const ADMISSION: Duration = Duration::from_secs(2);

/// A membership of the attacker's own.
pub(crate) struct Insider {
    name: NodeName,
    role: Role,
    run: u64,
    membership: ActorRef<MembershipMessage>,
    counters: Arc<FrameCounters>,
    target: Target,
    members: watch::Receiver<Vec<Member>>,
    /// The description that it states.
    description: Option<DescriptionStamp>,
}

impl Insider {
    /// Greets all nodes with the cell's key, and with a certificate if one is given.
    pub(crate) async fn join(
        target: &Target,
        name: &'static str,
        role: Role,
        credentials: Option<Arc<Credentials>>,
    ) -> anyhow::Result<Self> {
        let mut config = MembershipConfig {
            key: Some(Secret::new(target.key)),
            bind: Some(SocketAddr::from((target.from, 0))),
            seeds: target.gossip.iter().map(ToString::to_string).collect(),
            ..MembershipConfig::default()
        };
        config.multicast.enabled = false;
        let name = NodeName::from_static(name);
        let counters = Arc::<FrameCounters>::default();
        let run = clock::now().micros();
        let (sender, members) = watch::channel(Vec::new());
        let arguments = MembershipArguments {
            name: name.clone(),
            cell: NodeName::from_static(CELL),
            run,
            role,
            broker: None,
            credentials,
            config,
            events: Arc::new(drop),
            members: sender,
            counters: Arc::clone(&counters),
        };
        let (membership, _) = Actor::spawn(None, Membership, arguments).await?;
        sleep(ADMISSION).await;
        Ok(Self {
            name,
            role,
            run,
            membership,
            counters,
            target: target.clone(),
            members,
            description: None,
        })
    }

    /// The same, once all nodes have admitted it.
    pub(crate) async fn admitted(self) -> anyhow::Result<Self> {
        let known = self.members.borrow().len();
        anyhow::ensure!(
            known == self.target.gossip.len(),
            "admitted by {known} nodes only"
        );
        Ok(self)
    }

    /// The same, with this description of the cell.
    pub(crate) fn stating(self, description: DescriptionStamp) -> Self {
        Self {
            description: Some(description),
            ..self
        }
    }

    /// Greets without end, and is not admitted by any node.
    pub(crate) async fn knock(&self) -> anyhow::Result<()> {
        loop {
            self.target
                .deeds
                .store(self.counters.get(FrameEvent::Sent), Ordering::Relaxed);
            anyhow::ensure!(self.members.borrow().is_empty(), "admitted");
            sleep(Duration::from_millis(100)).await;
        }
    }

    /// An invented epoch of the attacker.
    pub(crate) fn epoch(&self, term: u64) -> Epoch {
        Epoch::new(term, self.name.clone())
    }

    /// Sends one message to all members, ten times a second.
    pub(crate) async fn repeat(
        &self,
        term: u64,
        epoch: Option<Epoch>,
        body: Body,
    ) -> anyhow::Result<()> {
        self.repeat_all(term, epoch, &[body]).await
    }

    /// Repeats several messages as [`Self::repeat`] repeats one.
    pub(crate) async fn repeat_all(
        &self,
        term: u64,
        epoch: Option<Epoch>,
        bodies: &[Body],
    ) -> anyhow::Result<()> {
        for (seq, body) in (1..).zip(bodies.iter().cycle()) {
            // It seems to be fit where it claims to lead.
            let fit = matches!(body, Body::Beat { .. });
            let message = ElectionMessage {
                schema: SCHEMA_VERSION,
                from: self.name.clone(),
                run: self.run,
                seq,
                candidacy: Candidacy {
                    role: self.role,
                    priority: u8::MAX,
                    load: 0,
                    fit,
                },
                term,
                epoch: epoch.clone(),
                hears_you: true,
                clock: None,
                description: self.description.map(Box::new),
                body: body.clone(),
            };
            let payload = Bytes::from(message.encode(Encoding::Cbor));
            let names: Vec<_> = self
                .members
                .borrow()
                .iter()
                .map(|member| member.name.clone())
                .collect();
            for to in names {
                self.membership.cast(MembershipMessage::Send {
                    to,
                    payload: payload.clone(),
                })?;
                self.target.did(1);
            }
            if seq % bodies.len() as u64 == 0 {
                sleep(Duration::from_millis(100)).await;
            }
        }
        Ok(())
    }
}
