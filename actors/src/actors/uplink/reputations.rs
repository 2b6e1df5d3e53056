//! The exchange of cells about vehicles, as this uplink carries it out.

use std::collections::BTreeSet;
use std::time::Duration;

use ecod::leadership::timers::MAX_RESET_AHEAD;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::neighbours::{ExchangeStep, ForeignNews};
use ecod::reputation::CellCounts;
use ecod::wire::{CellReputation, RejectReason};
use ractor::ActorRef;

use super::UplinkState;
use crate::messages::fuser::FuserMessage;
use crate::messages::uplink::UplinkMessage;
use crate::platform::clock;
use crate::telemetry::counters::Event;
use crate::transport::mqtt::region_inbox::source;

/// Time between two looks at what is to be told and asked.
pub(super) const EXCHANGE_PERIOD: Duration = Duration::from_millis(250);

/// Maximum number of messages about vehicles in that time. Maps share the link's queue.
const MAX_MESSAGES: usize = 6;

/// Time for which first words of other cells are gathered: a vehicle that comes is told of by many at once.
const GATHER_TIME: Duration = Duration::from_millis(20);

/// Time for which further counts are gathered.
const FURTHER_GATHER_TIME: Duration = Duration::from_secs(1);

impl UplinkState {
    /// Takes the vehicles that are present, and tells the fuser if there is less to be said of them. The same ones again come
    /// from a fuser that has been told nothing.
    pub(super) fn set_present(&mut self, vehicles: BTreeSet<NodeName>) {
        if self.exchange.set_present(&vehicles) || vehicles == self.present {
            self.tell_foreign_at = Some(clock::now());
        }
        self.present = vehicles;
        self.exchange_reputations();
    }

    /// Takes what the cell's own evidence says. It may contradict what other cells said.
    pub(super) fn count_vehicles(&mut self, counts: Vec<(NodeName, CellCounts)>) {
        let before = self.exchange.dropped();
        counts.into_iter().for_each(|(vehicle, counts)| self.exchange.count(&vehicle, counts));
        self.setup.counters.add(Event::CellReputationDropped, self.exchange.dropped() - before);
        if self.exchange.trust_in_words() != self.trust_in_words {
            self.tell_foreign_at.get_or_insert(clock::now() + FURTHER_GATHER_TIME);
        }
    }

    /// Takes what a cell says of a vehicle; what does not count is counted by its reason and cell.
    pub(super) fn take_reputation(
        &mut self,
        message: &CellReputation,
        received_at: Timestamp,
        myself: &ActorRef<UplinkMessage>,
    ) {
        let now = self.setup.clock.date(received_at);
        if message.reset_at_us.is_some_and(|at| at.since(now) >= MAX_RESET_AHEAD) {
            let reason = RejectReason::FromTheFuture;
            return self.setup.counters.reject_message(reason, &source(&message.cell), || {
                format!("what the cell {} says of {} not used: reset in the future", message.cell, message.vehicle)
            });
        }
        let Some(news) = self.exchange.hear(message) else { return };
        self.setup.counters.count(Event::CellReputationAccepted);
        let gather_time = if news == ForeignNews::First { GATHER_TIME } else { FURTHER_GATHER_TIME };
        let tell_at = clock::now() + gather_time;
        if self.tell_foreign_at.is_none_or(|at| tell_at < at) {
            self.tell_foreign_at = Some(tell_at);
            myself.send_after(gather_time, || UplinkMessage::Exchange);
        }
    }

    /// Tells the fuser what is new, and carries out the next steps on the link.
    pub(super) fn exchange_reputations(&mut self) {
        if self.tell_foreign_at.take_if(|at| *at <= clock::now()).is_some() {
            self.trust_in_words = self.exchange.trust_in_words();
            let (reputations, trust_in_words) = (self.exchange.foreign().clone().into(), self.trust_in_words.clone());
            self.setup.fuser.send(FuserMessage::TakeForeign { reputations, trust_in_words });
        }
        let Some(link) = self.link.as_mut().filter(|link| link.is_up()) else { return };
        for step in self.exchange.next(clock::now(), MAX_MESSAGES) {
            match step {
                ExchangeStep::Subscribe(filters) if !link.subscribe(&filters) => {
                    // There is no room. Asked anew, the region tells anew.
                    self.exchange.connect();
                    return;
                }
                ExchangeStep::Subscribe(_) => {}
                ExchangeStep::Unsubscribe(filters) => link.unsubscribe(&filters),
                ExchangeStep::Publish(message) if link.publish_reputation(&message) => {
                    self.setup.counters.count(Event::CellReputationPublished);
                }
                ExchangeStep::Publish(message) => self.exchange.not_sent(&message.vehicle),
            }
        }
    }
}
