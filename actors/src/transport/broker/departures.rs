//! Clients that have recently left: their publications may still be in use when their
//! certificates are revoked.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use rustls::pki_types::{CertificateDer, UnixTime};
use rustls::server::danger::ClientCertVerifier;
use rustls::{CertificateError, Error};

/// Callback with the name in the certificate of a present or recent client, when the certificate is
/// not trusted any more, for example because it was revoked. It must not block.
pub type ExpulsionSink = Arc<dyn Fn(NodeName) + Send + Sync>;

/// Time for which a client that has left is kept: objects are published for at most this time after
/// their last detection.
const MEMORY: Duration = Duration::from_secs(60);

/// Maximum number of clients that are kept, so that a new revocation list is applied to all of them
/// within milliseconds. The longest absent is dropped first.
const MAX_CLIENTS: usize = 1024;

/// Clients that have left, by the name in their certificate, with the latest certificate of each.
#[derive(Debug, Default)]
pub(super) struct Departures(Mutex<BTreeMap<NodeName, Departed>>);

#[derive(Debug)]
struct Departed {
    certificate: CertificateDer<'static>,
    left_at: Timestamp,
}

impl Departures {
    /// Records that a client has left.
    pub(super) fn record(
        &self,
        name: NodeName,
        certificate: CertificateDer<'static>,
        now: Timestamp,
    ) {
        let mut clients = self.clients();
        clients.retain(|_, client| now.since(client.left_at) <= MEMORY);
        if clients.len() >= MAX_CLIENTS && !clients.contains_key(&name) {
            let oldest = clients.iter().min_by_key(|(_, client)| client.left_at);
            if let Some(oldest) = oldest.map(|(name, _)| name.clone()) {
                clients.remove(&oldest);
            }
        }
        let departed = Departed {
            certificate,
            left_at: now,
        };
        clients.insert(name, departed);
    }

    /// Removes the clients whose certificates are not trusted any more, and returns their names.
    pub(super) fn take_distrusted(
        &self,
        verifier: &dyn ClientCertVerifier,
        now: Timestamp,
    ) -> Vec<NodeName> {
        let wall = UnixTime::now();
        let mut clients = self.clients();
        let is_gone = |_: &NodeName, client: &mut Departed| {
            let verified = verifier.verify_client_cert(&client.certificate, &[], wall);
            verified.is_err_and(|error| is_distrust(&error))
        };
        clients.retain(|_, client| now.since(client.left_at) <= MEMORY);
        clients
            .extract_if(.., is_gone)
            .map(|(name, _)| name)
            .collect()
    }

    fn clients(&self) -> MutexGuard<'_, BTreeMap<NodeName, Departed>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// True if a certificate is invalid for another reason than its time. Reports that a node made
/// before its certificate expired stay valid.
pub(super) fn is_distrust(error: &Error) -> bool {
    use CertificateError::{Expired, ExpiredContext, NotValidYet, NotValidYetContext};
    !matches!(
        error,
        Error::InvalidCertificate(
            Expired | ExpiredContext { .. } | NotValidYet | NotValidYetContext { .. }
        )
    )
}

#[cfg(test)]
mod tests {
    use ecod::wire::Role;

    use super::*;
    use crate::platform::clock;
    use crate::transport::pki::{Authority, Credentials, TlsConfig};

    #[test]
    fn revoked_client_is_named_once() {
        let directory = tempfile::tempdir().unwrap();
        let [lot, gauss, euclid] = ["lot", "gauss", "euclid"].map(NodeName::from_static);
        let mut authority = Authority::init(directory.path(), &lot, clock::now()).unwrap();
        let load = |authority: &Authority, node: &NodeName| {
            let (certificate, key) = authority.files_of(node);
            let files = TlsConfig {
                ca: authority.ca(),
                certificate,
                key,
                revocation_list: Some(authority.revocation_list()),
                city: None,
            };
            Credentials::load(&files, node).unwrap().current()
        };
        let mut certificates = [&gauss, &euclid].map(|node| {
            let valid = Duration::from_secs(3600);
            authority
                .issue(node, Role::Cav, valid, clock::now())
                .unwrap();
            CertificateDer::from(load(&authority, node).certificate().to_vec())
        });
        let departures = Departures::default();
        let at = |seconds| Timestamp(0) + Duration::from_secs(seconds);
        departures.record(gauss.clone(), certificates[0].clone(), at(1));
        departures.record(euclid.clone(), certificates[1].clone(), at(1));
        let taken = |authority: &Authority, seconds| {
            let clients = load(authority, &euclid).clients.clone();
            departures.take_distrusted(&*clients, at(seconds))
        };
        assert_eq!(taken(&authority, 2), []);
        authority.revoke(&gauss, clock::now()).unwrap();
        assert_eq!(taken(&authority, 3), std::slice::from_ref(&gauss));
        assert_eq!(taken(&authority, 3), []);
        departures.record(gauss.clone(), certificates[0].clone(), at(4));
        assert_eq!(taken(&authority, 65), [], "all its entries are removed");
        for number in 0..=MAX_CLIENTS {
            let name = NodeName::new(format!("v{number}")).unwrap();
            certificates.swap(0, 1);
            departures.record(name, certificates[0].clone(), at(100 + number as u64 / 100));
        }
        assert_eq!(departures.clients().len(), MAX_CLIENTS);
    }
}
