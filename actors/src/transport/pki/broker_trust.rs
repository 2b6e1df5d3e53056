//! Verification of a broker's certificate for as long as a connection lasts, not only in the
//! handshake.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use ecod::model::names::NodeName;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::{ClientConfig, DigitallySignedStruct, SignatureScheme};
use tokio::time::{sleep, timeout};

use super::{CertificateSubject, Credentials, DOOR_NAME, LoadedCredentials};

/// TLS of one connection to a broker, and the repeated verification of its certificate.
#[derive(Debug)]
pub struct BrokerTrust {
    client: Arc<ClientConfig>,
    recorded: Arc<RecordingVerifier>,
    verifier: Arc<dyn ServerCertVerifier>,
    /// Source of changed revocation lists, for a broker of the cell.
    reloaded_from: Option<(Arc<Credentials>, Arc<LoadedCredentials>)>,
    checked: Instant,
}

/// The certificates of both sides of one connection to a broker of the cell; the broker's once the
/// handshake is over.
#[derive(Debug)]
pub struct BrokerIdentity(Option<ProvenSides>);

#[derive(Debug)]
struct ProvenSides {
    own: Arc<LoadedCredentials>,
    broker: Arc<RecordingVerifier>,
}

impl BrokerIdentity {
    /// The node whose certificate the broker has; `None` for a broker outside the cell.
    pub fn node(&self) -> Option<NodeName> {
        Some(self.broker()?.name().clone())
    }

    /// The node and validity that the broker's certificate states.
    pub(crate) fn broker(&self) -> Option<CertificateSubject> {
        let recorded = &self.0.as_ref()?.broker.chain;
        let chain = recorded.lock().unwrap_or_else(PoisonError::into_inner);
        let (certificates, _) = chain.as_ref()?;
        CertificateSubject::of(certificates.first()?).ok()
    }

    /// True if a certificate of this node ends later than the connection's.
    pub(crate) fn ends_before(&self, own: &LoadedCredentials) -> bool {
        let sides = self.0.as_ref();
        sides.is_some_and(|sides| sides.own.identity.expires() < own.identity.expires())
    }
}

/// Time between two verifications of a certificate, which may have expired.
const RECHECK_INTERVAL: Duration = Duration::from_secs(30);

impl BrokerTrust {
    /// Trust by a verifier, for a certificate with `name`, or otherwise with the host name of the
    /// connection.
    pub(super) fn new(
        client: &ClientConfig,
        verifier: Arc<dyn ServerCertVerifier>,
        name: Option<ServerName<'static>>,
    ) -> Self {
        let recorded = Arc::new(RecordingVerifier::new(Arc::clone(&verifier), name));
        let mut client = client.clone();
        client
            .dangerous()
            .set_certificate_verifier(Arc::clone(&recorded) as Arc<dyn ServerCertVerifier>);
        Self {
            client: Arc::new(client),
            recorded,
            verifier,
            reloaded_from: None,
            checked: Instant::now(),
        }
    }

    /// Trust in brokers of the cell, based on the current content of the node's files.
    pub fn of_cell(credentials: &Arc<Credentials>) -> Self {
        let current = credentials.current();
        let trust = Self::new(
            &current.client,
            Arc::clone(&current.brokers),
            Some(current.broker_name.clone()),
        );
        Self {
            reloaded_from: Some((Arc::clone(credentials), current)),
            ..trust
        }
    }

    /// Trust in the local broker of the node with these certificates.
    ///
    /// The certificate is only verified in the handshake, because programs connect for a moment.
    pub fn of_door(credentials: &Credentials) -> Self {
        let current = credentials.current();
        Self::new(
            &current.client,
            Arc::clone(&current.doors),
            ServerName::try_from(DOOR_NAME).ok(),
        )
    }

    /// TLS configuration for one connection.
    pub fn client(&self) -> Arc<ClientConfig> {
        Arc::clone(&self.client)
    }

    /// The certificates of both sides; the broker's is available after the handshake.
    pub fn identity(&self) -> BrokerIdentity {
        BrokerIdentity(self.reloaded_from.as_ref().map(|(_, own)| ProvenSides {
            own: Arc::clone(own),
            broker: Arc::clone(&self.recorded),
        }))
    }

    /// Waits until the broker's certificate becomes invalid; returns the reason.
    pub async fn invalidated(mut self) -> rustls::Error {
        loop {
            match &self.reloaded_from {
                Some((credentials, known)) => {
                    drop(timeout(RECHECK_INTERVAL, credentials.changed(known)).await);
                }
                None => sleep(RECHECK_INTERVAL).await,
            }
            if let Err(error) = self.recheck(Instant::now()) {
                return error;
            }
        }
    }

    fn recheck(&mut self, now: Instant) -> Result<(), rustls::Error> {
        let mut has_changed = false;
        if let Some((credentials, known)) = &mut self.reloaded_from {
            let current = credentials.current();
            has_changed = !Arc::ptr_eq(&current, known);
            self.verifier = Arc::clone(&current.brokers);
            *known = current;
        }
        if !has_changed && now.duration_since(self.checked) < RECHECK_INTERVAL {
            return Ok(());
        }
        self.checked = now;
        self.recorded.check(&*self.verifier)
    }
}

/// Verifier that records the certificate of the broker.
#[derive(Debug)]
pub(super) struct RecordingVerifier {
    verifier: Arc<dyn ServerCertVerifier>,
    /// Name that the certificate must have; without it, the host name of the connection.
    name: Option<ServerName<'static>>,
    chain: Mutex<Option<(Vec<CertificateDer<'static>>, ServerName<'static>)>>,
}

impl RecordingVerifier {
    pub(super) fn new(
        verifier: Arc<dyn ServerCertVerifier>,
        name: Option<ServerName<'static>>,
    ) -> Self {
        Self {
            verifier,
            name,
            chain: Mutex::default(),
        }
    }

    /// Verifies the presented certificate again, if there is one.
    fn check(&self, verifier: &dyn ServerCertVerifier) -> Result<(), rustls::Error> {
        let chain = self.chain.lock().unwrap_or_else(PoisonError::into_inner);
        let Some((chain, name)) = &*chain else {
            return Ok(());
        };
        let Some((own, intermediates)) = chain.split_first() else {
            return Ok(());
        };
        verifier
            .verify_server_cert(own, intermediates, name, &[], UnixTime::now())
            .map(drop)
    }
}

impl ServerCertVerifier for RecordingVerifier {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        name: &ServerName<'_>,
        ocsp_response: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        // A certificate of the cell is directly signed by a CA of the node's files.
        let (name, intermediates) = match &self.name {
            Some(name) => (name, &[][..]),
            None => (name, intermediates),
        };
        let verified = self.verifier.verify_server_cert(
            end_entity,
            intermediates,
            name,
            ocsp_response,
            now,
        )?;
        let chain = [end_entity]
            .into_iter()
            .chain(intermediates)
            .map(|recorded| recorded.clone().into_owned())
            .collect();
        *self.chain.lock().unwrap_or_else(PoisonError::into_inner) = Some((chain, name.to_owned()));
        Ok(verified)
    }

    fn verify_tls12_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        self.verifier.verify_tls12_signature(message, cert, dss)
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        self.verifier.verify_tls13_signature(message, cert, dss)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.verifier.supported_verify_schemes()
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use ecod::model::names::NodeName;
    use ecod::wire::Role;
    use rustls::pki_types::pem::PemObject;

    use super::*;
    use crate::platform::clock;
    use crate::transport::pki::{Authority, BROKER_NAME, TlsConfig};

    const DAY: Duration = Duration::from_secs(86_400);

    /// The credentials of `euclid`, and certificates of `edge` and, for five seconds, of `brief`.
    fn credentials(directory: &Path) -> (Authority, Arc<Credentials>) {
        let mut authority =
            Authority::init(directory, &NodeName::from_static("lot"), clock::now()).unwrap();
        let [euclid, edge, brief] = ["euclid", "edge", "brief"].map(NodeName::from_static);
        for (name, valid) in [
            (&euclid, DAY),
            (&edge, DAY),
            (&brief, Duration::from_secs(5)),
        ] {
            authority
                .issue(name, Role::Auto, valid, clock::now())
                .unwrap();
        }
        let (certificate, key) = authority.files_of(&euclid);
        let list = authority.revocation_list();
        let files = TlsConfig {
            ca: authority.ca(),
            certificate,
            key,
            revocation_list: Some(list),
            city: None,
        };
        (
            authority,
            Arc::new(Credentials::load(&files, &euclid).unwrap()),
        )
    }

    /// Trust of a connection to a broker, after the handshake.
    fn connected(
        credentials: &Arc<Credentials>,
        authority: &Authority,
        broker: &NodeName,
    ) -> BrokerTrust {
        let trust = BrokerTrust::of_cell(credentials);
        let recorded = CertificateDer::from_pem_file(authority.files_of(broker).0).unwrap();
        let name = ServerName::try_from(BROKER_NAME).unwrap();
        assert_eq!(trust.identity().node(), None, "before the handshake");
        trust
            .recorded
            .verify_server_cert(&recorded, &[], &name, &[], UnixTime::now())
            .unwrap();
        assert_eq!(trust.identity().node().as_ref(), Some(broker));
        trust
    }

    #[tokio::test]
    async fn revoked_broker_loses_all_connections() {
        let directory = tempfile::tempdir().unwrap();
        let edge = NodeName::from_static("edge");
        let (mut authority, credentials) = credentials(directory.path());
        let mut connections = tokio::task::JoinSet::new();
        for _ in 0..4 {
            connections.spawn(connected(&credentials, &authority, &edge).invalidated());
            sleep(Duration::from_millis(200)).await;
        }
        let known = credentials.current();
        authority.revoke(&edge, clock::now()).unwrap();
        credentials.changed(&known).await;
        // All of them wait in this thread: each gets its turn before the list could be read again.
        for _ in 0..100 {
            tokio::task::yield_now().await;
        }
        let mut ended = 0;
        while connections.try_join_next().is_some() {
            ended += 1;
        }
        assert_eq!(ended, 4);
    }

    #[test]
    fn broker_is_trusted_until_expiry() {
        let directory = tempfile::tempdir().unwrap();
        let (mut authority, credentials) = credentials(directory.path());
        let [edge, brief] = ["edge", "brief"].map(NodeName::from_static);
        let connected = |broker: &NodeName| connected(&credentials, &authority, broker);
        let mut brief_trust = connected(&brief);
        let mut edge_trust = connected(&edge);
        assert_eq!(
            brief_trust.recheck(Instant::now() + RECHECK_INTERVAL),
            Ok(())
        );
        std::thread::sleep(Duration::from_millis(6100));
        assert_eq!(
            brief_trust.recheck(Instant::now()),
            Ok(()),
            "looked at from time to time only"
        );
        let expired = brief_trust.recheck(Instant::now() + 2 * RECHECK_INTERVAL);
        assert!(
            matches!(expired, Err(rustls::Error::InvalidCertificate(_))),
            "{expired:?}"
        );

        assert_eq!(
            edge_trust.recheck(Instant::now() + RECHECK_INTERVAL),
            Ok(())
        );
        authority.revoke(&edge, clock::now()).unwrap();
        std::thread::sleep(Duration::from_millis(600));
        let revoked = edge_trust.recheck(Instant::now());
        let why = rustls::Error::InvalidCertificate(rustls::CertificateError::Revoked);
        assert_eq!(revoked, Err(why), "at once when the list has changed");
    }
}
