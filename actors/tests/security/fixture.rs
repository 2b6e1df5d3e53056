//! A broker behind a gate, two honest clients, and the tools of an attacker.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use ecod::leadership::Rights;
use ecod::model::names::NodeName;
use ecod::wire::{Limits, Role, Topics};
use ecod_actors::platform::clock;
use ecod_actors::telemetry::counters::{Counters, Event};
use ecod_actors::transport::broker::{AccessPolicy, BrokerConfig, EmbeddedBroker, MqttBroker};
use ecod_actors::transport::pki::{Authority, BROKER_NAME, CityTlsConfig, Credentials, TlsConfig};
use rumqttc::{AsyncClient, EventLoop, MqttOptions, Packet, QoS, TlsConfiguration, Transport};
use rustls::ClientConfig;
use rustls::pki_types::ServerName;
use tempfile::TempDir;
use tokio::net::{TcpSocket, TcpStream};
use tokio::time::{Instant, sleep, timeout};
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use uuid::Uuid;

pub(crate) const DAY: Duration = Duration::from_secs(86_400);

/// Maximum time for anything on a machine that does much else.
pub(crate) const SOON: Duration = Duration::from_secs(20);

/// Maximum time from a changed revocation list until a node has removed all traces of the revoked node.
pub(crate) const GONE_WITHIN: Duration = Duration::from_secs(2);

/// Largest packet of the broker.
pub(crate) const MAX_PACKET: usize = 64 * 1024;

/// Maximum size of a report in bytes.
pub(crate) const MAX_REPORT: usize = 16 * 1024;

/// Most clients of one certificate.
pub(crate) const MAX_EACH: usize = 4;

pub(crate) fn node(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

/// A CA, the CA of its city if there is one, and their directory.
pub(crate) struct Pki {
    pub(crate) directory: TempDir,
    pub(crate) authority: Authority,
    pub(crate) city: Option<Authority>,
}

impl Pki {
    pub(crate) fn new() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let authority = Authority::init(directory.path(), &node("lot"), clock::now()).unwrap();
        Self {
            directory,
            authority,
            city: None,
        }
    }

    /// The same below a city.
    pub(crate) fn in_city() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let mut city =
            Authority::init_city(&directory.path().join("city"), &node("town"), clock::now())
                .unwrap();
        let authority = city
            .init_cell(&directory.path().join("lot"), &node("lot"), clock::now())
            .unwrap();
        Self {
            directory,
            authority,
            city: Some(city),
        }
    }

    /// The files of a new certificate.
    pub(crate) fn issue(
        &mut self,
        name: &str,
        rights: impl Into<Rights>,
        valid: Duration,
    ) -> TlsConfig {
        self.authority
            .issue(&node(name), rights, valid, clock::now())
            .unwrap();
        self.files(&self.authority, name)
    }

    /// The files of an edge, a candidate and a vehicle that cannot lead.
    pub(crate) fn issue_three(&mut self) -> [TlsConfig; 3] {
        [
            ("edge", Role::Edge),
            ("euclid", Role::Auto),
            ("gauss", Role::Cav),
        ]
        .map(|(node, role)| self.issue(node, role, DAY))
    }

    /// The files in this cell of a certificate that another CA may have issued.
    pub(crate) fn files(&self, issuer: &Authority, name: &str) -> TlsConfig {
        let (certificate, key) = issuer.files_of(&node(name));
        let ca = self.authority.ca();
        let list = self.authority.revocation_list();
        let city = self.city.as_ref();
        let city = city.map(|city| CityTlsConfig {
            ca: city.ca(),
            revocation_list: Some(city.revocation_list()),
        });
        TlsConfig {
            ca,
            certificate,
            key,
            revocation_list: Some(list),
            city,
        }
    }
}

/// The client's side of certificates.
pub(crate) fn client_config(name: &str, files: &TlsConfig) -> Arc<ClientConfig> {
    Arc::clone(
        &Credentials::load(files, &node(name))
            .unwrap()
            .current()
            .client,
    )
}

/// Another host than the honest ones, as far as a broker can see.
const ELSEWHERE: Ipv4Addr = Ipv4Addr::new(127, 66, 6, 6);

pub(crate) async fn knock(broker: SocketAddr) -> TcpStream {
    knock_from(ELSEWHERE, broker).await
}

pub(crate) async fn knock_from(address: Ipv4Addr, broker: SocketAddr) -> TcpStream {
    let socket = TcpSocket::new_v4().unwrap();
    socket.bind((address, 0).into()).unwrap();
    socket.connect(broker).await.unwrap()
}

/// A connection with a new certificate, before its login.
pub(crate) async fn secure(cell: &mut Cell) -> TlsStream<TcpStream> {
    let files = cell.pki.issue("gauss", Role::Auto, DAY);
    let name = ServerName::try_from(BROKER_NAME).unwrap();
    // The time to log in runs from here.
    let connector = TlsConnector::from(client_config("gauss", &files));
    connector
        .connect(name, knock(cell.address).await)
        .await
        .unwrap()
}

/// An edge's broker, which `edge` is elected to use, and two honest clients.
pub(crate) struct Cell {
    pub(crate) pki: Pki,
    pub(crate) address: SocketAddr,
    pub(crate) counters: Arc<Counters>,
    edge: Client,
    euclid: Client,
    sent: u64,
    _broker: EmbeddedBroker,
}

impl Cell {
    pub(crate) async fn start() -> Self {
        Self::start_with(|_| ()).await
    }

    /// The fixture with other limits.
    pub(crate) async fn start_with(adjust: impl FnOnce(&mut BrokerConfig)) -> Self {
        Self::start_in(Pki::new(), adjust).await
    }

    /// The fixture with certificates of this CA.
    pub(crate) async fn start_in(mut pki: Pki, adjust: impl FnOnce(&mut BrokerConfig)) -> Self {
        let edge = pki.issue("edge", Role::Edge, DAY);
        let euclid = pki.issue("euclid", Role::Cav, DAY);
        let counters = Arc::<Counters>::default();
        let guard = AccessPolicy {
            credentials: Some(Arc::new(Credentials::load(&edge, &node("edge")).unwrap())),
            topics: Topics::new(&node("lot")),
            limits: Limits {
                payload_bytes: MAX_REPORT,
                ..Limits::default()
            },
            elected: Arc::new(|name| name.as_str() == "edge"),
            counters: Arc::clone(&counters),
        };
        let mut config = BrokerConfig {
            max_packet_bytes: Some(MAX_PACKET as u32),
            connects_per_s: 1,
            max_clients_each: MAX_EACH,
            ..BrokerConfig::default()
        };
        adjust(&mut config);
        let mut broker = EmbeddedBroker::protected(config, guard);
        let address = broker
            .start(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))
            .unwrap();
        let mut edge = Client::new(address, "edge", &client_config("edge", &edge));
        edge.log_in().await.unwrap();
        edge.subscribe("ecod/v1/lot/#").await;
        let mut euclid = Client::new(address, "euclid", &client_config("euclid", &euclid));
        euclid.log_in().await.unwrap();
        Self {
            pki,
            address,
            counters,
            edge,
            euclid,
            sent: 0,
            _broker: broker,
        }
    }

    /// Asserts that a report of the vehicle, and only this report, reaches the edge.
    pub(crate) async fn honest_traffic_goes_on(&mut self) {
        self.sent += 1;
        let report = format!("report {}", self.sent);
        self.euclid
            .publish("ecod/v1/lot/detections/euclid", report.as_bytes());
        let flush = self.euclid.drive();
        tokio::pin!(flush);
        let received = async {
            tokio::select! {
                error = &mut flush => panic!("the vehicle lost its broker: {error}"),
                received = timeout(SOON, self.edge.message()) => received.expect("no message arrived").unwrap(),
            }
        };
        assert_eq!(
            received.await,
            ("ecod/v1/lot/detections/euclid".to_owned(), report)
        );
    }

    /// Waits until something was counted.
    pub(crate) async fn counted(&self, event: Event, at_least: u64) {
        let until = Instant::now() + SOON;
        while self.counters.events(event) < at_least {
            assert!(
                Instant::now() < until,
                "{event:?}: {} of {at_least}",
                self.counters.events(event)
            );
            sleep(Duration::from_millis(10)).await;
        }
    }
}

/// A plain MQTT client.
pub(crate) struct Client {
    client: AsyncClient,
    events: EventLoop,
}

impl Client {
    pub(crate) fn new(address: SocketAddr, name: &str, tls: &Arc<ClientConfig>) -> Self {
        Self::with_id(
            address,
            &format!("{name}-{}", Uuid::now_v7().simple()),
            tls,
            |_| (),
        )
    }

    pub(crate) fn with_id(
        address: SocketAddr,
        client_id: &str,
        tls: &Arc<ClientConfig>,
        adjust: impl FnOnce(&mut MqttOptions),
    ) -> Self {
        let mut options = MqttOptions::new(client_id, address.ip().to_string(), address.port());
        options.set_transport(Transport::tls_with_config(TlsConfiguration::Rustls(
            Arc::clone(tls),
        )));
        options.set_max_packet_size(4 * MAX_PACKET, 4 * MAX_PACKET);
        adjust(&mut options);
        let (client, events) = AsyncClient::new(options, 64);
        Self { client, events }
    }

    /// Connects, or returns the reason of the refusal.
    pub(crate) async fn log_in(&mut self) -> Result<(), String> {
        let polled = timeout(SOON, self.events.poll())
            .await
            .map_err(|_| "no answer".to_owned())?;
        polled.map(drop).map_err(|error| error.to_string())
    }

    pub(crate) async fn subscribe(&mut self, filter: &str) {
        self.client.try_subscribe(filter, QoS::AtMostOnce).unwrap();
        while !matches!(
            self.events.poll().await.unwrap(),
            rumqttc::Event::Incoming(Packet::SubAck(_))
        ) {}
    }

    pub(crate) fn publish(&self, topic: &str, payload: &[u8]) {
        self.client
            .try_publish(topic, QoS::AtMostOnce, false, payload)
            .unwrap();
    }

    /// Publishes and waits until the broker has dealt with it, permitted or not.
    pub(crate) async fn publish_and_wait(
        &mut self,
        topic: &str,
        retain: bool,
    ) -> Result<(), String> {
        self.publish_all_and_wait(topic, retain, b"forged").await
    }

    /// Publishes with this payload.
    pub(crate) async fn publish_all_and_wait(
        &mut self,
        topic: &str,
        retain: bool,
        payload: &[u8],
    ) -> Result<(), String> {
        self.client
            .try_publish(topic, QoS::AtLeastOnce, retain, payload)
            .unwrap();
        let acknowledged = async {
            loop {
                match self.events.poll().await {
                    Ok(rumqttc::Event::Incoming(Packet::PubAck(_))) => return Ok(()),
                    Ok(_) => {}
                    Err(error) => return Err(error.to_string()),
                }
            }
        };
        timeout(SOON, acknowledged).await.expect("no answer")
    }

    /// Sends and receives until the connection ends.
    pub(crate) async fn drive(&mut self) -> String {
        loop {
            if let Err(error) = self.events.poll().await {
                return error.to_string();
            }
        }
    }

    async fn message(&mut self) -> Result<(String, String), String> {
        loop {
            match self.events.poll().await {
                Ok(rumqttc::Event::Incoming(Packet::Publish(publish))) => {
                    return Ok((
                        publish.topic,
                        String::from_utf8_lossy(&publish.payload).into_owned(),
                    ));
                }
                Ok(_) => {}
                Err(error) => return Err(error.to_string()),
            }
        }
    }
}
