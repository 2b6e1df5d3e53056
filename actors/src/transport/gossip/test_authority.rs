//! A cell's CA in a directory of its own, for tests and fuzz targets.

use std::path::PathBuf;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use ecod::leadership::Rights;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use rustls::pki_types::UnixTime;

use super::handshake::Identity;
use crate::transport::pki::{Authority, Credentials, TlsConfig};

/// The CA; its directory is removed with it.
pub(crate) struct TestAuthority {
    directory: PathBuf,
    pub(crate) authority: Authority,
}

impl TestAuthority {
    #[expect(clippy::expect_used, reason = "a test ends without its directory")]
    pub(crate) fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let directory =
            std::env::temp_dir().join(format!("ecod-trial-ca-{}-{count}", std::process::id()));
        let authority = Authority::init(&directory, &NodeName::from_static("lot-1"), now())
            .expect("a CA is made");
        Self {
            directory,
            authority,
        }
    }

    /// A new certificate's files.
    #[expect(clippy::expect_used, reason = "a test ends without its certificate")]
    pub(crate) fn issue(
        &mut self,
        name: &str,
        rights: impl Into<Rights>,
        valid: Duration,
    ) -> TlsConfig {
        let name = NodeName::new(name).expect("a name");
        self.authority
            .issue(&name, rights, valid, now())
            .expect("a certificate is made");
        self.files(&name)
    }

    /// The identity of a node with a new certificate, which may outlive the test.
    pub(crate) fn identity(&mut self, name: &str, rights: impl Into<Rights>) -> Identity {
        let files = self.issue(name, rights, Duration::from_secs(86_400));
        Self::read(&files, name)
    }

    /// The identity of a node with its last certificate and the current revocation list.
    #[expect(clippy::expect_used, reason = "a test ends without its certificate")]
    pub(crate) fn read(files: &TlsConfig, name: &str) -> Identity {
        let credentials = Credentials::load(files, &NodeName::new(name).expect("a name"))
            .expect("files of a node");
        Identity {
            credentials: credentials.current(),
            wall: UnixTime::now(),
        }
    }

    /// Paths of a node's files.
    pub(crate) fn files(&self, name: &NodeName) -> TlsConfig {
        let (certificate, key) = self.authority.files_of(name);
        let ca = self.authority.ca();
        let list = self.authority.revocation_list();
        TlsConfig {
            ca,
            certificate,
            key,
            revocation_list: Some(list),
            city: None,
        }
    }

    /// Revokes a node; other nodes discover it when they read the list.
    #[cfg(test)]
    pub(crate) fn revoke(&mut self, name: &NodeName) {
        self.authority
            .revoke(name, now())
            .expect("a certificate to revoke");
    }
}

impl Drop for TestAuthority {
    fn drop(&mut self) {
        // A directory that cannot be removed does not fail a test.
        let _ = std::fs::remove_dir_all(&self.directory);
    }
}

fn now() -> Timestamp {
    crate::platform::clock::now()
}
