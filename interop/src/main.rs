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
    let Command::Cpm(connection) = Cli::parse().command;
    let ended = CpmBridge::connect(connection.settings()).and_then(|bridge| bridge.run());
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            log::error!("{error}");
            ExitCode::from(2)
        }
    }
}
