//! A vehicle that moves from cell to cell by its position, without a restart.
//!
//! ```text
//! PoseReceiver ── latest poses ──> Roamer ── observe ──> CellChoice
//!                                    ├─ present node: cameras, page, door, log
//!                                    └─ next node: gets ready beside it, then takes them over
//! ```
//!
//! The next node follows its cell's leader before the vehicle leaves the present node, so the
//! vehicle always has maps.

use std::convert::Infallible;
use std::time::Duration;

use ecod::diagnostics::TroubleKind;
use ecod::model::names::NodeName;
use ecod::model::origin::{GeographicPosition, StatedPose};
use ecod::model::time::Timestamp;
use ecod::roaming::{CellChoice, CellMove};
use tokio::time::{MissedTickBehavior, interval, timeout};

use super::config::{CellEntry, NodeConfig};
use super::presence::{MoveStep, Presence, VehicleParts};
use super::service::ServiceManager;
use super::{NodeError, NodeHandle, NodeMessage, start_with};
use crate::platform::clock;

/// Time between two checks of the position.
const CHECK_PERIOD: Duration = Duration::from_millis(200);

/// Age from which a pose is too old to be used.
const MAX_POSE_AGE: Duration = Duration::from_secs(2);

const NO_PLACE: &str =
    "no pose on Earth is available: the vehicle stays in its cell, wherever it is";
const PLACE_REMEDY: &str = "send poses with `latitude_deg` and `longitude_deg` to `pose.listen`";

/// Longest time for a step of a node.
const STEP_TIMEOUT: Duration = Duration::from_secs(5);

/// A running vehicle: its present node, and the next one while it changes to another cell.
pub struct Roamer {
    config: NodeConfig,
    cells: Vec<CellEntry>,
    vehicle: VehicleParts,
    choice: CellChoice,
    present: NodeHandle,
    next: Option<(NodeName, NodeHandle)>,
    /// The node of the cell that is being left.
    former: Option<NodeHandle>,
    /// Time at which the position was last available.
    placed_at: Timestamp,
}

impl Roamer {
    /// Starts the vehicle in its own cell; `config` is taken as valid. Without `cells` it stays
    /// there.
    ///
    /// # Errors
    /// Returns a [`NodeError`] if a part cannot start, or the file of cells cannot be used.
    pub async fn start(config: NodeConfig) -> Result<Self, NodeError> {
        let mut cells = config
            .load_cells()
            .map_err(|error| NodeError::Failed(format!("key `cells`: {error}")))?;
        let vehicle = VehicleParts::new(&config);
        // An error in another cell's entry must not keep the vehicle out of its own cell.
        cells.retain(|cell| match config.credentials_in(cell) {
            Ok(_) => true,
            Err(error) => {
                let about = cell.name.as_str();
                let cause = error.to_string();
                vehicle
                    .counters
                    .troubles()
                    .record_about(about, TroubleKind::CellLeftOut, &cause);
                cell.name == config.cell
            }
        });
        let choice = CellChoice::new(
            cells.iter().map(CellEntry::known).collect(),
            config.cell.clone(),
        );
        let present = start_with(vehicle.clone(), Presence::Active, config.clone()).await?;
        Ok(Self {
            config,
            cells,
            vehicle,
            choice,
            present,
            next: None,
            former: None,
            placed_at: clock::now(),
        })
    }

    /// The node of the vehicle's present cell.
    pub fn present(&self) -> &NodeHandle {
        &self.present
    }

    /// The vehicle's present cell.
    pub fn cell(&self) -> &NodeName {
        self.choice.present()
    }

    /// Moves from cell to cell until a node gives up.
    ///
    /// # Errors
    /// Always returns a [`NodeError`] with the reason, because a vehicle does not end successfully
    /// by itself.
    pub async fn drive(&mut self) -> Result<Infallible, NodeError> {
        let mut checks = interval(CHECK_PERIOD);
        checks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                failed = self.present.failed() => failed?,
                (cell, change) = next_change(&mut self.next) => self.change(&cell, change).await?,
                _ = checks.tick() => self.check_position().await?,
            }
        }
    }

    /// Stops the vehicle, the node that is not yet present first.
    pub async fn stop(self) {
        if let Some((_, next)) = self.next {
            next.stop().await;
        }
        self.present.stop().await;
        if let Some(former) = self.former {
            former.stop().await;
        }
    }

    /// Processes the latest position, if there is one.
    async fn check_position(&mut self) -> Result<(), NodeError> {
        let now = clock::now();
        let troubles = self.vehicle.counters.troubles();
        let place = self.place();
        if place.is_some() {
            self.placed_at = now;
        } else if !self.cells.is_empty() && now.since(self.placed_at) > MAX_POSE_AGE {
            troubles.record_with_remedy(None, TroubleKind::NoPose, NO_PLACE, PLACE_REMEDY);
        }
        match self.choice.observe(place.as_ref(), now) {
            Some(CellMove::Join(cell)) => self.join(cell).await,
            Some(CellMove::GiveUp(cell)) => {
                self.stay(&cell, "no map, or no `[origin]` of the cell, came in time; or the vehicle turned back").await
            }
            None => Ok(()),
        }
    }

    /// The vehicle's position on Earth.
    fn place(&self) -> Option<GeographicPosition> {
        let (at, pose) = self.vehicle.poses.borrow().back().copied()?;
        let StatedPose::OnEarth(pose) = pose else {
            return None;
        };
        let now = clock::now();
        let is_fresh = now.since(at).max(at.since(now)) <= MAX_POSE_AGE;
        let latitude_deg = pose.latitude_deg;
        let longitude_deg = pose.longitude_deg;
        is_fresh.then(|| GeographicPosition {
            latitude_deg,
            longitude_deg,
            height_m: pose.height_m.unwrap_or(0.0),
        })
    }

    /// Starts a second node in the next cell.
    async fn join(&mut self, cell: NodeName) -> Result<(), NodeError> {
        let Some(entry) = self.cells.iter().find(|entry| entry.name == cell) else {
            return Ok(());
        };
        let Ok(config) = self.config.in_cell(entry) else {
            return Ok(());
        };
        tracing::info!(from = %self.choice.present(), %cell, "getting ready in the next cell");
        // Nodes of the cell will connect to it, not just local programs.
        if config.serves_nodes()
            && let Err(error) = step(&self.present, MoveStep::CloseDoor).await
        {
            return self.fail(&cell, &error).await;
        }
        match start_with(self.vehicle.clone(), Presence::Preparing, config).await {
            Ok(node) => {
                self.next = Some((cell, node));
                Ok(())
            }
            Err(error) => self.fail(&cell, &error).await,
        }
    }

    async fn change(&mut self, cell: &NodeName, change: Change) -> Result<(), NodeError> {
        match change {
            Change::Follows => self.enter(cell).await,
            Change::Failed(error) => self.fail(cell, &error).await,
        }
    }

    /// Reports in the next cell from now on, and leaves the present one.
    async fn enter(&mut self, cell: &NodeName) -> Result<(), NodeError> {
        let Some((_, next)) = self.next.take_if(|_| self.choice.enter(cell)) else {
            return Ok(());
        };
        let former = self
            .former
            .insert(std::mem::replace(&mut self.present, next));
        step(former, MoveStep::HandOver).await?;
        self.vehicle.present_cell.send_replace(cell.clone());
        step(&self.present, MoveStep::TakeOver).await?;
        if let Some(former) = self.former.take() {
            former.stop().await;
        }
        step(&self.present, MoveStep::Activate).await?;
        if let Some(manager) = ServiceManager::from_environment() {
            self.present.report_to(manager);
        }
        tracing::info!(%cell, "the vehicle is in another cell now");
        Ok(())
    }

    /// Stays in the present cell, because a node in the next cell could not be started.
    async fn fail(&mut self, cell: &NodeName, error: &NodeError) -> Result<(), NodeError> {
        self.choice.fail(cell, clock::now());
        self.stay(cell, &error.to_string()).await
    }

    /// Stays in the present cell, and stops the node that was preparing in another.
    async fn stay(&mut self, cell: &NodeName, why: &str) -> Result<(), NodeError> {
        tracing::warn!(%cell, why, present = %self.choice.present(), "the vehicle stays in its cell");
        if let Some((_, next)) = self.next.take() {
            next.stop().await;
            self.vehicle.counters.troubles().leave_cell();
        }
        step(&self.present, MoveStep::Activate).await
    }
}

/// News of the next node.
enum Change {
    /// The node follows its cell's leader, and has the place of the cell on Earth.
    Follows,
    /// It has given up.
    Failed(NodeError),
}

/// Waits for news of the next node; forever without a next node.
async fn next_change(next: &mut Option<(NodeName, NodeHandle)>) -> (NodeName, Change) {
    let Some((cell, node)) = next else {
        return std::future::pending().await;
    };
    let mut maps = node.newest_map();
    let mut verdicts = node.newest_verdicts();
    let mut shared = node.shared.clone();
    let follows = async {
        let has_round = tokio::select! {
            map = maps.wait_for(Option::is_some) => map.is_ok(),
            verdicts = verdicts.wait_for(Option::is_some) => verdicts.is_ok(),
        };
        has_round
            && shared
                .wait_for(|shared| shared.origin.is_some())
                .await
                .is_ok()
    };
    let change = tokio::select! {
        true = follows => Change::Follows,
        Err(error) = node.failed() => Change::Failed(error),
        else => return std::future::pending().await,
    };
    (cell.clone(), change)
}

/// Makes a node take a step.
async fn step(node: &NodeHandle, step: MoveStep) -> Result<(), NodeError> {
    let taken = node
        .supervisor
        .call(|done| NodeMessage::Move { step, done }, Some(STEP_TIMEOUT));
    match timeout(STEP_TIMEOUT, taken).await {
        Ok(Ok(ractor::rpc::CallResult::Success(()))) => Ok(()),
        _ => Err(NodeError::Failed(format!(
            "the node did not take the step {step:?} of its way to another cell"
        ))),
    }
}
