//! A simulated vehicle: one MQTT connection, and when answers came over it.

use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Instant;

use ecod::time::Timestamp;
use ecod::wire::{GlobalMap, Limits, Topic, Topics, decode};
use rumqttc::{AsyncClient, Event, EventLoop, Packet, Publish};
use tokio::sync::watch;
use tokio::task::AbortHandle;

use super::echo::{BACK, tick_of};
use super::schedule::Schedule;
use super::two_hop::subscribed;
use crate::gateway::BrokerAddress;

/// What the vehicles of a run have in common.
#[derive(Debug)]
pub(super) struct Common {
    pub(super) broker: BrokerAddress,
    pub(super) topics: Topics,
    /// Set when all are connected.
    pub(super) schedule: OnceLock<Schedule>,
    /// Bytes of the newest map.
    pub(super) map_bytes: Arc<AtomicUsize>,
    /// Whether any map came.
    pub(super) has_map: watch::Sender<bool>,
}

/// When the answer to each tick came; `None` until it does.
#[derive(Debug, Default)]
pub(super) struct Arrivals {
    pub(super) maps: Vec<Option<Instant>>,
    pub(super) echoes: Vec<Option<Instant>>,
}

/// A connected vehicle; its connection is cut when it is dropped.
#[derive(Debug)]
pub(super) struct Vehicle {
    pub(super) client: AsyncClient,
    pub(super) arrivals: Arc<Mutex<Arrivals>>,
    task: AbortHandle,
}

impl Vehicle {
    pub(super) async fn connect(
        id: &str,
        ticks: usize,
        common: &Arc<Common>,
    ) -> Result<Self, rumqttc::ConnectionError> {
        let map_topic = common.topics.path(&Topic::GlobalDetections);
        let (client, events) = subscribed(&common.broker, id, &[&map_topic, BACK]).await?;
        let arrivals = Arrivals { maps: vec![None; ticks], echoes: vec![None; ticks] };
        let arrivals = Arc::new(Mutex::new(arrivals));
        let task = tokio::spawn(receive(events, map_topic, Arc::clone(&arrivals), Arc::clone(common)));
        Ok(Self { client, arrivals, task: task.abort_handle() })
    }
}

impl Drop for Vehicle {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn receive(mut events: EventLoop, map_topic: String, arrivals: Arc<Mutex<Arrivals>>, common: Arc<Common>) {
    // The first tick to which no map has come.
    let mut open = 0;
    while let Ok(event) = events.poll().await {
        let at = Instant::now();
        let Event::Incoming(Packet::Publish(Publish { topic, payload, .. })) = event else { continue };
        if topic == map_topic {
            common.map_bytes.store(payload.len(), Relaxed);
            common.has_map.send_if_modified(|has_map| !std::mem::replace(has_map, true));
        }
        let Some(schedule) = common.schedule.get() else { continue };
        let mut arrivals = arrivals.lock().unwrap_or_else(PoisonError::into_inner);
        if topic == map_topic {
            let rests_on = oldest_capture(&payload).and_then(|oldest| schedule.tick_captured_at(oldest));
            while rests_on.is_some_and(|tick| open <= tick as usize)
                && let Some(arrival) = arrivals.maps.get_mut(open)
            {
                *arrival = Some(at);
                open += 1;
            }
        } else if let Some(arrival) = tick_of(&payload).and_then(|tick| arrivals.echoes.get_mut(tick as usize)) {
            *arrival = Some(at);
        }
    }
}

/// Capture time of the oldest report that a map rests on. The fields of a JSON map that come before it are few and short.
fn oldest_capture(map: &[u8]) -> Option<Timestamp> {
    if map.first() != Some(&b'{') {
        return decode::<GlobalMap>(map, &Limits::default()).ok()?.oldest_capture_us;
    }
    let head = &map[..map.len().min(512)];
    let key = head.windows(KEY.len()).position(|window| window == KEY)?;
    let digits = head[key + KEY.len()..].iter().map_while(|byte| char::from(*byte).to_digit(10));
    digits.map(u64::from).reduce(|number, digit| number.saturating_mul(10) + digit).map(Timestamp)
}

const KEY: &[u8] = b"\"oldest_capture_us\":";

#[cfg(test)]
mod tests {
    use ecod::names::NodeName;
    use ecod::wire::{Encoding, SCHEMA_VERSION, encode};

    use super::*;

    #[test]
    fn a_map_in_any_encoding_tells_what_it_rests_on() {
        let mut map = GlobalMap {
            schema: SCHEMA_VERSION,
            aggregator: NodeName::from_static("edge"),
            epoch: u64::MAX >> 11,
            round: u64::MAX >> 11,
            fused_at_us: Timestamp(1_732_154_400_200_000),
            oldest_capture_us: Some(Timestamp(1_732_154_400_123_456)),
            landmarks: vec![],
            objects: vec![],
            pose_corrections: Default::default(),
        };
        for encoding in [Encoding::Json, Encoding::Cbor] {
            assert_eq!(oldest_capture(&encode(&map, encoding)), map.oldest_capture_us);
        }
        map.oldest_capture_us = None;
        assert_eq!(oldest_capture(&encode(&map, Encoding::Json)), None);
    }
}
