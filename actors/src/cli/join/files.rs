//! Files of one node of a cell, as the service reads them.

use std::fmt;
use std::fs::{self, DirBuilder};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, bail, ensure};
use ecod::model::names::NodeName;
use serde::Serialize;
use serde_json::json;

use crate::cli::installation;
use crate::node::config::guidance::SERVICE_DIRECTORY;
use crate::node::config::{END_OF_CONFIGURATION, NodeConfig};
use crate::platform::bounded_file;
use crate::platform::owner::{give, is_root};
use crate::platform::state_file::replace_file;
use crate::transport::invitation::Welcome;
use crate::transport::pki::{CertificateSubject, CityTlsConfig, Credentials, TlsConfig};

/// Directory of the service's state.
const STATE_DIRECTORY: &str = "/var/lib/ecod";

/// Files of the city that the cell belongs to.
const CITY_CA: &str = "city.pem";
const CITY_LIST: &str = "city-revoked.pem";

/// A directory with the files of a node; on the machine that created the cell, it also contains the
/// files of the CA.
pub(super) struct NodeDirectory {
    path: PathBuf,
    /// Directory of the service's state, if these are the service's files; its owner is the
    /// service's user.
    state_of_service: Option<PathBuf>,
}

/// `node.toml` as it is first written.
#[derive(Serialize)]
struct Configuration<'a> {
    name: &'a NodeName,
    cell: &'a NodeName,
    role: ecod::wire::Role,
    state_dir: PathBuf,
    membership: MembershipSection<'a>,
    tls: &'a TlsConfig,
}

#[derive(Serialize)]
struct MembershipSection<'a> {
    key_file: PathBuf,
    #[serde(skip_serializing_if = "<[String]>::is_empty")]
    seeds: &'a [String],
}

impl NodeDirectory {
    /// The given directory, or this user's default directory; it is created if missing.
    pub(super) fn new(given: Option<&Path>) -> anyhow::Result<Self> {
        let requested = given.unwrap_or(installation::directory());
        let made = DirBuilder::new()
            .recursive(true)
            .mode(0o750)
            .create(requested);
        let path = made
            .and_then(|()| requested.canonicalize())
            .with_context(|| format!("cannot use {}", requested.display()))?;
        let is_service = is_root() && path == Path::new(SERVICE_DIRECTORY);
        Ok(Self {
            path,
            state_of_service: is_service.then(|| STATE_DIRECTORY.into()),
        })
    }

    /// Checks that the directory contains no node's files.
    pub(super) fn check_vacant(&self) -> anyhow::Result<()> {
        // This file is written last: files left by a failed attempt are overwritten.
        let path = self.path.join("cell.key");
        ensure!(
            !path.exists(),
            "{} is there: {self} belongs to a node already. Choose another --dir, or remove the files of that node",
            path.display()
        );
        Ok(())
    }

    /// The configuration of the node in the directory; `None` if the directory is vacant.
    ///
    /// # Errors
    /// Returns an error if it is another node's directory.
    pub(super) fn resident(&self, node: &NodeName) -> anyhow::Result<Option<NodeConfig>> {
        let Err(occupied) = self.check_vacant() else {
            return Ok(None);
        };
        let config = NodeConfig::load(Some(&self.configuration()), &json!({}))?;
        if config.name.as_ref() == Some(node) {
            Ok(Some(config))
        } else {
            Err(occupied)
        }
    }

    /// Replaces the certificates of the node in the directory by the certificates of an invitation, such as
    /// after their end.
    pub(super) fn renew(
        &self,
        config: &NodeConfig,
        welcome: &Welcome,
        key: &str,
    ) -> anyhow::Result<()> {
        let (Some(tls), Some(node)) = (&config.tls, &config.name) else {
            bail!("the node in {self} has no `[tls]`");
        };
        ensure!(
            config.cell == welcome.cell,
            "the node in {self} is of cell {}, and the token of {}",
            config.cell,
            welcome.cell
        );
        let rights = CertificateSubject::of_pem(&welcome.certificate)?.rights();
        ensure!(
            rights.allow(config.role, config.election.priority),
            "the node has the role {} and priority {}, and is invited with less: `ecod-node invite --role {}`",
            config.role,
            config.election.priority,
            config.role
        );
        let city = tls.city.as_ref().zip(welcome.city.as_ref());
        let of_city = city.iter().flat_map(|(paths, city)| {
            let list = paths
                .revocation_list
                .as_ref()
                .map(|path| (path.clone(), city.revocation_list.as_str(), 0o644));
            [(paths.ca.clone(), city.ca.as_str(), 0o644)]
                .into_iter()
                .chain(list)
        });
        let list = tls
            .revocation_list
            .as_ref()
            .map(|path| (path.clone(), welcome.revocation_list.as_str(), 0o644));
        self.put(of_city.chain(list).chain([
            (tls.ca.clone(), welcome.ca.as_str(), 0o644),
            (tls.certificate.clone(), welcome.certificate.as_str(), 0o644),
            (tls.key.clone(), key, self.key_mode()),
        ]))?;
        Credentials::load(tls, node).context("the files do not fit together")?;
        Ok(())
    }

    /// Permissions of the node's private key: programs of the service's group may use the node's
    /// local broker, but are not members.
    fn key_mode(&self) -> u32 {
        if self.state_of_service.is_some() {
            0o640
        } else {
            0o600
        }
    }

    /// Writes files, each with its permissions; they belong to the service's user, if these are the
    /// service's files.
    fn put<'a>(&self, files: impl Iterator<Item = (PathBuf, &'a str, u32)>) -> anyhow::Result<()> {
        for (path, text, mode) in files {
            replace_file(&path, text.as_bytes(), mode)
                .and_then(|()| self.hand_over(&path))
                .with_context(|| format!("cannot write {}", path.display()))?;
        }
        Ok(())
    }

    /// Gives the CA to the service's user, whose node renews certificates.
    pub(super) fn hand_over_pki(&self) -> anyhow::Result<()> {
        let list = |directory: &Path| fs::read_dir(directory).map(|all| all.flatten());
        let pki = self.pki();
        let files = list(&pki).and_then(|files| Ok(files.chain(list(&pki.join("nodes"))?)));
        let all = files.map(|files| files.map(|file| file.path()).chain([pki.clone()]));
        all.and_then(|mut all| all.try_for_each(|path| self.hand_over(&path)))
            .with_context(|| format!("cannot give {} to the service's user", pki.display()))
    }

    /// Gives a file to the service's user, if this is the service's directory.
    fn hand_over(&self, path: &Path) -> std::io::Result<()> {
        match self.state_of_service.as_ref().map(fs::metadata) {
            Some(Ok(service)) => give(path, &service),
            _ => Ok(()),
        }
    }

    /// Makes the directory vacant again.
    pub(super) fn vacate(&self) -> anyhow::Result<()> {
        let path = self.path.join("cell.key");
        fs::remove_file(&path).with_context(|| format!("cannot remove {}", path.display()))
    }

    /// Directory of the cell's CA.
    pub(super) fn pki(&self) -> PathBuf {
        self.path.join("pki")
    }

    /// The files of the city, which a cell that belongs to one has here; `None` if it stands alone.
    pub(super) fn city(&self, is_of_city: bool) -> anyhow::Result<Option<CityTlsConfig>> {
        let missing = [CITY_CA, CITY_LIST]
            .map(|name| self.path.join(name))
            .into_iter()
            .find(|path| !path.exists());
        match missing.filter(|_| is_of_city) {
            Some(path) => bail!(
                "{} is missing: a city has signed the cell's CA. Copy the city's ca.pem and revoked.pem to {CITY_CA} and {CITY_LIST} \
                 in {self}, so that nodes that join take its vehicles",
                path.display()
            ),
            None => Ok(is_of_city.then(|| self.city_files())),
        }
    }

    fn city_files(&self) -> CityTlsConfig {
        CityTlsConfig {
            ca: self.path.join(CITY_CA),
            revocation_list: Some(self.path.join(CITY_LIST)),
        }
    }

    pub(super) fn configuration(&self) -> PathBuf {
        self.path.join("node.toml")
    }

    pub(super) fn cell_key(&self) -> anyhow::Result<String> {
        let path = self.path.join("cell.key");
        bounded_file::read_text(&path)
            .with_context(|| format!("cannot read the cell's key {}", path.display()))
    }

    /// Writes all files of a node, and checks their consistency. An existing configuration, such as
    /// the package's, is kept as `node.toml.1`, or with the next free number.
    pub(super) fn write(
        &self,
        node: &NodeName,
        welcome: &Welcome,
        key: &str,
    ) -> anyhow::Result<()> {
        let file = |name: &str| self.path.join(name);
        let tls = TlsConfig {
            ca: file("ca.pem"),
            certificate: file("node.pem"),
            key: file("node.key"),
            revocation_list: Some(file("revoked.pem")),
            city: welcome.city.as_ref().map(|_| self.city_files()),
        };
        let state_dir = self
            .state_of_service
            .clone()
            .unwrap_or_else(|| file("state"));
        let configuration = toml::to_string(&Configuration {
            name: node,
            cell: &welcome.cell,
            role: welcome.role,
            state_dir,
            membership: MembershipSection {
                key_file: file("cell.key"),
                seeds: &welcome.seeds,
            },
            tls: &tls,
        })?;
        let configuration = format!("{HEAD}{configuration}{END_OF_CONFIGURATION}\n");
        if self.configuration().exists() {
            let mut free = (1..)
                .map(|number| file(&format!("node.toml.{number}")))
                .filter(|path| !path.exists());
            let kept = free
                .next()
                .map(|path| fs::rename(self.configuration(), path));
            kept.transpose()
                .context("cannot keep the former node.toml")?;
        }
        let of_city = welcome.city.iter().flat_map(|city| {
            [
                (CITY_CA, city.ca.as_str(), 0o644),
                (CITY_LIST, city.revocation_list.as_str(), 0o644),
            ]
        });
        // The cell's key is written last, because it marks the directory as a node's.
        let files = of_city.chain([
            ("ca.pem", welcome.ca.as_str(), 0o644),
            ("node.pem", welcome.certificate.as_str(), 0o644),
            ("revoked.pem", welcome.revocation_list.as_str(), 0o644),
            ("node.toml", configuration.as_str(), 0o640),
            ("node.key", key, self.key_mode()),
            ("cell.key", welcome.cell_key.as_str(), 0o600),
        ]);
        self.put(files.map(|(name, text, mode)| (file(name), text, mode)))?;
        Credentials::load(&tls, node).context("the files do not fit together")?;
        Ok(())
    }

    /// Makes the system run the node from now on, if it is the system's node; returns true in that
    /// case.
    pub(super) fn enable_service(&self) -> anyhow::Result<bool> {
        let units = ["/lib/systemd/system", "/etc/systemd/system"];
        let has_unit = units
            .iter()
            .any(|units| Path::new(units).join("ecod-node.service").exists());
        if self.state_of_service.is_none()
            || !has_unit
            || !Path::new("/run/systemd/system").exists()
        {
            return Ok(false);
        }
        // A running service still has its previous configuration.
        for command in ["enable", "restart"] {
            let done = Command::new("systemctl")
                .args([command, "ecod-node"])
                .status();
            ensure!(
                done.context("cannot run systemctl")?.success(),
                "`systemctl {command} ecod-node` failed"
            );
        }
        Ok(true)
    }

    /// A command that uses this directory.
    pub(super) fn command(&self, command: &str) -> String {
        if self.state_of_service.is_some() {
            format!("ecod-node {command}")
        } else {
            format!("ecod-node {command} --dir {self}")
        }
    }
}

impl fmt::Display for NodeDirectory {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.path.display().fmt(f)
    }
}

/// Comment at the beginning of `node.toml`.
const HEAD: &str = "\
# This file is whole while it has the line `# end of node.toml`; without it the node does not start.
# Pose and camera are yours to add: docs/first-cell.md. `ecod-node --config FILE --print-config` shows every key with its
# value. Known locations belong to the whole cell: `ecod-node cell set --config FILE cell.toml` gives them to all nodes.
";

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;
    use std::time::Duration;

    use ecod::wire::Role;

    use super::*;
    use crate::platform::clock;
    use crate::transport::pki::Authority;

    #[test]
    fn services_group_cannot_read_cell_key() {
        let directory = tempfile::tempdir().unwrap();
        let cell = NodeName::from_static("lot-1");
        let node = NodeName::from_static("euclid");
        let mut authority =
            Authority::init(&directory.path().join("pki"), &cell, clock::now()).unwrap();
        authority
            .issue(&node, Role::Cav, Duration::from_secs(86_400), clock::now())
            .unwrap();
        let (certificate, key) = authority.files_of(&node);
        let read = |path: PathBuf| fs::read_to_string(path).unwrap();
        let welcome = Welcome {
            cell,
            role: Role::Cav,
            certificate: read(certificate),
            ca: read(authority.ca()),
            revocation_list: read(authority.revocation_list()),
            cell_key: "k".repeat(64),
            seeds: Vec::new(),
            city: None,
        };
        let key = read(key);
        for (state_of_service, expected) in [(Some(directory.path().into()), 0o640), (None, 0o600)]
        {
            let files = NodeDirectory {
                path: directory.path().into(),
                state_of_service,
            };
            files.write(&node, &welcome, &key).unwrap();
            let mode = |name| {
                fs::metadata(directory.path().join(name))
                    .unwrap()
                    .permissions()
                    .mode()
                    & 0o777
            };
            assert_eq!(
                [mode("node.pem"), mode("node.key"), mode("cell.key")],
                [0o644, expected, 0o600]
            );
        }
    }
}
