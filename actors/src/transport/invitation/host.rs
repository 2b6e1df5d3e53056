//! The side that has the CA; it admits each guest once.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use ecod::leadership::Rights;
use ecod::model::names::NodeName;
use rcgen::{CertificateParams, CertificateSigningRequestParams, KeyPair};
use ring::digest::{SHA256, digest};
use ring::rand::{SecureRandom, SystemRandom};
use rustls::ServerConfig;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer};
use tokio::io::BufStream;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until, timeout};
use tokio_rustls::TlsAcceptor;

use super::{
    CONVERSATION_TIME, CityFiles, HOST_NAME, KEPT, MAX_REQUEST_BYTES, Reply, Request, Token,
    Welcome, read_line, write_line,
};
use crate::platform::bounded_file;
use crate::platform::clock;
use crate::transport::pki::{Authority, AuthorityError, CityTlsConfig, DEFAULT_DAYS, check_name};

/// A cell's CA and key, and the nodes that it has invited.
pub struct Host {
    authority: Authority,
    cell_key: String,
    seeds: Vec<String>,
    city: Option<CityTlsConfig>,
    guests: BTreeMap<NodeName, Guest>,
    tls: TlsAcceptor,
    fingerprint: [u8; 32],
}

/// A node that may join.
struct Guest {
    rights: Rights,
    secret: [u8; 16],
    /// Serial number of the last certificate issued to the guest.
    issued: Option<String>,
}

/// End of a conversation.
#[derive(Debug)]
pub enum Visit {
    /// The node has kept its files; its token is used up.
    Joined(NodeName),
    /// The token of the node was used by two guests. The certificate of the first one is revoked.
    UsedAgain(NodeName),
    /// No certificate was issued, or the guest did not confirm that it has stored it: address and
    /// reason.
    Failed(SocketAddr, String),
}

/// Maximum number of failures that are reported.
const MAX_FAILURES: usize = 256;

/// Conversations at once; more wait.
pub(super) const MAX_VISITS: usize = 64;

/// Wait after an error of the listener, such as too many open files.
const PAUSE: Duration = Duration::from_millis(100);

type Question = (Request, oneshot::Sender<Answer>);

/// The reply, and the serial number of the certificate in it.
type Answer = (Reply, Option<String>);

impl Host {
    /// A host without guests. `seeds` are `host:port` of nodes through which a guest finds the
    /// cell. Guests get the current files of the `city`.
    ///
    /// # Errors
    /// Returns an [`AuthorityError`] if the system cannot create keys.
    pub fn new(
        authority: Authority,
        cell_key: String,
        seeds: Vec<String>,
        city: Option<CityTlsConfig>,
    ) -> Result<Self, AuthorityError> {
        let key = KeyPair::generate()?;
        let certificate = CertificateParams::new([HOST_NAME.to_owned()])?.self_signed(&key)?;
        let mut fingerprint = [0; 32];
        fingerprint.copy_from_slice(digest(&SHA256, certificate.der()).as_ref());
        let private = PrivateKeyDer::from(PrivatePkcs8KeyDer::from(key.serialize_der()));
        let chain = vec![CertificateDer::from(certificate.der().to_vec())];
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let config = ServerConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&rustls::version::TLS13])
            .and_then(|builder| {
                builder
                    .with_no_client_auth()
                    .with_single_cert(chain, private)
            })
            .map_err(|error| AuthorityError::Crypto(error.to_string()))?;
        let tls = TlsAcceptor::from(Arc::new(config));
        Ok(Self {
            authority,
            cell_key,
            seeds,
            city,
            guests: BTreeMap::new(),
            tls,
            fingerprint,
        })
    }

    /// Creates the token of a node, with which it finds the host at one of the addresses. A former
    /// token of the node becomes invalid.
    ///
    /// # Errors
    /// Returns an [`AuthorityError`] if the name cannot have a certificate or the system provides
    /// no random numbers.
    pub fn invite(
        &mut self,
        node: &NodeName,
        rights: impl Into<Rights>,
        addresses: Vec<SocketAddr>,
    ) -> Result<Token, AuthorityError> {
        check_name(node)?;
        let mut secret = [0; 16];
        let drawn = SystemRandom::new().fill(&mut secret);
        drawn.map_err(|_| AuthorityError::Crypto("the system gives no random numbers".into()))?;
        self.guests.insert(
            node.clone(),
            Guest {
                rights: rights.into(),
                secret,
                issued: None,
            },
        );
        Ok(Token {
            node: node.clone(),
            addresses,
            fingerprint: self.fingerprint,
            secret,
        })
    }

    /// Serves guests until all have joined or the time is over, and reports each visit; returns the
    /// guests that did not join.
    ///
    /// For each host, one failure per reason is reported. Certificates that were not stored are
    /// revoked at the end.
    pub async fn serve(
        mut self,
        listener: TcpListener,
        until: Instant,
        report: impl Fn(Visit),
    ) -> Vec<NodeName> {
        let mut visits = JoinSet::new();
        let mut failures = BTreeSet::new();
        let (ask, mut questions) = mpsc::channel::<Question>(MAX_VISITS);
        while !self.guests.is_empty() {
            tokio::select! {
                accepted = listener.accept(), if visits.len() < MAX_VISITS => match accepted {
                    Ok((stream, from)) => {
                        let tls = self.tls.clone();
                        let ask = ask.clone();
                        visits.spawn(async move {
                            let visit = timeout(CONVERSATION_TIME, receive(tls, stream, ask)).await;
                            let failed = |reason: String| (from, reason);
                            visit
                                .map_err(|_| failed("it took too long".into()))
                                .and_then(|joined| joined.map_err(|error| failed(error.to_string())))
                        });
                    }
                    Err(_) => tokio::time::sleep(PAUSE).await,
                },
                Some((request, answer)) = questions.recv() => {
                    let is_again = self.guests.get(&request.node).is_some_and(|guest| guest.issued.is_some());
                    let given = self.answer(&request);
                    if is_again && given.1.is_some() {
                        report(Visit::UsedAgain(request.node));
                    }
                    // A guest that has left does not wait for it.
                    let _ = answer.send(given);
                }
                Some(Ok(visit)) = visits.join_next() => match visit {
                    Ok((_, node, serial)) if self.guests.get(&node).is_some_and(|guest| guest.issued == serial) => {
                        self.guests.remove(&node);
                        report(Visit::Joined(node));
                    }
                    Ok((from, node, _)) => report(Visit::Failed(from, format!("the token of {node} was used again since"))),
                    Err((from, reason)) => {
                        if failures.len() < MAX_FAILURES && failures.insert((from.ip(), reason.clone())) {
                            report(Visit::Failed(from, reason));
                        }
                    }
                },
                () = sleep_until(until) => break,
            }
        }
        for serial in self
            .guests
            .values()
            .filter_map(|guest| guest.issued.as_ref())
        {
            if let Err(error) = self.authority.revoke_serial(serial, clock::now()) {
                tracing::warn!(%error, "a certificate that was not kept stays valid");
            }
        }
        self.guests.into_keys().collect()
    }

    fn answer(&mut self, request: &Request) -> Answer {
        match self.welcome(request) {
            Ok((welcome, serial)) => (Reply::Welcome(Box::new(welcome)), Some(serial)),
            Err(reason) => (Reply::Refused(reason), None),
        }
    }

    fn welcome(&mut self, request: &Request) -> Result<(Welcome, String), String> {
        let unusable =
            |error: &dyn std::fmt::Display| format!("the host cannot issue a certificate: {error}");
        // Hashes are compared, so that the time of the comparison reveals no information about the
        // secret.
        let hash = |secret: &[u8]| digest(&SHA256, secret).as_ref().to_vec();
        let secret = hex::decode(&request.secret).unwrap_or_default();
        let guest = self
            .guests
            .get_mut(&request.node)
            .filter(|guest| hash(&guest.secret) == hash(&secret))
            .ok_or("the token was used already, or is of another `ecod-node invite`")?;
        let signing = CertificateSigningRequestParams::from_pem(&request.request)
            .map_err(|error| format!("the certificate signing request cannot be used: {error}"))?;
        let node = &request.node;
        let now = clock::now();
        if let Some(serial) = &guest.issued {
            self.authority
                .revoke_serial(serial, now)
                .map_err(|error| unusable(&error))?;
        }
        let rights = guest.rights;
        let valid = Duration::from_secs(u64::from(DEFAULT_DAYS) * 86_400);
        let issued = self
            .authority
            .certify(node, rights, valid, now, &signing.public_key);
        let (certificate, serial) = issued.map_err(|error| unusable(&error))?;
        guest.issued = Some(serial.clone());
        let read = |path: &Path| bounded_file::read_text(path).map_err(|error| unusable(&error));
        let city = |city: &CityTlsConfig| {
            let list = city
                .revocation_list
                .as_deref()
                .ok_or("the city has no revocation list")?;
            Ok::<_, String>(CityFiles {
                ca: read(&city.ca)?,
                revocation_list: read(list)?,
            })
        };
        let welcome = Welcome {
            cell: self.authority.cell().clone(),
            role: rights.role,
            certificate,
            ca: read(&self.authority.ca())?,
            revocation_list: read(&self.authority.revocation_list())?,
            cell_key: self.cell_key.clone(),
            seeds: self.seeds.clone(),
            city: self.city.as_ref().map(city).transpose()?,
        };
        Ok((welcome, serial))
    }
}

/// The key that is to be certified, in DER, of a guest's message that is complete. Only built for
/// the fuzz targets.
#[cfg(fuzzing)]
pub fn read_request(sent: &[u8]) -> Option<Vec<u8>> {
    use futures_util::FutureExt;
    use rcgen::PublicKeyData;

    let read = read_line::<Request>(&mut &*sent, MAX_REQUEST_BYTES).now_or_never();
    let request = read
        .expect("bytes that are there are not waited for")
        .ok()?;
    let signing = CertificateSigningRequestParams::from_pem(&request.request).ok()?;
    Some(signing.public_key.der_bytes().to_vec())
}

/// One conversation; returns the node that has stored its files, and the serial number of its
/// certificate.
async fn receive(
    tls: TlsAcceptor,
    stream: TcpStream,
    ask: mpsc::Sender<Question>,
) -> anyhow::Result<(SocketAddr, NodeName, Option<String>)> {
    let from = stream.peer_addr()?;
    let mut stream = BufStream::new(tls.accept(stream).await?);
    let request: Request = read_line(&mut stream, MAX_REQUEST_BYTES).await?;
    let node = request.node.clone();
    let (answer, answered) = oneshot::channel();
    ask.send((request, answer)).await?;
    let (reply, serial) = answered.await?;
    write_line(&mut stream, &reply).await?;
    if let Reply::Refused(reason) = reply {
        anyhow::bail!("{node}: {reason}");
    }
    let kept: String = read_line(&mut stream, MAX_REQUEST_BYTES).await?;
    anyhow::ensure!(kept == KEPT, "{node} has not kept its files");
    write_line(&mut stream, &KEPT).await?;
    Ok((from, node, serial))
}
