//! Debian's mosquitto as an external broker.

use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use ecod_actors::transport::mqtt::BrokerAddress;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tempfile::TempDir;

const PROGRAM: &str = "/usr/sbin/mosquitto";

/// A mosquitto process on a free loopback port; killed when dropped.
pub(crate) struct Mosquitto {
    child: Child,
    directory: TempDir,
    port: u16,
}

impl Mosquitto {
    pub(crate) fn start() -> Self {
        Self::configured(|_| "allow_anonymous true\n".to_owned())
    }

    /// Admits only this user.
    pub(crate) fn with_user(user: &str, password: &str) -> Self {
        Self::configured(|directory| passwords(directory, user, password))
    }

    /// Admits only this user, with the rights in the list.
    pub(crate) fn with_permissions(user: &str, password: &str, permissions: &str) -> Self {
        Self::configured(|directory| {
            let file = directory.join("permissions");
            std::fs::write(&file, format!("user {user}\n{permissions}\n")).unwrap();
            format!(
                "{}acl_file {}\n",
                passwords(directory, user, password),
                file.display()
            )
        })
    }

    /// With further settings, whose files may be in the directory.
    pub(crate) fn configured(settings: impl Fn(&Path) -> String) -> Self {
        assert!(
            Path::new(PROGRAM).exists(),
            "{PROGRAM} is missing: install Debian's package mosquitto"
        );
        let directory = tempfile::tempdir().unwrap();
        let settings = settings(directory.path());
        // Another process may take the port between its choice and mosquitto's start.
        for _ in 0..5 {
            let port = std::net::TcpListener::bind("127.0.0.1:0")
                .unwrap()
                .local_addr()
                .unwrap()
                .port();
            let user = "user root\nset_tcp_nodelay true\n";
            let text = format!("listener {port} 127.0.0.1\n{user}{settings}");
            std::fs::write(directory.path().join("mosquitto.conf"), text).unwrap();
            let mut child = spawn(directory.path());
            if serves(&mut child, port) {
                return Self {
                    child,
                    directory,
                    port,
                };
            }
        }
        panic!("mosquitto did not start on any of five free ports");
    }

    pub(crate) fn address(&self) -> BrokerAddress {
        format!("127.0.0.1:{}", self.port).parse().unwrap()
    }

    pub(crate) fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Stops the process where it is; its connections stay open.
    pub(crate) fn freeze(&self) {
        self.signal(Signal::SIGSTOP);
    }

    pub(crate) fn thaw(&self) {
        self.signal(Signal::SIGCONT);
    }

    fn signal(&self, signal: Signal) {
        kill(
            Pid::from_raw(i32::try_from(self.child.id()).unwrap()),
            signal,
        )
        .unwrap();
    }

    pub(crate) fn revive(&mut self) {
        self.child = spawn(self.directory.path());
        assert!(
            serves(&mut self.child, self.port),
            "mosquitto starts again on port {}",
            self.port
        );
    }
}

impl Drop for Mosquitto {
    fn drop(&mut self) {
        if self.child.kill().is_ok() {
            self.child.wait().unwrap();
        }
    }
}

fn passwords(directory: &Path, user: &str, password: &str) -> String {
    let file = directory.join("passwords");
    let made = Command::new("mosquitto_passwd")
        .arg("-b")
        .arg("-c")
        .arg(&file)
        .args([user, password])
        .status();
    assert!(
        made.is_ok_and(|status| status.success()),
        "mosquitto_passwd makes {}",
        file.display()
    );
    format!("allow_anonymous false\npassword_file {}\n", file.display())
}

fn spawn(directory: &Path) -> Child {
    Command::new(PROGRAM)
        .arg("-c")
        .arg(directory.join("mosquitto.conf"))
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

fn serves(child: &mut Child, port: u16) -> bool {
    let deadline = Instant::now() + Duration::from_secs(10);
    while Instant::now() < deadline && child.try_wait().unwrap().is_none() {
        if TcpStream::connect(("127.0.0.1", port)).is_ok() {
            return true;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    false
}
