//! Three servers with TLS between them and to cells, by the committed configuration.

use std::io::Read;
use std::net::TcpStream;
use std::sync::Arc;

use ecod_testkit::until;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, ServerName};
use rustls::{ClientConfig, ClientConnection, RootCertStore, StreamOwned};

use crate::broker::{Broker, LOT};
use crate::cell::Cell;

#[tokio::test(flavor = "multi_thread")]
async fn certified_servers_exchange_maps() {
    let servers = Broker::cluster();
    let state = servers[1].read(|_| ());
    until("the reader is let in", || state.link().is_up).await;
    let lot = Cell::connect(&servers[0], LOT);
    let mut round = 0;
    until(
        "a map of the first server's cell is read at the second",
        || {
            round += 1;
            lot.publish_map(round, 1);
            state.town().counts().maps > 0
        },
    )
    .await;
    let before = state.town().counts().maps;
    servers[2].signal("KILL");
    let maps = || state.town().counts().maps;
    until("maps come with one server gone", || {
        round += 1;
        lot.publish_map(round, 1);
        maps() > before + 10
    })
    .await;
    let refused = connect_without_certificate(&servers[0])
        .unwrap_err()
        .to_string();
    assert!(refused.contains("Certificate"), "{refused}");
}

/// The answer to a stranger at a server's address for other servers.
fn connect_without_certificate(server: &Broker) -> std::io::Result<usize> {
    let mut roots = RootCertStore::empty();
    roots
        .add(CertificateDer::from_pem_file(server.directory().join("tls/ca.pem")).unwrap())
        .unwrap();
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .unwrap();
    let config = builder.with_root_certificates(roots).with_no_client_auth();
    let name = ServerName::try_from("127.0.0.1").unwrap();
    let connection = ClientConnection::new(Arc::new(config), name).unwrap();
    let stream = TcpStream::connect(server.route.unwrap()).unwrap();
    StreamOwned::new(connection, stream).read(&mut [0; 64])
}
