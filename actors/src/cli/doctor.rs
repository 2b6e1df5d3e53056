//! `ecod-node doctor`: checks whether a node can run here.

use std::time::Duration;

use anyhow::Context;
use clap::Args;

use super::installation::ConfigurationArguments;
use super::{Failure, print};
use crate::doctor::{CheckResult, Finding, examine};

/// Flags of `doctor`.
#[derive(Debug, Args)]
pub(super) struct DoctorArguments {
    #[command(flatten)]
    configuration: ConfigurationArguments,
    /// Print JSON for programs
    #[arg(long)]
    json: bool,
}

/// Prints one line per check; fails if one is broken.
pub(super) fn run(arguments: &DoctorArguments) -> Result<(), Failure> {
    let (config, file) = arguments.configuration.load()?;
    let runtime = tokio::runtime::Runtime::new().context("cannot start threads")?;
    let findings = runtime.block_on(examine(&config, &file));
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
