//! A whole cell on this machine: one process for the edge and one for each vehicle, watched from
//! outside.
//!
//! ```text
//! demo ── spawns ──> ecod-node --role edge
//!      ── spawns ──> ecod-node --role auto × n  (each plays rendered frames, detects, projects, publishes, logs the maps it gets)
//!      ── listens to every report on all brokers, to compute what each vehicle would have detected alone
//!      ── kills the edge half-way and starts it again a second later
//! ```

mod judged_term;
mod report_collector;
mod stage;
pub mod street_demo;

use std::collections::BTreeMap;
use std::fs;
use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use anyhow::Context;
use ecod::aggregator::{Aggregator, Fused};
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, ReportKind};

pub use self::judged_term::JudgedTerm;
pub use self::report_collector::ObservedReport;
pub use self::stage::{News, Progress};

use self::judged_term::judged_terms;
use self::stage::{Played, Stage};
use crate::testbed::score::{SceneResult, SpotScore};
use crate::testbed::{Cav, Scene, Testbed, frames, setup};

/// One scene to be run live.
#[derive(Debug, Clone, Copy)]
pub struct Demo<'a> {
    /// The program that is run as every node.
    pub program: &'a Path,
    /// The camera and the placards of the scenes.
    pub testbed: &'a Testbed,
    /// The scene that is run.
    pub scene: &'a Scene,
    /// Time for which the maps are evaluated.
    pub duration: Duration,
    /// Directory for configurations and logs.
    pub directory: &'a Path,
    /// Address of the first vehicle's page.
    pub dashboard: SocketAddr,
}

/// Result of one scene, with the data for its drawing.
#[derive(Debug, Clone)]
pub struct DemoResult {
    /// Shares of spots and verdicts that were right.
    pub result: SceneResult,
    /// Number of maps that at least one vehicle received.
    pub maps: usize,
    /// Number of maps that a vehicle of the cell did not receive.
    pub missed: usize,
    /// Time from the capture of the oldest report in a map to its receipt by a vehicle, median.
    pub median_age: Duration,
    /// The last map that a vehicle received; `None` if there was no map.
    pub last_map: Option<GlobalMap>,
    /// All reports in the order of their receipt.
    pub reports: Vec<ObservedReport>,
    /// Time from which on the maps are evaluated.
    pub from: Timestamp,
    /// Terms of all leaders, in order.
    pub terms: Vec<JudgedTerm>,
}

impl Demo<'_> {
    /// Runs the scene; `progress` is called once a second.
    ///
    /// # Errors
    /// Returns an error if a node does not start or ends early, `progress` fails, or a file cannot
    /// be written; all nodes are stopped in any case.
    pub async fn run(
        &self,
        progress: impl Fn(Progress) -> anyhow::Result<()>,
    ) -> anyhow::Result<DemoResult> {
        let stage = Stage::new(self.program, self.directory, self.scene.cavs.len() + 1)?;
        // Before any node runs: the renderer needs the processor.
        let frames = self.directory.join("frames");
        let render = |cav: &Cav| {
            frames::render(
                self.testbed,
                self.scene,
                cav,
                1,
                &frames.join(cav.name.as_str()),
            )
        };
        let sources = self
            .scene
            .cavs
            .iter()
            .map(render)
            .collect::<anyhow::Result<Vec<_>>>()?;
        let mut configs = vec![setup::edge(self.testbed, self.scene)];
        for (cav, source) in self.scene.cavs.iter().zip(sources) {
            configs.push(setup::cav(self.testbed, self.scene, cav, source));
        }
        let observer = setup::unused_name(self.scene, "observer");
        let played = stage
            .play(configs, self.dashboard, observer, self.duration, progress)
            .await;
        fs::remove_dir_all(&frames)
            .with_context(|| format!("cannot remove {}", frames.display()))?;
        let Played {
            reports,
            from,
            until,
            ..
        } = played?;
        self.evaluate(&stage, reports, from, until)
    }

    fn evaluate(
        &self,
        stage: &Stage<'_>,
        reports: Vec<ObservedReport>,
        from: Timestamp,
        until: Timestamp,
    ) -> anyhow::Result<DemoResult> {
        let within = |time: Timestamp| from <= time && time <= until;
        let mut maps: BTreeMap<(Epoch, u64), GlobalMap> = BTreeMap::new();
        let mut ages = Vec::new();
        let mut logs = Vec::new();
        for cav in &self.scene.cavs {
            let mut log = stage.map_log(&cav.name)?;
            log.retain(|line| within(line.map.fused_at_us));
            for line in &log {
                ages.extend(
                    line.map
                        .oldest_capture_us
                        .map(|capture| line.received_at.since(capture)),
                );
                let epoch = Epoch::new(line.map.epoch, line.map.aggregator.clone());
                maps.insert((epoch, line.map.round), GlobalMap::clone(&line.map));
            }
            logs.push(log);
        }
        let received: usize = logs.iter().map(Vec::len).sum();
        let mut fused = SpotScore::default();
        maps.values()
            .for_each(|map| fused.judge(self.testbed, self.scene, map));
        ages.sort();
        Ok(DemoResult {
            result: SceneResult::new(
                self.testbed,
                self.scene,
                maps.len() as u64,
                &fused,
                &self.alone(&reports, from),
            ),
            missed: (maps.len() * self.scene.cavs.len()).saturating_sub(received),
            maps: maps.len(),
            median_age: ages.get(ages.len() / 2).copied().unwrap_or_default(),
            last_map: maps.into_values().next_back(),
            reports,
            from,
            terms: judged_terms(logs.iter().map(Vec::as_slice), |maps| {
                let mut score = SpotScore::default();
                maps.iter()
                    .for_each(|map| score.judge(self.testbed, self.scene, map));
                score.accuracy_pct()
            }),
        })
    }

    /// Accuracy of every vehicle alone.
    fn alone(&self, reports: &[ObservedReport], from: Timestamp) -> BTreeMap<NodeName, SpotScore> {
        let alone = |cav: &Cav| {
            let landmarks = self.scene.landmarks(&self.testbed.placard);
            let start = reports
                .first()
                .map_or(from, |observed| observed.received_at);
            let mut aggregator = Aggregator::new(
                cav.name.clone(),
                1,
                setup::fusion(self.testbed),
                landmarks,
                start,
            );
            let mut score = SpotScore::default();
            for observed in reports
                .iter()
                .filter(|observed| observed.report.node == cav.name)
            {
                let fused = aggregator.report(
                    ReportKind::Detections,
                    &observed.report,
                    observed.received_at,
                );
                if let Ok(Some(Fused { map: Some(map), .. })) = fused
                    && map.fused_at_us >= from
                {
                    score.judge(self.testbed, self.scene, &map);
                }
            }
            (cav.name.clone(), score)
        };
        self.scene.cavs.iter().map(alone).collect()
    }
}
