//! Checks of the machine for everything that a node needs.
//!
//! The checks leave the machine unchanged: they close the ports that they open, remove the files
//! that they create, disconnect from the broker, and leave the cell, which they observe for some
//! seconds. The ports of the node itself, if it runs, count as free.

#[cfg(feature = "camera")]
mod camera;
mod cell;
mod certificates;
mod clock;
mod network;
mod storage;

use std::path::Path;

use ecod::diagnostics::TroubleKind;
use serde::Serialize;

use crate::node::config::NodeConfig;
use crate::node::running::{RunningNode, RunningReadiness};

/// Result of one check.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// Name of the check.
    pub check: &'static str,
    /// Outcome of the check.
    pub verdict: CheckResult,
    /// Observation that led to the outcome.
    pub seen: String,
    /// Suggested fix; `None` if the check found no problem.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fix: Option<String>,
}

/// Outcome of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum CheckResult {
    /// The check found no problem.
    Fine,
    /// The node runs, but with a limitation.
    Doubtful,
    /// The node does not run, or cannot fulfil its role.
    Broken,
}

impl Finding {
    fn fine(check: &'static str, seen: impl Into<String>) -> Self {
        Self {
            check,
            verdict: CheckResult::Fine,
            seen: seen.into(),
            fix: None,
        }
    }

    fn doubtful(check: &'static str, seen: impl Into<String>, fix: impl Into<String>) -> Self {
        Self {
            check,
            verdict: CheckResult::Doubtful,
            seen: seen.into(),
            fix: Some(fix.into()),
        }
    }

    fn broken(check: &'static str, seen: impl Into<String>, fix: impl Into<String>) -> Self {
        Self {
            check,
            verdict: CheckResult::Broken,
            seen: seen.into(),
            fix: Some(fix.into()),
        }
    }
}

/// Runs all checks for a valid configuration that was read from `file`.
pub async fn examine(config: &NodeConfig, file: &Path) -> Vec<Finding> {
    let mut findings = Vec::new();
    #[cfg(feature = "camera")]
    findings.extend(camera::examine(config).await);
    findings.extend(units(config));
    let running = own_node(config).await;
    let is_running = running.is_some();
    findings.extend(running);
    findings.extend(network::broker(config, is_running).await);
    findings.extend(network::uplink(config).await);
    findings.push(network::gossip(config, is_running));
    findings.extend(network::seeds(config).await);
    findings.extend(cell::examine(config).await);
    #[cfg(feature = "camera")]
    findings.extend(network::poses(config, is_running));
    findings.extend(network::dashboard(config, is_running));
    findings.extend(storage::floor_plan(config));
    #[cfg(feature = "foxglove")]
    findings.extend(network::live(config, is_running));
    findings.extend(network::multicast(config));
    findings.push(storage::key(config));
    findings.extend(certificates::examine(config));
    findings.extend(certificates::cells(config));
    findings.push(clock::synchronised());
    findings.extend(storage::directories(config));
    findings.extend(storage::service(config, file));
    findings
}

/// The node of this configuration, if it runs on this machine.
async fn own_node(config: &NodeConfig) -> Option<Finding> {
    let node = RunningNode::find(config).await?;
    let name = &node.node.name;
    let RunningReadiness { ready, reason } = &node.readiness;
    let seen = format!("{name} runs: {reason}");
    Some(if *ready {
        Finding::fine("node", seen)
    } else {
        Finding::doubtful("node", seen, "`ecod-node status` names its troubles")
    })
}

/// Checks that values look as if they had the units of their keys.
fn units(config: &NodeConfig) -> impl Iterator<Item = Finding> {
    config
        .doubtful_units()
        .into_iter()
        .filter_map(|(kind, cause)| {
            let check = if kind == TroubleKind::ImplausibleSize {
                "sizes"
            } else {
                "units"
            };
            Some(Finding::doubtful(check, cause?, kind.remedy()))
        })
}

#[cfg(test)]
mod tests {
    use std::fs::Permissions;
    use std::net::{TcpListener, UdpSocket};
    use std::os::unix::fs::PermissionsExt;
    use std::time::Duration;

    use ecod::model::names::NodeName;
    use ecod::wire::Role;

    use super::*;
    use crate::observe::dashboard::{FloorPlanConfig, FloorPlanPoint};
    use crate::observe::recorder::RecordConfig;
    use crate::transport::pki::{Authority, TlsConfig};

    fn config() -> NodeConfig {
        let mut config = NodeConfig {
            name: Some(NodeName::from_static("edge")),
            role: Role::Edge,
            ..NodeConfig::default()
        };
        config.listen = Some("127.0.0.1:0".parse().unwrap());
        config.membership.bind = Some("127.0.0.1:0".parse().unwrap());
        config.membership.multicast.enabled = false;
        config.dashboard.enabled = false;
        config
    }

    async fn finding(config: &NodeConfig, check: &str) -> Finding {
        let findings = examine(config, Path::new("node.toml")).await;
        findings
            .iter()
            .find(|finding| finding.check == check)
            .unwrap_or_else(|| panic!("{check}: {findings:?}"))
            .clone()
    }

    #[tokio::test]
    async fn runnable_node_passes_all_checks() {
        let directory = tempfile::tempdir().unwrap();
        let mut config = config();
        config.state_dir = Some(directory.path().into());
        config.record = Some(RecordConfig {
            min_free_mb: 0,
            ..RecordConfig::new(directory.path().join("a/b"))
        });
        let findings = examine(&config, Path::new("node.toml")).await;
        assert!(
            findings
                .iter()
                .all(|finding| finding.verdict < CheckResult::Broken),
            "{findings:?}"
        );
        assert_eq!(
            std::fs::read_dir(directory.path()).unwrap().count(),
            0,
            "the test file was removed"
        );
    }

    /// Issues certificates for 60 days into the directory.
    fn certificates(config: &NodeConfig, directory: &Path) -> TlsConfig {
        let now = crate::platform::clock::now();
        let name = NodeName::from_static("edge");
        let mut authority = Authority::init(directory, &config.cell, now).unwrap();
        authority
            .issue(&name, Role::Edge, Duration::from_secs(60 * 86_400), now)
            .unwrap();
        let (certificate, key) = authority.files_of(&name);
        TlsConfig {
            ca: authority.ca(),
            certificate,
            key,
            revocation_list: Some(authority.revocation_list()),
            city: None,
        }
    }

    #[tokio::test]
    async fn unprotected_key_is_doubtful() {
        let directory = tempfile::tempdir().unwrap();
        let mut config = config();
        let files = certificates(&config, directory.path());
        config.tls = Some(files.clone());
        for (mode, verdict) in [
            (0o600, CheckResult::Fine),
            (0o640, CheckResult::Fine),
            (0o644, CheckResult::Doubtful),
            (0o660, CheckResult::Doubtful),
        ] {
            std::fs::set_permissions(&files.key, Permissions::from_mode(mode)).unwrap();
            let finding = finding(&config, "certificates").await;
            assert_eq!(finding.verdict, verdict, "{mode:o}: {finding:?}");
        }
    }

    #[tokio::test]
    async fn foreign_or_revoked_certificate_is_broken() {
        let directory = tempfile::tempdir().unwrap();
        let elsewhere = tempfile::tempdir().unwrap();
        let mut config = config();
        let files = certificates(&config, directory.path());
        let others = certificates(&config, elsewhere.path());
        for ca in [&files, &others] {
            std::fs::set_permissions(&ca.key, Permissions::from_mode(0o600)).unwrap();
        }
        config.tls = Some(files.clone());
        assert_eq!(
            finding(&config, "certificates").await.verdict,
            CheckResult::Fine
        );
        config.tls = Some(TlsConfig {
            ca: others.ca,
            revocation_list: None,
            ..files.clone()
        });
        let found = finding(&config, "certificates").await;
        assert!(
            found.verdict == CheckResult::Broken && found.seen.contains("does not accept"),
            "{found:?}"
        );
        let now = crate::platform::clock::now();
        Authority::open(directory.path())
            .unwrap()
            .revoke(&NodeName::from_static("edge"), now)
            .unwrap();
        config.tls = Some(files);
        let found = finding(&config, "certificates").await;
        assert!(
            found.verdict == CheckResult::Broken && found.seen.to_lowercase().contains("revoked"),
            "{found:?}"
        );
    }

    #[tokio::test]
    async fn empty_revocation_list_is_named() {
        let directory = tempfile::tempdir().unwrap();
        let mut config = config();
        let files = certificates(&config, directory.path());
        std::fs::write(files.revocation_list.as_ref().unwrap(), "").unwrap();
        config.tls = Some(files);
        let finding = finding(&config, "certificates").await;
        assert_eq!(finding.verdict, CheckResult::Broken);
        assert!(
            finding.seen.contains("revoked.pem") && finding.fix.unwrap().contains("revoked.pem")
        );
    }

    #[tokio::test]
    async fn ports_in_use_are_named() {
        let tcp = TcpListener::bind("127.0.0.1:0").unwrap();
        let udp = UdpSocket::bind("127.0.0.1:0").unwrap();
        let mut config = config();
        config.listen = tcp.local_addr().ok();
        config.membership.bind = udp.local_addr().ok();
        let page = TcpListener::bind("127.0.0.1:0").unwrap();
        config.dashboard.enabled = true;
        config.dashboard.listen = page.local_addr().ok();
        for (check, port, key) in [
            ("broker port", tcp.local_addr().unwrap().port(), "`listen`"),
            (
                "gossip port",
                udp.local_addr().unwrap().port(),
                "`membership.bind`",
            ),
            (
                "dashboard",
                page.local_addr().unwrap().port(),
                "`dashboard.listen`",
            ),
        ] {
            let finding = finding(&config, check).await;
            assert_eq!(finding.verdict, CheckResult::Broken);
            assert!(finding.seen.contains(&port.to_string()) && finding.fix.unwrap().contains(key));
        }
    }

    #[tokio::test]
    async fn unusable_listener_address_is_broken() {
        let port = TcpListener::bind("127.0.0.1:0").unwrap();
        let cav = NodeConfig {
            role: Role::Cav,
            listen: port.local_addr().ok(),
            ..config()
        };
        let mut beside_another_broker = NodeConfig {
            role: Role::Auto,
            ..cav.clone()
        };
        beside_another_broker.mqtt.broker = port.local_addr().ok().map(Into::into);
        for config in [&cav, &beside_another_broker] {
            let found = finding(config, "broker port").await;
            assert!(
                found.verdict == CheckResult::Broken && found.fix.unwrap().contains("`listen`")
            );
        }
        let unset = NodeConfig {
            listen: None,
            ..cav.clone()
        };
        // The port is in use, by this test or by another.
        let _taken = TcpListener::bind(unset.broker_listen());
        let found = finding(&unset, "broker port").await;
        assert!(found.verdict == CheckResult::Doubtful && found.fix.unwrap().contains("`listen`"));
        let mut closed = cav;
        closed.broker.door = false;
        assert!(
            examine(&closed, Path::new("node.toml"))
                .await
                .iter()
                .all(|finding| finding.check != "broker port")
        );
    }

    #[cfg(feature = "camera")]
    #[tokio::test]
    async fn busy_pose_port_is_named() {
        let taken = UdpSocket::bind("127.0.0.1:0").unwrap();
        let mut config = config();
        config.pose.listen = taken.local_addr().ok();
        let finding = finding(&config, "pose port").await;
        assert!(
            finding.verdict == CheckResult::Broken
                && finding.fix.unwrap().contains("`pose.listen`")
        );
    }

    #[tokio::test]
    async fn replaceable_page_port_is_fine() {
        // The port is in use, by this test or by another.
        let _taken = TcpListener::bind(crate::observe::dashboard::DEFAULT_ADDRESS);
        let mut config = config();
        config.dashboard.enabled = true;
        assert!(finding(&config, "dashboard").await.verdict < CheckResult::Broken);
        config.dashboard.enabled = false;
        assert!(
            examine(&config, Path::new("node.toml"))
                .await
                .iter()
                .all(|finding| finding.check != "dashboard")
        );
    }

    #[tokio::test]
    async fn missing_floor_plan_is_broken() {
        let mut config = config();
        let point = |metres: f64| FloorPlanPoint {
            pixel: [metres; 2],
            position_m: [metres; 2],
        };
        let image = "/nowhere/plan.png".into();
        config.dashboard.enabled = true;
        config.dashboard.floor_plan = Some(FloorPlanConfig {
            image,
            points: [point(0.0), point(1.0)],
        });
        let finding = finding(&config, "floor plan").await;
        assert!(
            finding.verdict == CheckResult::Broken && finding.seen.contains("No such file"),
            "{finding:?}"
        );
    }

    /// A vehicle that moves between the cells of a file.
    fn moving(file: &Path) -> NodeConfig {
        let mut config = NodeConfig {
            cells: Some(file.to_owned()),
            ..config()
        };
        config.pose.listen = Some("127.0.0.1:0".parse().unwrap());
        config
    }

    #[tokio::test]
    async fn unusable_cells_file_is_broken() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("cells.toml");
        std::fs::write(
            &file,
            "[[cells]]\nname = \"elsewhere\"\nlatitude_deg = 1\nlongitude_deg = 2\n",
        )
        .unwrap();
        let finding = finding(&moving(&file), "cells").await;
        assert!(
            finding.verdict == CheckResult::Broken && finding.seen.contains("not among"),
            "{finding:?}"
        );
    }

    #[tokio::test]
    async fn missing_cell_files_are_doubtful() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("cells.toml");
        let cell = |name, more| {
            format!("[[cells]]\nname = \"{name}\"\nlatitude_deg = 1\nlongitude_deg = 2\n{more}")
        };
        std::fs::write(
            &file,
            cell("cell", "") + &cell("elsewhere", "key_file = \"gone.key\"\n"),
        )
        .unwrap();
        let finding = finding(&moving(&file), "cells").await;
        assert!(
            finding.verdict == CheckResult::Doubtful && finding.seen.contains("gone.key"),
            "{finding:?}"
        );
    }

    #[tokio::test]
    async fn cell_refusing_certificate_is_doubtful() {
        let directory = tempfile::tempdir().unwrap();
        let elsewhere = tempfile::tempdir().unwrap();
        let own = certificates(&config(), directory.path());
        let other = certificates(&config(), elsewhere.path());
        let file = directory.path().join("cells.toml");
        let cell = |name, ca: &Path| {
            format!(
                "[[cells]]\nname = \"{name}\"\nlatitude_deg = 1\nlongitude_deg = 2\nca = {ca:?}\n"
            )
        };
        std::fs::write(&file, cell("cell", &own.ca) + &cell("elsewhere", &other.ca)).unwrap();
        let finding = finding(
            &NodeConfig {
                tls: Some(own),
                ..moving(&file)
            },
            "cells",
        )
        .await;
        assert_eq!(finding.verdict, CheckResult::Doubtful, "{finding:?}");
        assert!(
            finding.seen.contains("cell elsewhere: it does not accept"),
            "{finding:?}"
        );
        assert!(!finding.seen.contains("cell cell"), "{finding:?}");
    }

    #[cfg(feature = "foxglove")]
    #[tokio::test]
    async fn busy_live_port_is_named() {
        let live = TcpListener::bind("127.0.0.1:0").unwrap();
        let directory = tempfile::tempdir().unwrap();
        let live_port = Some(live.local_addr().unwrap().port());
        let record = Some(RecordConfig {
            live_port,
            ..RecordConfig::new(directory.path())
        });
        let finding = finding(&NodeConfig { record, ..config() }, "live port").await;
        assert!(
            finding.verdict == CheckResult::Broken
                && finding.fix.unwrap().contains("`record.live_port`")
        );
    }

    #[tokio::test]
    async fn foreign_addresses_and_missing_directories_named() {
        let mut config = config();
        config.listen = Some("192.0.2.1:1883".parse().unwrap());
        config.map_log = Some("/no/such/maps".into());
        let port = finding(&config, "broker port").await;
        assert!(
            port.verdict == CheckResult::Broken
                && port.fix.unwrap().contains("an address of this machine")
        );
        let log = finding(&config, "map log").await;
        assert!(
            log.verdict == CheckResult::Broken && log.seen.contains("/no/such"),
            "{log:?}"
        );
    }

    #[tokio::test]
    async fn external_broker_must_be_reachable() {
        let address = TcpListener::bind("127.0.0.1:0")
            .unwrap()
            .local_addr()
            .unwrap();
        let mut config = config();
        config.mqtt.broker = Some(address.into());
        let finding = finding(&config, "broker").await;
        assert_eq!(finding.verdict, CheckResult::Broken);
        assert!(finding.seen.contains(&address.to_string()), "{finding:?}");
    }

    #[tokio::test]
    async fn missing_region_is_doubtful() {
        let address = TcpListener::bind("127.0.0.1:0")
            .unwrap()
            .local_addr()
            .unwrap();
        let mut config = config();
        config.uplink.broker = Some(address.into());
        let finding = finding(&config, "uplink").await;
        assert!(
            finding.verdict == CheckResult::Doubtful && finding.seen.contains(&address.to_string()),
            "{finding:?}"
        );
    }

    #[tokio::test]
    async fn seed_without_address_is_doubtful() {
        let mut config = config();
        config.role = Role::Cav;
        let seeds = ["127.0.0.1:17884", "[::1]:17884", "egde.invalid:17884"].map(str::to_owned);
        config.membership.seeds = seeds.to_vec();
        let findings = examine(&config, Path::new("node.toml")).await;
        let findings: Vec<_> = findings
            .into_iter()
            .filter(|finding| finding.check == "seed")
            .collect();
        let verdicts: Vec<_> = findings.iter().map(|finding| finding.verdict).collect();
        assert_eq!(
            verdicts,
            [
                CheckResult::Fine,
                CheckResult::Doubtful,
                CheckResult::Doubtful
            ],
            "{findings:?}"
        );
        assert!(
            findings
                .iter()
                .zip(&seeds)
                .all(|(finding, seed)| finding.seen.contains(seed)),
            "{findings:?}"
        );
    }

    /// An edge on loopback, and the configuration of a node that has it as its seed.
    async fn edge_and_seeded(key: &str) -> (crate::node::NodeHandle, NodeConfig) {
        use crate::platform::secret::Secret;
        let mut edge = config();
        edge.cell = NodeName::from_static("ux-lot");
        edge.membership.key = Some(Secret::new("correct horse battery"));
        let edge = crate::node::start(edge).await.unwrap();
        let mut config = config();
        config.name = Some(NodeName::from_static("euclid"));
        config.role = Role::Cav;
        config.cell = NodeName::from_static("ux-lot");
        config.membership.key = Some(Secret::new(key));
        config.membership.seeds = vec![edge.gossip_address().unwrap().to_string()];
        (edge, config)
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn cell_is_checked_with_key() {
        let (edge, mut config) = edge_and_seeded("correct horse battery").await;
        let found = finding(&config, "cell").await;
        assert!(
            found.verdict == CheckResult::Fine && found.seen.contains("ux-lot is led by edge"),
            "{found:?}"
        );
        config.membership.key = Some(crate::platform::secret::Secret::new(
            "another horse battery",
        ));
        let found = finding(&config, "cell").await;
        assert!(
            found.verdict == CheckResult::Doubtful && found.seen == "no node of ux-lot answers",
            "{found:?}"
        );
        assert!(found.fix.unwrap().contains("the key"));
        let troubles = edge.troubles();
        assert!(
            troubles
                .iter()
                .any(|(_, trouble)| trouble.cause.contains("another key")),
            "{troubles:?}"
        );
        edge.stop().await;
    }

    /// A log may be written by any user who tries, but not by the service, whose unit restricts its
    /// paths.
    #[tokio::test]
    async fn unwritable_unit_directory_is_doubtful() {
        let unit = include_str!("../../packaging/systemd/ecod-node.service");
        for line in [
            "ProtectSystem=strict",
            "StateDirectory=ecod",
            "ExecStart=/usr/bin/ecod-node --config /etc/ecod/node.toml",
        ] {
            assert!(unit.lines().any(|found| found == line), "{line}");
        }
        let directory = tempfile::tempdir().unwrap();
        let mut config = config();
        config.record = Some(RecordConfig {
            min_free_mb: 0,
            ..RecordConfig::new(directory.path().join("log"))
        });
        let of_service = Path::new("/etc/ecod/node.toml");
        let findings = examine(&config, of_service).await;
        let found: Vec<_> = findings
            .iter()
            .filter(|finding| finding.check == "service")
            .collect();
        assert!(
            found.len() == 1 && found[0].verdict == CheckResult::Doubtful,
            "{findings:?}"
        );
        assert!(
            found[0]
                .fix
                .as_ref()
                .is_some_and(|fix| fix.contains("`record.dir`") && fix.contains("ReadWritePaths"))
        );
        assert!(
            storage::service(&config, Path::new("node.toml")).is_empty(),
            "another node may write where it likes"
        );
        config.record = Some(RecordConfig::new("/var/lib/ecod/log"));
        config.state_dir = Some("/var/lib/ecod".into());
        assert!(storage::service(&config, of_service).is_empty());
    }

    #[tokio::test]
    async fn unusable_keys_and_directories_are_named() {
        let directory = tempfile::tempdir().unwrap();
        let short = directory.path().join("key");
        let file = directory.path().join("file");
        std::fs::write(&short, "short").unwrap();
        std::fs::write(&file, "").unwrap();
        let mut config = config();
        assert_eq!(
            finding(&config, "cell key").await.verdict,
            CheckResult::Doubtful
        );
        config.membership.key_file = Some(short);
        assert_eq!(
            finding(&config, "cell key").await.verdict,
            CheckResult::Broken
        );
        config.state_dir = Some(file.join("below"));
        let found = finding(&config, "state directory").await;
        assert!(
            found.verdict == CheckResult::Broken && found.seen.contains("below"),
            "{found:?}"
        );
        config.record = Some(RecordConfig {
            min_free_mb: 1_000_000_000,
            ..RecordConfig::new(directory.path())
        });
        let found = finding(&config, "log directory").await;
        assert!(found.verdict == CheckResult::Broken && found.fix.unwrap().contains("min_free_mb"));
    }
}
