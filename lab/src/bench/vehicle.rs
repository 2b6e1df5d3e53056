//! A simulated vehicle: one MQTT connection, and the arrival times of answers.

use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Instant;

use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, Limits, Topic, Topics, Verdicts, decode};
use rumqttc::{AsyncClient, Event, EventLoop, Packet, Publish};
use tokio::sync::watch;
use tokio::task::AbortHandle;

use super::access::BrokerAccess;
use super::echo::{AnswerBytes, BACK, tick_of};
use super::schedule::Schedule;

/// State that the vehicles of a run share.
#[derive(Debug)]
pub(super) struct Common {
    pub(super) access: BrokerAccess,
    pub(super) topics: Topics,
    /// Set when all are connected.
    pub(super) schedule: OnceLock<Schedule>,
    pub(super) answer_bytes: Arc<AnswerBytes>,
    /// True once a map has come.
    pub(super) has_map: watch::Sender<bool>,
}

/// Arrival times of the answers to each tick on one path; `None` until they arrive.
#[derive(Debug)]
pub(super) struct Came {
    pub(super) map: Vec<Option<Instant>>,
    pub(super) verdict: Vec<Option<Instant>>,
}

impl Came {
    fn none(ticks: usize) -> Self {
        Self {
            map: vec![None; ticks],
            verdict: vec![None; ticks],
        }
    }
}

/// Arrival times of answers through the cell and on the bare path.
#[derive(Debug)]
pub(super) struct Arrivals {
    pub(super) cell: Came,
    pub(super) bare: Came,
    /// The first ticks to which no map and no verdicts have come.
    open: [usize; 2],
    /// Round of the last map that answered a tick.
    answered_in: u64,
}

/// A connected vehicle; its connection is cut when it is dropped.
#[derive(Debug)]
pub(super) struct BenchVehicle {
    pub(super) client: AsyncClient,
    pub(super) arrivals: Arc<Mutex<Arrivals>>,
    task: AbortHandle,
}

impl BenchVehicle {
    pub(super) async fn connect(
        id: &str,
        ticks: usize,
        common: &Arc<Common>,
    ) -> Result<Self, rumqttc::ConnectionError> {
        let topics = [Topic::GlobalDetections, Topic::GlobalVerdicts]
            .map(|topic| common.topics.path(&topic));
        let [map_topic, verdict_topic] = &topics;
        let (client, events) = common
            .access
            .subscribed(id, &[map_topic, verdict_topic, BACK])
            .await?;
        let arrivals = Arc::new(Mutex::new(Arrivals::none(ticks)));
        let task = tokio::spawn(receive(
            events,
            topics,
            Arc::clone(&arrivals),
            Arc::clone(common),
        ));
        Ok(Self {
            client,
            arrivals,
            task: task.abort_handle(),
        })
    }
}

impl Drop for BenchVehicle {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn receive(
    mut events: EventLoop,
    topics: [String; 2],
    arrivals: Arc<Mutex<Arrivals>>,
    common: Arc<Common>,
) {
    let [map_topic, verdict_topic] = topics;
    while let Ok(event) = events.poll().await {
        let at = Instant::now();
        let Event::Incoming(Packet::Publish(Publish { topic, payload, .. })) = event else {
            continue;
        };
        if topic == map_topic {
            common.answer_bytes.map.store(payload.len(), Relaxed);
            common
                .has_map
                .send_if_modified(|has_map| !std::mem::replace(has_map, true));
        } else if topic == verdict_topic {
            common.answer_bytes.verdict.store(payload.len(), Relaxed);
        }
        let Some(schedule) = common.schedule.get() else {
            continue;
        };
        let mut arrivals = arrivals.lock().unwrap_or_else(PoisonError::into_inner);
        if topic == map_topic {
            if let Some(head) = MapHead::of(common.access.unseal(&payload))
                && let Some(tick) = head
                    .oldest_capture
                    .and_then(|oldest| schedule.tick_captured_at(oldest))
            {
                arrivals.map(head.round, tick, at);
            }
        } else if topic == verdict_topic {
            if let Some(round) = round_of_verdicts(common.access.unseal(&payload)) {
                arrivals.verdict(round, at);
            }
        } else if let Some(tick) = tick_of(&payload) {
            arrivals.echo(tick, at);
        }
    }
}

impl Arrivals {
    fn none(ticks: usize) -> Self {
        Self {
            cell: Came::none(ticks),
            bare: Came::none(ticks),
            open: [0; 2],
            answered_in: 0,
        }
    }

    /// Processes a map that includes no report from before `tick`: it answers that tick and all
    /// earlier ones.
    fn map(&mut self, round: u64, tick: u32, at: Instant) {
        let [open, _] = &mut self.open;
        while *open <= tick as usize
            && let Some(arrival) = self.cell.map.get_mut(*open)
        {
            *arrival = Some(at);
            *open += 1;
            self.answered_in = round;
        }
    }

    /// Processes verdicts: if their round is not before the round of the last answering map, they
    /// answer the same ticks. The aggregator sends them after the map of their round, on the same
    /// path.
    fn verdict(&mut self, round: u64, at: Instant) {
        let [answered, open] = &mut self.open;
        if round >= self.answered_in && *open < *answered {
            for arrival in self.cell.verdict.iter_mut().take(*answered).skip(*open) {
                *arrival = Some(at);
            }
            *open = *answered;
        }
    }

    /// Processes an answer on the bare path; the first to a tick stands for the map, the second for
    /// the verdicts.
    fn echo(&mut self, tick: u32, at: Instant) {
        let Came { map, verdict } = &mut self.bare;
        if let (Some(map), Some(verdict)) =
            (map.get_mut(tick as usize), verdict.get_mut(tick as usize))
        {
            *(if map.is_none() { map } else { verdict }) = Some(at);
        }
    }
}

/// Fields of a map that determine its round.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct MapHead {
    round: u64,
    /// Capture time of the oldest report in it.
    oldest_capture: Option<Timestamp>,
}

impl MapHead {
    fn of(map: &[u8]) -> Option<Self> {
        if map.first() != Some(&b'{') {
            let map = decode::<GlobalMap>(map, &Limits::default()).ok()?;
            return Some(Self {
                round: map.round,
                oldest_capture: map.oldest_capture_us,
            });
        }
        Some(Self {
            round: number(map, ROUND)?,
            oldest_capture: number(map, OLDEST_CAPTURE).map(Timestamp),
        })
    }
}

fn round_of_verdicts(verdicts: &[u8]) -> Option<u64> {
    if verdicts.first() != Some(&b'{') {
        return Some(decode::<Verdicts>(verdicts, &Limits::default()).ok()?.round);
    }
    number(verdicts, ROUND)
}

/// The number after a key at the head of a JSON payload, where fields are few and short.
fn number(json: &[u8], key: &[u8]) -> Option<u64> {
    let head = json.get(..HEAD_BYTES).unwrap_or(json);
    let at = head.windows(key.len()).position(|window| window == key)?;
    let digits = head[at + key.len()..]
        .iter()
        .map_while(|byte| char::from(*byte).to_digit(10));
    digits
        .map(u64::from)
        .reduce(|number, digit| number.saturating_mul(10).saturating_add(digit))
}

const HEAD_BYTES: usize = 512;
const ROUND: &[u8] = b"\"round\":";
const OLDEST_CAPTURE: &[u8] = b"\"oldest_capture_us\":";

#[cfg(test)]
mod tests {
    use ecod::model::epoch::Epoch;
    use ecod::model::names::NodeName;
    use ecod::wire::{Encoding, encode};

    use super::*;

    #[test]
    fn every_encoding_gives_round() {
        let largest = u64::MAX >> 11;
        let fused_at = Timestamp(1_732_154_400_200_000);
        let epoch = Epoch::new(largest, NodeName::from_static("edge"));
        let oldest_capture_us = Some(Timestamp(1_732_154_400_123_456));
        let mut map = GlobalMap {
            oldest_capture_us,
            ..GlobalMap::new(&epoch, largest, fused_at)
        };
        let verdicts = Verdicts::new(&epoch, 4711, fused_at, Vec::new());
        for encoding in [Encoding::Json, Encoding::Cbor, Encoding::Compact] {
            let head = MapHead {
                round: map.round,
                oldest_capture: map.oldest_capture_us,
            };
            assert_eq!(MapHead::of(&encode(&map, encoding)), Some(head));
            assert_eq!(round_of_verdicts(&encode(&verdicts, encoding)), Some(4711));
        }
        map.oldest_capture_us = None;
        let head = MapHead {
            round: map.round,
            oldest_capture: None,
        };
        assert_eq!(MapHead::of(&encode(&map, Encoding::Json)), Some(head));
    }

    #[test]
    fn verdicts_are_paired_with_maps() {
        let mut arrivals = Arrivals::none(4);
        let at = |ms| Instant::now() + std::time::Duration::from_millis(ms);
        let times: Vec<_> = (0..6).map(at).collect();
        arrivals.verdict(6, times[0]);
        arrivals.map(7, 1, times[1]);
        arrivals.verdict(6, times[2]);
        assert_eq!(arrivals.cell.verdict, [None; 4], "of before the round");
        arrivals.verdict(7, times[3]);
        assert_eq!(
            arrivals.cell.map[..3],
            [Some(times[1]), Some(times[1]), None]
        );
        assert_eq!(
            arrivals.cell.verdict[..3],
            [Some(times[3]), Some(times[3]), None]
        );
        arrivals.map(8, 2, times[4]);
        arrivals.map(9, 2, times[4]);
        arrivals.verdict(8, times[5]);
        assert_eq!(
            arrivals.cell.verdict[1..],
            [Some(times[3]), Some(times[5]), None]
        );
    }

    #[test]
    fn the_bare_way_answers_twice() {
        let mut arrivals = Arrivals::none(1);
        let times = [Instant::now(), Instant::now()];
        for at in times {
            arrivals.echo(0, at);
        }
        arrivals.echo(1, times[0]);
        assert_eq!(
            (arrivals.bare.map[0], arrivals.bare.verdict[0]),
            (Some(times[0]), Some(times[1]))
        );
    }
}
