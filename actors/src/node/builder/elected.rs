//! Who may speak for all at this node's broker.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use ecod::names::NodeName;
use tokio::sync::watch;

use crate::messages::leadership::Leadership;
use crate::transport::broker::LeaderCheck;

/// How long after it was last heard a leader that is not elected any more may still speak: its last round is under way
/// when its successor is known already.
const FAREWELL: Duration = Duration::from_secs(1);

/// Whoever this node knows to lead, as the other nodes told it over authenticated datagrams; while it knows of nobody,
/// anyone, and receivers decide.
pub(super) fn rule(leadership: watch::Receiver<Leadership>) -> LeaderCheck {
    let voices = Mutex::<Voices>::default();
    Arc::new(move |name| {
        let leadership = leadership.borrow();
        let mut voices = voices.lock().unwrap_or_else(PoisonError::into_inner);
        match leadership.leader() {
            None => true,
            Some(leader) if leader == name => voices.note(name),
            Some(_) => voices.heard_lately(name),
        }
    })
}

/// The two leaders that spoke last, and when.
#[derive(Debug, Default)]
struct Voices {
    last: Option<(NodeName, Instant)>,
    before: Option<(NodeName, Instant)>,
}

impl Voices {
    fn note(&mut self, name: &NodeName) -> bool {
        if self.last.as_ref().is_some_and(|(last, _)| last != name) {
            self.before = self.last.take();
        }
        self.last = Some((name.clone(), Instant::now()));
        true
    }

    fn heard_lately(&self, name: &NodeName) -> bool {
        [&self.last, &self.before].into_iter().flatten().any(|(voice, at)| voice == name && at.elapsed() < FAREWELL)
    }
}

#[cfg(test)]
mod tests {
    use ecod::epoch::Epoch;

    use super::*;
    use crate::messages::leadership::Position;

    #[test]
    fn the_elected_speaks_and_the_one_before_says_farewell() {
        let led_by = |leader: &str| Leadership {
            position: Position::Following,
            epoch: Some(Epoch::new(1, NodeName::new(leader).unwrap())),
            standby: None,
        };
        let (sender, receiver) = watch::channel(Leadership::default());
        let speaks = rule(receiver);
        let [edge, euclid, gauss] = ["edge", "euclid", "gauss"].map(|name| NodeName::new(name).unwrap());
        assert!(speaks(&gauss), "nobody is known to lead");
        sender.send_replace(led_by("edge"));
        assert!(speaks(&edge) && !speaks(&euclid) && !speaks(&gauss));
        sender.send_replace(led_by("euclid"));
        assert!(speaks(&edge) && speaks(&euclid) && speaks(&edge), "its last round");
        assert!(!speaks(&gauss));
    }
}
