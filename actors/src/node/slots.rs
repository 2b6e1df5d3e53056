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
    /// The embedded broker.
    Broker,
    /// The gossip with the other nodes.
    Membership,
    /// The keeper of the cell's description.
    DescriptionKeeper,
    /// The MQTT connections.
    Gateway,
    /// The taker of maps.
    Follower,
    /// The holder of reputations.
    ReputationKeeper,
    /// The maker of maps.
    Fuser,
    /// The connection to the region.
    Uplink,
    /// The node's election.
    LeaderElection,
    /// The node's page.
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
    /// The recorder's.
    pub recorder: ActorSlot<RecorderMessage>,
    /// The embedded broker's.
    pub broker: ActorSlot<BrokerMessage>,
    /// The membership's.
    pub membership: ActorSlot<MembershipMessage>,
    /// The keeper's of the cell's description.
    pub description: ActorSlot<DescriptionKeeperMessage>,
    /// The gateway's.
    pub gateway: ActorSlot<GatewayMessage>,
    /// The follower's.
    pub follower: ActorSlot<FollowerMessage>,
    /// The reputation keeper's.
    pub keeper: ActorSlot<ReputationKeeperMessage>,
    /// The fuser's.
    pub fuser: ActorSlot<FuserMessage>,
    /// The uplink's.
    pub uplink: ActorSlot<UplinkMessage>,
    /// The election's.
    pub election: ActorSlot<LeaderElectionMessage>,
    /// The dashboard's.
    pub dashboard: ActorSlot<DashboardMessage>,
    /// The pose receiver's.
    pub pose_receiver: ActorSlot<PoseReceiverMessage>,
    /// The projectors', one for each camera.
    #[cfg(feature = "camera")]
    pub projectors: Vec<ActorSlot<ProjectorMessage>>,
    /// The detectors', one for each camera.
    #[cfg(feature = "camera")]
    pub detectors: Vec<ActorSlot<DetectorMessage>>,
}
