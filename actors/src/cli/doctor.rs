//! `ecod-node doctor`: checks whether a node can run here.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use clap::Args;

use super::{Failure, print};
use crate::doctor::{CheckResult, Finding, examine};
use crate::node::config::NodeConfig;

/// Flags of `doctor`.
#[derive(Debug, Args)]
pub(super) struct DoctorArguments {
    /// Configuration of the node (TOML); `ECOD_…` variables apply as they do to the node
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Print JSON for programs
    #[arg(long)]
    json: bool,
}

/// Prints one line per check; fails if one is broken.
pub(super) fn run(arguments: &DoctorArguments) -> Result<(), Failure> {
    let config = NodeConfig::load(Some(&arguments.config), &BTreeMap::<String, String>::new())
        .map_err(Failure::usage)?;
    let runtime = tokio::runtime::Runtime::new().context("cannot start threads")?;
    let findings = runtime.block_on(examine(&config, &arguments.config));
    // A camera may block forever.
    runtime.shutdown_timeout(Duration::ZERO);
    if arguments.json {
        print(&(serde_json::to_string_pretty(&findings).context("findings as JSON")? + "\n"))?;
    } else {
        print(&findings.iter().map(line).collect::<String>())?;
    }
    match findings
        .iter()
        .filter(|finding| finding.verdict == CheckResult::Broken)
        .count()
    {
        0 => Ok(()),
        broken => Err(anyhow::anyhow!("{broken} of {} checks failed", findings.len()).into()),
    }
}

fn line(
    Finding {
        check,
        verdict,
        seen,
        fix,
    }: &Finding,
) -> String {
    let sign = match verdict {
        CheckResult::Fine => "ok  ",
        CheckResult::Doubtful => "warn",
        CheckResult::Broken => "FAIL",
    };
    let fix = fix
        .as_ref()
        .map_or_else(String::new, |fix| format!("  -> {fix}"));
    format!("{sign}  {check:<16}  {}{fix}\n", seen.replace('\n', " "))
}
