//! The actor that receives a moving vehicle's poses from its localisation, one pose per datagram.
//!
//! ```text
//! localisation ── UDP ──> PoseReceiver ── HandlePose ──> Projector of each camera
//!                              └─ latest poses ──> choice of the cell
//! ```

use std::collections::VecDeque;
use std::convert::Infallible;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use ecod::model::origin::StatedPose;
use ecod::model::time::Timestamp;
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::net::UdpSocket;
use tokio::sync::watch;
use tokio::task::JoinSet;

use crate::camera::vehicle_pose::read_pose;
#[cfg(feature = "camera")]
use crate::messages::actor_slot::ActorSlot;
use crate::messages::pose_receiver::PoseReceiverMessage;
#[cfg(feature = "camera")]
use crate::messages::projector::ProjectorMessage;
use crate::platform::clock;
use crate::platform::throttle::TokenBucket;
use crate::telemetry::counters::{Counters, Event};

/// Wait before the address is tried again.
const RETRY: Duration = Duration::from_secs(1);

/// Number of kept poses, for projectors that start: half a second of them at 30 Hz.
const KEPT_POSES: usize = 16;

/// Maximum number of poses a second, more than an inertial unit gives.
const MAX_POSE_HZ: u32 = 500;

/// Maximum length of a datagram in bytes.
const MAX_BYTES: usize = 1024;

/// Arguments of the receiver's start.
pub struct PoseReceiverArguments {
    /// UDP address for the poses.
    pub address: SocketAddr,
    /// The projectors of all cameras.
    #[cfg(feature = "camera")]
    pub projectors: Vec<ActorSlot<ProjectorMessage>>,
    /// Keeps the latest poses, the newest last.
    pub poses: watch::Sender<VecDeque<(Timestamp, StatedPose)>>,
    /// Counters of the node.
    pub counters: Arc<Counters>,
}

/// The only owner of the address for poses.
#[derive(Debug, Default)]
pub struct PoseReceiver;

/// Receivers of the poses.
pub struct PoseReceiverState {
    arguments: PoseReceiverArguments,
    /// Ends with the actor.
    _listener: JoinSet<()>,
}

impl Actor for PoseReceiver {
    type Msg = PoseReceiverMessage;
    type State = PoseReceiverState;
    type Arguments = PoseReceiverArguments;

    async fn pre_start(
        &self,
        myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        let mut listener = JoinSet::new();
        listener.spawn(listen(
            arguments.address,
            myself,
            Arc::clone(&arguments.counters),
        ));
        Ok(PoseReceiverState {
            arguments,
            _listener: listener,
        })
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        PoseReceiverMessage::HandlePose { at, pose }: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        #[cfg(feature = "camera")]
        for projector in &state.arguments.projectors {
            projector.send(ProjectorMessage::HandlePose { at, pose });
        }
        state.arguments.poses.send_modify(|poses| {
            if poses.len() == KEPT_POSES {
                poses.pop_front();
            }
            poses.push_back((at, pose));
        });
        Ok(())
    }
}

/// Takes poses until the receiver ends. An address that cannot be bound is tried again.
async fn listen(
    address: SocketAddr,
    receiver: ActorRef<PoseReceiverMessage>,
    counters: Arc<Counters>,
) {
    let mut is_logged = false;
    loop {
        let Err(error) = receive(address, &receiver, &counters).await;
        if !std::mem::replace(&mut is_logged, true) {
            tracing::warn!(%error, %address, "cannot receive poses, trying again");
        }
        tokio::time::sleep(RETRY).await;
    }
}

/// Receives poses on a UDP address. Usable poses go to the actor; others, and poses beyond
/// [`MAX_POSE_HZ`], are counted.
///
/// # Errors
/// Returns the error of the socket, which ends the reception.
async fn receive(
    address: SocketAddr,
    receiver: &ActorRef<PoseReceiverMessage>,
    counters: &Counters,
) -> io::Result<Infallible> {
    let socket = UdpSocket::bind(address).await?;
    tracing::info!(%address, "receiving poses");
    let mut datagram = [0; MAX_BYTES];
    let mut bucket = TokenBucket::new(
        MAX_POSE_HZ,
        Duration::from_secs(1) / MAX_POSE_HZ,
        clock::now(),
    );
    let mut is_logged = false;
    loop {
        let length = socket.recv(&mut datagram).await?;
        let datagram = datagram.get(..length).unwrap_or_default();
        let now = clock::now();
        let pose = match read_pose(datagram, now, clock::wall_offset_us()) {
            _ if !bucket.allow(now) => Err(format!("more than {MAX_POSE_HZ} poses a second")),
            pose => pose,
        };
        match pose {
            // The listener ends with the receiver.
            Ok((at, pose)) => _ = receiver.cast(PoseReceiverMessage::HandlePose { at, pose }),
            Err(reason) => {
                counters.count(Event::PoseRejected);
                if !std::mem::replace(&mut is_logged, true) {
                    tracing::warn!(reason, "pose rejected, further ones are only counted");
                }
            }
        }
    }
}
