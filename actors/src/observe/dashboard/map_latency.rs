//! Latency of maps as histograms over the whole run.

use ecod::model::time::Timestamp;
use prometheus_client::metrics::histogram::Histogram;

/// Upper bounds of the buckets in seconds.
const BOUNDS_S: [f64; 12] = [
    0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0,
];

/// Latency of maps in two parts and as a whole. All but the first compare the clocks of aggregator
/// and node.
#[derive(Debug)]
pub(crate) struct MapLatency {
    /// From the oldest capture in a map, on the aggregator's clock, to its fusion.
    pub capture_to_fused: Histogram,
    /// From its fusion to its receipt here.
    pub fused_to_received: Histogram,
    /// From the oldest capture to the receipt.
    pub capture_to_received: Histogram,
}

impl Default for MapLatency {
    fn default() -> Self {
        let new = || Histogram::new(BOUNDS_S);
        Self {
            capture_to_fused: new(),
            fused_to_received: new(),
            capture_to_received: new(),
        }
    }
}

impl MapLatency {
    pub(crate) fn observe(
        &self,
        captured_at: Option<Timestamp>,
        fused_at: Timestamp,
        received_at: Timestamp,
    ) {
        self.fused_to_received
            .observe(received_at.since(fused_at).as_secs_f64());
        if let Some(captured_at) = captured_at {
            self.capture_to_fused
                .observe(fused_at.since(captured_at).as_secs_f64());
            self.capture_to_received
                .observe(received_at.since(captured_at).as_secs_f64());
        }
    }
}
