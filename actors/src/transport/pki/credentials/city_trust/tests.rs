use std::fs;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use ecod::leadership::Rights;
use ecod::model::names::NodeName;
use ecod::wire::Role;
use rustls::client::danger::ServerCertVerifier;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use tempfile::TempDir;

use super::*;
use crate::platform::clock;
use crate::transport::pki::{
    Authority, BROKER_NAME, Credentials, DOOR_NAME, LoadedCredentials, TlsConfig,
};

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
        let mut city =
            Authority::init_city(&at("city"), &NodeName::from_static("town"), clock::now())
                .unwrap();
        let cells = ["north", "south"].map(|name| {
            city.init_cell(&at(name), &NodeName::from_static(name), clock::now())
                .unwrap()
        });
        Self {
            directory,
            city,
            cells,
        }
    }

    /// Files of `node`, certified by `authority`, in the cell of this number.
    fn files(&self, authority: &Authority, node: &NodeName, cell: usize) -> TlsConfig {
        let (certificate, key) = authority.files_of(node);
        let city = CityTlsConfig {
            ca: self.city.ca(),
            revocation_list: Some(self.city.revocation_list()),
        };
        let ca = self.cells[cell].ca();
        let list = self.cells[cell].revocation_list();
        TlsConfig {
            ca,
            certificate,
            key,
            revocation_list: Some(list),
            city: Some(city),
        }
    }

    fn load(&self, authority: &Authority, node: &NodeName, cell: usize) -> Arc<LoadedCredentials> {
        Credentials::load(&self.files(authority, node, cell), node)
            .unwrap()
            .current()
    }
}

fn certificate(path: PathBuf) -> CertificateDer<'static> {
    CertificateDer::from_pem_file(path).unwrap()
}

#[test]
fn city_vehicle_joins_without_leading() {
    let mut city = City::new();
    let [euclid, edge] = ["euclid", "edge"].map(NodeName::from_static);
    city.city
        .issue(
            &euclid,
            Rights {
                priority: 255,
                ..Rights::from(Role::Edge)
            },
            DAY,
            clock::now(),
        )
        .unwrap();
    for cell in 0..2 {
        city.cells[cell]
            .issue(&edge, Role::Edge, DAY, clock::now())
            .unwrap();
        let of_edge = city.load(&city.cells[cell], &edge, cell);
        let own = certificate(city.city.files_of(&euclid).0);
        let subject = of_edge.verify_node(&own, UnixTime::now()).unwrap();
        assert_eq!(
            (subject.name(), subject.rights(), subject.may_serve()),
            (&euclid, Rights::NONE, false)
        );
        let of_euclid = city.load(&city.city, &euclid, cell);
        let broker = certificate(city.cells[cell].files_of(&edge).0);
        assert_eq!(
            of_euclid
                .verify_node(&broker, UnixTime::now())
                .unwrap()
                .name(),
            &edge
        );
    }
    city.city.revoke(&euclid, clock::now()).unwrap();
    let of_edge = city.load(&city.cells[0], &edge, 0);
    of_edge
        .verify_node(&certificate(city.city.files_of(&euclid).0), UnixTime::now())
        .unwrap_err();
}

#[test]
fn stolen_key_opens_one_cell() {
    let mut city = City::new();
    let edge = NodeName::from_static("edge");
    for cell in &mut city.cells {
        cell.issue(&edge, Role::Edge, DAY, clock::now()).unwrap();
    }
    let files = city.files(&city.cells[0], &edge, 0);
    // Without lists, only the chain can be wrong.
    let open_city = files.city.clone().map(|city| CityTlsConfig {
        revocation_list: None,
        ..city
    });
    let without_lists = TlsConfig {
        revocation_list: None,
        city: open_city,
        ..files.clone()
    };
    for files in [files, without_lists] {
        refuses_the_other_cell(
            &city,
            &Credentials::load(&files, &edge).unwrap().current(),
            &edge,
        );
    }
}

fn refuses_the_other_cell(city: &City, of_north: &LoadedCredentials, edge: &NodeName) {
    let stolen = certificate(city.cells[1].files_of(edge).0);
    let chain = [certificate(city.cells[1].ca()), certificate(city.city.ca())];
    of_north.verify_node(&stolen, UnixTime::now()).unwrap_err();
    of_north
        .clients
        .verify_client_cert(&stolen, &chain, UnixTime::now())
        .unwrap_err();
    // By the same names and chain, the verifier of brokers.
    let name = of_north.broker_name.clone();
    let trusts = |broker: &CertificateDer<'_>| {
        let verifier =
            super::super::RecordingVerifier::new(Arc::clone(&of_north.brokers), Some(name.clone()));
        verifier
            .verify_server_cert(broker, &chain, &name, &[], UnixTime::now())
            .is_ok()
    };
    assert!(!trusts(&stolen), "the neighbouring cell's");
    assert!(
        trusts(&certificate(city.cells[0].files_of(edge).0)),
        "the own cell's"
    );
}

/// Replaces the certificate of a city's vehicle by a certificate of the city's CA with all properties
/// of a leader's certificate.
fn overstate(city: &City, node: &NodeName) {
    let directory = city.city.ca();
    let (certificate, key) = city.city.files_of(node);
    let ca_key =
        rcgen::KeyPair::from_pem(&fs::read_to_string(directory.with_file_name("ca.key")).unwrap())
            .unwrap();
    let issuer =
        rcgen::Issuer::from_ca_cert_pem(&fs::read_to_string(&directory).unwrap(), ca_key).unwrap();
    let mut claims =
        rcgen::CertificateParams::new([BROKER_NAME.to_owned(), DOOR_NAME.to_owned()]).unwrap();
    claims.distinguished_name = rcgen::DistinguishedName::new();
    claims
        .distinguished_name
        .push(rcgen::DnType::CommonName, node.as_str());
    claims.subject_alt_names.push(rcgen::SanType::URI(
        "ecod:role=edge;priority=255".try_into().unwrap(),
    ));
    claims.use_authority_key_identifier_extension = true;
    let own = rcgen::KeyPair::from_pem(&fs::read_to_string(key).unwrap()).unwrap();
    fs::write(certificate, claims.signed_by(&own, &issuer).unwrap().pem()).unwrap();
}

#[test]
fn certificate_cannot_make_city_vehicle_leader() {
    let mut city = City::new();
    let [euclid, edge] = ["euclid", "edge"].map(NodeName::from_static);
    city.city
        .issue(&euclid, Role::Cav, DAY, clock::now())
        .unwrap();
    city.cells[0]
        .issue(&edge, Role::Edge, DAY, clock::now())
        .unwrap();
    overstate(&city, &euclid);
    let shown = certificate(city.city.files_of(&euclid).0);
    let claimed = crate::transport::pki::CertificateSubject::of(&shown).unwrap();
    assert!(
        claimed.may_serve() && claimed.rights().may_lead(),
        "it claims to"
    );
    let of_edge = city.load(&city.cells[0], &edge, 0);
    let subject = of_edge.verify_node(&shown, UnixTime::now()).unwrap();
    assert_eq!(
        (subject.rights(), subject.may_serve()),
        (Rights::NONE, false),
        "in the election and in evidence"
    );
    let subject = of_edge.subject_of(&shown).unwrap();
    assert_eq!(
        (subject.rights(), subject.may_serve()),
        (Rights::NONE, false),
        "as a client of the broker"
    );
    let verify = |verifier: &Arc<dyn ServerCertVerifier>, name: &'static str| {
        let name = ServerName::try_from(name).unwrap();
        verifier
            .verify_server_cert(&shown, &[], &name, &[], UnixTime::now())
            .is_ok()
    };
    assert!(!verify(&of_edge.brokers, BROKER_NAME), "as a broker");
    assert!(verify(&of_edge.doors, DOOR_NAME), "its door is its own");
    let own = Credentials::load(&city.files(&city.city, &euclid, 0), &euclid).unwrap();
    own.check_rights(Role::Edge, 255).unwrap_err();
    own.check_rights(Role::Cav, 0).unwrap();
    let leader = of_edge
        .verify_node(of_edge.certificate(), UnixTime::now())
        .unwrap();
    assert!(leader.may_serve() && leader.rights().may_lead());
}

#[test]
fn same_named_authorities_are_distinguished() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let town = NodeName::from_static("town");
    let mut city = Authority::init_city(&at("city"), &town, clock::now()).unwrap();
    // The cell has the city's name, and a second CA of the same name, as while the CA is changed.
    let mut cells =
        ["former", "present"].map(|path| city.init_cell(&at(path), &town, clock::now()).unwrap());
    let [edge, gauss, euclid] = ["edge", "gauss", "euclid"].map(NodeName::from_static);
    cells[0]
        .issue(&edge, Role::Edge, DAY, clock::now())
        .unwrap();
    cells[0]
        .issue(&gauss, Role::Edge, DAY, clock::now())
        .unwrap();
    cells[1]
        .issue(&edge, Role::Edge, DAY, clock::now())
        .unwrap();
    city.issue(&euclid, Role::Cav, DAY, clock::now()).unwrap();
    cells[0].revoke(&gauss, clock::now()).unwrap();
    let ca = at("ca.pem");
    let list = at("revoked.pem");
    let both = |paths: [PathBuf; 2]| paths.map(|path| fs::read_to_string(path).unwrap()).concat();
    for order in [[0, 1], [1, 0]] {
        fs::write(&ca, both(order.map(|cell: usize| cells[cell].ca()))).unwrap();
        fs::write(
            &list,
            both(order.map(|cell: usize| cells[cell].revocation_list())),
        )
        .unwrap();
        let (certificate_file, key) = cells[1].files_of(&edge);
        let city_files = CityTlsConfig {
            ca: city.ca(),
            revocation_list: Some(city.revocation_list()),
        };
        let ca = ca.clone();
        let revocation_list = Some(list.clone());
        let files = TlsConfig {
            ca,
            certificate: certificate_file,
            key,
            revocation_list,
            city: Some(city_files),
        };
        let of_edge = Credentials::load(&files, &edge).unwrap().current();
        let verify = |authority: &Authority, node| {
            of_edge
                .verify_node(&certificate(authority.files_of(node).0), UnixTime::now())
                .map(|node| node.may_serve())
        };
        assert_eq!(verify(&cells[0], &edge), Ok(true), "{order:?}");
        assert_eq!(verify(&cells[1], &edge), Ok(true), "{order:?}");
        assert_eq!(verify(&city, &euclid), Ok(false), "{order:?}");
        assert!(
            verify(&cells[0], &gauss).is_err()
                && of_edge.has_revoked(&certificate(cells[0].files_of(&gauss).0))
        );
    }
}

#[test]
fn revoked_cell_ca_invalidates_cell_only() {
    let mut city = City::new();
    let [euclid, edge] = ["euclid", "edge"].map(NodeName::from_static);
    city.city
        .issue(&euclid, Role::Cav, DAY, clock::now())
        .unwrap();
    city.cells[0]
        .issue(&edge, Role::Edge, DAY, clock::now())
        .unwrap();
    city.city
        .revoke_cell(&NodeName::from_static("north"), clock::now())
        .unwrap();
    let of_euclid = city.load(&city.city, &euclid, 0);
    of_euclid
        .verify_node(
            &certificate(city.cells[0].files_of(&edge).0),
            UnixTime::now(),
        )
        .unwrap_err();
    of_euclid
        .verify_node(of_euclid.certificate(), UnixTime::now())
        .unwrap();
    assert!(
        of_euclid.has_revoked(&certificate(city.cells[0].files_of(&edge).0)),
        "what it stated goes with it"
    );
    assert!(!of_euclid.has_revoked(of_euclid.certificate()));
    city.city
        .revoke_cell(&NodeName::from_static("south"), clock::now())
        .unwrap();
    city.city
        .revoke(&NodeName::from_static("south"), clock::now())
        .unwrap_err();
}

#[test]
fn unsigned_ca_names_remedy() {
    let mut city = City::new();
    let edge = NodeName::from_static("edge");
    city.cells[0]
        .issue(&edge, Role::Edge, DAY, clock::now())
        .unwrap();
    let strange = city.directory.path().join("strange");
    let strange = Authority::init(&strange, &NodeName::from_static("north"), clock::now()).unwrap();
    let files = TlsConfig {
        ca: strange.ca(),
        ..city.files(&city.cells[0], &edge, 0)
    };
    let error = Credentials::load(&files, &edge).unwrap_err().to_string();
    assert!(
        error.starts_with("key `tls.ca`: ") && error.contains("pki init --city"),
        "{error}"
    );
    let mut cell = Authority::open(city.cells[0].ca().parent().unwrap()).unwrap();
    let refused = cell
        .init_cell(&city.directory.path().join("below"), &edge, clock::now())
        .unwrap_err();
    assert!(
        refused.to_string().contains("has the CA of a cell"),
        "{refused}"
    );
    assert!(!fs::exists(city.directory.path().join("below/ca.key")).unwrap());
}
