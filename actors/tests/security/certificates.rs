//! Clients without a valid certificate of the cell.

use std::fs;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ecod::wire::Role;
use ecod_actors::platform::clock;
use ecod_actors::telemetry::counters::Event;
use ecod_actors::transport::pki::{BROKER_NAME, TlsConfig, external_broker};
use rustls::pki_types::ServerName;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_rustls::TlsConnector;

use crate::fixture::{Cell, Client, DAY, GONE_WITHIN, Pki, SOON, client_config, node};

/// A login as MQTT 3.1.1 writes it, with an empty client id.
const LOGIN_PACKET: [u8; 14] = [0x10, 12, 0, 4, b'M', b'Q', b'T', b'T', 4, 2, 0, 60, 0, 0];

#[tokio::test]
async fn client_without_certificate_is_refused() {
    let mut cell = Cell::start().await;
    let mut plain = TcpStream::connect(cell.address).await.unwrap();
    plain.write_all(&LOGIN_PACKET).await.unwrap();
    let mut answer = Vec::new();
    timeout(SOON, plain.read_to_end(&mut answer))
        .await
        .expect("the connection stays open without an answer")
        .ok();
    assert_ne!(answer.first(), Some(&0x20), "no CONNACK");

    let anonymous = external_broker("mqtt.ca", &cell.pki.authority.ca(), None)
        .unwrap()
        .client();
    let stream = TcpStream::connect(cell.address).await.unwrap();
    let name = ServerName::try_from(BROKER_NAME).unwrap();
    // With TLS 1.3 the client receives the refusal with its first read.
    if let Ok(mut stream) = TlsConnector::from(anonymous).connect(name, stream).await {
        stream.write_all(&LOGIN_PACKET).await.ok();
        let read = timeout(SOON, stream.read(&mut [0; 16]))
            .await
            .expect("the connection stays open without an answer");
        assert!(!matches!(read, Ok(1..)), "{read:?}");
    }
    cell.counted(Event::ClientUntrusted, 2).await;
    cell.honest_traffic_goes_on().await;
}

#[tokio::test]
async fn foreign_certificate_is_refused() {
    let mut cell = Cell::start().await;
    let theirs = Pki::new().issue_elsewhere("euclid", &cell);
    let refused = Client::new(cell.address, "euclid", &client_config("euclid", &theirs.0))
        .log_in()
        .await;
    assert!(refused.is_err(), "{refused:?}");
    cell.counted(Event::ClientUntrusted, 1).await;
    cell.honest_traffic_goes_on().await;
}

#[tokio::test]
async fn only_city_vehicle_connects() {
    let mut cell = Cell::start_in(Pki::in_city(), |_| ()).await;
    let city = cell.pki.city.as_mut().unwrap();
    city.issue(&node("gauss"), Role::Cav, DAY, clock::now())
        .unwrap();
    let mut other = city
        .init_cell(
            &cell.pki.directory.path().join("other"),
            &node("other"),
            clock::now(),
        )
        .unwrap();
    other
        .issue(&node("zeno"), Role::Edge, DAY, clock::now())
        .unwrap();

    let gauss = cell.pki.files(cell.pki.city.as_ref().unwrap(), "gauss");
    let mut gauss = Client::new(cell.address, "gauss", &client_config("gauss", &gauss));
    gauss.log_in().await.unwrap();

    let zeno = cell.pki.files(&other, "zeno");
    let chain = [
        &zeno.certificate,
        &other.ca(),
        &cell.pki.city.as_ref().unwrap().ca(),
    ];
    let chain: String = chain
        .iter()
        .map(|path| fs::read_to_string(path).unwrap())
        .collect();
    let certificate = cell.pki.directory.path().join("chain.pem");
    fs::write(&certificate, chain).unwrap();
    let zeno = client_config(
        "zeno",
        &TlsConfig {
            certificate,
            ..zeno
        },
    );
    let refused = Client::new(cell.address, "zeno", &zeno).log_in().await;
    assert!(refused.is_err());
    cell.counted(Event::ClientUntrusted, 1).await;

    cell.pki
        .city
        .as_mut()
        .unwrap()
        .revoke(&node("gauss"), clock::now())
        .unwrap();
    timeout(GONE_WITHIN, gauss.drive())
        .await
        .expect("still connected");
    cell.honest_traffic_goes_on().await;
}

impl Pki {
    /// A certificate of this CA for a client that trusts the cell's CA.
    fn issue_elsewhere(mut self, name: &str, cell: &Cell) -> (TlsConfig, Self) {
        let files = self.issue(name, Role::Edge, DAY);
        (
            TlsConfig {
                ca: cell.pki.authority.ca(),
                revocation_list: None,
                ..files
            },
            self,
        )
    }
}

#[tokio::test]
async fn an_expired_certificate_is_refused() {
    let mut cell = Cell::start().await;
    let expired = cell.pki.issue("gauss", Role::Auto, Duration::ZERO);
    tokio::time::sleep(Duration::from_millis(1100)).await;
    let refused = Client::new(cell.address, "gauss", &client_config("gauss", &expired))
        .log_in()
        .await;
    assert!(
        refused
            .as_ref()
            .is_err_and(|error| error.to_lowercase().contains("expired")),
        "{refused:?}"
    );
    cell.counted(Event::ClientUntrusted, 1).await;
    cell.honest_traffic_goes_on().await;
}

#[tokio::test]
async fn expired_client_is_disconnected() {
    const VALID: Duration = Duration::from_secs(4);
    let mut cell = Cell::start().await;
    let brief = cell.pki.issue("gauss", Role::Auto, VALID);
    let issued = Instant::now();
    let mut gauss = Client::new(cell.address, "gauss", &client_config("gauss", &brief));
    gauss.log_in().await.unwrap();
    timeout(VALID + Duration::from_secs(32), gauss.drive())
        .await
        .expect("still connected");
    assert!(
        issued.elapsed() > VALID,
        "it was valid: {:?}",
        issued.elapsed()
    );
    cell.counted(Event::ClientExpelled, 1).await;
    cell.honest_traffic_goes_on().await;
}

#[tokio::test]
async fn revoked_client_is_disconnected() {
    let mut cell = Cell::start().await;
    let files = cell.pki.issue("gauss", Role::Auto, DAY);
    let tls = client_config("gauss", &files);
    let mut gauss = Client::new(cell.address, "gauss", &tls);
    gauss.log_in().await.unwrap();
    cell.pki
        .authority
        .revoke(
            &crate::fixture::node("gauss"),
            ecod_actors::platform::clock::now(),
        )
        .unwrap();
    timeout(GONE_WITHIN, gauss.drive())
        .await
        .expect("still connected");
    cell.counted(Event::ClientExpelled, 1).await;
    let refused = Client::new(cell.address, "gauss", &tls).log_in().await;
    assert!(
        refused
            .as_ref()
            .is_err_and(|error| error.to_lowercase().contains("revoked")),
        "{refused:?}"
    );
    cell.honest_traffic_goes_on().await;
    let renewed = cell.pki.issue("gauss", Role::Auto, DAY);
    Client::new(cell.address, "gauss", &client_config("gauss", &renewed))
        .log_in()
        .await
        .unwrap();
}

/// A vehicle that cannot lead cannot pose as a broker: other nodes reject its certificate.
#[tokio::test]
async fn vehicle_certificate_makes_no_broker() {
    let mut cell = Cell::start().await;
    let cav = cell.pki.issue("euclid", Role::Cav, DAY);
    let gauss = cell.pki.issue("gauss", Role::Auto, DAY);
    let posing =
        ecod_actors::transport::pki::Credentials::load(&cav, &crate::fixture::node("euclid"))
            .unwrap();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let server = tokio_rustls::TlsAcceptor::from(Arc::clone(&posing.current().server));
    let serving = tokio::spawn(async move {
        let (stream, _) = listener.accept().await.unwrap();
        server.accept(stream).await.map(drop)
    });
    let refused = Client::new(address, "gauss", &client_config("gauss", &gauss))
        .log_in()
        .await;
    assert!(refused.is_err() && serving.await.unwrap().is_err());
    Client::new(cell.address, "gauss", &client_config("gauss", &gauss))
        .log_in()
        .await
        .unwrap();
    cell.honest_traffic_goes_on().await;
}
