//! What a user of a node can do next, as text.

use std::net::SocketAddr;
use std::path::Path;

use super::NodeConfig;

/// Directory of the configuration of a machine's service; commands read it without a flag.
pub(crate) const SERVICE_DIRECTORY: &str = "/etc/ecod";

impl NodeConfig {
    /// How another node joins the cell of this one.
    pub fn joining(&self) -> String {
        let cell = &self.cell;
        let Some(tls) = &self.tls else {
            let key = match &self.membership.key_file {
                Some(file) => format!(" and a copy of {}", file.display()),
                None if self.membership.has_key() => " and the same key".to_owned(),
                None => " on this machine".to_owned(),
            };
            let seed = match self.membership.bind {
                Some(bind) if !self.membership.multicast.enabled => format!(" --seed {bind}"),
                _ => String::new(),
            };
            return format!(
                "another node joins by `ecod-node --name NAME --cell {cell}{seed}`{key}"
            );
        };
        let parent = tls.ca.parent().unwrap_or(Path::new("."));
        if !parent.join("pki").exists() {
            return "another node joins by `ecod-node invite NAME` on the machine where `ecod-node init` made the cell"
                .to_owned();
        }
        let directory = if parent == Path::new(SERVICE_DIRECTORY) {
            String::new()
        } else {
            format!("--dir {} ", parent.display())
        };
        format!("another node joins by `ecod-node invite {directory}NAME`")
    }

    /// How to send reports to a node without reports, whose broker listens at `door`.
    pub fn reporting(&self, door: Option<SocketAddr>) -> String {
        let name = self.name.as_ref().map_or("NAME", |name| name.as_str());
        let programs = match door.filter(|_| self.broker.door) {
            Some(door) => format!("; a program on this machine reports at {door} as {name}--PART"),
            None => String::new(),
        };
        format!("no vehicle reports yet: {}{programs}", self.joining())
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use ecod::model::names::NodeName;

    use super::*;
    use crate::transport::pki::TlsConfig;

    #[test]
    fn next_step_names_cell_command() {
        let mut config = NodeConfig {
            name: Some(NodeName::from_static("euclid")),
            cell: NodeName::from_static("lot-1"),
            ..NodeConfig::default()
        };
        let door = "127.0.0.1:1883".parse().ok();
        assert_eq!(
            config.reporting(door),
            "no vehicle reports yet: another node joins by `ecod-node --name NAME --cell lot-1` on this machine; \
             a program on this machine reports at 127.0.0.1:1883 as euclid--PART"
        );
        config.membership.key_file = Some("/etc/ecod/cell.key".into());
        assert!(
            config
                .joining()
                .ends_with("and a copy of /etc/ecod/cell.key")
        );
        let directory = tempfile::tempdir().unwrap();
        let file = |name: &str| directory.path().join(name);
        config.tls = Some(TlsConfig {
            ca: file("ca.pem"),
            certificate: file("node.pem"),
            key: file("node.key"),
            revocation_list: None,
            city: None,
        });
        assert!(
            config
                .joining()
                .contains("on the machine where `ecod-node init`")
        );
        fs::create_dir(file("pki")).unwrap();
        let invite = format!(
            "`ecod-node invite --dir {} NAME`",
            directory.path().display()
        );
        assert!(config.joining().contains(&invite));
    }
}
