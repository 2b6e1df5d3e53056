//! What the election wants done, done in its order.

use ecod::election::{Body, Effect};
use ecod::wire::Encoding;
use ractor::ActorProcessingErr;

use super::{CONNECT_TIME, ElectionDriver, Preparing};
use crate::messages::fuser::FuserMessage;
use crate::messages::leader_election::LeaderElectionMessage;
use crate::messages::membership::MembershipMessage;
use crate::messages::reputation_keeper::ReputationKeeperMessage;
use crate::platform::clock;

impl ElectionDriver {
    pub(super) async fn carry_out(&mut self, effects: Vec<Effect>) -> Result<(), ActorProcessingErr> {
        for effect in effects {
            match effect {
                Effect::PersistTerm { term } => self.terms.save(term),
                Effect::Send { to, message } => {
                    // The next round is the other's unless it stays away for a whole period.
                    if matches!(message.body, Body::Yield { .. }) {
                        self.parts.fuser.send(FuserMessage::HoldRound);
                    }
                    let payload = message.encode(Encoding::Cbor).into();
                    self.parts.membership.send(MembershipMessage::Send { to, payload });
                }
                Effect::Lead { epoch, first_round, first } => {
                    self.terms.settle(epoch.term).await;
                    tracing::info!(%epoch, first_round, ?first, "leading");
                    self.preparing = None;
                    // The node's broker admits the first round only if it knows who leads.
                    self.tell_leadership();
                    self.parts.fuser.send(FuserMessage::Lead { epoch, first_round, first });
                }
                Effect::StopPublishing { epoch } => {
                    tracing::info!(%epoch, "no longer leading");
                    self.parts.fuser.send(FuserMessage::StopPublishing);
                }
                Effect::Prepare { leader } => {
                    tracing::info!(%leader, "preparing to take over");
                    let has_state = self.parts.keeper.get().is_none();
                    self.preparing = Some(Preparing { leader, since: clock::now(), has_state });
                    self.myself.send_after(CONNECT_TIME, || LeaderElectionMessage::CheckPrepared);
                }
                Effect::SendState { to } => {
                    self.parts.keeper.send(ReputationKeeperMessage::SendSnapshot { to });
                }
                // States, compared as a whole in `reflect`.
                Effect::Follow { .. } | Effect::Seek | Effect::AnnounceStandby { .. } => {}
            }
        }
        Ok(())
    }
}
