//! The counterpart of the aggregator on the bare path.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::Ordering::Relaxed;
use std::thread;

use anyhow::Context;
use rumqttc::{Event, Packet, QoS};
use tokio::sync::oneshot;

use super::access::BrokerAccess;

/// Where vehicles send; below it their names.
pub(super) const OUT: &str = "ecod/bench/out";

/// Where the answers are.
pub(super) const BACK: &str = "ecod/bench/back";

/// Bytes of the newest map and of the newest verdicts, as they travel.
#[derive(Debug, Default)]
pub(super) struct AnswerBytes {
    pub(super) map: AtomicUsize,
    pub(super) verdict: AtomicUsize,
}

impl AnswerBytes {
    pub(super) fn all(&self) -> [usize; 2] {
        [&self.map, &self.verdict].map(|bytes| bytes.load(Relaxed))
    }
}

/// Answers once all vehicles have sent, with a map's and a verdict's bytes; runs on its own thread,
/// like the aggregator, and ends when dropped.
#[derive(Debug)]
pub(super) struct Echo {
    _stop: oneshot::Sender<()>,
}

impl Echo {
    /// Starts the echo; it is subscribed when this returns. A tick is complete after `packets`
    /// packets. Its answers have the current sizes in `answer_bytes`; without verdicts there is one
    /// answer.
    pub(super) async fn start(
        access: BrokerAccess,
        packets: usize,
        answer_bytes: Arc<AnswerBytes>,
        votes: bool,
    ) -> anyhow::Result<Self> {
        let (stop, stopped) = oneshot::channel();
        let (ready, started) = oneshot::channel();
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()?;
        let serve = async move {
            // An aggregator gets its own maps back too.
            let filters = [&*format!("{OUT}/+"), BACK];
            let (client, mut events) = match access.subscribed("ecod-bench-echo", &filters).await {
                Ok(connected) => connected,
                Err(error) => {
                    // The caller may have given up.
                    let _ = ready.send(Err(error));
                    return;
                }
            };
            // The caller may have given up.
            let _ = ready.send(Ok(()));
            let mut arrived = BTreeMap::<u32, usize>::new();
            while let Ok(event) = events.poll().await {
                let Event::Incoming(Packet::Publish(publish)) = event else {
                    continue;
                };
                let Some(tick) = tick_of(&publish.payload).filter(|_| publish.topic != BACK) else {
                    continue;
                };
                let count = arrived.entry(tick).or_default();
                *count += 1;
                if *count == packets {
                    // Earlier ticks that are incomplete have lost packets.
                    arrived.retain(|earlier, _| *earlier > tick);
                    for bytes in answer_bytes.all().into_iter().take(1 + usize::from(votes)) {
                        let answer = stamped(tick, vec![0; bytes]);
                        // A refusal shows as a missing answer.
                        let _ = client.try_publish(BACK, QoS::AtMostOnce, false, answer);
                    }
                }
            }
        };
        thread::Builder::new()
            .name("bench-echo".into())
            .spawn(move || {
                runtime.block_on(async {
                    tokio::select! {
                        () = serve => {}
                        _ = stopped => {}
                    }
                });
            })?;
        started.await.context("the echo ended at once")??;
        Ok(Self { _stop: stop })
    }
}

/// The bytes with the tick in place of the first four.
pub(super) fn stamped(tick: u32, mut bytes: Vec<u8>) -> Vec<u8> {
    bytes.resize(bytes.len().max(4), 0);
    bytes[..4].copy_from_slice(&tick.to_le_bytes());
    bytes
}

/// The tick in the first four bytes.
pub(super) fn tick_of(payload: &[u8]) -> Option<u32> {
    payload
        .first_chunk()
        .map(|bytes| u32::from_le_bytes(*bytes))
}
