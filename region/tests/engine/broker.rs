//! Brokers as processes of their own, in a directory of their own, on free ports of loopback.

use std::fs;
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;

use ecod::leadership::BrokerAddress;
use ecod_region::broker::{BrokerArguments, BrokerLogin};
use ecod_region::reader::{self, Reading, RegionState};
use ecod_testkit::{output_of, until_blocking};
use tempfile::TempDir;

/// A broker and its directory; ended when dropped.
pub(crate) struct Broker {
    child: Child,
    directory: TempDir,
    pub(crate) address: SocketAddr,
    /// Address for other servers.
    pub(crate) route: Option<SocketAddr>,
}

/// Name and place of a cell.
#[derive(Clone, Copy)]
pub(crate) struct PlacedCell {
    pub(crate) name: &'static str,
    pub(crate) latitude_deg: f64,
    pub(crate) longitude_deg: f64,
}

pub(crate) const LOT: PlacedCell = PlacedCell {
    name: "lot-1",
    latitude_deg: 48.8584,
    longitude_deg: 2.2945,
};

/// Some kilometres from [`LOT`].
pub(crate) const FAR: PlacedCell = PlacedCell {
    name: "far-1",
    latitude_deg: 48.80,
    longitude_deg: 2.40,
};

const DEPLOY: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/region");

impl Broker {
    /// NATS by `nats.conf`, with TLS and accounts of [`LOT`] and [`FAR`].
    pub(crate) fn nats() -> Self {
        let directory = TempDir::new().unwrap();
        let address = free_address();
        for file in ["common.conf", "nats.conf", "mqtt.conf"] {
            fs::copy(Path::new(DEPLOY).join(file), directory.path().join(file)).unwrap();
        }
        make_certificates(&directory.path().join("tls"));
        for cell in [LOT, FAR] {
            add_cell(directory.path(), &[], cell);
        }
        let mut command = Command::new("nats-server");
        command
            .args(["-c", "nats.conf"])
            .env("REGION_SERVER", "region-1")
            .env("REGION_MQTT", address.to_string())
            .env("REGION_CLIENTS", free_address().to_string())
            .env("REGION_MONITOR", free_address().to_string())
            .env("REGION_DATA", directory.path().join("data"));
        Self::start(command, directory, address)
    }

    /// Three servers by `nats-cluster.conf`, with TLS between them and the same accounts.
    pub(crate) fn cluster() -> [Self; 3] {
        let directories = [(); 3].map(|()| TempDir::new().unwrap());
        let [servers, routes] = [(); 2].map(|()| [(); 3].map(|()| free_address()));
        let first = directories[0].path();
        make_certificates(&first.join("tls"));
        add_cell(first, &[], LOT);
        let names = routes.map(|route| format!("\"nats://{route}\""));
        for directory in &directories {
            for file in [
                "common.conf",
                "nats-cluster.conf",
                "cluster-tls.conf",
                "mqtt.conf",
            ] {
                fs::copy(Path::new(DEPLOY).join(file), directory.path().join(file)).unwrap();
            }
            fs::write(
                directory.path().join("routes.conf"),
                format!("routes: [{}]\n", names.join(", ")),
            )
            .unwrap();
        }
        for directory in &directories[1..] {
            let copied = ["tls", "passwords", "accounts.conf"].map(|path| first.join(path));
            let status = Command::new("cp")
                .arg("-r")
                .args(copied)
                .arg(directory.path())
                .status()
                .unwrap();
            assert!(status.success());
        }
        let mut number = 0;
        directories.map(|directory| {
            let mut command = Command::new("nats-server");
            command
                .args(["-c", "nats-cluster.conf"])
                .env("REGION_SERVER", format!("region-{}", number + 1))
                .env("REGION_MQTT", servers[number].to_string())
                .env("REGION_CLIENTS", free_address().to_string())
                .env("REGION_MONITOR", free_address().to_string())
                .env("REGION_CLUSTER", routes[number].to_string())
                .env("REGION_DATA", directory.path().join("data"));
            number += 1;
            let mut server = Self::start(command, directory, servers[number - 1]);
            server.route = Some(routes[number - 1]);
            server
        })
    }

    /// mosquitto with the same accounts and certificates, and the user `town`, who may publish for all cells.
    pub(crate) fn mosquitto() -> Self {
        let directory = TempDir::new().unwrap();
        let address = free_address();
        let at = |file: &str| directory.path().join(file).display().to_string();
        make_certificates(&directory.path().join("tls"));
        let mut acl =
            "user region.reader\ntopic read ecod/v1/#\nuser town\ntopic write ecod/v1/#\n"
                .to_owned();
        for cell in [LOT, FAR] {
            acl += &account(&["--engine", "mosquitto"], cell);
        }
        fs::write(at("acl"), acl).unwrap();
        fs::create_dir(at("passwords")).unwrap();
        for user in ["region.reader", "town", LOT.name, FAR.name] {
            fs::write(at(&format!("passwords/{user}")), "secret\n").unwrap();
            let file = at("passwd");
            let made = directory.path().join("passwd").exists();
            let create: &[&str] = if made { &[] } else { &["-c"] };
            let status = Command::new("mosquitto_passwd")
                .args(create)
                .args(["-b", &file, user, "secret"])
                .status();
            assert!(status.unwrap().success());
        }
        let conf = fs::read_to_string(Path::new(DEPLOY).join("mosquitto.conf")).unwrap();
        let conf = conf
            .replace(
                "listener 8883",
                &format!("listener {} 127.0.0.1", address.port()),
            )
            .replace("/etc/ecod-region", directory.path().to_str().unwrap())
            .replace("persistence true", "persistence false");
        fs::write(at("mosquitto.conf"), conf).unwrap();
        let mut command = Command::new("mosquitto");
        command.args(["-c", "mosquitto.conf"]);
        Self::start(command, directory, address)
    }

    fn start(mut command: Command, directory: TempDir, address: SocketAddr) -> Self {
        let log = fs::File::create(directory.path().join("log")).unwrap();
        command
            .current_dir(directory.path())
            .stdout(Stdio::null())
            .stderr(log)
            .process_group(0);
        let child = command
            .spawn()
            .expect("nats-server and mosquitto are installed by `make test`");
        let broker = Self {
            child,
            directory,
            address,
            route: None,
        };
        until_blocking("the broker listens", || TcpStream::connect(address).is_ok());
        broker
    }

    /// The directory with passwords and certificates.
    pub(crate) fn directory(&self) -> &Path {
        self.directory.path()
    }

    /// Sends a signal, such as `HUP`.
    pub(crate) fn signal(&self, name: &str) {
        let status = Command::new("kill")
            .args([&format!("-{name}"), &self.child.id().to_string()])
            .status();
        assert!(status.unwrap().success());
    }

    /// The broker and a user on the command line.
    pub(crate) fn arguments(&self, user: &str) -> BrokerArguments {
        BrokerArguments {
            broker: BrokerAddress::from(self.address),
            ca: Some(self.directory().join("tls/ca.pem")),
            user: Some(user.to_owned()),
            password_file: Some(self.directory().join("passwords").join(user)),
        }
    }

    /// The login of a user.
    pub(crate) fn login(&self, user: &str) -> BrokerLogin {
        self.arguments(user).load().unwrap()
    }

    /// The account of one more cell, which the server takes while it runs.
    pub(crate) fn add_cell(&self, cell: PlacedCell) {
        add_cell(self.directory(), &[], cell);
        self.signal("HUP");
    }

    /// Another password for a cell, which the server takes while it runs.
    pub(crate) fn renew_password(&self, cell: PlacedCell) {
        add_cell(self.directory(), &["--new-password"], cell);
        self.signal("HUP");
    }

    /// The lines that `make-streams` prints.
    pub(crate) fn make_streams(&self) -> Vec<String> {
        let port = self.address.port().to_string();
        output_of(
            Command::new(Path::new(DEPLOY).join("make-streams"))
                .args([
                    "1",
                    "-h",
                    "127.0.0.1",
                    "-p",
                    &port,
                    "--cafile",
                    "tls/ca.pem",
                ])
                .current_dir(self.directory())
                .env("REGION_CONFIG", self.directory()),
        )
        .lines()
        .map(str::to_owned)
        .collect()
    }

    /// A reader of the whole region that reports each message.
    pub(crate) fn read(&self, seen: impl FnMut(&Reading<'_>) + Send + 'static) -> Arc<RegionState> {
        let login = self.login("region.reader");
        let state = Arc::new(RegionState::default());
        state.ask(["".parse().unwrap()].into());
        let read = Arc::clone(&state);
        tokio::spawn(async move { reader::read(&login, &read, seen).await });
        state
    }
}

impl Drop for Broker {
    fn drop(&mut self) {
        let _ = Command::new("kill")
            .args(["-CONT", &self.child.id().to_string()])
            .status();
        let _ = self.child.kill();
        let _ = self.child.wait();
        if std::thread::panicking() {
            eprintln!(
                "{}",
                fs::read_to_string(self.directory().join("log")).unwrap_or_default()
            );
        }
    }
}

/// Runs `add-cell` as an operator does.
fn add_cell(directory: &Path, flags: &[&str], cell: PlacedCell) {
    output_of(
        Command::new(Path::new(DEPLOY).join("add-cell"))
            .args(flags)
            .args([
                cell.name,
                &cell.latitude_deg.to_string(),
                &cell.longitude_deg.to_string(),
            ])
            .env("REGION_CONFIG", directory)
            .env("REGION_PROGRAM", env!("CARGO_BIN_EXE_ecod-region")),
    );
}

fn account(flags: &[&str], cell: PlacedCell) -> String {
    let place = [
        format!("--cell={}", cell.name),
        format!("--latitude={}", cell.latitude_deg),
        format!("--longitude={}", cell.longitude_deg),
    ];
    output_of(
        Command::new(env!("CARGO_BIN_EXE_ecod-region"))
            .arg("cell-account")
            .args(place)
            .args(flags),
    )
}

/// A CA, and the certificate of a server at this machine's loopback address.
fn make_certificates(directory: &PathBuf) {
    fs::create_dir(directory).unwrap();
    let ca_key = rcgen::KeyPair::generate().unwrap();
    let mut ca = rcgen::CertificateParams::new(Vec::new()).unwrap();
    ca.is_ca = rcgen::IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
    // OpenSSL takes a certificate for self-signed that has its issuer's name.
    ca.distinguished_name
        .push(rcgen::DnType::CommonName, "region");
    let ca_certificate = ca.self_signed(&ca_key).unwrap();
    let issuer = rcgen::Issuer::new(ca, ca_key);
    let key = rcgen::KeyPair::generate().unwrap();
    let names = vec!["127.0.0.1".to_owned(), "localhost".to_owned()];
    let server = rcgen::CertificateParams::new(names)
        .unwrap()
        .signed_by(&key, &issuer)
        .unwrap();
    fs::write(directory.join("ca.pem"), ca_certificate.pem()).unwrap();
    fs::write(directory.join("server.pem"), server.pem()).unwrap();
    fs::write(directory.join("server-key.pem"), key.serialize_pem()).unwrap();
}

pub(crate) fn free_address() -> SocketAddr {
    TcpListener::bind((Ipv4Addr::LOCALHOST, 0))
        .unwrap()
        .local_addr()
        .unwrap()
}
