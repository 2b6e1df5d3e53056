//! What a node tells the service manager that started it, by the protocol of systemd's `sd_notify`.
//!
//! `READY=1` once all parts run, `STATUS=` whenever the node's readiness changes, `STOPPING=1` at the end. The watchdog is
//! fed only while rounds flow: a node that follows a live aggregator whose rounds arrive, or that leads with a working
//! broker. A leader at whose broker nobody can log in feeds it, too: its way to the others is broken, and a start anew would
//! mend nothing. One that does none of this for as long as the watchdog waits is started anew.

use std::io;
use std::time::Duration;

use ecod::leadership::readiness::Readiness;
use sd_notify::NotifyState;

/// The service manager of this process.
#[derive(Debug)]
pub struct ServiceManager {
    /// Time for which it waits for a sign of life; none without a watchdog.
    watchdog: Option<Duration>,
    told: Option<String>,
    failing: bool,
}

/// Time between two looks at readiness; shorter where a watchdog waits for less than a few of them.
const PERIOD: Duration = Duration::from_secs(1);
const BEATS: u32 = 4;

impl ServiceManager {
    /// The manager that the environment names; none where nobody waits to be told.
    pub fn from_environment() -> Option<Self> {
        std::env::var_os("NOTIFY_SOCKET")?;
        Some(Self {
            watchdog: sd_notify::watchdog_enabled(),
            told: None,
            failing: false,
        })
    }

    /// Time between two signs of life.
    pub fn period(&self) -> Duration {
        self.watchdog.map_or(PERIOD, |watchdog| {
            (watchdog / BEATS).clamp(Duration::from_millis(1), PERIOD)
        })
    }

    /// All parts run.
    pub fn started(&mut self) {
        self.tell(&[NotifyState::Ready]);
    }

    /// Takes the node's readiness; feeds the watchdog unless a start anew may help.
    pub fn beat(&mut self, readiness: Readiness) {
        if !readiness.needs_restart && self.watchdog.is_some() {
            self.tell(&[NotifyState::Watchdog]);
        }
        if self.told.as_ref() != Some(&readiness.reason) {
            self.tell(&[NotifyState::Status(&readiness.reason)]);
            self.told = Some(readiness.reason);
        }
    }

    /// The node ends.
    pub fn stopping(&mut self) {
        self.tell(&[NotifyState::Stopping]);
    }

    /// A manager that does not listen is told of once.
    fn tell(&mut self, news: &[NotifyState<'_>]) {
        let told: io::Result<()> = sd_notify::notify(news);
        if let Err(error) = &told
            && !self.failing
        {
            tracing::warn!(%error, "service manager not told");
        }
        self.failing = told.is_err();
    }
}
