//! A detection's way through two processes, as a collector of spans gets it.

use std::collections::HashMap;
use std::fs::{self, File};
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use axum::Router;
use axum::body::Bytes;
use axum::extract::State;
use axum::routing::post;
use ecod_testkit::{PATIENCE, car_ahead, command};
use hyper::server::conn::http1;
use hyper_util::rt::TokioIo;
use hyper_util::service::TowerToHyperService;
use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceRequest;
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::trace::v1::Span;
use prost::Message;
use tokio::net::TcpListener;
use tokio::time::timeout;
use uuid::Uuid;

/// What both nodes have in their files.
const CELL: &str = r#"
    listen = "127.0.0.1:0"
    membership = { bind = "127.0.0.1:0", multicast = { enabled = false } }
    dashboard = { enabled = false }
"#;

/// The spans that came, each with the service it is of.
type Spans = Arc<Mutex<Vec<(String, Span)>>>;

/// A collector on loopback.
async fn collector() -> (String, Spans) {
    let spans = Spans::default();
    let routes = Router::new()
        .route("/v1/traces", post(collect))
        .with_state(Arc::clone(&spans));
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    tokio::spawn(async move {
        while let Ok((stream, _)) = listener.accept().await {
            let service = TowerToHyperService::new(routes.clone());
            tokio::spawn(http1::Builder::new().serve_connection(TokioIo::new(stream), service));
        }
    });
    (format!("http://{address}"), spans)
}

async fn collect(State(spans): State<Spans>, body: Bytes) {
    for resource in ExportTraceServiceRequest::decode(body)
        .unwrap()
        .resource_spans
    {
        let service = attributes(&resource.resource.unwrap().attributes)
            .remove("service.name")
            .unwrap();
        for span in resource
            .scope_spans
            .into_iter()
            .flat_map(|scope| scope.spans)
        {
            spans.lock().unwrap().push((service.clone(), span));
        }
    }
}

fn attributes(
    pairs: &[opentelemetry_proto::tonic::common::v1::KeyValue],
) -> HashMap<String, String> {
    let text = |value: Value| match value {
        Value::StringValue(text) => text,
        Value::IntValue(number) => number.to_string(),
        other => format!("{other:?}"),
    };
    let pairs = pairs.iter().cloned();
    pairs
        .filter_map(|pair| Some((pair.key, text(pair.value?.value?))))
        .collect()
}

/// A node as a process; killed when dropped.
struct Process(Child);

impl Process {
    /// Ends a node by the end of its input.
    async fn end(mut self) {
        drop(self.0.stdin.take());
        let ended = async {
            loop {
                if let Some(status) = self.0.try_wait().unwrap() {
                    return status;
                }
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        };
        let status = timeout(PATIENCE, ended)
            .await
            .expect("the node does not end");
        assert!(status.success(), "{status}");
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().unwrap();
    }
}

/// Starts a node with this configuration; its log goes into the directory.
fn node(name: &str, config: &str, directory: &Path, collector: &str) -> Process {
    let file = directory.join(format!("{name}.toml"));
    fs::write(&file, format!("name = \"{name}\"\n{CELL}\n{config}")).unwrap();
    let log = File::create(directory.join(format!("{name}.log"))).unwrap();
    let process = command(env!("CARGO_BIN_EXE_ecod-node"))
        .args(["--log-format", "text", "--stop-at-eof", "--config"])
        .arg(file)
        .env_remove("RUST_LOG")
        .env("OTEL_EXPORTER_OTLP_ENDPOINT", collector)
        .env("OTEL_SERVICE_NAME", name)
        .env("OTEL_BSP_SCHEDULE_DELAY", "200")
        .stdin(Stdio::piped())
        .stderr(log)
        .spawn()
        .unwrap();
    Process(process)
}

/// Address of the edge's broker, as soon as the edge logs it.
async fn broker(directory: &Path) -> SocketAddr {
    let logged = async {
        loop {
            let log = fs::read_to_string(directory.join("edge.log")).unwrap();
            if let Some((address, _)) = log
                .split_once("broker serves address=")
                .and_then(|(_, rest)| rest.split_once('\n'))
            {
                return address.parse().unwrap();
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(PATIENCE, logged)
        .await
        .expect("the edge does not listen")
}

/// A vehicle before whose camera a car always stands.
fn vehicle(broker: SocketAddr, directory: &Path) -> String {
    format!(
        "role = \"cav\"\nmqtt = {{ broker = \"{broker}\" }}\n[camera]\n{}",
        car_ahead(directory)
    )
}

/// Spans of one detection: by name, from frame to acceptance.
struct Way {
    frame: Span,
    steps: Vec<Span>,
    report: Span,
    round: Span,
    accept: Span,
}

fn way(spans: &[(String, Span)]) -> Option<Way> {
    let of = |service: &str, name: &str| -> Vec<Span> {
        spans
            .iter()
            .filter(|(of, span)| of == service && span.name == name)
            .map(|(_, span)| span.clone())
            .collect()
    };
    let child = |parent: &Span, span: &Span| {
        parent.trace_id == span.trace_id && parent.span_id == span.parent_span_id
    };
    let linked = |from: &Span, to: &Span| {
        from.links
            .iter()
            .any(|link| link.trace_id == to.trace_id && link.span_id == to.span_id)
    };
    of("euclid", "frame").into_iter().find_map(|frame| {
        let steps = ["detect", "project", "publish"];
        let steps = steps.map(|step| {
            of("euclid", step)
                .into_iter()
                .find(|span| child(&frame, span))
        });
        let report = of("edge", "report")
            .into_iter()
            .find(|report| child(&frame, report))?;
        let round = of("edge", "round")
            .into_iter()
            .find(|round| linked(round, &frame) && linked(&report, round))?;
        let accept = of("euclid", "accept")
            .into_iter()
            .find(|accept| child(&round, accept))?;
        let published = of("edge", "publish")
            .into_iter()
            .any(|publish| child(&round, &publish));
        let fused = of("edge", "fuse")
            .into_iter()
            .any(|fuse| child(&round, &fuse));
        (published && fused).then_some(())?;
        Some(Way {
            frame,
            steps: steps.into_iter().collect::<Option<_>>()?,
            report,
            round,
            accept,
        })
    })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn spans_follow_frame_to_map() {
    let (endpoint, spans) = collector().await;
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path();
    let edge = node("edge", "role = \"edge\"", directory, &endpoint);
    let vehicle = vehicle(broker(directory).await, directory);
    let nodes = [edge, node("euclid", &vehicle, directory, &endpoint)];
    let followed = async {
        loop {
            tokio::time::sleep(Duration::from_millis(100)).await;
            let way = way(&spans.lock().unwrap());
            if let Some(way) = way {
                return way;
            }
        }
    };
    let way = timeout(PATIENCE, followed)
        .await
        .expect("no detection could be followed");
    assert!(
        way.frame.parent_span_id.is_empty() && way.round.parent_span_id.is_empty(),
        "they begin traces"
    );
    assert_eq!(attributes(&way.report.attributes)["from"], "euclid");
    assert_eq!(
        attributes(&way.accept.attributes)["round"],
        attributes(&way.round.attributes)["round"]
    );
    let mut starts = vec![way.frame.start_time_unix_nano];
    starts.extend(way.steps.iter().map(|step| step.start_time_unix_nano));
    starts.extend([&way.report, &way.accept].map(|span| span.start_time_unix_nano));
    assert!(starts.is_sorted(), "{starts:?}");
    assert!(
        way.frame.end_time_unix_nano >= way.steps[2].end_time_unix_nano,
        "a frame's span lasts until it is published"
    );

    // The last spans go out as a node ends.
    for node in nodes {
        node.end().await;
    }
    let spans = spans.lock().unwrap();
    let names: Vec<_> = spans.iter().map(|(_, span)| &*span.name).collect();
    let ours = [
        "accept", "detect", "frame", "fuse", "project", "publish", "report", "round",
    ];
    assert!(names.iter().all(|name| ours.contains(name)), "{names:?}");
    for (_, span) in &*spans {
        let attributes = attributes(&span.attributes);
        assert!(
            attributes
                .keys()
                .all(|key| key == "ecod.id" || !key.starts_with("ecod.")),
            "{attributes:?}"
        );
        if let Some(name) = attributes.get("ecod.id") {
            assert_eq!(
                (&*span.trace_id, &*span.span_id),
                (&id(name)[..], &id(name)[8..]),
                "{name}"
            );
        }
    }
}

/// The id that docs/protocol.md makes of a name.
fn id(name: &str) -> [u8; 16] {
    Uuid::new_v5(&Uuid::NAMESPACE_URL, format!("ecod:{name}").as_bytes()).into_bytes()
}

#[test]
fn span_id_matches_documentation() {
    let id = Uuid::from_bytes(id("lot-1/euclid/1732154400123456"));
    assert_eq!(id.simple().to_string(), "c14169bfb35459ee95b084c5c2655300");
}
