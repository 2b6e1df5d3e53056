//! Messages whose objects are spread over several.

use std::collections::BTreeMap;

use ecod::wire::Limits;

use super::{CpmError, ReceivedCpm};

/// Segments of a station's latest message, until it is whole.
#[derive(Debug, Default)]
pub struct Segments {
    of_latest: BTreeMap<u8, ReceivedCpm>,
}

impl Segments {
    /// A whole message; `None` while segments of it are missing. Objects that a report omits would
    /// count as gone. A segment of another time drops the previous segments.
    ///
    /// # Errors
    /// Returns [`CpmError::TooManyObjects`] if all segments together have more than a report may
    /// have; they are dropped.
    pub fn join(&mut self, received: ReceivedCpm) -> Result<Option<ReceivedCpm>, CpmError> {
        let Some((number, total)) = received.segment else {
            return Ok(Some(received));
        };
        self.of_latest
            .retain(|_, segment| segment.captured_at == received.captured_at);
        self.of_latest.insert(number, received);
        if self
            .of_latest
            .values()
            .map(|segment| segment.objects.len())
            .sum::<usize>()
            > Limits::default().objects
        {
            self.of_latest.clear();
            return Err(CpmError::TooManyObjects);
        }
        if self.of_latest.len() < usize::from(total) {
            return Ok(None);
        }
        let segments = std::mem::take(&mut self.of_latest).into_values();
        Ok(segments.reduce(|mut whole, segment| {
            whole.objects.extend(segment.objects);
            whole.left_out += segment.left_out;
            whole
        }))
    }
}
