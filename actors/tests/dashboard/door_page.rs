//! The page of `clients/web` at a node's door, in a real browser.

use ecod::wire::Role;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpListener;

use crate::cell::{self, Vehicles, config};
use crate::webdriver::Browser;

const PAGE: &str = include_str!("../../../clients/web/map.html");

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs Chromium: make test-dashboard"]
async fn only_host_page_shows_map() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = listener.local_addr().unwrap().port();
    tokio::spawn(async move {
        while let Ok((mut stream, _)) = listener.accept().await {
            let head = format!(
                "HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nContent-Length: {}\r\n",
                PAGE.len()
            );
            // A browser may close a connection that it opened in advance.
            let Ok(1..) = stream.read(&mut [0; 4096]).await else {
                continue;
            };
            let page = format!("{head}Connection: close\r\n\r\n{PAGE}");
            if let Err(error) = stream.write_all(page.as_bytes()).await {
                eprintln!("cannot send the page: {error}");
            }
        }
    });
    let config = config("euclid", Role::Auto, 12);
    let cell = config.cell.clone();
    let (node, _) = cell::start(config).await;
    let door = node.broker_address().unwrap();
    let _vehicles = Vehicles::start(&[door], 4, 12);
    let browser = Browser::start().await;
    browser.look(412, 800, "light").await;
    let query = format!("map.html?cell={cell}&port={}", door.port());
    browser
        .open(&format!("http://127.0.0.1:{port}/{query}"))
        .await;
    browser
        .until("/^euclid, round/.test(document.querySelector('#state').textContent)")
        .await;
    browser
        .until("document.querySelectorAll('.place').length === 12")
        .await;
    // Chromium resolves every name below localhost to this machine; the door rejects such names.
    browser
        .open(&format!("http://elsewhere.localhost:{port}/{query}"))
        .await;
    browser
        .until("/^No connection/.test(document.querySelector('#state').textContent)")
        .await;
    browser.quit().await;
    node.stop().await;
}
