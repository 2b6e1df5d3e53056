use std::fs;
use std::path::PathBuf;
use std::time::Duration;

use ecod::leadership::Rights;
use ecod::model::names::NodeName;
use ecod::wire::Role;
use rustls::pki_types::pem::PemObject;
use tempfile::TempDir;

use super::*;
use crate::platform::clock;
use crate::transport::pki::{Authority, Credentials, LoadedCredentials, TlsConfig};

const DAY: Duration = Duration::from_secs(86_400);

/// A city with the cells `north` and `south`.
struct City {
    directory: TempDir,
    city: Authority,
    cells: [Authority; 2],
}

impl City {
    fn new() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        let mut city = Authority::init_city(&at("city"), &NodeName::from_static("town"), clock::now()).unwrap();
        let cells = ["north", "south"]
            .map(|name| city.init_cell(&at(name), &NodeName::from_static(name), clock::now()).unwrap());
        Self { directory, city, cells }
    }

    /// Files of `node`, certified by `authority`, in the cell of this number.
    fn files(&self, authority: &Authority, node: &NodeName, cell: usize) -> TlsConfig {
        let (certificate, key) = authority.files_of(node);
        let city = CityTlsConfig { ca: self.city.ca(), revocation_list: Some(self.city.revocation_list()) };
        let (ca, list) = (self.cells[cell].ca(), self.cells[cell].revocation_list());
        TlsConfig { ca, certificate, key, revocation_list: Some(list), city: Some(city) }
    }

    fn load(&self, authority: &Authority, node: &NodeName, cell: usize) -> Arc<LoadedCredentials> {
        Credentials::load(&self.files(authority, node, cell), node).unwrap().current()
    }
}

fn certificate(path: PathBuf) -> CertificateDer<'static> {
    CertificateDer::from_pem_file(path).unwrap()
}

#[test]
fn a_vehicle_of_the_city_takes_part_in_every_cell_and_leads_in_none() {
    let mut city = City::new();
    let [euclid, edge] = ["euclid", "edge"].map(NodeName::from_static);
    city.city.issue(&euclid, Rights { role: Role::Edge, priority: 255 }, DAY, clock::now()).unwrap();
    for cell in 0..2 {
        city.cells[cell].issue(&edge, Role::Edge, DAY, clock::now()).unwrap();
        let of_edge = city.load(&city.cells[cell], &edge, cell);
        let own = certificate(city.city.files_of(&euclid).0);
        let subject = of_edge.verify_node(&own, UnixTime::now()).unwrap();
        assert_eq!((subject.name(), subject.rights(), subject.may_serve()), (&euclid, Rights::NONE, false));
        let of_euclid = city.load(&city.city, &euclid, cell);
        let broker = certificate(city.cells[cell].files_of(&edge).0);
        assert_eq!(of_euclid.verify_node(&broker, UnixTime::now()).unwrap().name(), &edge);
    }
    city.city.revoke(&euclid, clock::now()).unwrap();
    let of_edge = city.load(&city.cells[0], &edge, 0);
    of_edge.verify_node(&certificate(city.city.files_of(&euclid).0), UnixTime::now()).unwrap_err();
}

#[test]
fn a_stolen_key_of_a_cell_lets_nobody_into_another_even_with_its_chain() {
    let mut city = City::new();
    let edge = NodeName::from_static("edge");
    for cell in &mut city.cells {
        cell.issue(&edge, Role::Edge, DAY, clock::now()).unwrap();
    }
    let files = city.files(&city.cells[0], &edge, 0);
    // Without lists, nothing but the chain can be wrong.
    let open_city = files.city.clone().map(|city| CityTlsConfig { revocation_list: None, ..city });
    let without_lists = TlsConfig { revocation_list: None, city: open_city, ..files.clone() };
    for files in [files, without_lists] {
        refuses_the_other_cell(&city, &Credentials::load(&files, &edge).unwrap().current(), &edge);
    }
}

fn refuses_the_other_cell(city: &City, of_north: &LoadedCredentials, edge: &NodeName) {
    let stolen = certificate(city.cells[1].files_of(edge).0);
    let chain = [certificate(city.cells[1].ca()), certificate(city.city.ca())];
    of_north.verify_node(&stolen, UnixTime::now()).unwrap_err();
    of_north.clients.verify_client_cert(&stolen, &chain, UnixTime::now()).unwrap_err();
    // By the same names and chain, the verifier of brokers.
    let name = of_north.broker_name.clone();
    let trusts = |broker: &CertificateDer<'_>| {
        let verifier = super::super::RecordingVerifier::new(Arc::clone(&of_north.brokers), Some(name.clone()));
        rustls::client::danger::ServerCertVerifier::verify_server_cert(
            &verifier,
            broker,
            &chain,
            &name,
            &[],
            UnixTime::now(),
        )
        .is_ok()
    };
    assert!(!trusts(&stolen), "the foreign cell's");
    assert!(trusts(&certificate(city.cells[0].files_of(edge).0)), "the own cell's");
}

#[test]
fn nothing_of_a_cell_whose_ca_the_city_has_revoked_counts_and_vehicles_stay() {
    let mut city = City::new();
    let [euclid, edge] = ["euclid", "edge"].map(NodeName::from_static);
    city.city.issue(&euclid, Role::Cav, DAY, clock::now()).unwrap();
    city.cells[0].issue(&edge, Role::Edge, DAY, clock::now()).unwrap();
    city.city.revoke_cell(&NodeName::from_static("north"), clock::now()).unwrap();
    let of_euclid = city.load(&city.city, &euclid, 0);
    of_euclid.verify_node(&certificate(city.cells[0].files_of(&edge).0), UnixTime::now()).unwrap_err();
    of_euclid.verify_node(of_euclid.certificate(), UnixTime::now()).unwrap();
    assert!(of_euclid.has_revoked(&certificate(city.cells[0].files_of(&edge).0)), "what it stated goes with it");
    assert!(!of_euclid.has_revoked(of_euclid.certificate()));
    city.city.revoke_cell(&NodeName::from_static("south"), clock::now()).unwrap();
    city.city.revoke(&NodeName::from_static("south"), clock::now()).unwrap_err();
}

#[test]
fn a_ca_that_the_city_has_not_signed_is_told_with_the_remedy() {
    let mut city = City::new();
    let edge = NodeName::from_static("edge");
    city.cells[0].issue(&edge, Role::Edge, DAY, clock::now()).unwrap();
    let strange = city.directory.path().join("strange");
    let strange = Authority::init(&strange, &NodeName::from_static("north"), clock::now()).unwrap();
    let files = TlsConfig { ca: strange.ca(), ..city.files(&city.cells[0], &edge, 0) };
    let error = Credentials::load(&files, &edge).unwrap_err().to_string();
    assert!(error.starts_with("key `tls.ca`: ") && error.contains("pki init --city"), "{error}");
    let mut cell = Authority::open(city.cells[0].ca().parent().unwrap()).unwrap();
    let refused = cell.init_cell(&city.directory.path().join("below"), &edge, clock::now()).unwrap_err();
    assert!(refused.to_string().contains("has the CA of a cell"), "{refused}");
    assert!(!fs::exists(city.directory.path().join("below/ca.key")).unwrap());
}
