//! A headless Chromium, driven by the WebDriver protocol and, for colours and sizes, by Chromium's own commands.

use std::net::SocketAddr;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use ecod_testkit::{PATIENCE, until_async as until};
use serde_json::{Value, json};
use tokio::net::TcpStream;

use crate::http::request;
use crate::processes::{Process, free_places};

/// A browser with one window.
pub(crate) struct Browser {
    driver: SocketAddr,
    session: String,
    _process: Process,
}

impl Browser {
    /// Starts Debian's `chromedriver`, and `chromium` through it.
    pub(crate) async fn start() -> Self {
        let [place] = free_places::<1>();
        let driver = place.page;
        let port = format!("--port={}", driver.port());
        let mut command = Command::new("chromedriver");
        command
            .arg(port)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        let process = Process(
            command
                .spawn()
                .expect("install chromium and chromium-driver: make test-dashboard does"),
        );
        until("chromedriver answers", || async {
            TcpStream::connect(driver).await.is_ok()
        })
        .await;
        let arguments = [
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--hide-scrollbars",
        ];
        let options = json!({ "goog:chromeOptions": { "args": arguments }, "goog:loggingPrefs": { "browser": "ALL" } });
        let mut browser = Self {
            driver,
            session: String::new(),
            _process: process,
        };
        let started = browser
            .post(
                "/session",
                json!({ "capabilities": { "alwaysMatch": options } }),
            )
            .await;
        browser.session = format!(
            "/session/{}",
            started["sessionId"].as_str().expect("no session")
        );
        browser
    }

    /// Runs a script in every page before the scripts of the page.
    pub(crate) async fn prepare(&self, script: &str) {
        self.chromium(
            "Page.addScriptToEvaluateOnNewDocument",
            json!({ "source": script }),
        )
        .await;
    }

    pub(crate) async fn open(&self, url: &str) {
        self.command("url", json!({ "url": url })).await;
    }

    /// Value of a script's expression.
    pub(crate) async fn evaluate(&self, expression: &str) -> Value {
        self.command(
            "execute/sync",
            json!({ "script": format!("return ({expression})"), "args": [] }),
        )
        .await
    }

    /// Waits until a script's expression is true.
    pub(crate) async fn until(&self, expression: &str) {
        until(expression, || async {
            self.evaluate(expression).await == true
        })
        .await;
    }

    /// Sets the size of the window in CSS pixels and the colours that the user prefers.
    pub(crate) async fn look(&self, width: u32, height: u32, scheme: &str) {
        let mobile = width < 600;
        let size =
            json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile });
        self.chromium("Emulation.setDeviceMetricsOverride", size)
            .await;
        let features = json!([{ "name": "prefers-color-scheme", "value": scheme }]);
        self.chromium(
            "Emulation.setEmulatedMedia",
            json!({ "features": features }),
        )
        .await;
        tokio::time::sleep(Duration::from_millis(600)).await;
    }

    /// Saves the whole page as a PNG file.
    pub(crate) async fn screenshot(&self, file: &Path) {
        let taken = self
            .chromium(
                "Page.captureScreenshot",
                json!({ "captureBeyondViewport": true }),
            )
            .await;
        let png = BASE64_STANDARD
            .decode(taken["data"].as_str().expect("no picture"))
            .unwrap();
        std::fs::write(file, png).unwrap();
    }

    /// Moves the mouse to the middle of an element.
    pub(crate) async fn point_at(&self, selector: &str) {
        let middle = format!(
            "(({{ x, y, width, height }}) => [x + width / 2, y + height / 2])\
             (document.querySelector('{selector}').getBoundingClientRect())"
        );
        let middle = self.evaluate(&middle).await;
        let event = json!({ "type": "mouseMoved", "x": middle[0], "y": middle[1] });
        self.chromium("Input.dispatchMouseEvent", event).await;
    }

    /// Clicks the middle of an element with the mouse.
    pub(crate) async fn click(&self, selector: &str) {
        self.click_within(selector, [0.5, 0.5]).await;
    }

    /// Clicks an element at these shares of its width and height.
    pub(crate) async fn click_within(&self, selector: &str, [across, down]: [f64; 2]) {
        let scroll =
            format!("document.querySelector('{selector}').scrollIntoView({{ block: 'center' }})");
        self.evaluate(&scroll).await;
        self.point_at(selector).await;
        let place = format!(
            "(({{ x, y, width, height }}) => [x + {across} * width, y + {down} * height])\
             (document.querySelector('{selector}').getBoundingClientRect())"
        );
        let middle = self.evaluate(&place).await;
        for kind in ["mousePressed", "mouseReleased"] {
            let event = json!({ "type": kind, "x": middle[0], "y": middle[1], "button": "left", "clickCount": 1 });
            self.chromium("Input.dispatchMouseEvent", event).await;
        }
    }

    /// Presses a key on the focused element.
    pub(crate) async fn press(&self, key: &str) {
        for kind in ["keyDown", "keyUp"] {
            let code = if key == "Tab" { 9 } else { 0 };
            let event =
                json!({ "type": kind, "key": key, "code": key, "windowsVirtualKeyCode": code });
            self.chromium("Input.dispatchKeyEvent", event).await;
        }
    }

    /// Draws a finger over the screen, from a place in CSS pixels by so many of them to the right and down, and lets it
    /// rest there, so that the page does not go on by itself.
    pub(crate) async fn swipe(&self, from: [f64; 2], by: [f64; 2]) {
        self.chromium(
            "Emulation.setTouchEmulationEnabled",
            json!({ "enabled": true }),
        )
        .await;
        for (kind, share) in [
            ("touchStart", 0.0),
            ("touchMove", 0.5),
            ("touchMove", 1.0),
            ("touchMove", 1.0),
        ] {
            let point = json!({ "x": from[0] + share * by[0], "y": from[1] + share * by[1] });
            self.chromium(
                "Input.dispatchTouchEvent",
                json!({ "type": kind, "touchPoints": [point] }),
            )
            .await;
            tokio::time::sleep(Duration::from_millis(150)).await;
        }
        self.chromium(
            "Input.dispatchTouchEvent",
            json!({ "type": "touchEnd", "touchPoints": [] }),
        )
        .await;
        self.chromium(
            "Emulation.setTouchEmulationEnabled",
            json!({ "enabled": false }),
        )
        .await;
    }

    /// Complaints of the browser: errors of scripts, of policies, of missing files.
    pub(crate) async fn complaints(&self) -> Vec<String> {
        let log = self.command("se/log", json!({ "type": "browser" })).await;
        let entries = log.as_array().cloned().unwrap_or_default();
        entries
            .iter()
            .map(|entry| entry["message"].to_string())
            .collect()
    }

    /// The page in its present state must not scroll sideways.
    pub(crate) async fn fits_the_width(&self, what: &str) {
        let wider = "document.documentElement.scrollWidth > document.documentElement.clientWidth";
        assert_eq!(
            self.evaluate(wider).await,
            false,
            "{what}: the page scrolls sideways"
        );
    }

    pub(crate) async fn quit_without_complaints(self) {
        assert_eq!(self.complaints().await, Vec::<String>::new());
        self.quit().await;
    }

    pub(crate) async fn quit(self) {
        request(
            self.driver,
            "DELETE",
            &self.session,
            &[("Host", "localhost")],
            "",
        )
        .await;
    }

    async fn chromium(&self, command: &str, parameters: Value) -> Value {
        self.command(
            "goog/cdp/execute",
            json!({ "cmd": command, "params": parameters }),
        )
        .await
    }

    async fn command(&self, command: &str, body: Value) -> Value {
        self.post(&format!("{}/{command}", self.session), body)
            .await
    }

    async fn post(&self, path: &str, body: Value) -> Value {
        let headers = [("Host", "localhost"), ("Content-Type", "application/json")];
        let body = body.to_string();
        let answered = tokio::time::timeout(
            PATIENCE,
            request(self.driver, "POST", path, &headers, &body),
        );
        let answer = answered.await.expect("the browser does not answer");
        assert_eq!(answer.status, 200, "{path}: {}", answer.body);
        answer.json()["value"].clone()
    }
}
