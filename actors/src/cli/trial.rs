//! `ecod-node try`: a cell from the user's own pictures, without a configuration, or from the
//! pictures of a street.

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

use super::Failure;
use super::run::{input_ended, ip_and_port, run_to_end};
use crate::camera::config::{CameraConfig, MountConfig, OpticsConfig};
use crate::camera::detect::DetectorConfig;
use crate::camera::detect::coco::CocoConfig;
use crate::camera::frame_source::SourceConfig;
use crate::camera::frame_source::capture::CaptureConfig;
use crate::node::config::NodeConfig;
use crate::node::{self, NodeHandle};
use crate::observe::dashboard::DEFAULT_ADDRESS;
use crate::platform::installed;
use crate::telemetry::counters::Event;

/// Flags of `try`.
#[derive(Debug, Args)]
pub(super) struct TryArguments {
    /// Video files, played repeatedly
    #[arg(long, value_name = "FILE", num_args = 1..)]
    video: Vec<PathBuf>,
    /// Directories of images, shown repeatedly in the order of their names
    #[arg(long, value_name = "DIR", num_args = 1..)]
    images: Vec<PathBuf>,
    /// Numbers of cameras of this machine, 0 for /dev/video0
    #[arg(long, value_name = "N", num_args = 1..)]
    camera: Vec<u32>,
    /// Addresses of network cameras, such as rtsp://192.168.1.20/stream1
    #[arg(long, value_name = "URL", num_args = 1..)]
    url: Vec<String>,
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
    /// The frame sources with the names of their vehicles.
    fn sources(&self) -> Vec<(String, SourceConfig)> {
        let numbered = |kind: &str, index: usize| format!("{kind}-{}", index + 1);
        // A saved configuration should work in every directory.
        let absolute = |path: &PathBuf| std::path::absolute(path).unwrap_or_else(|_| path.clone());
        let videos = self.video.iter().enumerate().map(|(index, path)| {
            (
                numbered("video", index),
                SourceConfig::Video {
                    path: absolute(path),
                    looping: true,
                },
            )
        });
        let images = self.images.iter().enumerate().map(|(index, path)| {
            (
                numbered("images", index),
                SourceConfig::Images {
                    path: absolute(path),
                    fps: 5.0,
                    looping: true,
                },
            )
        });
        let cameras = self.camera.iter().map(|number| {
            let device = PathBuf::from(format!("/dev/video{number}"));
            (
                format!("camera-{number}"),
                SourceConfig::V4l2 {
                    device,
                    width: None,
                    height: None,
                    fps: None,
                },
            )
        });
        let urls = self.url.iter().enumerate().map(|(index, url)| {
            (
                numbered("url", index),
                SourceConfig::Url { url: url.clone() },
            )
        });
        videos.chain(images).chain(cameras).chain(urls).collect()
    }

    /// The configurations of the vehicles. The other vehicles get the first vehicle's address once
    /// it runs.
    fn configs(&self) -> Result<Vec<NodeConfig>, Failure> {
        let sources = self.sources();
        let mut configs = Vec::new();
        for (index, (name, source)) in sources.into_iter().enumerate() {
            if let SourceConfig::Video { .. } | SourceConfig::Images { .. } = source {
                source
                    .open(PROGRESS_PERIOD)
                    .map(drop)
                    .map_err(Failure::usage)?;
            }
            let mut config = vehicle(NodeName::new(name).map_err(Failure::usage)?, source);
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
            "no street in {}: run this in ecod's sources, or install the package ecod-node; or give --video FILE, --images DIR, \
             --camera 0 or --url rtsp://...",
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

/// A vehicle that stands at the origin, with default guesses for all unstated values. The
/// covariance of its objects includes the errors of the guesses.
fn vehicle(name: NodeName, source: SourceConfig) -> NodeConfig {
    let camera = CameraConfig {
        name: None,
        source,
        capture: CaptureConfig::default(),
        optics: OpticsConfig::default(),
        mount: MountConfig {
            height_m: Some(CAMERA_HEIGHT_M),
            ..MountConfig::default()
        },
        detector: DetectorConfig::Coco(CocoConfig::default()),
        projection: ProjectionConfig {
            pixel_sigma_px: 4.0,
            tilt_sigma_rad: 0.07,
            height_sigma_m: 0.4,
            ..ProjectionConfig::default()
        },
        view: ViewConfig::default(),
        votes: false,
    };
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
