//! The certificates of one node, and the verifiers of other nodes' certificates.

mod city_trust;
mod issuers;
mod replacement;

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use ecod::model::names::NodeName;
use ecod::wire::Role;
use rustls::client::danger::ServerCertVerifier;
use rustls::client::{Resumption, WebPkiServerVerifier};
use rustls::crypto::{CryptoProvider, ring as provider};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, CertificateRevocationListDer, PrivateKeyDer, ServerName};
use rustls::server::NoServerSessionStorage;
use rustls::server::danger::ClientCertVerifier;
use rustls::sign::Signer;
use rustls::version::TLS13;
use rustls::{ClientConfig, RootCertStore, ServerConfig};
use tokio::sync::Notify;
use tokio::time::timeout;

use super::attestation::{is_key_of, signer};
use super::broker_trust::RecordingVerifier;
use super::subject::{Validity, rights_uri, role_name};
use super::{
    Authority, BROKER_NAME, BrokerTrust, CertificateSubject, InvalidCertificate,
    MAX_CERTIFICATE_BYTES, TlsConfig,
};
use city_trust::CityAuthorities;
use issuers::{Issuers, ServingNodes};

use crate::platform::bounded_file;

/// Certificates of a node, reloaded when their files change.
#[derive(Debug)]
pub struct Credentials {
    files: TlsConfig,
    node: NodeName,
    cache: Mutex<CachedCredentials>,
    changed: Notify,
    /// The reason why a certificate that ends soon is not renewed yet.
    unrenewed: Mutex<Option<String>>,
    /// True while the machine's clock is found to be wrong, which suspends renewals.
    is_clock_wrong: AtomicBool,
}

#[derive(Debug)]
struct CachedCredentials {
    checked_at: Instant,
    fingerprints: Vec<Option<(SystemTime, u64)>>,
    current: Arc<LoadedCredentials>,
}

/// Content of the files, and the TLS configurations made of it.
#[derive(Debug)]
pub struct LoadedCredentials {
    /// The node's own certificate.
    pub identity: CertificateSubject,
    /// Validity of the CA that has issued it.
    pub(crate) ca_validity: Validity,
    /// TLS of the node's own broker: version 1.3, client certificates of the cell, no resumption. A
    /// resumed session would not be checked against the revocation list.
    pub server: Arc<ServerConfig>,
    /// TLS of connections to brokers of the cell.
    pub client: Arc<ClientConfig>,
    /// Verifier of clients' certificates.
    pub clients: Arc<dyn ClientCertVerifier>,
    /// Verifier of certificates of the cell's brokers, which have `broker_name` at any address.
    pub(super) brokers: Arc<dyn ServerCertVerifier>,
    pub(super) broker_name: ServerName<'static>,
    /// Verifier of certificates of nodes' local brokers.
    pub(super) doors: Arc<dyn ServerCertVerifier>,
    issuers: Arc<Issuers>,
    pub(super) certificates: Vec<CertificateDer<'static>>,
    /// CAs of the cell that the city has revoked.
    pub(super) revoked_cas: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
    /// Signer of the membership's handshakes.
    pub(super) signer: Box<dyn Signer>,
}

/// An error in the files of a node's certificates.
#[derive(Debug, thiserror::Error)]
pub enum CredentialsError {
    /// A file cannot be read, or is not PEM of the expected kind.
    #[error("key `{key}`: {path}: {reason}")]
    File {
        /// The configuration key that names the file.
        key: &'static str,
        /// Path of the file.
        path: PathBuf,
        /// Reason why the file cannot be used.
        reason: String,
    },
    /// The certificate names another node.
    #[error("key `tls.certificate`: {path} is for {found}, this node is {node}")]
    WrongName {
        /// Path of the file.
        path: PathBuf,
        /// The node that it names.
        found: NodeName,
        /// Name of this node.
        node: NodeName,
    },
    /// The node is configured to be more than its certificate allows.
    #[error(
        "keys `role` and `election.priority`: this node is to be {role} with priority {priority}, its certificate \
         {path} allows at most {allowed}; issue one by `ecod-node pki issue {node} --role {role} --priority {priority}`"
    )]
    Overreached {
        /// Path of the file.
        path: PathBuf,
        /// Name of this node.
        node: NodeName,
        /// Role that `role` configures.
        role: &'static str,
        /// Priority that `election.priority` configures.
        priority: u8,
        /// Highest role and priority by the certificate.
        allowed: String,
    },
    /// Key, certificate, CA and list do not belong together.
    #[error("table `tls`: {0}")]
    Unusable(String),
}

/// Minimum time between two checks of the files.
const RELOAD_INTERVAL: Duration = Duration::from_millis(500);

/// Maximum size of a file with certificates, a key or a revocation list, in bytes.
const MAX_PEM_BYTES: u64 = 16 * 1024 * 1024;

impl LoadedCredentials {
    /// The node that a certificate names, and its rights if the cell has issued it. Its validity is
    /// verified elsewhere.
    ///
    /// # Errors
    /// Returns an [`InvalidCertificate`] if it names no node.
    pub(crate) fn subject_of(
        &self,
        certificate: &[u8],
    ) -> Result<CertificateSubject, InvalidCertificate> {
        subject_of(&self.issuers, certificate)
    }
}

impl Credentials {
    /// Reads a node's files.
    ///
    /// # Errors
    /// Returns a [`CredentialsError`] that names the file.
    pub fn load(files: &TlsConfig, node: &NodeName) -> Result<Self, CredentialsError> {
        let fingerprints = fingerprints(files);
        let current = Arc::new(read(files, node)?);
        let cache = Mutex::new(CachedCredentials {
            checked_at: Instant::now(),
            fingerprints,
            current,
        });
        Ok(Self {
            files: files.clone(),
            node: node.clone(),
            cache,
            changed: Notify::new(),
            unrenewed: Mutex::default(),
            is_clock_wrong: AtomicBool::new(false),
        })
    }

    /// Checks that the node's certificate allows its configured role and priority.
    ///
    /// # Errors
    /// Returns [`CredentialsError::Overreached`] with both.
    pub fn check_rights(&self, role: Role, priority: u8) -> Result<(), CredentialsError> {
        let rights = self.current().identity.rights_of(&self.node);
        if rights.allow(role, priority) {
            return Ok(());
        }
        let path = self.files.certificate.clone();
        let node = self.node.clone();
        Err(CredentialsError::Overreached {
            path,
            node,
            role: role_name(role),
            priority,
            allowed: rights_uri(rights),
        })
    }

    /// True if the node's certificate is an operator's, so that the cell's description may be set
    /// here.
    pub fn may_describe(&self) -> bool {
        self.current().identity.rights_of(&self.node).may_describe
    }

    /// The current content of the files. While they are unusable, which is logged, the previous
    /// content.
    pub fn current(&self) -> Arc<LoadedCredentials> {
        let mut cache = self.cache.lock().unwrap_or_else(PoisonError::into_inner);
        if cache.checked_at.elapsed() >= RELOAD_INTERVAL {
            cache.checked_at = Instant::now();
            let fingerprints = fingerprints(&self.files);
            if fingerprints != cache.fingerprints {
                cache.fingerprints = fingerprints;
                match read(&self.files, &self.node) {
                    Ok(current) => {
                        tracing::info!("certificates read again");
                        cache.current = Arc::new(current);
                        self.changed.notify_waiters();
                    }
                    Err(error) => tracing::warn!(%error, "changed certificates not used"),
                }
            }
        }
        Arc::clone(&cache.current)
    }

    /// The reason why a certificate that ends soon is not renewed yet.
    pub fn unrenewed(&self) -> Option<String> {
        self.lock_unrenewed().clone()
    }

    /// Records the reason why a certificate that ends soon is not renewed yet.
    pub(crate) fn set_unrenewed(&self, reason: Option<String>) {
        *self.lock_unrenewed() = reason;
    }

    /// True while the machine's clock is found to be wrong.
    pub(crate) fn is_clock_wrong(&self) -> bool {
        self.is_clock_wrong.load(Ordering::Relaxed)
    }

    /// Records whether the machine's clock is wrong.
    pub(crate) fn set_clock_wrong(&self, is_wrong: bool) {
        self.is_clock_wrong.store(is_wrong, Ordering::Relaxed);
    }

    /// Directory of the cell's CA, if its key is on this machine: `pki` beside `tls.ca`, where
    /// `ecod-node init` makes it.
    pub(crate) fn authority(&self) -> Option<PathBuf> {
        let directory = self.files.ca.parent()?.join("pki");
        Authority::has_key(&directory).then_some(directory)
    }

    fn lock_unrenewed(&self) -> MutexGuard<'_, Option<String>> {
        self.unrenewed
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until the content of the files differs from `known`: half a second at most after the
    /// change. All waiting tasks are notified at once.
    pub async fn changed(&self, known: &Arc<LoadedCredentials>) -> Arc<LoadedCredentials> {
        loop {
            let changed = self.changed.notified();
            let current = self.current();
            if !Arc::ptr_eq(&current, known) {
                return current;
            }
            // Other tasks check the files, too: the next check is due half a second after the last
            // one.
            let since = self
                .cache
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .checked_at
                .elapsed();
            let due = RELOAD_INTERVAL
                .saturating_sub(since)
                .max(Duration::from_millis(1));
            // The files are checked again in either case.
            let _ = timeout(due, changed).await;
        }
    }
}

/// Trust in a broker outside the cell. Its certificate must be signed by a CA in `ca` and have the
/// configured host name. The node presents its own certificate, if it has one. `key` is the key of
/// the configuration that names `ca`.
///
/// # Errors
/// Returns a [`CredentialsError`] that names the file.
pub fn external_broker(
    key: &'static str,
    ca: &Path,
    own: Option<&LoadedCredentials>,
) -> Result<BrokerTrust, CredentialsError> {
    let roots = Arc::new(roots(key, ca)?);
    let verifier = WebPkiServerVerifier::builder_with_provider(Arc::clone(&roots), crypto())
        .build()
        .map_err(|error| CredentialsError::Unusable(error.to_string()))?;
    let builder = ClientConfig::builder_with_provider(crypto())
        .with_safe_default_protocol_versions()
        .map_err(unusable)?
        .with_root_certificates(roots);
    let client = match own {
        Some(own) => builder
            .with_client_auth_cert(own.certificates.clone(), own.key.clone_key())
            .map_err(unusable)?,
        None => builder.with_no_client_auth(),
    };
    Ok(BrokerTrust::new(&client, verifier, None))
}

fn read(files: &TlsConfig, node: &NodeName) -> Result<LoadedCredentials, CredentialsError> {
    let mut lists = files
        .revocation_list
        .as_deref()
        .map(|path| lists("tls.revocation_list", path))
        .transpose()?
        .unwrap_or_default();
    let (issuers, revoked_cas) = match &files.city {
        Some(city) => {
            let CityAuthorities {
                of_cell,
                revoked,
                of_city,
            } = city_trust::authorities_of(&files.ca, city, &mut lists)?;
            (Issuers::new(of_cell, Some(of_city), &lists)?, revoked)
        }
        None => (
            Issuers::new(authorities("tls.ca", &files.ca)?, None, &lists)?,
            Vec::new(),
        ),
    };
    let issuers = Arc::new(issuers);
    let certificates: Vec<CertificateDer<'static>> = pem("tls.certificate", &files.certificate)?;
    let own = certificates
        .first()
        .ok_or_else(|| file_error("tls.certificate", &files.certificate, "no certificate"))?;
    let key = key_of(own, &files.key)?;
    let identity = subject_of(&issuers, own)
        .map_err(|error| file_error("tls.certificate", &files.certificate, &error))?;
    if !identity.may_act_as(node.as_str()) {
        let path = files.certificate.clone();
        let found = identity.name().clone();
        return Err(CredentialsError::WrongName {
            path,
            found,
            node: node.clone(),
        });
    }
    if own.len() > MAX_CERTIFICATE_BYTES {
        let reason = format!(
            "{} bytes, at most {MAX_CERTIFICATE_BYTES} fit a datagram",
            own.len()
        );
        return Err(file_error("tls.certificate", &files.certificate, &reason));
    }
    let signer =
        signer(&key).ok_or_else(|| file_error("tls.key", &files.key, "not an ECDSA P-256 key"))?;
    let clients = Arc::clone(&issuers) as Arc<dyn ClientCertVerifier>;
    let mut server = ServerConfig::builder_with_provider(crypto())
        .with_protocol_versions(&[&TLS13])
        .map_err(unusable)?
        .with_client_cert_verifier(Arc::clone(&clients))
        .with_single_cert(certificates.clone(), key.clone_key())
        .map_err(unusable)?;
    server.session_storage = Arc::new(NoServerSessionStorage {});
    server.send_tls13_tickets = 0;
    let brokers = ServingNodes::brokers(&issuers);
    let doors = ServingNodes::doors(&issuers);
    let broker_name = ServerName::try_from(BROKER_NAME)
        .map_err(|error| CredentialsError::Unusable(error.to_string()))?;
    let mut client = ClientConfig::builder_with_provider(crypto())
        .with_protocol_versions(&[&TLS13])
        .map_err(unusable)?
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(RecordingVerifier::new(
            Arc::clone(&brokers),
            Some(broker_name.clone()),
        )))
        .with_client_auth_cert(certificates.clone(), key.clone_key())
        .map_err(unusable)?;
    client.resumption = Resumption::disabled();
    let server = Arc::new(server);
    let client = Arc::new(client);
    Ok(LoadedCredentials {
        ca_validity: issuers.validity_of_issuer(own),
        identity,
        server,
        client,
        clients,
        brokers,
        broker_name,
        doors,
        issuers,
        certificates,
        revoked_cas,
        key,
        signer,
    })
}

/// The private key in a file that belongs to a certificate; the first if none does. There are two
/// while a certificate is replaced.
fn key_of(certificate: &[u8], path: &Path) -> Result<PrivateKeyDer<'static>, CredentialsError> {
    let mut keys: Vec<PrivateKeyDer<'static>> = pem("tls.key", path)?;
    if keys.is_empty() {
        return Err(file_error("tls.key", path, "no private key"));
    }
    let own = keys
        .iter()
        .position(|key| is_key_of(key, certificate))
        .unwrap_or(0);
    Ok(keys.swap_remove(own))
}

/// The node that a certificate names, and its effective rights.
fn subject_of(
    issuers: &Issuers,
    certificate: &[u8],
) -> Result<CertificateSubject, InvalidCertificate> {
    let subject = CertificateSubject::of(certificate)?;
    Ok(if issuers.give_rights(certificate) {
        subject
    } else {
        subject.without_rights()
    })
}

fn crypto() -> Arc<CryptoProvider> {
    Arc::new(provider::default_provider())
}

fn roots(key: &'static str, path: &Path) -> Result<RootCertStore, CredentialsError> {
    let mut roots = RootCertStore::empty();
    for certificate in authorities(key, path)? {
        roots
            .add(certificate)
            .map_err(|error| file_error(key, path, &error))?;
    }
    Ok(roots)
}

/// Certificates of CAs; at least one.
fn authorities(
    key: &'static str,
    path: &Path,
) -> Result<Vec<CertificateDer<'static>>, CredentialsError> {
    let certificates = pem(key, path)?;
    if certificates.is_empty() {
        Err(file_error(key, path, "no certificate"))
    } else {
        Ok(certificates)
    }
}

/// Reads revocation lists. A file without any, for example an incomplete copy, is an
/// error and not an empty list.
fn lists(
    key: &'static str,
    path: &Path,
) -> Result<Vec<CertificateRevocationListDer<'static>>, CredentialsError> {
    let lists = pem(key, path)?;
    if lists.is_empty() {
        Err(file_error(key, path, "no revocation list"))
    } else {
        Ok(lists)
    }
}

fn pem<T: PemObject>(key: &'static str, path: &Path) -> Result<Vec<T>, CredentialsError> {
    let items: Result<Vec<T>, _> = T::pem_slice_iter(&bytes(key, path)?).collect();
    items.map_err(|error| file_error(key, path, &error))
}

fn bytes(key: &'static str, path: &Path) -> Result<Vec<u8>, CredentialsError> {
    bounded_file::read(path, MAX_PEM_BYTES)
        .and_then(bounded_file::without_mark)
        .map_err(|error| file_error(key, path, &error))
}

fn file_error(
    key: &'static str,
    path: &Path,
    reason: &(impl ToString + ?Sized),
) -> CredentialsError {
    CredentialsError::File {
        key,
        path: path.into(),
        reason: reason.to_string(),
    }
}

#[expect(clippy::needless_pass_by_value, reason = "takes what map_err gives")]
fn unusable(error: rustls::Error) -> CredentialsError {
    CredentialsError::Unusable(error.to_string())
}

/// Modification time and length of each file, which change when it is replaced.
fn fingerprints(files: &TlsConfig) -> Vec<Option<(SystemTime, u64)>> {
    let stamp = |path: &PathBuf| {
        let facts = fs::metadata(path).ok()?;
        Some((facts.modified().ok()?, facts.len()))
    };
    let city = files
        .city
        .iter()
        .flat_map(|city| std::iter::once(&city.ca).chain(&city.revocation_list));
    let paths = [&files.ca, &files.certificate, &files.key];
    paths
        .into_iter()
        .chain(&files.revocation_list)
        .chain(city)
        .map(stamp)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::platform::clock;
    use crate::transport::pki::Authority;

    #[test]
    fn empty_revocation_list_keeps_previous() {
        let directory = tempfile::tempdir().unwrap();
        let edge = NodeName::from_static("edge");
        let mut authority = Authority::init(
            directory.path(),
            &NodeName::from_static("lot"),
            clock::now(),
        )
        .unwrap();
        authority
            .issue(&edge, Role::Edge, Duration::from_secs(60), clock::now())
            .unwrap();
        let (certificate, key) = authority.files_of(&edge);
        let list = directory.path().join("copied.pem");
        fs::copy(authority.revocation_list(), &list).unwrap();
        let files = TlsConfig {
            ca: authority.ca(),
            certificate,
            key,
            revocation_list: Some(list.clone()),
            city: None,
        };
        let credentials = Credentials::load(&files, &edge).unwrap();
        let before = credentials.current();
        for text in ["", "# revoked\n", "-----BEGIN X509 CRL-----\nMIIB"] {
            fs::write(&list, text).unwrap();
            let error = Credentials::load(&files, &edge).unwrap_err().to_string();
            assert!(
                error.starts_with("key `tls.revocation_list`: ") && error.contains("copied.pem"),
                "{error}"
            );
        }
        std::thread::sleep(RELOAD_INTERVAL);
        assert!(
            Arc::ptr_eq(&credentials.current(), &before),
            "still checked against the list before"
        );
        fs::copy(authority.revocation_list(), &list).unwrap();
        std::thread::sleep(RELOAD_INTERVAL);
        assert!(
            !Arc::ptr_eq(&credentials.current(), &before),
            "and against the next"
        );
    }

    #[test]
    fn role_beyond_certificate_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let euclid = NodeName::from_static("euclid");
        let mut authority = Authority::init(
            directory.path(),
            &NodeName::from_static("lot"),
            clock::now(),
        )
        .unwrap();
        authority
            .issue(&euclid, Role::Auto, Duration::from_secs(60), clock::now())
            .unwrap();
        let files = authority.tls_of(&euclid);
        let credentials = Credentials::load(&files, &euclid).unwrap();
        assert!(
            credentials.check_rights(Role::Auto, 100).is_ok()
                && credentials.check_rights(Role::Cav, 255).is_ok()
        );
        for (role, priority) in [(Role::Edge, 100), (Role::Auto, 101)] {
            let error = credentials
                .check_rights(role, priority)
                .unwrap_err()
                .to_string();
            let named = [
                role_name(role),
                &priority.to_string(),
                "ecod:role=auto;priority=100",
                "pki issue euclid",
            ];
            assert!(named.iter().all(|part| error.contains(part)), "{error}");
        }
        let observer = Credentials::load(&files, &NodeName::from_static("euclid--top")).unwrap();
        assert!(
            observer.check_rights(Role::Auto, 0).is_err(),
            "an observer does not lead"
        );
    }
}
