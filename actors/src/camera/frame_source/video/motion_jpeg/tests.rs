use std::io::{BufRead, BufReader, Write};
use std::net::TcpListener;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::*;

const CHALLENGE: &str = "HTTP/1.1 401 Unauthorized\r\nContent-Length: 0\r\nWWW-Authenticate:";
const STREAM: &str = "HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=frame";

/// A camera on a free port that sends every client one answer.
struct Camera {
    url: String,
    /// Number of requests so far.
    requests: Arc<AtomicUsize>,
}

impl Camera {
    fn with_answer(answer: String) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://user:hush@{}/1", listener.local_addr().unwrap());
        let requests = Arc::<AtomicUsize>::default();
        let counted = Arc::clone(&requests);
        std::thread::spawn(move || {
            for visitor in listener.incoming() {
                let mut visitor = visitor.unwrap();
                let lines = BufReader::new(visitor.try_clone().unwrap()).lines();
                lines
                    .map_while(Result::ok)
                    .take_while(|line| !line.is_empty())
                    .for_each(drop);
                counted.fetch_add(1, Ordering::SeqCst);
                visitor.write_all(answer.as_bytes()).unwrap();
            }
        });
        Self { url, requests }
    }
}

/// True if the stream is open, false if it is left to FFmpeg.
fn open(url: &str) -> Result<bool, String> {
    let source = SourceConfig::Url {
        url: url.to_owned(),
        latency_s: None,
    };
    let opened = MotionJpeg::open(&source, Duration::from_secs(60));
    opened
        .map(|stream| stream.is_some())
        .map_err(|error| error.to_string())
}

#[test]
fn refused_request_is_the_error() {
    for (answer, reason, requests) in [
        (
            "HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n".into(),
            "404 Not Found",
            1,
        ),
        (
            "HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\n\r\n".into(),
            "403 Forbidden",
            1,
        ),
        (
            format!("{CHALLENGE} Basic realm=\"camera\"\r\n\r\n"),
            "401 Unauthorized: the camera refuses user or password",
            2,
        ),
        (format!("{STREAM}\r\n\r\n"), "no further frame", 1),
    ] {
        let camera = Camera::with_answer(answer);
        let error = open(&camera.url).expect_err(reason);
        assert!(
            error.starts_with("cannot open http://127.0.0.1:") && error.ends_with(reason),
            "{error}"
        );
        assert_eq!(camera.requests.load(Ordering::SeqCst), requests, "{reason}");
    }
    let camera = Camera::with_answer(format!("{CHALLENGE} Digest realm=\"camera\"\r\n\r\n"));
    let error = open(&camera.url.replace("user:hush@", "")).expect_err("no login");
    assert!(
        error.ends_with("the address has no user and password"),
        "{error}"
    );
}

#[test]
fn unreachable_camera_is_the_error() {
    for url in ["http://camera.invalid/1", "http://127.0.0.1:1/1"] {
        let error = open(url).expect_err(url);
        assert!(
            error.starts_with(&format!("cannot open {url}: ")),
            "{error}"
        );
    }
}

#[test]
fn ffmpeg_reads_other_streams() {
    for answer in [
        "HTTP/1.1 200 OK\r\nContent-Type: video/mp2t\r\n\r\n".into(),
        "HTTP/1.1 302 Found\r\nContent-Length: 0\r\nLocation: /2\r\n\r\n".into(),
        "ICY 200 OK\r\n\r\n".into(),
        format!("{CHALLENGE} Digest realm=\"camera\"\r\n\r\n"),
        format!("{STREAM}\r\n\r\n--frame\r\nContent-Type: image/jpeg\r\n\r\n"),
    ] {
        let camera = Camera::with_answer(answer.clone());
        assert_eq!(open(&camera.url), Ok(false), "{answer}");
    }
    assert_eq!(open("https://127.0.0.1:1/1"), Ok(false));
}
