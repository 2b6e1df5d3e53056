//! Troubles that a cell shows during faults: each trouble must name the fault, and other troubles must not appear.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::wire::Role;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::observe::recorder::RecordConfig;
use ecod_actors::platform::clock;
use ecod_actors::telemetry::counters::Counters;
use ecod_actors::transport::pki::{Authority, Credentials};
use ecod_testkit::{Cell, PATIENCE, car_ahead, node_config};
use rumqttc::{AsyncClient, MqttOptions, QoS, TlsConfiguration, Transport};
use tokio::task::{JoinHandle, JoinSet};
use tokio::time::{Instant, sleep};
use uuid::Uuid;

/// Validity of certificates.
const DAY: Duration = Duration::from_secs(86_400);

/// Time in which troubles may appear that follow from what happened.
const AFTERMATH: Duration = Duration::from_secs(4);

/// Longest time for which a trouble is shown after its end.
const LAPSE: Duration = Duration::from_secs(80);

/// Node that shows a trouble, its kind and its subject, which is empty for the node itself.
type Shown = [String; 3];

/// A node with certificates, in the directory of the cell.
fn configure(node: &str, role: Role, directory: &Path) -> NodeConfig {
    let mut config = node_config(node, "lot", role);
    let pki = directory.join("pki");
    let name = NodeName::new(node).unwrap();
    let mut authority = Authority::open(&pki)
        .or_else(|_| Authority::init(&pki, &NodeName::from_static("lot"), clock::wall()))
        .unwrap();
    authority.issue(&name, role, DAY, clock::wall()).unwrap();
    config.tls = Some(authority.tls_of(&name));
    config.state_dir = Some(directory.join(node));
    if node == "gauss" {
        config.camera = Some(toml::from_str(&car_ahead(directory)).unwrap());
        config.record = Some(RecordConfig {
            min_free_mb: 0,
            ..RecordConfig::new(directory.join("log"))
        });
    }
    config
}

/// A cell whose troubles are watched.
struct Watched {
    cell: Cell,
    counters: Arc<Mutex<BTreeMap<String, Arc<Counters>>>>,
    shown: Arc<Mutex<BTreeMap<Shown, String>>>,
    watch: JoinHandle<()>,
    table: Vec<String>,
    wrong: Vec<String>,
}

impl Watched {
    fn new() -> Self {
        let counters = Arc::<Mutex<BTreeMap<String, Arc<Counters>>>>::default();
        let shown = Arc::<Mutex<BTreeMap<Shown, String>>>::default();
        let watched = Arc::clone(&counters);
        let seen = Arc::clone(&shown);
        let watch = tokio::spawn(async move {
            loop {
                for (node, counters) in watched.lock().unwrap().iter() {
                    for trouble in counters.troubles().present() {
                        let about = trouble.about.unwrap_or_default();
                        let key = [node.clone(), trouble.kind, about];
                        seen.lock().unwrap().insert(key, trouble.cause);
                    }
                }
                sleep(Duration::from_millis(20)).await;
            }
        });
        Self {
            cell: Cell::new(configure),
            counters,
            shown,
            watch,
            table: Vec::new(),
            wrong: Vec::new(),
        }
    }

    async fn start(&mut self, node: &str, role: Role) {
        self.cell.start(node, role).await;
        let counters = Arc::clone(self.cell.node(node).counters());
        self.counters
            .lock()
            .unwrap()
            .insert(node.to_owned(), counters);
    }

    fn remove_counters(&mut self, node: &str) {
        self.counters.lock().unwrap().remove(node);
    }

    fn kill(&mut self, node: &str) {
        self.remove_counters(node);
        self.cell.kill(node);
    }

    async fn stop(&mut self, node: &str) {
        self.remove_counters(node);
        self.cell.stop_node(node).await;
    }

    fn is_shown(&self, [kind, about]: [&str; 2]) -> bool {
        let shown = self.shown.lock().unwrap();
        shown
            .keys()
            .any(|[_, found, subject]| found == kind && subject == about)
    }

    /// Judges the troubles since the last call: these kinds and subjects must have been shown, and no others.
    async fn judge(&mut self, cause: &str, expected: &[[&str; 2]]) {
        sleep(AFTERMATH).await;
        let deadline = Instant::now() + PATIENCE;
        while !expected.iter().all(|trouble| self.is_shown(*trouble)) && Instant::now() < deadline {
            sleep(Duration::from_millis(50)).await;
        }
        let quiet_by = Instant::now() + LAPSE;
        let is_quiet = || {
            let all = self.counters.lock().unwrap();
            all.values()
                .all(|counters| counters.troubles().present().is_empty())
        };
        while !is_quiet() {
            assert!(Instant::now() < quiet_by, "{cause}: {:?}", self.shown);
            sleep(Duration::from_millis(100)).await;
        }
        let shown = std::mem::take(&mut *self.shown.lock().unwrap());
        let missing = expected.iter().filter(|[kind, about]| {
            let is_it = |[_, found, subject]: &Shown| found == kind && subject == about;
            !shown.keys().any(is_it)
        });
        let missing: BTreeSet<_> = missing.collect();
        for [kind, about] in &missing {
            self.wrong
                .push(format!("{cause} | {kind} {about} | not shown"));
        }
        for ([node, kind, about], text) in &shown {
            let is_right = expected.contains(&[kind, about]);
            let verdict = if is_right { "right" } else { "wrong" };
            let row = format!("{cause} | {kind} {about} at {node}: {text} | {verdict}");
            if !is_right {
                self.wrong.push(row.clone());
            }
            self.table.push(row);
        }
        if shown.is_empty() {
            self.table.push(format!("{cause} | nothing | right"));
        }
    }

    async fn end(self) {
        println!("cause | shown | verdict\n{}", self.table.join("\n"));
        self.watch.abort();
        self.cell.stop().await;
        assert!(self.wrong.is_empty(), "{:#?}", self.wrong);
    }

    /// A program of `gauss` that sends far more reports than are taken.
    fn flood(&self) -> JoinSet<()> {
        let broker = self.cell.node("edge").broker_address().unwrap();
        let name = NodeName::from_static("gauss");
        let tls = self.cell.config("gauss", Role::Cav).tls.unwrap();
        let tls = Credentials::load(&tls, &name).unwrap();
        let client = Arc::clone(&tls.current().client);
        let id = format!("gauss--cam-{}", Uuid::from_u128(7).simple());
        let mut options = MqttOptions::new(id, broker.ip().to_string(), broker.port());
        options.set_transport(Transport::tls_with_config(TlsConfiguration::Rustls(client)));
        let (client, mut events) = AsyncClient::new(options, 16);
        let mut tasks = JoinSet::new();
        tasks.spawn(async move { while events.poll().await.is_ok() {} });
        tasks.spawn(async move {
            for seq in 1_u64.. {
                let captured = clock::wall().micros();
                let report = format!(
                    r#"{{"schema":1,"node":"gauss--cam","seq":{seq},"captured_at_us":{captured},"objects":[]}}"#
                );
                let topic = "ecod/v1/lot/detections/gauss--cam";
                client.publish(topic, QoS::AtMostOnce, false, report).await.ok();
                sleep(Duration::from_millis(3)).await;
            }
        });
        tasks
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_trouble_has_its_cause() {
    let mut watched = Watched::new();
    watched.start("edge", Role::Edge).await;
    watched.start("euclid", Role::Auto).await;
    watched.start("gauss", Role::Cav).await;
    watched.cell.led_by("edge").await;
    watched.judge("a cell starts", &[]).await;

    for is_killed in [false, true] {
        let runtime = tokio::runtime::Runtime::new().unwrap();
        let config = watched
            .cell
            .config("euclid", Role::Auto)
            .observing("top")
            .unwrap();
        let observer = runtime
            .spawn(ecod_actors::node::start(config))
            .await
            .unwrap()
            .unwrap();
        observer
            .newest_map()
            .wait_for(Option::is_some)
            .await
            .unwrap();
        if !is_killed {
            runtime.spawn(observer.stop()).await.unwrap();
        }
        runtime.shutdown_background();
        let end = if is_killed { "is killed" } else { "leaves" };
        watched
            .judge(&format!("an observer comes and {end}"), &[])
            .await;
    }

    watched.stop("gauss").await;
    watched.start("gauss", Role::Cav).await;
    watched.cell.served_by("edge").await;
    watched.judge("a vehicle restarts", &[]).await;

    watched.stop("edge").await;
    watched.cell.served_by("euclid").await;
    watched.start("edge", Role::Edge).await;
    watched.cell.served_by("edge").await;
    watched.judge("the leader restarts", &[]).await;

    watched.kill("edge");
    watched.cell.served_by("euclid").await;
    watched.start("edge", Role::Edge).await;
    watched.cell.served_by("edge").await;
    watched.judge("the leader is killed and returns", &[]).await;

    watched.start("noether", Role::Auto).await;
    watched.cell.served_by("edge").await;
    watched.judge("a node joins", &[]).await;

    watched.kill("noether");
    watched
        .cell
        .until("noether is missed", |_| {
            watched.is_shown(["node_missing", "noether"]).then_some(())
        })
        .await;
    watched.start("noether", Role::Auto).await;
    watched
        .judge("a node is killed", &[["node_missing", "noether"]])
        .await;

    let flood = watched.flood();
    watched
        .cell
        .until("the flood is named", |_| {
            watched.is_shown(["overload", "gauss"]).then_some(())
        })
        .await;
    drop(flood);
    watched
        .judge("a program floods", &[["overload", "gauss"]])
        .await;

    let log = watched.cell.directory().join("log");
    std::fs::remove_dir_all(&log).unwrap();
    std::fs::write(&log, "a file").unwrap();
    watched
        .cell
        .until("recording has stopped", |_| {
            watched.is_shown(["not_recorded", ""]).then_some(())
        })
        .await;
    std::fs::remove_file(&log).unwrap();
    watched
        .judge("a recording stops", &[["not_recorded", ""]])
        .await;
    watched.end().await;
}
