//! `ecod-region cell-account`: the rights of a cell on its region's broker.

use std::path::PathBuf;

use anyhow::anyhow;
use clap::{Args, ValueEnum};
use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod_actors::cli::{Failure, print};

use crate::account::CellAccount;
use crate::broker::read_secret;

/// Flags of `cell-account`.
#[derive(Debug, Args)]
pub(super) struct AccountArguments {
    /// Name of the cell
    #[arg(long)]
    cell: NodeName,
    /// Latitude of the cell's origin in degrees
    #[arg(long, value_name = "DEGREES", allow_negative_numbers = true)]
    latitude: f64,
    /// Longitude of the cell's origin in degrees
    #[arg(long, value_name = "DEGREES", allow_negative_numbers = true)]
    longitude: f64,
    /// File with the cell's password; for NATS
    #[arg(long, value_name = "FILE", required_if_eq("engine", "nats"))]
    password_file: Option<PathBuf>,
    /// The broker's program
    #[arg(long, value_enum, default_value_t = Engine::Nats)]
    engine: Engine,
}

/// A program that can be a region's broker.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Engine {
    /// A user for `users` in the configuration of NATS
    Nats,
    /// Lines for mosquitto's `acl_file`
    Mosquitto,
}

pub(super) fn run(arguments: &AccountArguments) -> Result<(), Failure> {
    let AccountArguments {
        latitude: latitude_deg,
        longitude: longitude_deg,
        ..
    } = *arguments;
    let origin = GeographicOrigin {
        latitude_deg,
        longitude_deg,
        height_m: 0.0,
        rotation_deg: 0.0,
    };
    origin.validate().map_err(Failure::usage)?;
    let account = CellAccount::new(arguments.cell.clone(), &origin);
    let text = match (arguments.engine, &arguments.password_file) {
        (Engine::Mosquitto, _) => account.mosquitto(),
        (Engine::Nats, Some(file)) => {
            let password = read_secret(file).map_err(Failure::usage)?;
            if !password
                .reveal()
                .bytes()
                .all(|byte| byte.is_ascii_alphanumeric() || b"-_".contains(&byte))
            {
                let allowed =
                    "letters, digits, - and _, so that it stands in the configuration as it is";
                return Err(Failure::usage(anyhow!(
                    "the password in {} is to have {allowed}",
                    file.display()
                )));
            }
            account.nats(password.reveal())
        }
        (Engine::Nats, None) => {
            return Err(Failure::usage(anyhow!(
                "--password-file is needed for NATS"
            )));
        }
    };
    print(&text)?;
    Ok(())
}
