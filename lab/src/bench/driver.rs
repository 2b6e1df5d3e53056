//! The thread that sends the reports; it only waits for the schedule.

use std::thread;
use std::time::{Duration, Instant};

use ecod::wire::{ObjectReport, encode};
use rumqttc::{AsyncClient, QoS};

use super::echo::stamped;
use super::load::Load;
use super::schedule::{Schedule, wait_until};
use super::target::Target;

/// Messages of one vehicle.
#[derive(Debug)]
pub(super) struct Sender {
    pub(super) client: AsyncClient,
    /// Payloads of every tick, in this order, with their topics.
    pub(super) messages: Vec<(ObjectReport, String)>,
    pub(super) bare_topic: String,
}

/// Result of the sending.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Sent {
    /// Most time by which a tick began late.
    pub(super) latest: Duration,
    /// Reports that a client's queue did not take.
    pub(super) refused: u64,
    /// Bytes of the last report.
    pub(super) report_bytes: usize,
}

/// Sends everything on schedule.
pub(super) fn drive(
    schedule: Schedule,
    load: Load,
    target: &Target,
    mut senders: Vec<Sender>,
) -> Sent {
    // Otherwise Linux lets a thread sleep 50 µs longer than requested. If the kernel refuses,
    // sleeps are only less exact.
    if let Err(error) = nix::sys::prctl::set_timerslack(1) {
        tracing::debug!(%error, "timer slack stays");
    }
    let mut sent = Sent::default();
    let last = u32::try_from(senders.len().saturating_sub(1))
        .unwrap_or(u32::MAX)
        .max(1);
    for tick in 0..load.ticks() {
        let payload = |(report, topic): &mut (ObjectReport, String)| {
            report.seq = tick.into();
            report.captured_at_us = schedule.captured_at(tick);
            target.access.seal(topic, encode(report, target.encoding))
        };
        let payloads: Vec<Vec<Vec<u8>>> = senders
            .iter_mut()
            .map(|sender| sender.messages.iter_mut().map(payload).collect())
            .collect();
        let mut send = |begin: Instant, bare: bool, payloads: Vec<Vec<Vec<u8>>>| {
            wait_until(begin);
            sent.latest = sent.latest.max(begin.elapsed());
            for ((index, sender), payloads) in (0..).zip(&senders).zip(payloads) {
                if !load.spread.is_zero() {
                    wait_until(begin + load.spread * index / last);
                }
                for ((_, topic), payload) in sender.messages.iter().zip(payloads) {
                    let topic = if bare { &sender.bare_topic } else { topic };
                    let taken = sender
                        .client
                        .try_publish(topic, QoS::AtMostOnce, false, payload);
                    sent.refused += u64::from(taken.is_err());
                }
            }
        };
        let begin = schedule.begin(tick);
        let stamp = |payloads: &Vec<Vec<u8>>| {
            payloads
                .iter()
                .cloned()
                .map(|bytes| stamped(tick, bytes))
                .collect()
        };
        let bare = load.bare.then(|| payloads.iter().map(stamp).collect());
        sent.report_bytes = payloads
            .last()
            .and_then(|payloads| payloads.last())
            .map_or(0, Vec::len);
        send(begin, false, payloads);
        if let Some(payloads) = bare {
            send(begin + schedule.period() / 2, true, payloads);
        }
    }
    thread::sleep(schedule.period());
    sent
}
