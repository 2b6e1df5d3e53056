//! The time over two hops of one broker: publish, subscriber, publish, subscriber. This is the
//! minimum time for a report to come back as a map.

use std::time::Duration;

use ecod_actors::transport::mqtt::BrokerAddress;
use hdrhistogram::Histogram;
use rumqttc::{Event, EventLoop, Packet, Publish, QoS};
use tokio::sync::mpsc;
use tokio::time::{Instant, MissedTickBehavior};

use super::access::BrokerAccess;

/// Messages that are sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TwoHopLoad {
    /// Number of messages; the first tenth is for warming up and is not counted.
    pub messages: u32,
    /// Time from one message to the next, independent of answers: a slow broker does not reduce the
    /// load.
    pub interval: Duration,
    /// Bytes of every payload, at least 4.
    pub payload_bytes: usize,
}

impl Default for TwoHopLoad {
    /// 10 s of a report of ten objects every 10 ms.
    fn default() -> Self {
        Self {
            messages: 1000,
            interval: Duration::from_millis(10),
            payload_bytes: 1500,
        }
    }
}

/// The reason why there is no result.
#[derive(Debug, thiserror::Error)]
pub enum TwoHopError {
    /// A connection could not be made or broke.
    #[error("connection to {broker}: {source}")]
    Connection {
        /// Address of the broker.
        broker: BrokerAddress,
        /// Reason why the connection failed.
        source: Box<rumqttc::ConnectionError>,
    },
    /// The broker did not answer or lost a message.
    #[error("{missing} of {messages} messages did not come back from {broker}")]
    Missing {
        /// Address of the broker.
        broker: BrokerAddress,
        /// Messages that are missing.
        missing: u32,
        /// Number of messages that were sent.
        messages: u32,
    },
}

const OUT: &str = "ecod/bench/out";
const BACK: &str = "ecod/bench/back";
const PATIENCE: Duration = Duration::from_secs(5);

/// Measures with two bare MQTT 3.1.1 clients, in nanoseconds from when a message was handed to its
/// client to when it was back.
///
/// # Errors
/// Returns a [`TwoHopError`] if the broker cannot be reached or loses messages.
pub async fn raw(broker: &BrokerAddress, load: TwoHopLoad) -> Result<Histogram<u64>, TwoHopError> {
    let error = |source| TwoHopError::Connection {
        broker: broker.clone(),
        source: Box::new(source),
    };
    let access = BrokerAccess::open(broker.clone());
    let (echoer, echo_events) = access
        .subscribed("ecod-bench-echo", &[OUT])
        .await
        .map_err(error)?;
    let (sender, events) = access
        .subscribed("ecod-bench", &[BACK])
        .await
        .map_err(error)?;
    let (arrivals, mut arrived) = mpsc::unbounded_channel();
    let echo = tokio::spawn(each_message(echo_events, move |publish| {
        echoer
            .try_publish(BACK, QoS::AtMostOnce, false, publish.payload)
            .is_ok()
    }));
    let receive = tokio::spawn(each_message(events, move |publish| {
        arrivals.send((publish.payload, Instant::now())).is_ok()
    }));

    let mut ticks = tokio::time::interval(load.interval);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Burst);
    let mut sent = Vec::new();
    for index in 0..load.messages {
        ticks.tick().await;
        let mut payload = vec![0; load.payload_bytes.max(4)];
        payload[..4].copy_from_slice(&index.to_le_bytes());
        // Measured from here and not from the tick's due time: the timer's millisecond is not due
        // to the broker, and publishing does not block.
        sent.push(Instant::now());
        // A refusal shows as a missing message.
        let _ = sender.try_publish(OUT, QoS::AtMostOnce, false, payload);
    }
    let mut histogram = latencies();
    let mut back = 0;
    while back < load.messages
        && let Ok(Some((payload, at))) = tokio::time::timeout(PATIENCE, arrived.recv()).await
    {
        back += 1;
        let index = payload
            .first_chunk()
            .map_or(0, |bytes| u32::from_le_bytes(*bytes));
        if index >= load.messages / 10
            && let Some(sent) = sent.get(index as usize)
        {
            histogram.saturating_record(u64::try_from((at - *sent).as_nanos()).unwrap_or(u64::MAX));
        }
    }
    echo.abort();
    receive.abort();
    let missing = load.messages - back;
    if missing > 0 {
        return Err(TwoHopError::Missing {
            broker: broker.clone(),
            missing,
            messages: load.messages,
        });
    }
    Ok(histogram)
}

/// An empty histogram of nanoseconds up to a minute, three digits.
///
/// # Panics
/// Does not panic: the bounds are allowed.
#[expect(clippy::expect_used, reason = "the bounds are constant and allowed")]
pub fn latencies() -> Histogram<u64> {
    Histogram::new_with_bounds(1, 60_000_000_000, 3).expect("the bounds are allowed")
}

/// Calls `act` for each message until it declines or the connection ends.
async fn each_message(mut events: EventLoop, act: impl Fn(Publish) -> bool) {
    while let Ok(event) = events.poll().await {
        if let Event::Incoming(Packet::Publish(publish)) = event
            && !act(publish)
        {
            return;
        }
    }
}
