//! What processes take of a machine, and whether that grows.

use std::fmt::{self, Display, Formatter};
use std::fs;

use anyhow::Context;
use serde::Serialize;

/// Resources of one process at a time, or the most of each that any of several has.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub(super) struct Resources {
    pub(super) resident_kib: u64,
    pub(super) descriptors: u64,
    pub(super) threads: u64,
}

impl Resources {
    /// Reads the figures of a process from `/proc`.
    pub(super) fn of(process: u32) -> anyhow::Result<Self> {
        let status = fs::read_to_string(format!("/proc/{process}/status"))?;
        let field = |name: &str| {
            let line = status.lines().find_map(|line| line.strip_prefix(name));
            line.and_then(|rest| rest.split_whitespace().next()?.parse().ok())
                .with_context(|| format!("no {name}"))
        };
        let descriptors = fs::read_dir(format!("/proc/{process}/fd"))?.count() as u64;
        Ok(Self {
            resident_kib: field("VmRSS:")?,
            descriptors,
            threads: field("Threads:")?,
        })
    }

    /// The larger of each.
    pub(super) fn max(self, other: Self) -> Self {
        Self {
            resident_kib: self.resident_kib.max(other.resident_kib),
            descriptors: self.descriptors.max(other.descriptors),
            threads: self.threads.max(other.threads),
        }
    }
}

impl Display for Resources {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let mib = self.resident_kib as f64 / 1024.0;
        write!(
            f,
            "{mib:.1} MiB, {} descriptors, {} threads",
            self.descriptors, self.threads
        )
    }
}

/// Resources of one process at the end of each minute of its life.
#[derive(Debug, Clone, Default)]
pub(super) struct Series(Vec<Resources>);

/// Fewer minutes than this show no growth: a process that comes to lead for the first time takes what that takes.
const LEAST_MINUTES: usize = 9;

/// Allowed growth from the middle third of a life to the last third, in addition to a tenth.
const ALLOWED: Resources = Resources {
    resident_kib: 2048,
    descriptors: 8,
    threads: 4,
};

impl Series {
    pub(super) fn push(&mut self, resources: Resources) {
        self.0.push(resources);
    }

    /// True if the process lived for long enough to show whether it grows.
    pub(super) fn is_telling(&self) -> bool {
        self.0.len() >= LEAST_MINUTES
    }

    /// The resources that grow, in words: the medians of the middle and the last third of the process's life are compared.
    pub(super) fn growth(&self) -> Option<String> {
        if !self.is_telling() {
            return None;
        }
        let third = self.0.len() / 3;
        let middle = &self.0[third..2 * third];
        let last = &self.0[self.0.len() - third..];
        let grows = |what: &str, of: fn(&Resources) -> u64| {
            let before = median(middle, of);
            let after = median(last, of);
            (after > before + before / 10 + of(&ALLOWED))
                .then(|| format!("{what} {before} to {after}"))
        };
        let found = [
            grows("resident KiB", |resources| resources.resident_kib),
            grows("descriptors", |resources| resources.descriptors),
            grows("threads", |resources| resources.threads),
        ];
        let found: Vec<_> = found.into_iter().flatten().collect();
        (!found.is_empty()).then(|| found.join(", "))
    }
}

fn median(samples: &[Resources], of: fn(&Resources) -> u64) -> u64 {
    let mut values: Vec<u64> = samples.iter().map(of).collect();
    values.sort_unstable();
    values[values.len() / 2]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn series(minutes: usize, of: impl Fn(usize) -> Resources) -> Series {
        Series((0..minutes).map(of).collect())
    }

    fn resident(resident_kib: usize) -> Resources {
        Resources {
            resident_kib: resident_kib as u64,
            descriptors: 40,
            threads: 12,
        }
    }

    #[test]
    fn only_steady_growth_is_leak() {
        let leak = series(30, |minute| resident(20_000 + 600 * minute));
        assert_eq!(leak.growth().unwrap(), "resident KiB 29000 to 35000");
        assert_eq!(
            series(30, |minute| resident(if minute < 5 {
                20_000
            } else {
                40_000
            }))
            .growth(),
            None
        );
        assert_eq!(
            series(30, |minute| resident(if minute == 25 {
                90_000
            } else {
                20_000
            }))
            .growth(),
            None
        );
        let short = series(8, |minute| resident(20_000 * minute));
        assert_eq!(
            (short.is_telling(), short.growth()),
            (false, None),
            "too short a life"
        );
        assert!(leak.is_telling());
    }

    #[test]
    fn descriptors_and_threads_count() {
        let leak = series(12, |minute| Resources {
            descriptors: 10 * minute as u64,
            ..resident(20_000)
        });
        assert!(leak.growth().unwrap().starts_with("descriptors "));
        let leak = series(12, |minute| Resources {
            threads: 10 * minute as u64,
            ..resident(20_000)
        });
        assert!(leak.growth().unwrap().starts_with("threads "));
    }

    #[test]
    fn process_resources_are_read() {
        let own = Resources::of(std::process::id()).unwrap();
        assert!(own.resident_kib > 0 && own.descriptors > 0 && own.threads > 0);
    }
}
