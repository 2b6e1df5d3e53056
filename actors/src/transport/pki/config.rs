//! Paths of a node's certificates.

use std::path::PathBuf;

use ecod::config::ConfigError;
use serde::{Deserialize, Serialize};

/// The files that `ecod-node pki` made for a node, in PEM. They are read again when they change, without a restart.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TlsConfig {
    /// The certificate of the cell's CA.
    pub ca: PathBuf,
    /// The node's own certificate; its common name is the node's name.
    pub certificate: PathBuf,
    /// The private key of the certificate. Only the node's user should be able to read it.
    pub key: PathBuf,
    /// The CA's revocation list; default none: a certificate is then valid until it expires.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub revocation_list: Option<PathBuf>,
}

impl TlsConfig {
    /// Checks that every path is given; the files are read when the node starts.
    ///
    /// # Errors
    /// [`ConfigError`] with the key, the value and what is allowed.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let list = self.revocation_list.as_ref();
        let paths = [("ca", &self.ca), ("certificate", &self.certificate), ("key", &self.key)];
        for (key, path) in paths.into_iter().chain(list.map(|list| ("revocation_list", list))) {
            if path.as_os_str().is_empty() {
                return Err(ConfigError::new(key, "nothing", "the path of a PEM file"));
            }
        }
        Ok(())
    }
}
