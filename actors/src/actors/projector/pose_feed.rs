//! Receiver of a moving vehicle's poses from its localisation, one per datagram.

use std::convert::Infallible;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::UdpSocket;

use crate::camera::vehicle_pose::read_pose;
use crate::messages::actor_slot::ActorSlot;
use crate::messages::projector::ProjectorMessage;
use crate::platform::clock;
use crate::telemetry::counters::{Counters, Event};

/// Wait before the address is tried again.
const RETRY: Duration = Duration::from_secs(1);

/// Maximum length of a datagram in bytes.
const MAX_BYTES: usize = 1024;

/// Address of the feed, and the projectors of all cameras of the vehicle.
pub(super) type PoseFeed = (SocketAddr, Vec<ActorSlot<ProjectorMessage>>);

/// Sends every pose to the projectors; never ends. An address that cannot be bound is tried again.
pub(super) async fn listen((address, projectors): PoseFeed, counters: Arc<Counters>) {
    let mut is_logged = false;
    loop {
        let Err(error) = receive(address, &projectors, &counters).await;
        if !std::mem::replace(&mut is_logged, true) {
            tracing::warn!(%error, %address, "cannot receive poses, trying again");
        }
        tokio::time::sleep(RETRY).await;
    }
}

async fn receive(
    address: SocketAddr,
    projectors: &[ActorSlot<ProjectorMessage>],
    counters: &Counters,
) -> io::Result<Infallible> {
    let socket = UdpSocket::bind(address).await?;
    tracing::info!(%address, "receiving poses");
    let mut datagram = [0; MAX_BYTES];
    let mut is_logged = false;
    loop {
        let length = socket.recv(&mut datagram).await?;
        let datagram = datagram.get(..length).unwrap_or_default();
        match read_pose(datagram, clock::now(), clock::wall_offset_us()) {
            Ok((at, pose)) => {
                for projector in projectors {
                    projector.send(ProjectorMessage::TakePose { at, pose });
                }
            }
            Err(reason) => {
                counters.count(Event::PoseRejected);
                if !std::mem::replace(&mut is_logged, true) {
                    tracing::warn!(reason, "pose rejected, further ones are only counted");
                }
            }
        }
    }
}
