//! Checks of the node's certificates and their expiry, in its own cell and in the cells to which it
//! moves.

use std::os::unix::fs::PermissionsExt;

use rustls::pki_types::UnixTime;

use super::Finding;
use crate::node::config::{CellEntry, NodeConfig};
use crate::platform::clock;
use crate::transport::pki::{CertificateSubject, Credentials, CredentialsError};

/// Checks the certificates of the configuration, or their absence.
pub(super) fn examine(config: &NodeConfig) -> Option<Finding> {
    let check = "certificates";
    let name = config.name.as_ref()?;
    let Some(files) = &config.tls else {
        return Some(
            if config.data_plane().embedded && config.membership.has_key() {
                let fix = "create certificates with `ecod-node pki` and set `[tls]`; or set `broker.allow_plaintext` in a trusted network";
                Finding::doubtful(
                    check,
                    "none: the node's broker is open to all, or accepts clients of this machine only",
                    fix,
                )
            } else {
                Finding::fine(check, "none, and none are needed on one machine")
            },
        );
    };
    let credentials = match Credentials::load(files, name) {
        Ok(credentials) => credentials,
        Err(error) => {
            let fix = match &error {
                CredentialsError::File {
                    key: "tls.revocation_list" | "tls.city.revocation_list",
                    ..
                } => "copy `revoked.pem` of the CA again".into(),
                _ => format!("`ecod-node pki issue {name}` creates new ones"),
            };
            return Some(Finding::broken(check, error.to_string(), fix));
        }
    };
    let current = credentials.current();
    let identity: &CertificateSubject = &current.identity;
    let left = identity.expires().since(clock::now());
    let shown = format!(
        "for {}, {} days left",
        identity.name(),
        left.as_secs() / 86_400
    );
    // Local programs may have read access through their group.
    let is_public = std::fs::metadata(&files.key)
        .is_ok_and(|metadata| metadata.permissions().mode() & 0o037 != 0);
    Some(if left.is_zero() {
        Finding::broken(check, "expired", renewal(config, &credentials))
    } else if let Some(distrust) = current
        .verify_node(current.certificate(), UnixTime::now())
        .err()
    {
        let fix = format!(
            "copy `ca.pem` and `revoked.pem` of the cell's CA again, or `ecod-node pki issue {name}` there; or set the clock"
        );
        Finding::broken(
            check,
            format!(
                "the cell does not accept {}: {distrust}",
                files.certificate.display()
            ),
            fix,
        )
    } else if let Some(error) = credentials
        .check_rights(config.role, config.election.priority)
        .err()
    {
        Finding::broken(
            check,
            error.to_string(),
            "issue one, or lower `role` or `election.priority`",
        )
    } else if is_public {
        Finding::doubtful(
            check,
            format!(
                "{} is readable by everyone, or may be written by others",
                files.key.display()
            ),
            format!("chmod 640 {}", files.key.display()),
        )
    } else if files.revocation_list.is_none() {
        Finding::doubtful(
            check,
            format!("{shown}, no revocation list"),
            "set `tls.revocation_list`",
        )
    } else if identity.due_for_renewal(clock::now()).is_some() {
        Finding::doubtful(check, shown, renewal(config, &credentials))
    } else {
        Finding::fine(check, shown)
    })
}

/// The command that renews the node's certificate.
fn renewal(config: &NodeConfig, credentials: &Credentials) -> String {
    if credentials.authority().is_some() {
        return "`ecod-node pki renew` creates a new one".into();
    }
    let name = credentials.current().identity.name().clone();
    let role = config.role;
    format!(
        "`ecod-node join` here, with the token of `ecod-node invite --role {role} {name}` on the machine with the CA"
    )
}

/// Checks that a vehicle that moves between cells can join each of them.
pub(super) fn cells(config: &NodeConfig) -> Option<Finding> {
    let check = "cells";
    let path = config.cells.as_ref()?;
    let cells = match config.load_cells() {
        Ok(cells) => cells,
        Err(error) => {
            return Some(Finding::broken(
                check,
                error.to_string(),
                "correct the file, or leave `cells` out",
            ));
        }
    };
    let distrust = |cell: &CellEntry| match config.credentials_in(cell) {
        Ok(credentials) => {
            let current = credentials?.current();
            let distrust = current
                .verify_node(current.certificate(), UnixTime::now())
                .err()?;
            Some(format!(
                "cell {}: it does not accept the node's certificate: {distrust}",
                cell.name
            ))
        }
        Err(error) => Some(error.to_string()),
    };
    let unusable: Vec<_> = cells.iter().filter_map(distrust).collect();
    Some(if unusable.is_empty() {
        Finding::fine(check, format!("{} in {}", cells.len(), path.display()))
    } else {
        let fix = "correct these entries and their files: the vehicle does not move to such cells";
        Finding::doubtful(check, unusable.join("; "), fix)
    })
}
