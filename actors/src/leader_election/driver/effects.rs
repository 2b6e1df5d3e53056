//! What the election wants done, done in its order.

use std::time::Duration;

use ecod::election::{Body, Effect};
use ecod::wire::Encoding;
use ractor::ActorProcessingErr;

use super::{CONNECT_TIME, ElectionDriver, Preparing};
use crate::clock;
use crate::fuser::FuserMessage;
use crate::leader_election::LeaderElectionMessage;
use crate::membership::MembershipMessage;
use crate::reputation_keeper::ReputationKeeperMessage;
use crate::state_file::StateFile;

/// How long a disk may take before the node goes on without it.
const DISK_PATIENCE: Duration = Duration::from_secs(1);

impl ElectionDriver {
    pub(super) async fn carry_out(&mut self, effects: Vec<Effect>) -> Result<(), ActorProcessingErr> {
        for effect in effects {
            match effect {
                Effect::PersistTerm { term } => {
                    if let Some(file) = self.term_file.clone() {
                        self.save(file, term).await;
                    }
                }
                Effect::Send { to, message } => {
                    // The next round is the other's unless it stays away for a whole period.
                    if matches!(message.body, Body::Yield { .. }) {
                        self.parts.fuser.send(FuserMessage::HoldRound);
                    }
                    let payload = message.encode(Encoding::Cbor).into();
                    self.parts.membership.send(MembershipMessage::Send { to, payload });
                }
                Effect::Lead { epoch, first_round, on_time } => {
                    tracing::info!(%epoch, first_round, on_time, "leading");
                    self.preparing = None;
                    self.parts.fuser.send(FuserMessage::Lead { epoch, first_round, on_time });
                }
                Effect::StopPublishing { epoch } => {
                    tracing::info!(%epoch, "no longer leading");
                    self.parts.fuser.send(FuserMessage::StopPublishing);
                }
                Effect::Prepare { leader } => {
                    tracing::info!(%leader, "preparing to take over");
                    let has_state = self.parts.keeper.holder().is_none();
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

    /// Waits until the term is on disk; a disk that fails or hangs is logged, and the node goes on as one without disk.
    async fn save(&mut self, file: StateFile, term: u64) {
        let path = file.path().to_owned();
        let writing = tokio::task::spawn_blocking(move || file.save(&term));
        let written = match tokio::time::timeout(DISK_PATIENCE, writing).await {
            Ok(written) => written.map_err(std::io::Error::other).flatten(),
            Err(elapsed) => Err(elapsed.into()),
        };
        match written {
            Ok(()) => self.disk_failed = false,
            Err(error) if !std::mem::replace(&mut self.disk_failed, true) => {
                tracing::warn!(path = %path.display(), %error, "term not saved");
            }
            Err(_) => {}
        }
    }
}
