//! Program `ecod-interop`: bridges between a cell and other systems' message formats.

#[cfg(feature = "ros2")]
use std::fmt::Display;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand};
use ecod::logins::without_logins;
use ecod_client::{Settings, Tls};
use ecod_interop::bridge::CpmBridge;
#[cfg(feature = "ros2")]
use ecod_interop::ros2::{Conversion, RosLog};
#[cfg(feature = "dds")]
use {
    ecod::model::geometry::Pose,
    ecod::perception::camera::Mount,
    ecod::wire::WirePose,
    ecod_interop::dds::{DetectorTopics, RosBridge, RosCamera, RosSettings},
};

/// Bridges between a cell and the messages of other stations. Runs in addition to a node, like any
/// local program.
#[derive(Parser)]
#[command(name = "ecod-interop", version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Maps and reports of the cell as ETSI CPM on `cpm/global` and `cpm/<node>`; CPMs on
    /// `cpm/received/<name>` as reports.
    Cpm(Connection),
    /// A log as MCAP of profile ros2: detections, markers, poses of cameras, pictures.
    #[cfg(feature = "ros2")]
    Ros2 {
        /// Log that a node recorded (MCAP), or a directory of them: all become one file.
        log: PathBuf,
        /// File to be written.
        output: PathBuf,
    },
    /// The cell as live topics of ROS 2, by DDS, and the detections of a topic as reports.
    #[cfg(feature = "dds")]
    Ros2Live(Box<RosOptions>),
}

/// Domain of DDS, and a detector whose detections are to be reported.
#[cfg(feature = "dds")]
#[derive(Args)]
struct RosOptions {
    #[command(flatten)]
    connection: Connection,
    /// Domain of DDS, 0 to 232.
    #[arg(long, env = "ROS_DOMAIN_ID", default_value = "0", value_parser = domain)]
    domain: u16,
    /// Address of this machine in a network in which to announce itself; may be given several
    /// times. Default: in all.
    #[arg(long, value_name = "ADDRESS")]
    network: Vec<std::net::IpAddr>,
    /// Topic of vision_msgs/Detection3DArray, in the frame `map` or in the frame of a camera with a
    /// --pose or --pose-topic.
    #[arg(long, value_name = "TOPIC", group = "detections")]
    detections_3d: Option<String>,
    /// Topic of vision_msgs/Detection2DArray: boxes in pictures without distortion.
    #[arg(long, value_name = "TOPIC", group = "detections", requires_all = ["camera_info", "camera_pose"])]
    detections_2d: Option<String>,
    /// Topic of sensor_msgs/CameraInfo: the optics of these pictures.
    #[arg(long, value_name = "TOPIC", requires = "detections_2d")]
    camera_info: Option<String>,
    /// Pose of the camera: metres east and north, degrees counter-clockwise from east.
    #[arg(long, value_name = "X,Y[,HEADING]", allow_hyphen_values = true, value_parser = place, group = "camera_pose")]
    pose: Option<CameraPlace>,
    /// Heading in degrees clockwise from north, in place of the third number of --pose.
    #[arg(long, value_name = "DEG", allow_hyphen_values = true, value_parser = degrees, requires = "pose")]
    azimuth: Option<f64>,
    /// Topic of geometry_msgs/PoseStamped: poses in the frame `map` of a camera that moves, x
    /// ahead.
    #[arg(
        long,
        value_name = "TOPIC",
        group = "camera_pose",
        requires = "detections"
    )]
    pose_topic: Option<String>,
    /// Height of the camera above the ground in metres; boxes are then also ranged by the ground.
    #[arg(long, value_parser = height)]
    height_m: Option<f64>,
    /// Angle of the camera's axis below the horizon in degrees.
    #[arg(long, default_value_t = 0.0, allow_hyphen_values = true, value_parser = finite)]
    pitch_deg: f64,
    /// File with the keys of `camera.projection` (TOML). Default: sizes of COCO's labels, and
    /// `pixel_sigma_px = 3`.
    #[arg(long, value_name = "FILE")]
    projection: Option<PathBuf>,
    /// Label of a class of the detector, such as 0=person; may be given several times.
    #[arg(long, value_name = "CLASS=LABEL", value_parser = class_label)]
    label: Vec<(String, String)>,
}

#[cfg(feature = "dds")]
impl RosOptions {
    fn settings(self) -> Result<(Settings, RosSettings), String> {
        let pose = self
            .pose
            .map(|place| place.with(self.azimuth))
            .transpose()?;
        let mut camera = RosCamera {
            pose,
            mount: Mount {
                height_m: self.height_m,
                pitch_rad: self.pitch_deg.to_radians(),
                ..Mount::default()
            },
            labels: self.label.into_iter().collect(),
            ..RosCamera::default()
        };
        if let Some(file) = &self.projection {
            let text = regular(file)
                .and_then(std::fs::read_to_string)
                .map_err(|error| format!("{}: {error}", file.display()))?;
            camera.projection =
                toml::from_str(&text).map_err(|error| format!("{}: {error}", file.display()))?;
            camera
                .projection
                .validate()
                .map_err(|error| format!("{}: {error}", file.display()))?;
        }
        let in_pictures = self
            .detections_2d
            .zip(self.camera_info)
            .map(|(topic, optics)| DetectorTopics::InPictures(topic, optics));
        let input = self
            .detections_3d
            .map(DetectorTopics::InSpace)
            .or(in_pictures);
        let pose_topic = self.pose_topic;
        let ros = RosSettings {
            domain: self.domain,
            networks: self.network,
            input,
            pose_topic,
            camera,
        };
        Ok((self.connection.settings(), ros))
    }
}

/// A number of a domain; of an empty variable the default one.
#[cfg(feature = "dds")]
fn domain(text: &str) -> Result<u16, String> {
    if text.is_empty() {
        Ok(0)
    } else {
        text.parse()
            .map_err(|_| "must be a number from 0 to 232".to_owned())
    }
}

#[cfg(feature = "dds")]
fn finite(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|number: &f64| number.is_finite())
        .ok_or_else(|| "must be a number".to_owned())
}

#[cfg(feature = "dds")]
fn height(text: &str) -> Result<f64, String> {
    finite(text)
        .ok()
        .filter(|height_m| *height_m > 0.0)
        .ok_or_else(|| "must be metres above the ground".to_owned())
}

/// Argument of --pose.
#[cfg(feature = "dds")]
#[derive(Clone, Copy)]
struct CameraPlace {
    x_m: f64,
    y_m: f64,
    /// Degrees counter-clockwise from east.
    heading_deg: Option<f64>,
}

#[cfg(feature = "dds")]
impl CameraPlace {
    /// The pose, whose heading is the third number or the azimuth.
    fn with(self, azimuth_deg: Option<f64>) -> Result<Pose, String> {
        let Self { x_m, y_m, .. } = self;
        match (self.heading_deg, azimuth_deg) {
            (Some(heading_deg), None) => Ok(Pose::new(x_m, y_m, heading_deg.to_radians())),
            (None, Some(azimuth_deg)) => WirePose::from_compass(x_m, y_m, azimuth_deg)
                .map(Pose::from)
                .map_err(|error| error.to_string()),
            _ => Err("--pose must be X,Y,HEADING, or X,Y with --azimuth DEG".to_owned()),
        }
    }
}

#[cfg(feature = "dds")]
fn place(text: &str) -> Result<CameraPlace, String> {
    let numbers: Option<Vec<f64>> = text
        .split(',')
        .map(|part| finite(part.trim()).ok())
        .collect();
    match numbers.as_deref() {
        Some(&[x_m, y_m]) => Ok(CameraPlace {
            x_m,
            y_m,
            heading_deg: None,
        }),
        Some(&[x_m, y_m, heading_deg]) if heading_deg.abs() <= 360.0 => Ok(CameraPlace {
            x_m,
            y_m,
            heading_deg: Some(heading_deg),
        }),
        Some(&[_, _, _]) => Err("the heading must be from -360 to 360".to_owned()),
        _ => Err("must be X,Y,HEADING, such as 1.5,-2,90, or X,Y with --azimuth".to_owned()),
    }
}

#[cfg(feature = "dds")]
fn degrees(text: &str) -> Result<f64, String> {
    finite(text)
        .ok()
        .filter(|angle_deg| angle_deg.abs() <= 360.0)
        .ok_or_else(|| "must be from -360 to 360".to_owned())
}

#[cfg(feature = "dds")]
fn class_label(text: &str) -> Result<(String, String), String> {
    let (class, label) = text
        .split_once('=')
        .ok_or("must be CLASS=LABEL, such as 0=person")?;
    Ok((class.to_owned(), label.to_owned()))
}

/// Address of the node, and its name. All options can be set by the environment, as for nodes.
#[derive(Args)]
struct Connection {
    /// HOST:PORT of the node's local broker.
    #[arg(long, env = "ECOD_BROKER", hide_env_values = true)]
    broker: Option<String>,
    /// Name of the cell.
    #[arg(long, env = "ECOD_CELL")]
    cell: Option<String>,
    /// Name of the program's node. Default: the machine's host name.
    #[arg(long, env = "ECOD_NAME")]
    node: Option<String>,
    /// Certificate of the cell's authority (PEM).
    #[arg(long, env = "ECOD_TLS__CA", requires_all = ["certificate", "key"])]
    ca: Option<PathBuf>,
    /// Certificate of the node (PEM).
    #[arg(long, env = "ECOD_TLS__CERTIFICATE")]
    certificate: Option<PathBuf>,
    /// Key of the node (PEM).
    #[arg(long, env = "ECOD_TLS__KEY")]
    key: Option<PathBuf>,
}

impl Connection {
    fn settings(self) -> Settings {
        let defaults = Settings::default();
        let tls = self.ca.zip(self.certificate.zip(self.key));
        Settings {
            broker: self.broker.unwrap_or(defaults.broker),
            cell: self.cell.unwrap_or(defaults.cell),
            node: self.node.unwrap_or(defaults.node),
            tls: tls.map(|(ca, (certificate, key))| Tls::of_door(ca, certificate, key)),
            ..Settings::default()
        }
    }
}

/// The process's arguments; ends the process if they cannot be used. The error shows no login.
fn arguments() -> Cli {
    Cli::try_parse().unwrap_or_else(|error| {
        let text = error.render().to_string();
        let shown = without_logins(&text);
        if shown == text {
            error.exit();
        }
        eprint!("{shown}");
        std::process::exit(error.exit_code())
    })
}

fn main() -> ExitCode {
    env_logger::Builder::from_env(
        env_logger::Env::default().default_filter_or("info,rustdds=error"),
    )
    .init();
    let ended = match arguments().command {
        Command::Cpm(connection) => CpmBridge::connect(connection.settings())
            .and_then(|bridge| bridge.run())
            .map_err(|error| error.to_string()),
        #[cfg(feature = "ros2")]
        Command::Ros2 { log, output } => convert(&log, &output),
        #[cfg(feature = "dds")]
        Command::Ros2Live(options) => options.settings().and_then(|(settings, ros)| {
            RosBridge::connect(settings, ros)
                .and_then(|bridge| bridge.run())
                .map_err(|error| error.to_string())
        }),
    };
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            log::error!("{error}");
            ExitCode::from(2)
        }
    }
}

/// The path of a regular file: a pipe or a device might not end.
#[cfg(feature = "ros2")]
fn regular(path: &std::path::Path) -> std::io::Result<&std::path::Path> {
    if std::fs::metadata(path)?.is_file() {
        Ok(path)
    } else {
        Err(std::io::Error::other("it is not a regular file"))
    }
}

#[cfg(feature = "ros2")]
fn convert(log: &std::path::Path, output: &std::path::Path) -> Result<(), String> {
    let logs = logs(log)?;
    let at_output = |error: &dyn Display| format!("{}: {error}", output.display());
    let file = std::fs::File::create_new(output).map_err(|error| at_output(&error))?;
    let write = || {
        let mut converted = RosLog::new(file).map_err(|error| at_output(&error))?;
        for log in &logs {
            let at_log = |error: &dyn Display| format!("{}: {error}", log.display());
            let file = regular(log)
                .and_then(std::fs::File::open)
                .map_err(|error| at_log(&error))?;
            converted
                .add(std::io::BufReader::new(file))
                .map_err(|error| at_log(&error))?;
        }
        converted
            .finish()
            .map_err(|error| format!("{}: {error}", log.display()))
    };
    let done = write().map_err(|error| {
        // An incomplete file, which would block the next attempt.
        let removed = std::fs::remove_file(output).err();
        let left = removed
            .map(|error| format!("; {} is left there: {error}", output.display()))
            .unwrap_or_default();
        format!("{error}{left}")
    })?;
    let Conversion {
        written,
        passed_over,
        unusable,
        cut,
    } = done;
    log::info!("{written} messages written, {passed_over} of other kinds, {unusable} unusable");
    if cut > 0 {
        log::warn!(
            "{cut} of {} logs end before their last messages; what is before that is written",
            logs.len()
        );
    }
    Ok(())
}

/// A log, or the logs of a directory sorted by name.
#[cfg(feature = "ros2")]
fn logs(path: &std::path::Path) -> Result<Vec<PathBuf>, String> {
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let entries =
        std::fs::read_dir(path).map_err(|error| format!("{}: {error}", path.display()))?;
    let is_log = |file: &PathBuf| file.extension().is_some_and(|ending| ending == "mcap");
    let mut logs: Vec<_> = entries
        .filter_map(Result::ok)
        .map(|entry| entry.path())
        .filter(is_log)
        .collect();
    logs.sort();
    if logs.is_empty() {
        Err(format!("{}: there is no .mcap file", path.display()))
    } else {
        Ok(logs)
    }
}

#[cfg(all(test, feature = "ros2"))]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn a_device_is_not_converted() {
        let directory = tempfile::tempdir().unwrap();
        let output = directory.path().join("ros2.mcap");
        let error = convert(Path::new("/dev/zero"), &output).unwrap_err();
        assert!(error.contains("not a regular file"), "{error}");
        assert!(!output.exists());
    }
}
