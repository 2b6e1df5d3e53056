//! `ecod-node try`: a cell from the user's own pictures, without a configuration, or from the
//! pictures of a street.

mod camera_watch;
mod picture_source;
mod template;

use std::collections::BTreeMap;
use std::io::{IsTerminal, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use clap::{ArgGroup, Args};
use ecod::aggregator::FusionConfig;
use ecod::model::names::{Label, NodeName};
use ecod::perception::projection::{MountEstimate, ProjectionConfig};
use ecod::perception::view::ViewConfig;
use ecod::tracking::TracksConfig;
use futures_util::FutureExt;
use tokio::signal::unix::{SignalKind, signal};

use self::camera_watch::CameraWatch;
use self::picture_source::PictureSource;
use self::template::{Guess, Template};
use super::Failure;
use super::run::{input_ended, ip_and_port, run_to_end};
use crate::camera::config::{CameraConfig, MountConfig, OpticsConfig};
use crate::camera::detect::DetectorConfig;
use crate::camera::detect::coco::CocoConfig;
use crate::camera::detect::onnx::OnnxConfig;
use crate::camera::frame_source::SourceConfig;
use crate::camera::frame_source::capture::CaptureConfig;
use crate::camera::image_size::ImageSize;
use crate::camera::mask::Mask;
use crate::node::config::NodeConfig;
use crate::node::{self, NodeHandle};
use crate::observe::dashboard::DEFAULT_ADDRESS;
use crate::platform::installed;
use crate::telemetry::counters::Event;

/// Arguments of `try`.
#[derive(Debug, Default, Args)]
#[command(group = ArgGroup::new("sources").multiple(true))]
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
    /// Height of the cameras above the ground in metres. Without it and --pitch: 1.5, until people who
    /// walk give both
    #[arg(long, value_name = "METRES", requires = "sources")]
    height: Option<f64>,
    /// Angle of the cameras below the horizon in degrees. Default 0, or from people who walk
    #[arg(
        long,
        value_name = "DEGREES",
        requires = "sources",
        allow_negative_numbers = true
    )]
    pitch: Option<f64>,
    /// Part of the pictures that is black, as corners in shares of width and height: "0,0 0.3,0 0.3,0.4".
    /// May be repeated
    #[arg(long, value_name = "CORNERS", requires = "sources")]
    mask: Vec<Mask>,
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

/// Maximum time for the first frame, of which only the size is used.
const FIRST_FRAME_TIME: Duration = Duration::from_secs(10);

/// Time between two figures of progress.
const PROGRESS_PERIOD: Duration = Duration::from_secs(1);

pub(super) fn run(arguments: &TryArguments) -> Result<(), Failure> {
    let configs = arguments.configs()?;
    let cell = TryCell {
        templates: arguments.templates(configs.len()).map_err(Failure::usage)?,
        guesses: arguments.guesses(),
        vehicles: Vec::new(),
    };
    run_to_end(cell.serve(configs, arguments.stop_at_eof))
}

impl TryArguments {
    /// The guesses about each vehicle. The street's vehicles have configurations.
    fn guesses(&self) -> Vec<Guess> {
        let stated = [
            (Guess::FieldOfView, self.fov.is_some()),
            (Guess::Height, self.height.is_some()),
            (Guess::Tilt, self.pitch.is_some()),
            (Guess::Position, false),
        ];
        let has_sources = !self.sources().is_empty();
        let guesses = stated.into_iter().filter(|(_, is_stated)| !is_stated);
        guesses
            .map(|(guess, _)| guess)
            .filter(|_| has_sources)
            .collect()
    }

    /// The files for the configurations of this number of vehicles, if they are to be written.
    fn templates(&self, count: usize) -> anyhow::Result<Vec<Template>> {
        let Some(path) = &self.output else {
            return Ok(Vec::new());
        };
        (0..count)
            .map(|index| Template::new(numbered(path, index)))
            .collect()
    }

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
            masks: self.mask.clone().into(),
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
            let mut camera = self.camera(source);
            if !camera.masks.is_empty() {
                state_size(&mut camera).map_err(Failure::usage)?;
            }
            if let SourceConfig::Video { .. } | SourceConfig::Images { .. } = camera.source {
                camera
                    .open(PROGRESS_PERIOD)
                    .map(drop)
                    .map_err(Failure::usage)?;
            }
            let name = NodeName::new(name).map_err(Failure::usage)?;
            let mut config = vehicle(name, camera);
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
            isolate(config);
            config.dashboard.listen = self.dashboard.filter(|_| index == 0);
            config.validate().map_err(Failure::usage)?;
        }
        Ok(configs)
    }
}

/// Sets the size of the optics to the size of the source's first frame, as masks require.
fn state_size(camera: &mut CameraConfig) -> anyhow::Result<()> {
    camera.masks.polygons().context("--mask")?;
    let masks = std::mem::take(&mut camera.masks);
    let end = Instant::now() + FIRST_FRAME_TIME;
    let mut source = camera.open(FIRST_FRAME_TIME)?;
    let size = loop {
        match source.next_frame() {
            Ok(frame) => break ImageSize::of(&frame.image),
            Err(error) if error.is_passing() && Instant::now() < end => {}
            Err(error) => return Err(error.into()),
        }
    };
    camera.optics.width_px = Some(size.width);
    camera.optics.height_px = Some(size.height);
    camera.masks = masks;
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

/// The running vehicles of `try`.
struct TryCell {
    /// Files for the configurations of the vehicles; empty without `--output`.
    templates: Vec<Template>,
    /// The guesses about each vehicle.
    guesses: Vec<Guess>,
    vehicles: Vec<Vehicle>,
}

/// A vehicle with its node.
struct Vehicle {
    /// The configuration, as `--output` writes it.
    config: NodeConfig,
    guesses: Vec<Guess>,
    /// Address of its page.
    page: SocketAddr,
    /// `None` if height and tilt of the camera are stated or found.
    watch: Option<CameraWatch>,
    node: NodeHandle,
}

impl Vehicle {
    fn name(&self) -> &str {
        self.config
            .name
            .as_ref()
            .map_or("a vehicle", NodeName::as_str)
    }

    /// Height and tilt of the camera, if people have just determined them.
    async fn find_camera(&mut self) -> anyhow::Result<Option<MountEstimate>> {
        let Some(mut watch) = self.watch.take() else {
            return Ok(None);
        };
        let fit = move || {
            let found = watch.find();
            (watch, found)
        };
        let (watch, found) = tokio::task::spawn_blocking(fit).await?;
        self.watch = Some(watch).filter(|_| found.is_none());
        Ok(found)
    }
}

/// Guesses that people who walk replace, if all of them are guesses.
const MOUNT: [Guess; 2] = [Guess::Height, Guess::Tilt];

impl TryCell {
    fn finds_cameras(&self) -> bool {
        MOUNT.iter().all(|guess| self.guesses.contains(guess))
    }

    /// Runs the vehicles until SIGINT or SIGTERM, or until one gives up.
    async fn serve(mut self, configs: Vec<NodeConfig>, stop_at_eof: bool) -> anyhow::Result<()> {
        let outcome = tokio::select! {
            outcome = self.start_and_watch(configs) => outcome,
            stopped = stop_signal() => stopped,
            () = input_ended(), if stop_at_eof => Ok(()),
        };
        if std::io::stderr().is_terminal() {
            eprintln!();
        }
        for vehicle in self.vehicles.into_iter().rev() {
            vehicle.node.stop().await;
        }
        outcome
    }

    async fn start_and_watch(&mut self, configs: Vec<NodeConfig>) -> anyhow::Result<()> {
        for (index, mut config) in configs.into_iter().enumerate() {
            let first = self.vehicles.first();
            let seed = first.and_then(|vehicle| vehicle.node.gossip_address());
            config.membership.seeds = seed.iter().map(ToString::to_string).collect();
            let vehicle = self.start(config).await?;
            let page = vehicle.page;
            if index == 0 {
                eprintln!("page: http://{page}/   (Ctrl-C ends)");
            } else {
                eprintln!("page of {}: http://{page}/", vehicle.name());
            }
            self.vehicles.push(vehicle);
            self.share_pictures();
            self.save(index)?;
        }
        self.watch().await
    }

    /// Starts a vehicle. The first one's configuration then states the address that its node has
    /// chosen, at which the others find it.
    async fn start(&self, mut config: NodeConfig) -> anyhow::Result<Vehicle> {
        let mut running = config.clone();
        let mut watch = None;
        if self.finds_cameras()
            && let Some(camera) = running.camera.take()
        {
            let (people, camera) = CameraWatch::new(camera)?;
            watch = Some(people);
            running.camera = Some(camera);
        }
        let node = node::start(running).await?;
        let mut address = node.dashboard_address();
        let page = address
            .wait_for(Option::is_some)
            .await
            .context("the page ended")?
            .unwrap_or(DEFAULT_ADDRESS);
        if self.vehicles.is_empty() {
            config.membership.bind = node.gossip_address();
        }
        Ok(Vehicle {
            config,
            guesses: self.guesses.clone(),
            page,
            watch,
            node,
        })
    }

    /// Writes the configuration of a vehicle, if requested.
    fn save(&mut self, index: usize) -> anyhow::Result<()> {
        let vehicle = &self.vehicles[index];
        let Some(template) = self.templates.get_mut(index) else {
            return Ok(());
        };
        template.write(&vehicle.config, &vehicle.guesses)
    }

    /// Shows the pictures of all vehicles on the page of each.
    fn share_pictures(&self) {
        for vehicle in &self.vehicles {
            let others = self
                .vehicles
                .iter()
                .filter(|other| other.page != vehicle.page)
                .flat_map(|other| other.node.cameras());
            vehicle.node.show_cameras(others.cloned().collect());
        }
    }

    /// Reports progress, and starts a vehicle anew when its camera is found, until a node gives up.
    async fn watch(&mut self) -> anyhow::Result<()> {
        let mut ticks = tokio::time::interval(PROGRESS_PERIOD);
        let mut frames = 0;
        let mut shown = String::new();
        loop {
            ticks.tick().await;
            for index in 0..self.vehicles.len() {
                let vehicle = &mut self.vehicles[index];
                vehicle.node.failed().now_or_never().unwrap_or(Ok(()))?;
                if let Some(estimate) = vehicle.find_camera().await? {
                    self.use_camera(index, &estimate).await?;
                }
            }
            let detected = self.events(Event::FrameDetected);
            let rate = detected.saturating_sub(std::mem::replace(&mut frames, detected)) as f64
                / PROGRESS_PERIOD.as_secs_f64();
            let map = self
                .vehicles
                .first()
                .map(|vehicle| vehicle.node.newest_map());
            let count = map.and_then(|map| map.borrow().as_ref().map(|map| map.map.objects.len()));
            let objects = count.map_or_else(
                || "no map yet".to_owned(),
                |objects| format!("{objects} objects on the map"),
            );
            let unplaced = self.events(Event::DetectionUnplaced);
            let line =
                format!("{rate:.0} frames/s, {objects}, {unplaced} detections without a place");
            let mut output = std::io::stderr().lock();
            // Failing to show progress does not end the command.
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

    /// Count of an event of all vehicles since they were last started.
    fn events(&self, event: Event) -> u64 {
        let counts = self
            .vehicles
            .iter()
            .map(|vehicle| vehicle.node.counters().events(event));
        counts.sum()
    }

    /// Starts a vehicle anew with height and tilt of its camera.
    async fn use_camera(&mut self, index: usize, estimate: &MountEstimate) -> anyhow::Result<()> {
        let Vehicle {
            mut config,
            mut guesses,
            page,
            node,
            ..
        } = self.vehicles.remove(index);
        node.stop().await;
        if let Some(camera) = &mut config.camera {
            camera_watch::apply(estimate, camera);
        }
        let mut running = config.clone();
        running.dashboard.listen = Some(page);
        let node = node::start(running).await?;
        guesses.retain(|guess| !MOUNT.contains(guess));
        guesses.push(Guess::MountFromPeople);
        let vehicle = Vehicle {
            config,
            guesses,
            page,
            watch: None,
            node,
        };
        let pitch_deg = estimate.mount.pitch_rad.to_degrees();
        eprintln!(
            "camera of {} found from people who walk: {:.1} m high, {:.0}° {}",
            vehicle.name(),
            estimate.mount.height_m.unwrap_or_default(),
            pitch_deg.abs(),
            if pitch_deg < 0.0 { "up" } else { "down" }
        );
        self.vehicles.insert(index, vehicle);
        self.share_pictures();
        if let Err(error) = self.save(index) {
            eprintln!("the file keeps the guessed mount: {error:#}");
        }
        Ok(())
    }
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

#[cfg(test)]
mod tests {
    use ecod::perception::camera::{Intrinsics, Mount};
    use ecod_testkit::{until, walking_people};
    use opencv::core::{CV_8UC1, Mat, Scalar};

    use super::*;
    use crate::camera::detect::recorded::RecordedConfig;
    use crate::camera::image_codec::encode_jpeg;

    /// A vehicle with a guessed mount, before whose camera people walk.
    fn sees_walkers(directory: &Path) -> NodeConfig {
        let blank = Mat::new_rows_cols_with_default(720, 1280, CV_8UC1, Scalar::all(90.0)).unwrap();
        std::fs::write(directory.join("0.jpg"), encode_jpeg(&blank, 95).unwrap()).unwrap();
        let real = Mount {
            height_m: Some(3.5),
            pitch_rad: 18f64.to_radians(),
            ..Mount::default()
        };
        let optics = Intrinsics::with_square_pixels(1280, 720, 62.2f64.to_radians());
        let boxes = directory.join("boxes.jsonl");
        let lines = (0..300).map(|frame| {
            let people = walking_people(f64::from(frame) * 0.3, &real, optics);
            serde_json::to_string(&people).unwrap() + "\n"
        });
        std::fs::write(&boxes, lines.collect::<String>()).unwrap();
        let source = SourceConfig::Images {
            path: directory.to_owned(),
            fps: 100.0,
            looping: true,
        };
        let arguments = TryArguments::default();
        let mut config = vehicle(NodeName::from_static("images-1"), arguments.camera(source));
        isolate(&mut config);
        config.dashboard.listen = Some(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)));
        config.camera.as_mut().unwrap().detector = DetectorConfig::Recorded(RecordedConfig {
            path: boxes,
            looping: true,
        });
        config
    }

    fn saved_to(path: &Path) -> TryCell {
        TryCell {
            templates: vec![Template::new(path.to_owned()).unwrap()],
            guesses: vec![
                Guess::FieldOfView,
                Guess::Height,
                Guess::Tilt,
                Guess::Position,
            ],
            vehicles: Vec::new(),
        }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn walking_people_replace_guessed_mount() {
        let directory = tempfile::tempdir().unwrap();
        let saved = directory.path().join("node.toml");
        let cell = saved_to(&saved);
        let text = || std::fs::read_to_string(&saved).unwrap_or_default();
        let found = || -> Option<[f64; 2]> {
            let config: toml::Table = text().parse().ok()?;
            let mount = config.get("camera")?.get("mount")?.as_table()?;
            let pitch_deg = mount.get("pitch_deg")?.as_float()?;
            Some([mount.get("height_m")?.as_float()?, pitch_deg])
        };
        let is_found = || found().is_some_and(|[height_m, _]| height_m != CAMERA_HEIGHT_M);
        tokio::select! {
            outcome = cell.serve(vec![sees_walkers(directory.path())], false) => panic!("ended: {outcome:?}"),
            _ = until("the mount is found", is_found) => {}
        }
        let [height_m, pitch_deg] = found().unwrap();
        assert!((height_m / 3.5 - 1.0).abs() < 0.08, "{height_m}");
        assert!((pitch_deg - 18.0).abs() < 1.0, "{pitch_deg}");
        let advice = format!("camera.mount: {height_m} m and {pitch_deg}° are estimated");
        let text = text();
        assert!(
            text.contains(&advice) && !text.contains("Measure with a tape"),
            "{text}"
        );
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn edited_file_survives_found_mount() {
        let directory = tempfile::tempdir().unwrap();
        let saved = directory.path().join("node.toml");
        let mut cell = saved_to(&saved);
        let started = cell.start(sees_walkers(directory.path())).await.unwrap();
        cell.vehicles.push(started);
        cell.save(0).unwrap();
        let edited = std::fs::read_to_string(&saved).unwrap() + "# my own\n";
        std::fs::write(&saved, &edited).unwrap();
        let estimate = MountEstimate {
            mount: Mount {
                height_m: Some(3.5),
                ..Mount::default()
            },
            pitch_sigma_rad: 0.01,
            roll_sigma_rad: 0.01,
            height_sigma_m: 0.05,
        };
        cell.use_camera(0, &estimate).await.unwrap();
        let vehicle = cell.vehicles.remove(0);
        let mount = vehicle.config.camera.as_ref().unwrap().mount;
        assert_eq!(
            mount.height_m,
            Some(3.5),
            "the vehicle uses the found mount"
        );
        assert_eq!(std::fs::read_to_string(&saved).unwrap(), edited);
        vehicle.node.stop().await;
    }
}
