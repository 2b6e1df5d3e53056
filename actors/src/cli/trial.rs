//! `ecod-node try`: a cell from the user's own pictures, without a configuration, or from the
//! pictures of a street.

mod picture_source;

use std::collections::BTreeMap;
use std::io::{IsTerminal, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, ensure};
use clap::Args;
use ecod::aggregator::FusionConfig;
use ecod::model::names::{Label, NodeName};
use ecod::perception::projection::ProjectionConfig;
use ecod::perception::view::ViewConfig;
use ecod::tracking::TracksConfig;
use futures_util::FutureExt;
use tokio::signal::unix::{SignalKind, signal};

use self::picture_source::PictureSource;
use super::Failure;
use super::run::{input_ended, ip_and_port, run_to_end};
use crate::camera::config::{CameraConfig, MountConfig, OpticsConfig};
use crate::camera::detect::DetectorConfig;
use crate::camera::detect::coco::CocoConfig;
use crate::camera::detect::onnx::OnnxConfig;
use crate::camera::frame_source::SourceConfig;
use crate::camera::frame_source::capture::CaptureConfig;
use crate::node::config::NodeConfig;
use crate::node::{self, NodeHandle};
use crate::observe::dashboard::DEFAULT_ADDRESS;
use crate::platform::installed;
use crate::telemetry::counters::Event;

/// Arguments of `try`.
#[derive(Debug, Args)]
pub(super) struct TryArguments {
    /// Video files, images, directories of images, patterns such as frames/%04d.png, cameras of
    /// this machine (0 or /dev/video0) and addresses of network cameras (rtsp://, http://). Files
    /// are shown repeatedly
    #[arg(value_name = "SOURCE", group = "sources")]
    source: Vec<PictureSource>,
    /// Video files
    #[arg(long, value_name = "FILE", num_args = 1.., group = "sources", hide = true)]
    video: Vec<PathBuf>,
    /// Directories of images
    #[arg(long, value_name = "DIR", num_args = 1.., group = "sources", hide = true)]
    images: Vec<PathBuf>,
    /// Numbers of cameras of this machine
    #[arg(long, value_name = "N", num_args = 1.., group = "sources", hide = true)]
    camera: Vec<u32>,
    /// Addresses of network cameras
    #[arg(long, value_name = "URL", num_args = 1.., group = "sources", hide = true)]
    url: Vec<String>,
    /// ONNX file of your own detector, in place of the COCO detector
    #[arg(long, value_name = "FILE", requires = "sources")]
    model: Option<PathBuf>,
    /// Horizontal field of view of the cameras in degrees. Default 62.2
    #[arg(long, value_name = "DEGREES", requires = "sources")]
    fov: Option<f64>,
    /// Height of the cameras above the ground in metres. Default 1.5
    #[arg(long, value_name = "METRES", requires = "sources")]
    height: Option<f64>,
    /// Angle of the cameras below the horizon in degrees. Default 0
    #[arg(
        long,
        value_name = "DEGREES",
        requires = "sources",
        allow_negative_numbers = true
    )]
    pitch: Option<f64>,
    /// Write the configuration that is used; the files of further vehicles are numbered, as in
    /// node-2.toml
    #[arg(short, long, alias = "save", value_name = "FILE")]
    output: Option<PathBuf>,
    /// Address of the first vehicle's page. Default 127.0.0.1:8080, or a free port if that is in
    /// use
    #[arg(long, value_name = "IP:PORT", value_parser = ip_and_port)]
    dashboard: Option<SocketAddr>,
    /// Stop when standard input ends, for example when the parent process ends
    #[arg(long, hide = true)]
    stop_at_eof: bool,
}

/// Distance in metres between vehicles: their true positions are unavailable, and a vehicle must
/// not take another's objects for its own.
const SPACING_M: f64 = 50.0;

/// The street, below the prefix of an installed program and in the sources.
const STREET_INSTALLED: &str = "share/ecod-node/street";
const STREET_IN_SOURCES: &str = "examples/street";

/// Assumed height of the camera in metres, between the heights of a dashboard and of a hand.
const CAMERA_HEIGHT_M: f64 = 1.5;

/// Time between two figures of progress.
const PROGRESS_PERIOD: Duration = Duration::from_secs(1);

pub(super) fn run(arguments: &TryArguments) -> Result<(), Failure> {
    let configs = arguments.configs()?;
    run_to_end(serve(
        configs,
        arguments.output.as_deref(),
        arguments.stop_at_eof,
    ))
}

impl TryArguments {
    /// All sources: those by position, then those by flags of the kind.
    fn sources(&self) -> Vec<PictureSource> {
        let videos = self.video.iter().cloned().map(PictureSource::Video);
        let images = self.images.iter().cloned().map(PictureSource::Images);
        let devices = self
            .camera
            .iter()
            .map(|number| PictureSource::device(*number));
        let urls = self.url.iter().cloned().map(PictureSource::Url);
        let flagged = videos.chain(images).chain(devices).chain(urls);
        self.source.iter().cloned().chain(flagged).collect()
    }

    /// The sources with the names of their vehicles, such as `video-2` for the second video.
    fn named_sources(&self) -> Vec<(String, SourceConfig)> {
        let mut counts = BTreeMap::<&str, usize>::new();
        let mut named = Vec::new();
        for source in self.sources() {
            let count = counts.entry(source.kind()).or_default();
            *count += 1;
            named.push((format!("{}-{count}", source.kind()), source.into_config()));
        }
        named
    }

    /// A camera with default guesses for all unstated values. The covariance of its objects includes
    /// the errors of the guesses.
    fn camera(&self, source: SourceConfig) -> CameraConfig {
        let mut optics = OpticsConfig::default();
        if let Some(fov_deg) = self.fov {
            optics.horizontal_fov_deg = fov_deg;
        }
        let mut projection = ProjectionConfig {
            pixel_sigma_px: 4.0,
            ..ProjectionConfig::default()
        };
        if self.pitch.is_none() {
            projection.tilt_sigma_rad = 0.07;
        }
        if self.height.is_none() {
            projection.height_sigma_m = 0.4;
        }
        let detector = match &self.model {
            Some(model) => DetectorConfig::Onnx(OnnxConfig::of(
                std::path::absolute(model).unwrap_or_else(|_| model.clone()),
            )),
            None => DetectorConfig::Coco(CocoConfig::default()),
        };
        CameraConfig {
            name: None,
            source,
            capture: CaptureConfig::default(),
            optics,
            mount: MountConfig {
                height_m: Some(self.height.unwrap_or(CAMERA_HEIGHT_M)),
                pitch_deg: self.pitch.unwrap_or_default(),
                ..MountConfig::default()
            },
            detector,
            projection,
            view: ViewConfig::default(),
            votes: false,
        }
    }

    /// The configurations of the vehicles. The other vehicles get the first vehicle's address once
    /// it runs.
    fn configs(&self) -> Result<Vec<NodeConfig>, Failure> {
        let mut configs = Vec::new();
        for (index, (name, source)) in self.named_sources().into_iter().enumerate() {
            if let SourceConfig::Video { .. } | SourceConfig::Images { .. } = source {
                source
                    .open(PROGRESS_PERIOD)
                    .map(drop)
                    .map_err(Failure::usage)?;
            }
            let name = NodeName::new(name).map_err(Failure::usage)?;
            let mut config = vehicle(name, self.camera(source));
            config.pose.y_m -= SPACING_M * index as f64;
            configs.push(config);
        }
        if let Some(page) = self.dashboard {
            let bound = TcpListener::bind(page).map(drop);
            let free = "give --dashboard another address, or leave it out for a free port";
            bound
                .with_context(|| format!("no page at {page}: {free}"))
                .map_err(Failure::usage)?;
        }
        if configs.is_empty() {
            configs = street().map_err(Failure::usage)?;
        }
        for (index, config) in configs.iter_mut().enumerate() {
            if let Some(path) = &self.output {
                check_absent(&numbered(path, index)).map_err(Failure::usage)?;
            }
            isolate(config);
            config.dashboard.listen = self.dashboard.filter(|_| index == 0);
            config.validate().map_err(Failure::usage)?;
        }
        Ok(configs)
    }
}

/// Checks that a file can be made.
fn check_absent(path: &Path) -> anyhow::Result<()> {
    let directory = path
        .parent()
        .filter(|parent| !parent.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    ensure!(
        directory.is_dir(),
        "cannot write {}: make the directory first",
        path.display()
    );
    ensure!(
        !path.exists(),
        "cannot write {}: it exists, choose another name for --output",
        path.display()
    );
    Ok(())
}

/// The nodes of the street that comes with the program: two cameras that stay where they are.
fn street() -> anyhow::Result<Vec<NodeConfig>> {
    let directory = std::path::absolute(
        installed::path(STREET_INSTALLED).unwrap_or_else(|| STREET_IN_SOURCES.into()),
    )?;
    let missing = || {
        format!(
            "no street in {}: run this in ecod's sources, or install the package ecod-node; or give a video, a directory of \
             images, a camera such as 0, or an address such as rtsp://...",
            directory.display()
        )
    };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(&directory).with_context(missing)? {
        files.push(entry?.path());
    }
    files.retain(|file| {
        file.extension()
            .is_some_and(|extension| extension == "toml")
    });
    files.sort();
    ensure!(!files.is_empty(), missing());
    let node = |file: &PathBuf| {
        let mut config = NodeConfig::load_cell(file)?;
        if let Some(CameraConfig {
            source: SourceConfig::Video { path, .. },
            ..
        }) = &mut config.camera
        {
            *path = directory.join(&path);
        }
        Ok(config)
    };
    files.iter().map(node).collect()
}

/// Isolates a node of this process in a cell of its own, at unused addresses.
fn isolate(config: &mut NodeConfig) {
    config.cell = NodeName::from_static("try");
    config.listen = Some(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)));
    config.membership.bind = config.listen;
    config.membership.multicast.enabled = false;
}

/// A vehicle that stands at the origin.
fn vehicle(name: NodeName, camera: CameraConfig) -> NodeConfig {
    // A hand-held camera is not a car, and objects may be close to it.
    let tracks = TracksConfig {
        vehicle_radius_m: 0.1,
        vehicle_label: Label::new_static("camera"),
        ..TracksConfig::default()
    };
    NodeConfig {
        name: Some(name),
        fusion: FusionConfig {
            tracks,
            ..FusionConfig::default()
        },
        camera: Some(camera),
        ..NodeConfig::default()
    }
}

/// Runs the vehicles until SIGINT or SIGTERM, or until one gives up.
async fn serve(
    configs: Vec<NodeConfig>,
    save: Option<&Path>,
    stop_at_eof: bool,
) -> anyhow::Result<()> {
    let mut nodes = Vec::new();
    let outcome = tokio::select! {
        outcome = start_and_watch(configs, save, &mut nodes) => outcome,
        stopped = stop_signal() => stopped,
        () = input_ended(), if stop_at_eof => Ok(()),
    };
    if std::io::stderr().is_terminal() {
        eprintln!();
    }
    for node in nodes.into_iter().rev() {
        node.stop().await;
    }
    outcome
}

async fn stop_signal() -> anyhow::Result<()> {
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
    }
    Ok(())
}

async fn start_and_watch(
    configs: Vec<NodeConfig>,
    save: Option<&Path>,
    nodes: &mut Vec<NodeHandle>,
) -> anyhow::Result<()> {
    for (index, mut config) in configs.into_iter().enumerate() {
        config.membership.seeds = nodes
            .first()
            .and_then(NodeHandle::gossip_address)
            .iter()
            .map(ToString::to_string)
            .collect();
        let node = node::start(config.clone()).await?;
        let mut address = node.dashboard_address();
        let page = address
            .wait_for(Option::is_some)
            .await
            .context("the page ended")?
            .unwrap_or(DEFAULT_ADDRESS);
        if index == 0 {
            config.membership.bind = node.gossip_address();
            eprintln!("page: http://{page}/   (Ctrl-C ends)");
        } else {
            eprintln!(
                "page of {}: http://{page}/",
                config.name.as_ref().map_or("another", NodeName::as_str)
            );
        }
        nodes.push(node);
        if let Some(path) = save {
            let path = numbered(path, index);
            let text = config
                .to_toml_changed()
                .context("the configuration cannot be written as TOML")?;
            let written = std::fs::File::create_new(&path)
                .and_then(|mut file| file.write_all(text.as_bytes()));
            written.with_context(|| format!("cannot write {}", path.display()))?;
        }
    }
    watch(nodes).await
}

/// `node.toml`, `node-2.toml`, `node-3.toml` …
fn numbered(path: &Path, index: usize) -> PathBuf {
    if index == 0 {
        return path.to_owned();
    }
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let extension = path
        .extension()
        .map(|extension| format!(".{}", extension.to_string_lossy()))
        .unwrap_or_default();
    path.with_file_name(format!("{stem}-{}{extension}", index + 1))
}

/// Reports progress until a node gives up.
async fn watch(nodes: &mut [NodeHandle]) -> anyhow::Result<()> {
    let sum = |nodes: &[NodeHandle], event| {
        nodes
            .iter()
            .map(|node| node.counters().events(event))
            .sum::<u64>()
    };
    let mut ticks = tokio::time::interval(PROGRESS_PERIOD);
    let mut frames = 0;
    let mut shown = String::new();
    loop {
        ticks.tick().await;
        for node in nodes.iter_mut() {
            node.failed().now_or_never().unwrap_or(Ok(()))?;
        }
        let detected = sum(nodes, Event::FrameDetected);
        let rate = (detected - std::mem::replace(&mut frames, detected)) as f64
            / PROGRESS_PERIOD.as_secs_f64();
        let map = nodes.first().and_then(|node| {
            node.newest_map()
                .borrow()
                .as_ref()
                .map(|map| map.map.objects.len())
        });
        let objects = map.map_or_else(
            || "no map yet".to_owned(),
            |objects| format!("{objects} objects on the map"),
        );
        let line = format!(
            "{rate:.0} frames/s, {objects}, {} detections without a place",
            sum(nodes, Event::DetectionUnplaced)
        );
        let mut output = std::io::stderr().lock();
        // Failing to show progress does not end the trial.
        let _ = if output.is_terminal() {
            write!(output, "\r\x1b[K{line}").and_then(|()| output.flush())
        } else if line != shown {
            writeln!(output, "{line}")
        } else {
            Ok(())
        };
        shown = line;
    }
}
