//! `ecod-node pki`: certificates of a cell or city.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::anyhow;
use clap::{Args, Subcommand};
use ecod::leadership::Rights;
use ecod::leadership::election::ElectionConfig;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::Role;

use super::installation::{self, AUTHORITY_DIRECTORY, ConfigurationArguments};
use super::{Failure, print};
use crate::platform::clock;
use crate::transport::pki::{Authority, Credentials, DEFAULT_DAYS, NewKey};

/// Commands of `pki`.
#[derive(Debug, Subcommand)]
pub(super) enum PkiCommand {
    /// Make the cell's CA and an empty revocation list
    Init {
        #[command(flatten)]
        ca: AuthorityDir,
        /// Name of the cell
        #[arg(long)]
        cell: NodeName,
        /// Directory of the CA of the city that signs the cell's CA; by default the cell stands
        /// alone
        #[arg(long, value_name = "DIR")]
        city: Option<PathBuf>,
    },
    /// Make a key and a certificate for a node
    Issue {
        #[command(flatten)]
        ca: AuthorityDir,
        /// Name of the node
        node: NodeName,
        /// Highest role of the node, its key `role`; with `cav` it cannot lead, with `auto` not as
        /// an edge
        #[arg(long, default_value = "auto", value_parser = ["auto", "cav", "edge"])]
        role: String,
        /// Highest priority of the node in the election, its key `election.priority`
        #[arg(long, default_value_t = ElectionConfig::default().priority)]
        priority: u8,
        /// The node is an operator's: the cell's description may be set there
        #[arg(long)]
        operator: bool,
        /// Validity of the certificate in days
        #[arg(long, default_value_t = DEFAULT_DAYS, value_parser = clap::value_parser!(u32).range(1..=3650))]
        days: u32,
    },
    /// Issue the certificate of this machine's node again, also after its end; no restart
    Renew {
        #[command(flatten)]
        ca: AuthorityDir,
        #[command(flatten)]
        node: ConfigurationArguments,
    },
    /// Revoke all certificates of a node
    Revoke {
        #[command(flatten)]
        ca: AuthorityDir,
        /// Name of the node
        node: NodeName,
    },
    /// Certificates of a city, whose vehicles are members of all its cells
    #[command(subcommand)]
    City(CityCommand),
}

/// Commands of `pki city`.
#[derive(Debug, Subcommand)]
pub(super) enum CityCommand {
    /// Make the city's CA and an empty revocation list
    Init {
        #[command(flatten)]
        ca: CityDir,
        /// Name of the city
        #[arg(long)]
        city: NodeName,
    },
    /// Make a key and a certificate for a vehicle; it leads in no cell
    Issue {
        #[command(flatten)]
        ca: CityDir,
        /// Name of the vehicle
        vehicle: NodeName,
        /// Validity of the certificate in days
        #[arg(long, default_value_t = DEFAULT_DAYS, value_parser = clap::value_parser!(u32).range(1..=3650))]
        days: u32,
    },
    /// Revoke all certificates of a vehicle, or the CA of a cell
    Revoke {
        #[command(flatten)]
        ca: CityDir,
        /// Name of the vehicle
        #[arg(required_unless_present = "cell")]
        vehicle: Option<NodeName>,
        /// Name of a cell whose CA becomes invalid, with all its certificates
        #[arg(long, conflicts_with = "vehicle")]
        cell: Option<NodeName>,
    },
}

#[derive(Debug, Args)]
pub(super) struct CityDir {
    /// Directory of the city's CA; anyone who can read its `ca.key` can make cells and vehicles
    #[arg(long, value_name = "DIR", default_value = "city")]
    dir: PathBuf,
}

#[derive(Debug, Args)]
pub(super) struct AuthorityDir {
    /// Directory of the CA; anyone who can read its `ca.key` can issue certificates [default: pki,
    /// or the CA that `ecod-node init` has made on this machine]
    #[arg(long, value_name = "DIR")]
    dir: Option<PathBuf>,
}

/// Runs the command and prints the files to distribute.
pub(super) fn run(command: &PkiCommand) -> Result<(), Failure> {
    let now = clock::now();
    let message = match command {
        PkiCommand::Init { ca, cell, city } => {
            let directory = ca.dir.as_deref().unwrap_or(Path::new(AUTHORITY_DIRECTORY));
            let made = match city {
                Some(city) => {
                    Authority::open(city).and_then(|mut city| city.init_cell(directory, cell, now))
                }
                None => Authority::init(directory, cell, now),
            };
            let authority = made.map_err(failure)?;
            format!(
                "made a CA for {cell}; copy its certificate to every node: {}\n",
                shown(&authority.ca())
            )
        }
        PkiCommand::Issue {
            ca,
            node,
            role,
            priority,
            operator,
            days,
        } => {
            let mut authority = open(&installation::authority(ca.dir.as_deref()), false)?;
            let rights = Rights {
                role: role_named(role),
                priority: *priority,
                may_describe: *operator,
            };
            authority
                .issue(node, rights, validity(*days), now)
                .map_err(failure)?;
            configuration(&authority, node)
        }
        PkiCommand::Renew { ca, node } => {
            let mut authority = open(&installation::authority(ca.dir.as_deref()), false)?;
            let (config, file) = node.load()?;
            let (Some(tls), Some(name)) = (&config.tls, &config.name) else {
                let file = file.display();
                return Err(Failure::usage(anyhow!("{file} has no name or no `[tls]`")));
            };
            let credentials = Credentials::load(tls, name).map_err(failure)?;
            NewKey::generate()
                .map_err(failure)?
                .reissue(&mut authority, &credentials)
                .map_err(|reason| anyhow!(reason))?;
            let renewed = Credentials::load(tls, name).map_err(failure)?;
            let days = renewed.current().identity.expires().since(now).as_secs() / 86_400;
            format!("renewed the certificate of {name}: it is valid for {days} days\n")
        }
        PkiCommand::Revoke { ca, node } => {
            let mut authority = open(&installation::authority(ca.dir.as_deref()), false)?;
            let count = authority.revoke(node, now).map_err(failure)?;
            let list = shown(&authority.revocation_list());
            format!(
                "revoked {count} of {node}; copy the list to every node (no restart needed): {list}\n"
            )
        }
        PkiCommand::City(command) => run_city(command, now)?,
    };
    Ok(print(&message)?)
}

fn run_city(command: &CityCommand, now: Timestamp) -> Result<String, Failure> {
    Ok(match command {
        CityCommand::Init { ca, city } => {
            let authority = Authority::init_city(&ca.dir, city, now).map_err(failure)?;
            let [ca, list] = [authority.ca(), authority.revocation_list()].map(|path| shown(&path));
            format!(
                "made a CA for {city}; copy its certificate and list to every node of its cells: {ca} {list}\n"
            )
        }
        CityCommand::Issue { ca, vehicle, days } => {
            let mut authority = open(&ca.dir, true)?;
            authority
                .issue(vehicle, Role::Cav, validity(*days), now)
                .map_err(failure)?;
            let (certificate, key) = authority.files_of(vehicle);
            let [ca, certificate, key, list] = [
                authority.ca(),
                certificate,
                key,
                authority.revocation_list(),
            ]
            .map(|path| shown(&path));
            format!(
                "role = \"cav\"\n\n# ca and revocation_list of the cell where it takes part\n\
                 [tls]\nca = \"ca.pem\"\nrevocation_list = \"revoked.pem\"\ncertificate = \"{certificate}\"\nkey = \"{key}\"\n\n\
                 [tls.city]\nca = \"{ca}\"\nrevocation_list = \"{list}\"\n"
            )
        }
        CityCommand::Revoke { ca, vehicle, cell } => {
            let mut authority = open(&ca.dir, true)?;
            let outcome = match (vehicle, cell) {
                (Some(vehicle), _) => authority
                    .revoke(vehicle, now)
                    .map(|count| format!("{count} of {vehicle}")),
                (None, Some(cell)) => authority
                    .revoke_cell(cell, now)
                    .map(|count| format!("{count} CAs of {cell}")),
                (None, None) => return Err(anyhow!("name a vehicle, or a cell by --cell").into()),
            };
            let revoked = outcome.map_err(failure)?;
            let list = shown(&authority.revocation_list());
            format!(
                "revoked {revoked}; copy the list to every node of the city's cells (no restart needed): {list}\n"
            )
        }
    })
}

/// The CA of a cell or, if `is_city`, of a city in a directory.
fn open(directory: &Path, is_city: bool) -> Result<Authority, Failure> {
    let authority = Authority::open(directory).map_err(failure)?;
    authority.check_is_city(is_city).map_err(failure)?;
    Ok(authority)
}

fn validity(days: u32) -> Duration {
    Duration::from_secs(u64::from(days) * 86_400)
}

/// The role of a flag with one of the three values.
pub(super) fn role_named(name: &str) -> Role {
    match name {
        "cav" => Role::Cav,
        "edge" => Role::Edge,
        _ => Role::Auto,
    }
}

/// Section of the node's configuration that names these files.
fn configuration(authority: &Authority, node: &NodeName) -> String {
    let files = authority.tls_of(node);
    let [ca, certificate, key] =
        [&files.ca, &files.certificate, &files.key].map(|path| shown(path));
    let list = shown(&authority.revocation_list());
    format!(
        "[tls]\nca = \"{ca}\"\ncertificate = \"{certificate}\"\nkey = \"{key}\"\nrevocation_list = \"{list}\"\n"
    )
}

fn shown(path: &Path) -> String {
    path.display().to_string()
}

fn failure(error: impl std::error::Error + Send + Sync + 'static) -> Failure {
    anyhow!(error).into()
}
