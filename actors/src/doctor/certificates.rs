//! Whether the node's certificates can be used, and for how long.

use std::os::unix::fs::PermissionsExt;
use std::time::Duration;

use super::Finding;
use crate::node::config::NodeConfig;
use crate::platform::clock;
use crate::transport::pki::{CertificateSubject, Credentials, CredentialsError};

/// Time before its end from which on a certificate should be replaced.
const SOON: Duration = Duration::from_secs(30 * 86_400);

/// The certificates of the configuration, or that there are none.
pub(super) fn examine(config: &NodeConfig) -> Option<Finding> {
    let check = "certificates";
    let name = config.name.as_ref()?;
    let Some(files) = &config.tls else {
        return Some(if config.data_plane().embedded && config.membership.has_key() {
            let fix = "`ecod-node pki` makes some, `[tls]` names them; or set `broker.allow_plaintext` in a network that is trusted";
            Finding::doubtful(
                check,
                "none: the node's broker takes clients of this machine only, or is open to all",
                fix,
            )
        } else {
            Finding::fine(check, "none, and none needed on one machine")
        });
    };
    let current = match Credentials::load(files, name) {
        Ok(credentials) => credentials.current(),
        Err(error) => {
            let fix = match &error {
                CredentialsError::File { key: "tls.revocation_list", .. } => {
                    "copy `revoked.pem` of the CA again".into()
                }
                _ => format!("`ecod-node pki issue {name}` makes them anew"),
            };
            return Some(Finding::broken(check, error.to_string(), fix));
        }
    };
    let identity: &CertificateSubject = &current.identity;
    let left = identity.expires().since(clock::now());
    let shown = format!("for {}, {} days left", identity.name(), left.as_secs() / 86_400);
    let readable = std::fs::metadata(&files.key).is_ok_and(|facts| facts.permissions().mode() & 0o077 != 0);
    Some(if left.is_zero() {
        Finding::broken(check, "expired", format!("`ecod-node pki issue {name}` makes another"))
    } else if config.may_lead() && !identity.may_serve() {
        Finding::broken(check, "for a vehicle that never leads", "issue one with `--role auto` or `--role edge`")
    } else if readable {
        Finding::doubtful(
            check,
            format!("{} can be read by others", files.key.display()),
            format!("chmod 600 {}", files.key.display()),
        )
    } else if files.revocation_list.is_none() {
        Finding::doubtful(check, format!("{shown}, no revocation list"), "set `tls.revocation_list`")
    } else if left < SOON {
        Finding::doubtful(check, shown, format!("`ecod-node pki issue {name}` makes another"))
    } else {
        Finding::fine(check, shown)
    })
}
