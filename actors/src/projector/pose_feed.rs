//! Takes a moving vehicle's poses from its localisation: one JSON object a datagram.
//!
//! ```json
//! {"x_m": 4.2, "y_m": -1.0, "heading_rad": 1.57, "captured_at_us": 1732154400000000}
//! ```

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use ecod::geometry::Pose;
use ecod::time::Timestamp;
use ractor::ActorRef;
use serde::Deserialize;
use tokio::net::UdpSocket;

use crate::clock;
use crate::counters::{Counters, Event};
use crate::projector::ProjectorMessage;

/// Farthest from the origin that a vehicle may be, in metres.
const WORLD_M: f64 = 1e8;

/// Time before the address is tried again.
const RETRY: Duration = Duration::from_secs(1);

/// Longest datagram, in bytes.
const MAX_BYTES: usize = 1024;

/// A pose as told; unknown fields are left alone.
#[derive(Debug, Deserialize)]
struct Fix {
    x_m: f64,
    y_m: f64,
    heading_rad: f64,
    /// Unix time by this machine's clock; the time of receipt without it.
    captured_at_us: Option<Timestamp>,
}

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
        match parse(&datagram[..length], clock::now()) {
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

fn parse(datagram: &[u8], now: Timestamp) -> Result<(Timestamp, Pose), String> {
    let fix: Fix = serde_json::from_slice(datagram).map_err(|error| error.to_string())?;
    let within = |value: f64, most: f64| value.abs() <= most;
    if !within(fix.x_m, WORLD_M) || !within(fix.y_m, WORLD_M) || !within(fix.heading_rad, 1e3) {
        return Err(format!("{fix:?} is not in this world"));
    }
    Ok((fix.captured_at_us.unwrap_or(now), Pose::new(fix.x_m, fix.y_m, fix.heading_rad)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_has_its_own_time_or_that_of_its_receipt() {
        let now = Timestamp(7);
        let told = parse(br#"{"x_m":1,"y_m":-2.5,"heading_rad":3.1,"captured_at_us":5,"speed_mps":4}"#, now).unwrap();
        assert_eq!(told, (Timestamp(5), Pose::new(1.0, -2.5, 3.1)));
        assert_eq!(parse(br#"{"x_m":1,"y_m":2,"heading_rad":0}"#, now).unwrap().0, now);
    }

    #[test]
    fn what_is_no_pose_is_refused_with_a_reason() {
        for (datagram, reason) in [
            (&b"{\"x_m\":1,\"y_m\":2}"[..], "heading_rad"),
            (b"{\"x_m\":1e12,\"y_m\":2,\"heading_rad\":0}", "world"),
            (b"{\"x_m\":1,\"y_m\":2,\"heading_rad\":0,\"captured_at_us\":-1}", "invalid value"),
            (b"\xff\xfe", "line 1"),
        ] {
            let error = parse(datagram, Timestamp(0)).unwrap_err();
            assert!(error.contains(reason), "{error}");
        }
    }
}
