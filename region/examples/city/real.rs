//! Real cells: an `ecod-node` each that leads, a vehicle that reports to it, and a line to the region that can be cut.

use std::fs;
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use anyhow::Context;
use ecod::leadership::BrokerAddress;
use ecod::model::names::NodeName;
use ecod::wire::{
    Encoding, ObjectReport, PerceivedObject, SCHEMA_VERSION, Topic, Topics, WirePose, encode,
};
use ecod_actors::platform::clock;
use ecod_region::broker::BrokerLogin;
use rumqttc::{AsyncClient, QoS};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Runtime;
use tokio::sync::watch;

use crate::cluster::{Cluster, PASSWORD, free_address};
use crate::places::Place;

/// Nodes that run; ended when dropped.
pub(crate) struct RealCells {
    nodes: Vec<Child>,
    lines: Vec<watch::Sender<bool>>,
    _runtime: Runtime,
}

/// Time between two reports of a vehicle.
const REPORT_PERIOD: Duration = Duration::from_millis(100);

/// Objects in a report.
const OBJECTS: usize = 10;

impl RealCells {
    pub(crate) fn start(
        node: Option<&Path>,
        places: &[Place],
        cluster: &Cluster,
        directory: &Path,
    ) -> anyhow::Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()?;
        let mut cells = Self {
            nodes: Vec::new(),
            lines: Vec::new(),
            _runtime: runtime,
        };
        let Some(node) = node else { return Ok(cells) };
        for Place { cell, origin } in places {
            let line = free_address()?;
            let listen = free_address()?;
            let gossip = free_address()?;
            let config = format!(
                "name = \"edge\"\ncell = \"{cell}\"\nrole = \"edge\"\nlisten = \"{listen}\"\n\
                 [fusion]\nalgorithms = \"pace\"\n[membership]\nbind = \"{gossip}\"\nmulticast.enabled = false\n\
                 [dashboard]\nenabled = false\n[origin]\nlatitude_deg = {}\nlongitude_deg = {}\n\
                 [uplink]\nbroker = \"{line}\"\nuser = \"{cell}\"\npassword = \"{PASSWORD}\"\n",
                origin.latitude_deg, origin.longitude_deg
            );
            let file = directory.join(format!("{cell}.toml"));
            fs::write(&file, config)?;
            let log = fs::File::create(directory.join(format!("{cell}.log")))?;
            let mut command = Command::new(node);
            // Only the file configures the node, not the environment of the benchmark.
            for (key, _) in
                std::env::vars_os().filter(|(key, _)| key.to_string_lossy().starts_with("ECOD_"))
            {
                command.env_remove(key);
            }
            let child = command
                .args(["--log-format", "text", "--stop-at-eof", "--config"])
                .arg(&file)
                .stdin(Stdio::piped())
                .stdout(Stdio::null())
                .stderr(log)
                .spawn()
                .with_context(|| format!("cannot start {}", node.display()))?;
            cells.nodes.push(child);
            let (is_open, opened) = watch::channel(true);
            cells.lines.push(is_open);
            let servers = Arc::new(cluster.addresses());
            cells._runtime.spawn(forward(line, servers, opened));
            cells._runtime.spawn(drive(listen, cell.clone()));
        }
        Ok(cells)
    }

    pub(crate) fn len(&self) -> usize {
        self.nodes.len()
    }

    pub(crate) fn pids(&self) -> Vec<u32> {
        self.nodes.iter().map(Child::id).collect()
    }

    /// Cuts the lines of the first `count` cells without closing their connections.
    pub(crate) fn cut(&self, count: usize) {
        self.lines.iter().take(count).for_each(|line| {
            line.send_replace(false);
        });
    }

    /// All lines work again.
    pub(crate) fn mend(&self) {
        self.lines.iter().for_each(|line| {
            line.send_replace(true);
        });
    }
}

impl Drop for RealCells {
    fn drop(&mut self) {
        for node in &mut self.nodes {
            drop(node.stdin.take());
        }
        for node in &mut self.nodes {
            // Its status makes no difference at the end.
            let _ = node.wait();
        }
    }
}

/// Passes connections on to the next server that takes them, as an address in front of the servers does.
async fn forward(line: SocketAddr, servers: Arc<Vec<SocketAddr>>, opened: watch::Receiver<bool>) {
    static NEXT: AtomicUsize = AtomicUsize::new(0);
    let Ok(listener) = TcpListener::bind(line).await else {
        return;
    };
    while let Ok((near, _)) = listener.accept().await {
        let servers = Arc::clone(&servers);
        let opened = opened.clone();
        tokio::spawn(async move {
            let first = NEXT.fetch_add(1, Ordering::Relaxed);
            for number in 0..servers.len() {
                if let Ok(far) = TcpStream::connect(servers[(first + number) % servers.len()]).await
                {
                    let (near_in, near_out) = near.into_split();
                    let (far_in, far_out) = far.into_split();
                    tokio::select! {
                        () = copy(near_in, far_out, opened.clone()) => {}
                        () = copy(far_in, near_out, opened) => {}
                    }
                    return;
                }
            }
        });
    }
}

/// Copies while the line is open; a cut one keeps what it has.
async fn copy(
    mut from: impl AsyncReadExt + Unpin,
    mut to: impl AsyncWriteExt + Unpin,
    mut opened: watch::Receiver<bool>,
) {
    let mut buffer = vec![0; 16 * 1024];
    while let Ok(count @ 1..) = from.read(&mut buffer).await {
        if opened.wait_for(|is_open| *is_open).await.is_err()
            || to.write_all(&buffer[..count]).await.is_err()
        {
            return;
        }
    }
}

/// A vehicle that reports to a cell's leader.
async fn drive(broker: SocketAddr, cell: NodeName) {
    let node = NodeName::from_static("euclid");
    let mut options = BrokerLogin::anonymous(BrokerAddress::from(broker)).options();
    options.set_keep_alive(Duration::from_secs(5));
    let (client, mut events) = AsyncClient::new(options, 8);
    tokio::spawn(async move {
        loop {
            if events.poll().await.is_err() {
                tokio::time::sleep(Duration::from_millis(500)).await;
            }
        }
    });
    let topic = Topics::new(&cell).path(&Topic::Detections(node.clone()));
    for sequence in 1_u64.. {
        tokio::time::sleep(REPORT_PERIOD).await;
        let object = |number: usize| {
            let angle = number as f64 + sequence as f64 / 100.0;
            PerceivedObject::new("car", 0.9, 20.0 * angle.cos(), 20.0 * angle.sin())
        };
        let report = ObjectReport {
            schema: SCHEMA_VERSION,
            node: node.clone(),
            seq: sequence,
            captured_at_us: clock::now(),
            pose: Some(WirePose::new(0.0, 0.0, 0.0)),
            objects: (0..OBJECTS).map(object).collect(),
            seen: None,
            view: None,
            clock_error_us: None,
            frame_yaw_rate_radps: None,
            moving: None,
        };
        // A report that the connection does not take is lost, as on a slow link.
        let _ = client.try_publish(
            &topic,
            QoS::AtMostOnce,
            false,
            encode(&report, Encoding::Json),
        );
    }
}
