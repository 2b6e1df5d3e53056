//! Troubles that the nodes showed, beside the faults of their minutes.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::{self, Display, Formatter};

use ecod::model::names::NodeName;
use serde::Serialize;

use crate::failover::logs::LoggedTrouble;
use crate::failover::soak::Minute;

/// Equal troubles after equal faults.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Alarm {
    fault: &'static str,
    kind: String,
    pub(super) is_right: bool,
    times: usize,
    /// The first of them: who showed it about whom, and why.
    example: String,
}

/// Judges troubles by node. A trouble is right if a fault explains it: of its minute, of the minute before, or an earlier
/// fault whose message brokers retain. A trouble before the first fault is wrong.
pub(super) fn judge(
    troubles: &BTreeMap<NodeName, Vec<LoggedTrouble>>,
    minutes: &[Minute],
) -> Vec<Alarm> {
    let mut alarms: Vec<Alarm> = Vec::new();
    let all = troubles
        .iter()
        .flat_map(|(node, troubles)| troubles.iter().map(move |trouble| (node, trouble)));
    for (node, trouble) in all {
        let begun = minutes.partition_point(|minute| minute.span.0 <= trouble.at);
        let (earlier, possible) = minutes[..begun].split_at(begun.saturating_sub(2));
        let retained = earlier
            .iter()
            .filter(|minute| minute.disturbance.is_retained());
        let cause = possible
            .iter()
            .rev()
            .chain(retained)
            .find(|minute| minute.disturbance.explains(trouble, &minute.struck));
        let fault = cause
            .or(possible.last())
            .map_or("the cell starts", |minute| minute.disturbance.cause());
        let is_right = cause.is_some();
        let known = alarms.iter_mut().find(|alarm| {
            alarm.fault == fault && alarm.kind == trouble.kind && alarm.is_right == is_right
        });
        if let Some(alarm) = known {
            alarm.times += 1;
            continue;
        }
        let about = trouble.about.as_deref().unwrap_or("itself");
        alarms.push(Alarm {
            fault,
            kind: trouble.kind.clone(),
            is_right,
            times: 1,
            example: format!("{node} about {about}: {}", trouble.cause),
        });
    }
    alarms.sort_by(|one, other| one.fault.cmp(other.fault));
    alarms
}

/// Faults after which no node showed a trouble.
pub(super) fn silent<'a>(minutes: &'a [Minute], alarms: &[Alarm]) -> BTreeSet<&'a str> {
    let faults = minutes.iter().map(|minute| minute.disturbance.cause());
    faults
        .filter(|fault| alarms.iter().all(|alarm| alarm.fault != *fault))
        .collect()
}

impl Display for Alarm {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self {
            fault,
            kind,
            is_right,
            times,
            example,
        } = self;
        let verdict = if *is_right { "right" } else { "WRONG" };
        write!(f, "{fault:<44}{kind:<18}{times:>5}  {verdict:<7}{example}")
    }
}
