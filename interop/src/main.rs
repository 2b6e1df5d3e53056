//! Program `ecod-interop`: bridges between a cell and the languages of others.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand};
use ecod_client::{Settings, Tls};
use ecod_interop::bridge::CpmBridge;

/// Bridges between a cell and the messages of other stations. Runs beside a node, as any program does.
#[derive(Parser)]
#[command(name = "ecod-interop", version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Maps and reports of the cell as ETSI CPM on `cpm/map` and `cpm/vehicles/<node>`; CPMs on `cpm/received/<name>` as
    /// reports.
    Cpm(Connection),
    /// A log as MCAP of profile ros2: detections, markers, poses of cameras, pictures.
    #[cfg(feature = "ros2")]
    Ros2 {
        /// Log that a node recorded (MCAP).
        log: PathBuf,
        /// File to be written.
        output: PathBuf,
    },
}

/// Where the node is, and its name. All can be set by the environment, as for nodes.
#[derive(Args)]
struct Connection {
    /// HOST:PORT of the node's door.
    #[arg(long, env = "ECOD_BROKER")]
    broker: Option<String>,
    /// Name of the cell.
    #[arg(long, env = "ECOD_CELL")]
    cell: Option<String>,
    /// Name of the node beside which the program runs. Default: the machine's host name.
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

fn main() -> ExitCode {
    env_logger::Builder::from_env(env_logger::Env::default().default_filter_or("info")).init();
    let ended = match Cli::parse().command {
        Command::Cpm(connection) => {
            CpmBridge::connect(connection.settings()).and_then(|bridge| bridge.run()).map_err(|error| error.to_string())
        }
        #[cfg(feature = "ros2")]
        Command::Ros2 { log, output } => convert(&log, &output),
    };
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            log::error!("{error}");
            ExitCode::from(2)
        }
    }
}

#[cfg(feature = "ros2")]
fn convert(log: &std::path::Path, output: &std::path::Path) -> Result<(), String> {
    let bytes = std::fs::read(log).map_err(|error| format!("{}: {error}", log.display()))?;
    let file = std::fs::File::create_new(output).map_err(|error| format!("{}: {error}", output.display()))?;
    let done = ecod_interop::ros2::convert(&bytes, file).map_err(|error| format!("{}: {error}", log.display()))?;
    log::info!("{} messages written, {} of other kinds, {} unusable", done.written, done.passed_over, done.unusable);
    if done.is_cut {
        log::warn!("{} ends in the middle or is damaged there", log.display());
    }
    Ok(())
}
