//! `ecod-region serve`: page and metrics.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;

use clap::Args;
use ecod::model::quadkey::Quadkey;
use ecod_actors::cli::Failure;
use ecod_actors::observe::dashboard::DashboardConfig;

use super::run_until_stopped;
use crate::broker::{BrokerArguments, read_secret};
use crate::page::{DEFAULT_ADDRESS, RegionPage};
use crate::reader::{self, RegionState};

/// Flags of `serve`.
#[derive(Debug, Args)]
pub(super) struct ServeArguments {
    #[command(flatten)]
    broker: BrokerArguments,
    /// Address and port of the page
    #[arg(long, value_name = "ADDRESS:PORT", default_value = DEFAULT_ADDRESS)]
    listen: SocketAddr,
    /// File with the secret that gives access, at least 12 characters; required for an address that
    /// other machines can reach
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Tile whose maps are always read, so that metrics include its silent cells; may be given
    /// several times
    #[arg(long, value_name = "QUADKEY")]
    watch: Vec<Quadkey>,
}

pub(super) fn run(arguments: &ServeArguments) -> Result<(), Failure> {
    let login = arguments.broker.load().map_err(Failure::usage)?;
    let token = arguments
        .token_file
        .as_deref()
        .map(read_secret)
        .transpose()
        .map_err(Failure::usage)?;
    let config = DashboardConfig {
        listen: Some(arguments.listen),
        token,
        ..DashboardConfig::default()
    };
    config
        .validate()
        .map_err(|error| Failure::usage(error.within("region")))?;
    let state = Arc::new(RegionState::default());
    run_until_stopped(async {
        let page = RegionPage::listen(
            arguments.listen,
            config.token.as_ref(),
            arguments.watch.clone(),
            Arc::clone(&state),
        )
        .await?;
        tracing::info!(url = %format_args!("http://{}/", page.address()), "page serves");
        tokio::join!(reader::read(&login, &state, |_| ()), page.serve());
        Ok(())
    })?;
    Ok(())
}
