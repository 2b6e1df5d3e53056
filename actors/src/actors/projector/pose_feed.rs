//! Takes a moving vehicle's poses from its localisation: one a datagram.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use ractor::ActorRef;
use tokio::net::UdpSocket;

use crate::camera::vehicle_pose::read_pose;
use crate::messages::projector::ProjectorMessage;
use crate::platform::clock;
use crate::telemetry::counters::{Counters, Event};

/// Time before the address is tried again.
const RETRY: Duration = Duration::from_secs(1);

/// Longest datagram, in bytes.
const MAX_BYTES: usize = 1024;

/// Tells the projector of every pose, for ever. An address that cannot be listened on is tried again.
pub(super) async fn listen(address: SocketAddr, projector: ActorRef<ProjectorMessage>, counters: Arc<Counters>) {
    let mut is_told = false;
    loop {
        if let Err(error) = receive(address, &projector, &counters).await
            && !std::mem::replace(&mut is_told, true)
        {
            tracing::warn!(%error, %address, "no poses can be taken, trying on");
        }
        tokio::time::sleep(RETRY).await;
    }
}

async fn receive(address: SocketAddr, projector: &ActorRef<ProjectorMessage>, counters: &Counters) -> io::Result<()> {
    let socket = UdpSocket::bind(address).await?;
    tracing::info!(%address, "taking poses");
    let mut datagram = [0; MAX_BYTES];
    let mut is_told = false;
    loop {
        let length = socket.recv(&mut datagram).await?;
        match read_pose(datagram.get(..length).unwrap_or_default(), clock::now()) {
            Ok((at, pose)) => {
                if projector.cast(ProjectorMessage::TakePose { at, pose }).is_err() {
                    return Ok(());
                }
            }
            Err(reason) => {
                counters.count(Event::PoseRejected);
                if !std::mem::replace(&mut is_told, true) {
                    tracing::warn!(reason, "pose not taken, the first");
                }
            }
        }
    }
}
