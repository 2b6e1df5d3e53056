//! The packets of a cell's rounds without the cell: as many bare clients, payloads as large, the same fan-out. What is
//! left of a cell's latency beyond this is the cell's own work.

use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::time::Duration;

use hdrhistogram::Histogram;
use rumqttc::QoS;
use tokio::sync::mpsc;
use tokio::time::Instant;

use super::two_hop::{TwoHopError, each_message, latencies, subscribed};
use crate::gateway::BrokerAddress;

/// What is sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Traffic {
    /// How many rounds; those of the first tenth warm up and are not counted.
    pub rounds: u32,
    /// Time from one round to the next.
    pub interval: Duration,
    /// Clients that send a message a round and receive the answer, at least 1.
    pub vehicles: usize,
    /// Time between the messages of a round.
    pub stagger: Duration,
    /// Bytes of every message, at least 4.
    pub message_bytes: usize,
    /// Bytes of the answer to the last message of a round, at least 4.
    pub answer_bytes: usize,
}

const OUT: &str = "ecod/bench/rounds/out";
const BACK: &str = "ecod/bench/rounds/back";
const PATIENCE: Duration = Duration::from_secs(5);

/// Nanoseconds from when the last message of a round was handed to its client to when each sender had the answer. The
/// answering client also receives its own answer, as an aggregator does.
///
/// # Errors
/// [`TwoHopError`] when the broker cannot be reached or loses messages.
pub async fn raw(broker: &BrokerAddress, traffic: Traffic) -> Result<Histogram<u64>, TwoHopError> {
    let error = |source| TwoHopError::Connection { broker: broker.clone(), source: Box::new(source) };
    let (echoer, echo_events) = subscribed(broker, "ecod-bench-echo", &[OUT, BACK]).await.map_err(error)?;
    let (arrivals, mut arrived) = mpsc::unbounded_channel();
    let mut tasks = Vec::new();
    let received = AtomicUsize::new(0);
    tasks.push(tokio::spawn(each_message(echo_events, move |publish| {
        let is_message = publish.topic == OUT;
        let is_last = is_message && received.fetch_add(1, Relaxed) % traffic.vehicles == traffic.vehicles - 1;
        let answer = || payload(round_of(&publish.payload).unwrap_or_default(), traffic.answer_bytes);
        !is_last || echoer.try_publish(BACK, QoS::AtMostOnce, false, answer()).is_ok()
    })));
    let mut senders = Vec::new();
    for vehicle in 0..traffic.vehicles {
        let (sender, events) = subscribed(broker, &format!("ecod-bench-{vehicle}"), &[BACK]).await.map_err(error)?;
        let arrivals = arrivals.clone();
        senders.push(sender);
        tasks.push(tokio::spawn(each_message(events, move |publish| {
            arrivals.send((round_of(&publish.payload), Instant::now())).is_ok()
        })));
    }
    let mut histogram = latencies();
    let mut ticks = tokio::time::interval(traffic.interval);
    let mut missing = 0;
    for round in 0..traffic.rounds {
        ticks.tick().await;
        let mut sent = Instant::now();
        for (vehicle, sender) in senders.iter().enumerate() {
            if vehicle > 0 && !traffic.stagger.is_zero() {
                tokio::time::sleep(traffic.stagger).await;
            }
            let message = payload(round, traffic.message_bytes);
            sent = Instant::now();
            // A refusal shows as a missing answer.
            sender.try_publish(OUT, QoS::AtMostOnce, false, message).unwrap_or_default();
        }
        let mut open = traffic.vehicles as u32;
        while open > 0 {
            let Ok(Some((answered, at))) = tokio::time::timeout(PATIENCE, arrived.recv()).await else { break };
            if answered == Some(round) {
                open -= 1;
                if round >= traffic.rounds / 10 {
                    histogram.saturating_record(u64::try_from((at - sent).as_nanos()).unwrap_or(u64::MAX));
                }
            }
        }
        missing += open;
    }
    tasks.iter().for_each(tokio::task::JoinHandle::abort);
    if missing > 0 {
        let messages = traffic.rounds * traffic.vehicles as u32;
        return Err(TwoHopError::Missing { broker: broker.clone(), missing, messages });
    }
    Ok(histogram)
}

/// The round's number and zeros.
fn payload(round: u32, bytes: usize) -> Vec<u8> {
    let mut payload = round.to_le_bytes().to_vec();
    payload.resize(bytes.max(payload.len()), 0);
    payload
}

fn round_of(payload: &[u8]) -> Option<u32> {
    payload.first_chunk().map(|bytes| u32::from_le_bytes(*bytes))
}
