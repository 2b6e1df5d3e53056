//! The parts of a node and their addresses.

use crate::messages::actor_slot::ActorSlot;
use crate::messages::broker::BrokerMessage;
use crate::messages::dashboard::DashboardMessage;
use crate::messages::description_keeper::DescriptionKeeperMessage;
#[cfg(feature = "camera")]
use crate::messages::detector::DetectorMessage;
use crate::messages::follower::FollowerMessage;
use crate::messages::fuser::FuserMessage;
use crate::messages::gateway::GatewayMessage;
use crate::messages::leader_election::LeaderElectionMessage;
use crate::messages::membership::MembershipMessage;
use crate::messages::pose_receiver::PoseReceiverMessage;
#[cfg(feature = "camera")]
use crate::messages::projector::ProjectorMessage;
use crate::messages::recorder::RecorderMessage;
use crate::messages::reputation_keeper::ReputationKeeperMessage;
use crate::messages::uplink::UplinkMessage;

/// A part of a node, in the order of starting.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, strum::Display)]
#[strum(serialize_all = "snake_case")]
pub enum ActorKind {
    /// The writer of the log.
    Recorder,
    /// The embedded MQTT broker of the node.
    Broker,
    /// The gossip with the other nodes.
    Membership,
    /// The keeper of the cell's description.
    DescriptionKeeper,
    /// The owner of the cell's MQTT connections.
    Gateway,
    /// The taker of maps.
    Follower,
    /// The holder of reputations.
    ReputationKeeper,
    /// The maker of maps.
    Fuser,
    /// The connection to the region.
    Uplink,
    /// The driver of the node's leadership.
    LeaderElection,
    /// The server of the node's page.
    Dashboard,
    /// The producer of a camera's reports, by its place in
    /// [`NodeConfig::all_cameras`](super::config::NodeConfig::all_cameras).
    #[cfg(feature = "camera")]
    Projector(usize),
    /// The detector of objects in a camera's frames.
    #[cfg(feature = "camera")]
    Detector(usize),
    /// The receiver of a moving vehicle's poses.
    PoseReceiver,
}

impl ActorKind {
    /// True for parts that work in only one of a vehicle's cells at a time.
    pub(super) fn is_of_vehicle(self) -> bool {
        match self {
            Self::PoseReceiver => true,
            #[cfg(feature = "camera")]
            Self::Projector(_) | Self::Detector(_) => true,
            _ => false,
        }
    }
}

/// Addresses of the parts of a node.
#[derive(Debug, Clone, Default)]
pub struct ActorSlots {
    /// Address of the recorder, which writes the log.
    pub recorder: ActorSlot<RecorderMessage>,
    /// Address of the embedded broker's actor.
    pub broker: ActorSlot<BrokerMessage>,
    /// Address of the membership, which sends datagrams.
    pub membership: ActorSlot<MembershipMessage>,
    /// Address of the keeper of the cell's description.
    pub description: ActorSlot<DescriptionKeeperMessage>,
    /// Address of the gateway, which publishes and receives.
    pub gateway: ActorSlot<GatewayMessage>,
    /// Address of the follower, which accepts rounds.
    pub follower: ActorSlot<FollowerMessage>,
    /// Address of the keeper of reputations.
    pub keeper: ActorSlot<ReputationKeeperMessage>,
    /// Address of the fuser, which closes rounds.
    pub fuser: ActorSlot<FuserMessage>,
    /// Address of the uplink to the region.
    pub uplink: ActorSlot<UplinkMessage>,
    /// Address of the leader election.
    pub election: ActorSlot<LeaderElectionMessage>,
    /// Address of the dashboard, which serves the page.
    pub dashboard: ActorSlot<DashboardMessage>,
    /// Address of the receiver of poses.
    pub pose_receiver: ActorSlot<PoseReceiverMessage>,
    /// Addresses of the projectors, one for each camera.
    #[cfg(feature = "camera")]
    pub projectors: Vec<ActorSlot<ProjectorMessage>>,
    /// Addresses of the detectors, one for each camera.
    #[cfg(feature = "camera")]
    pub detectors: Vec<ActorSlot<DetectorMessage>>,
}
