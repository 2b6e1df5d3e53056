//! A scene from its first frame to its last map, in virtual time: rendered, detected, projected and
//! fused by the parts that a live node runs.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;

use anyhow::Context;
use ecod::aggregator::{Aggregator, Algorithms, Fused, FusionConfig};
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::pace::PaceMode;
use ecod::wire::{ObjectReport, RejectReason, ReportKind};
use ecod_actors::camera::detect::Detect;
use ecod_actors::camera::detect::placard::{PlacardConfig, PlacardDetector};
use ecod_actors::camera::frame::CameraFrame;

use super::camera::TestbedCamera;
use super::score::{SceneResult, SpotScore};
use super::setup;
use crate::testbed::{Cav, Scene, Testbed};

/// One scene to be run.
#[derive(Debug, Clone, Copy)]
pub struct SceneRun<'a> {
    /// The camera and the placards of the scenes.
    pub testbed: &'a Testbed,
    /// The scene that is run.
    pub scene: &'a Scene,
    /// Number of fused maps to evaluate.
    pub verdicts: u64,
    /// Seed of everything that varies from frame to frame.
    pub seed: u64,
}

/// When virtual time begins.
const START: Timestamp = Timestamp(1_700_000_000_000_000);

impl SceneRun<'_> {
    /// Fuses the reports of the scene's vehicles and evaluates the maps.
    pub fn run(&self, reports: &BTreeMap<NodeName, Vec<ObjectReport>>) -> SceneResult {
        let mut fused = self.aggregator(Algorithms::Pace);
        let mut by_paper = self.paper_aggregator();
        let mut voting = self.aggregator(Algorithms::Vote);
        let mut agreeing = self.aggregator(Algorithms::Both);
        let unscored = || (self.aggregator(Algorithms::Pace), SpotScore::default());
        let mut alone: BTreeMap<NodeName, (Aggregator, SpotScore)> = self
            .scene
            .cavs
            .iter()
            .map(|cav| (cav.name.clone(), unscored()))
            .collect();
        let mut score = SpotScore::default();
        let mut paper = SpotScore::default();
        let mut votes = SpotScore::default();
        let mut answers = SpotScore::default();
        for verdict in 0..self.verdicts {
            let steps =
                verdict * self.frames_per_verdict()..(verdict + 1) * self.frames_per_verdict();
            let of_verdict =
                |cav: &[ObjectReport]| cav[steps.start as usize..steps.end as usize].to_vec();
            let all: Vec<_> = reports.values().flat_map(|cav| of_verdict(cav)).collect();
            for (aggregator, score) in [
                (&mut fused, &mut score),
                (&mut voting, &mut votes),
                (&mut agreeing, &mut answers),
            ] {
                self.judge(aggregator, all.clone(), score);
            }
            if let Some(map) = fuse(&mut by_paper, all).and_then(|fused| fused.map) {
                paper.judge_paper(self.testbed, self.scene, &map);
            }
            for (name, cav) in reports {
                if let Some((aggregator, score)) = alone.get_mut(name) {
                    self.judge(aggregator, of_verdict(cav), score);
                }
            }
        }
        let alone = alone
            .into_iter()
            .map(|(name, (_, score))| (name, score))
            .collect();
        let result = SceneResult::new(self.testbed, self.scene, self.verdicts, &score, &alone);
        let [vote_accuracy_pct, answer_accuracy_pct] =
            [votes, answers].map(|score| Some(score.accuracy_pct()));
        SceneResult {
            paper_accuracy_pct: Some(paper.accuracy_pct()),
            vote_accuracy_pct,
            answer_accuracy_pct,
            ..result
        }
    }

    /// Fuses one verdict's reports and evaluates the result.
    fn judge(
        &self,
        aggregator: &mut Aggregator,
        reports: Vec<ObjectReport>,
        score: &mut SpotScore,
    ) {
        let Some(Fused { map, verdicts, .. }) = fuse(aggregator, reports) else {
            return;
        };
        match (map, verdicts) {
            (Some(map), _) => score.judge(self.testbed, self.scene, &map),
            (None, Some(verdicts)) => score.judge_verdicts(self.testbed, self.scene, &verdicts),
            (None, None) => {}
        }
    }

    /// Frames that every vehicle captures for one verdict.
    pub fn frames_per_verdict(&self) -> u64 {
        let camera = &self.testbed.camera;
        let frames =
            camera.submission_interval.as_secs_f64() / camera.capture_interval.as_secs_f64();
        (frames.round() as u64).max(1)
    }

    /// Every vehicle's reports, one for each frame, computed on all cores. `progress` is called for
    /// every processed frame.
    ///
    /// # Errors
    /// Returns an error if a part of the pipeline cannot be built or a frame cannot be rendered.
    pub fn reports(
        &self,
        progress: &(impl Fn() + Sync),
    ) -> anyhow::Result<BTreeMap<NodeName, Vec<ObjectReport>>> {
        let next = AtomicU64::new(0);
        let done = Mutex::new(BTreeMap::new());
        let workers = thread::available_parallelism()
            .map_or(1, usize::from)
            .min(self.scene.cavs.len().max(1));
        thread::scope(|scope| {
            let work = || {
                while let Some(cav) = self
                    .scene
                    .cavs
                    .get(next.fetch_add(1, Ordering::Relaxed) as usize)
                {
                    let reports = self
                        .watch(cav, progress)
                        .with_context(|| format!("vehicle {}", cav.name));
                    done.lock()
                        .unwrap_or_else(std::sync::PoisonError::into_inner)
                        .insert(cav.name.clone(), reports);
                }
            };
            (1..workers).for_each(|_| drop(scope.spawn(work)));
            work();
        });
        let done = done
            .into_inner()
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        done.into_iter()
            .map(|(name, reports)| Ok((name, reports?)))
            .collect()
    }

    /// The reports of one vehicle from all its frames.
    fn watch(&self, cav: &Cav, progress: &impl Fn()) -> anyhow::Result<Vec<ObjectReport>> {
        let camera = TestbedCamera::new(self.testbed, self.scene, cav, self.seed)?;
        let mut detector = PlacardDetector::new(PlacardConfig::default());
        let mut perception = setup::perception(self.testbed, self.scene, cav);
        let interval = self.testbed.camera.capture_interval;
        (0..self.verdicts * self.frames_per_verdict())
            .map(|seq| {
                let captured_at = START + interval * u32::try_from(seq)?;
                let frame = CameraFrame {
                    image: camera.frame(seq)?,
                    captured_at,
                    seq,
                };
                let report = perception.report(detector.detect(&frame)?, captured_at);
                progress();
                Ok(report)
            })
            .collect()
    }

    fn aggregator(&self, algorithms: Algorithms) -> Aggregator {
        self.aggregator_with(FusionConfig {
            algorithms,
            ..setup::fusion(self.testbed)
        })
    }

    /// PACE with the formulas of the paper.
    fn paper_aggregator(&self) -> Aggregator {
        let mut fusion = setup::fusion(self.testbed);
        fusion.pace.mode = PaceMode::Paper;
        self.aggregator_with(fusion)
    }

    fn aggregator_with(&self, fusion: FusionConfig) -> Aggregator {
        let landmarks = self.scene.landmarks(&self.testbed.placard);
        Aggregator::new(NodeName::from_static("edge"), 1, fusion, landmarks, START)
    }
}

/// Fuses one verdict's reports in the order of capture, each for the algorithms that run, and
/// returns the last round.
fn fuse(aggregator: &mut Aggregator, mut reports: Vec<ObjectReport>) -> Option<Fused> {
    reports.sort_by(|a, b| {
        a.captured_at_us
            .cmp(&b.captured_at_us)
            .then_with(|| a.node.cmp(&b.node))
    });
    let last = reports.last()?.captured_at_us;
    let mut round = None;
    for report in &reports {
        let node = &report.node;
        let captured_at = report.captured_at_us;
        for (kind, report) in [
            (ReportKind::VoteDetections, report.votes()),
            (ReportKind::Detections, report.clone()),
        ] {
            match aggregator.report(kind, &Arc::new(report), captured_at) {
                Ok(closed) => round = closed.or(round),
                Err(RejectReason::NotFused) => {}
                Err(reason) => tracing::warn!(%node, %reason, "report not used"),
            }
        }
    }
    let deadline = aggregator.deadline();
    aggregator.tick(deadline.max(last)).or(round)
}
