//! The exchange of counts about vehicles between cells, as carried out by this uplink.

use std::collections::BTreeSet;
use std::time::Duration;

use ecod::leadership::timers::MAX_RESET_AHEAD;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::neighbours::ExchangeStep;
use ecod::reputation::CellCounts;
use ecod::wire::{CellReputation, RejectReason};
use ractor::ActorRef;

use super::UplinkState;
use crate::messages::fuser::FuserMessage;
use crate::messages::uplink::UplinkMessage;
use crate::platform::clock;
use crate::telemetry::counters::Event;
use crate::transport::mqtt::region_inbox::source;

/// Time between two steps of the exchange.
pub(super) const EXCHANGE_PERIOD: Duration = Duration::from_millis(250);

/// Maximum number of messages about vehicles per step. Maps share the link's queue.
const MAX_MESSAGES: usize = 6;

impl UplinkState {
    /// Sets the present vehicles.
    pub(super) fn set_present(&mut self, vehicles: &BTreeSet<NodeName>) {
        self.exchange.set_present(vehicles);
        self.exchange_reputations();
    }

    /// Sets the counts of the cell's own evidence.
    pub(super) fn count_vehicles(&mut self, counts: Vec<(NodeName, CellCounts)>) {
        let (before, now) = (self.exchange.dropped(), clock::now());
        counts
            .into_iter()
            .for_each(|(vehicle, counts)| self.exchange.count(&vehicle, counts, now));
        self.setup.counters.add(
            Event::CellReputationDropped,
            self.exchange.dropped() - before,
        );
    }

    /// Processes a cell's counts about a vehicle; counts that are not accepted are counted by
    /// reason and cell.
    pub(super) fn take_reputation(
        &mut self,
        message: &CellReputation,
        received_at: Timestamp,
        myself: &ActorRef<UplinkMessage>,
    ) {
        let now = self.setup.clock.date(received_at);
        if message
            .reset_at_us
            .is_some_and(|at| at.since(now) >= MAX_RESET_AHEAD)
        {
            let reason = RejectReason::FromTheFuture;
            return self
                .setup
                .counters
                .reject_message(reason, &source(&message.cell), || {
                    format!(
                        "what the cell {} says of {} not used: reset in the future",
                        message.cell, message.vehicle
                    )
                });
        }
        let before = self.exchange.news_at();
        if self.exchange.hear(message, received_at) {
            self.setup.counters.count(Event::CellReputationAccepted);
        }
        if let Some(news_at) = self
            .exchange
            .news_at()
            .filter(|news_at| before.is_none_or(|before| *news_at < before))
        {
            myself.send_after(news_at.since(clock::now()), || UplinkMessage::Exchange);
        }
    }

    /// Sends new counts to the fuser, and carries out the next steps on the link.
    pub(super) fn exchange_reputations(&mut self) {
        if let Some(reputations) = self.exchange.take_news(clock::now()) {
            self.setup.fuser.send(FuserMessage::TakeForeign {
                reputations: reputations.into(),
            });
        }
        let Some(link) = self.link.as_mut().filter(|link| link.is_up()) else {
            return;
        };
        for step in self.exchange.next(clock::now(), MAX_MESSAGES) {
            match step {
                ExchangeStep::Subscribe(filters) if !link.subscribe(&filters) => {
                    // There is no room. After a new subscription, the region sends its retained
                    // messages again.
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
