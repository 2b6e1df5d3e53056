//! Reports of a node to the service manager that started it, by the protocol of systemd's
//! `sd_notify`.
//!
//! `READY=1` is sent once all parts run, `STATUS=` whenever the node's readiness changes, and
//! `STOPPING=1` at the end. The watchdog is fed only while rounds flow: by a node that follows a
//! live aggregator whose rounds arrive, or that leads with a working broker. A leader whose
//! followers cannot log in at its broker also feeds it: its connection to the other nodes is
//! broken, and a restart would not repair it. A node in any other state for as long as the
//! watchdog's timeout is restarted.

use std::io;
use std::time::Duration;

use ecod::leadership::readiness::Readiness;
use sd_notify::NotifyState;

/// The service manager of this process.
#[derive(Debug)]
pub struct ServiceManager {
    /// Timeout of the watchdog; `None` without a watchdog.
    watchdog: Option<Duration>,
    status: Option<String>,
    failing: bool,
}

/// Time between two checks of readiness; shorter if the watchdog's timeout is less than a few of
/// these periods.
const PERIOD: Duration = Duration::from_secs(1);
const BEATS: u32 = 4;

impl ServiceManager {
    /// The manager that the environment names; `None` if the service was not started by a manager.
    pub fn from_environment() -> Option<Self> {
        std::env::var_os("NOTIFY_SOCKET")?;
        Some(Self {
            watchdog: sd_notify::watchdog_enabled(),
            status: None,
            failing: false,
        })
    }

    /// Time between two signs of life.
    pub fn period(&self) -> Duration {
        self.watchdog.map_or(PERIOD, |watchdog| {
            (watchdog / BEATS).clamp(Duration::from_millis(1), PERIOD)
        })
    }

    /// Notifies the manager that all parts of the node run.
    pub fn started(&mut self) {
        self.notify(&[NotifyState::Ready]);
    }

    /// Processes the node's readiness; feeds the watchdog unless a restart may help.
    pub fn beat(&mut self, readiness: Readiness) {
        if !readiness.needs_restart && self.watchdog.is_some() {
            self.notify(&[NotifyState::Watchdog]);
        }
        if self.status.as_ref() != Some(&readiness.reason) {
            self.notify(&[NotifyState::Status(&readiness.reason)]);
            self.status = Some(readiness.reason);
        }
    }

    /// Notifies the manager that the node is about to end.
    pub fn stopping(&mut self) {
        self.notify(&[NotifyState::Stopping]);
    }

    /// Sends news to the manager; if the manager does not listen, this is logged once.
    fn notify(&mut self, news: &[NotifyState<'_>]) {
        let sent: io::Result<()> = sd_notify::notify(news);
        if let Err(error) = &sent
            && !self.failing
        {
            tracing::warn!(%error, "cannot notify the service manager");
        }
        self.failing = sent.is_err();
    }
}
