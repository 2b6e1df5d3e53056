//! Messages whose objects are spread over several.

use std::collections::BTreeMap;

use super::ReceivedCpm;

/// Segments of a station's latest message, until it is whole.
#[derive(Debug, Default)]
pub struct Segments {
    of_latest: BTreeMap<u8, ReceivedCpm>,
}

impl Segments {
    /// A whole message; `None` while segments of it are missing. Objects that a report omits would count as gone. A segment
    /// of another time drops those before.
    pub fn join(&mut self, received: ReceivedCpm) -> Option<ReceivedCpm> {
        let Some((number, total)) = received.segment else { return Some(received) };
        self.of_latest.retain(|_, segment| segment.captured_at == received.captured_at);
        self.of_latest.insert(number, received);
        if self.of_latest.len() < usize::from(total) {
            return None;
        }
        let mut segments = std::mem::take(&mut self.of_latest).into_values();
        let mut whole = segments.next()?;
        for segment in segments {
            whole.objects.extend(segment.objects);
            whole.left_out += segment.left_out;
        }
        Some(whole)
    }
}
